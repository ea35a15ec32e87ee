"""A long recording filtered in chunks of rows side by side, where a filter forgets how it began.

The estimate after row k of a linear filter depends on its state W rows before by the product of W closed loops
(I - K H) F. Where that is nothing, a chunk may begin with any state W rows ahead of its first row, and chunks are runs
of one program, a lane each. Nothing is taken on trust: the state in which a chunk ends, which has all data, and that
with which the next one began agree to `TOLERANCE` of a deviation, or the latter is filtered again from the former. The
difference e that is left between two means has an e' P^-1 e that never grows, P the covariance that the filter claims.

Products of a row, of 4 states and 2 outputs: 257. The elements (A, b, C, eta, J) of a scan by an associative operation,
which need no forgetting, take 257, 160 for the columns of A and 120 for the factors of J, before the row is filtered
with the state that they give: 2.5 times as many, and W rows ahead of L chunks 1 + W / L times.

Source: the elements: Särkkä and García-Fernández, Temporal parallelization of Bayesian smoothers (2021).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.engine.choice import choose_code
from heliograph.factors.gaussian import Gaussian
from heliograph.filters.smoother_step import gaussian_of, with_gaussian
from heliograph.numerics.module import Module
from heliograph.numerics.types import Array, Bool, Int, PyTree

TOLERANCE = 1e-11  # of a deviation, between two states that should be the same
ROUNDINGS = 64  # of a number, by which two ways to it differ
CHUNKS = 16  # at least: two cores with eight lanes each
PROBES = 8  # joints at which forgetting is tried before all rows are filtered
BLOCKS = 64  # places in a pass without data


class Lengths(NamedTuple):
    """Rows of a chunk, and rows ahead of it in which its start is forgotten."""

    chunk: int
    ahead: int


# Results of 2,048 rows in eight lanes are 4 MB, as fast as a fourth of them; in 512 rows positions and speeds of which
# positions are measured every tenth of a second, or levels with a hundredth of their noise, are forgotten.
LADDER = Lengths(2048, 512), Lengths(8192, 2048)


class FilterRows(Module):
    """A filter over rows (z, u), and what is kept of each: output(filter, state, innovation, k)."""

    filter: Any
    output: Callable[..., PyTree] = eqx.field(static=True)

    def step(self, state: PyTree, row: tuple[Array, Array], k: Array) -> tuple[PyTree, PyTree]:
        """Return the state after row k, and what is kept of it."""
        z, u = row
        after, innovation = self.filter.correct(self.filter.predict(state, u, k), z, k)
        return after, self.output(self.filter, after, innovation, k)


class Pass(NamedTuple):
    """The state after the last row, and what is kept of each row (rows, ...)."""

    last: PyTree
    outputs: PyTree


def filter_in_chunks(filter: Any, z: Array, u: Array, output: Callable[..., PyTree]) -> Pass | None:
    """Filter rows in chunks side by side; None where rows are few, or the filter is not linear or forgets too late.

    Args:
        filter: of whose state, a Gaussian or what holds one, only the mean depends on data, if it is linear.
        z: measurements (rows, received), NaN for what did not arrive.
        u: inputs (rows, inputs).
        output: what is kept of a row, a function of the filter, its state, the innovation and the row's number.
    """
    if len(z) < CHUNKS * LADDER[0].chunk or not getattr(filter, "is_linear", False):
        return None
    start = jax.tree.map(np.asarray, filter.init())
    if not isinstance(gaussian_of(start), Gaussian):
        return None
    scanned, rows = FilterRows(filter, output), (np.asarray(z), np.asarray(u))
    with jax.enable_x64(True):
        for lengths in LADDER:
            begun = _begin_chunks(scanned, start, rows, lengths) if len(z) >= CHUNKS * lengths.chunk else None
            if begun is not None:
                return _filter_all(scanned, begun, rows, lengths)
    return None


def scan_chunk(scanned: FilterRows, state: PyTree, rows: PyTree, first: Array, count: Array) -> tuple[PyTree, PyTree]:
    """Scan rows from number `first` on; from row `count` on, behind the end of the data, the state stays."""

    def body(state: PyTree, row: tuple[PyTree, Array]) -> tuple[PyTree, PyTree]:
        data, k = row
        after, output = scanned.step(state, data, k)
        return jax.tree.map(lambda new, old: jnp.where(k < count, new, old), after, state), output

    return jax.lax.scan(body, jax.tree.map(jnp.asarray, state), (rows, first + jnp.arange(len(rows[0]))))


def _end_of_rows(scanned: FilterRows, state: PyTree, rows: PyTree, first: Array) -> PyTree:
    """Return the state after some rows alone."""

    def body(state: PyTree, row: tuple[PyTree, Array]) -> tuple[PyTree, None]:
        return scanned.step(state, *row)[0], None

    return jax.lax.scan(body, jax.tree.map(jnp.asarray, state), (rows, first + jnp.arange(len(rows[0]))))[0]


def _predict_blocks(scanned: FilterRows, state: PyTree, inputs: Array, first: Array) -> tuple[PyTree, PyTree]:
    """Return what a state holds beside its Gaussian, which no data change, after each block of inputs, and before."""

    def predict(state: PyTree, row: tuple[Array, Array]) -> tuple[PyTree, None]:
        return scanned.filter.predict(state, *row), None

    def block(state: PyTree, now: tuple[Array, Array]) -> tuple[PyTree, PyTree]:
        return jax.lax.scan(predict, state, now)[0], _beside_gaussian(state)

    blocks, size = inputs.shape[:2]
    k = (first + jnp.arange(blocks * size)).reshape(blocks, size)
    last, before = jax.lax.scan(block, jax.tree.map(jnp.asarray, state), (inputs, k))
    return _beside_gaussian(last), before


def _begin_chunks(scanned: FilterRows, start: PyTree, rows: PyTree, lengths: Lengths) -> PyTree | None:
    """Return the state with which each chunk begins (chunks, ...); None where probes do not agree on theirs.

    What a state holds beside its Gaussian, moments before any data, may never forget: then it is computed of all rows.
    """
    first = np.arange(1, -(-len(rows[0]) // lengths.chunk)) * lengths.chunk
    starts = _repeat(start, len(rows[0]) // lengths.ahead)  # one each `ahead` rows
    forgets = _is_forgotten(scanned, starts, rows, first, lengths.ahead)
    if forgets is False and gaussian_of(start) is not start:
        starts = _with_moments_before_data(scanned, start, rows, lengths.ahead)
        forgets = starts is not None and _is_forgotten(scanned, starts, rows, first, lengths.ahead)
    if not forgets:
        return None
    reached = _reach(scanned, starts, rows, first, lengths.ahead)
    return jax.tree.map(lambda one, others: np.concatenate([one[None], others]), start, reached)


def _is_forgotten(
    scanned: FilterRows, starts: PyTree, rows: PyTree, first: Int[np.ndarray, " chunks"], ahead: int
) -> bool | None:
    """Test at some joints whether most have forgotten their start `ahead` rows later; None without native code.

    Begun twice as many rows ahead, half of them leave of the start as much as the other half has to forget.
    """
    probes = first[:: -(-len(first) // PROBES)]
    once, early = (_reach(scanned, starts, rows, places, ahead) for places in (probes, probes - ahead))
    if once is None:
        return None
    twice = _reach(scanned, early, rows, probes, ahead, begun=True)
    return bool(np.mean(agree(once, twice)) > 0.5)


def _reach(
    scanned: FilterRows, starts: PyTree, rows: PyTree, places: Int[np.ndarray, " n"], ahead: int, begun: bool = False
) -> PyTree:
    """Return the states before these rows, begun `ahead` rows before them; None without native code.

    `starts` has a state for each `ahead` rows of the recording, or, where they have `begun`, for each place.
    """
    begin = places - ahead
    taken = jax.tree.map(lambda leaf: leaf[begin[:, None] + np.arange(ahead)], rows)
    states = starts if begun else jax.tree.map(lambda leaf: leaf[begin // ahead], starts)
    choice = choose_code(_end_of_rows, (scanned, states, taken, begin), [False, True, True, True])
    return None if choice.code is None else choice.results()


def _with_moments_before_data(scanned: FilterRows, start: PyTree, rows: PyTree, ahead: int) -> PyTree | None:
    """Return starts, one each `ahead` rows, with what a state holds there beside its Gaussian."""
    u, parts, state = rows[1], list[PyTree](), start
    size, gaussian = BLOCKS * ahead, gaussian_of(start)
    for begin in range(0, len(u), size):
        inputs = _fill(u[begin : begin + size], size).reshape(BLOCKS, ahead, -1)
        choice = choose_code(_predict_blocks, (scanned, state, inputs, np.asarray(begin)), [False] * 4)
        if choice.code is None:
            return None
        last, before = choice.results()
        state = with_gaussian(jax.tree.map(lambda leaf: leaf[0, ...], last), gaussian)
        parts.append(jax.tree.map(lambda leaf: leaf[0, ...], before))
    joined = jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)
    return with_gaussian(joined, _repeat(gaussian, BLOCKS * len(parts)))


def _filter_all(scanned: FilterRows, begun: PyTree, rows: PyTree, lengths: Lengths) -> Pass | None:
    """Filter all chunks from the states with which they begin, and again those that the one before contradicts."""
    total, chunks = len(rows[0]), -(-len(rows[0]) // lengths.chunk)
    filled = jax.tree.map(lambda leaf: _fill(leaf, chunks * lengths.chunk), rows)
    split = jax.tree.map(lambda leaf: leaf.reshape(chunks, lengths.chunk, *leaf.shape[1:]), filled)
    first, count = np.arange(chunks) * lengths.chunk, np.asarray(total)

    def scan(states: PyTree, which: slice) -> PyTree:
        arguments = scanned, states, _take(split, which), first[which], count
        choice = choose_code(scan_chunk, arguments, [False, True, True, True, False])
        return None if choice.code is None else choice.results()

    results = scan(begun, slice(chunks))
    if results is None:
        return None
    _mend(scan, begun, results)
    last, outputs = results
    joined = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:])[:total], outputs)
    return Pass(jax.tree.map(lambda leaf: leaf[-1, ...], last), joined)


def _mend(scan: Callable[[PyTree, slice], PyTree], begun: PyTree, results: tuple[PyTree, PyTree]) -> None:
    """Filter those chunks again, in their order, that began otherwise than the one before them ends."""
    ends = results[0]
    wrong = ~agree(_take(ends, slice(None, -1)), _take(begun, slice(1, None)))
    for c in range(1, len(wrong) + 1):
        if not wrong[c - 1]:
            continue
        here, following = slice(c, c + 1), slice(c + 1, c + 2)
        again = scan(_take(ends, slice(c - 1, c)), here)
        for held, new in zip(jax.tree.leaves(results), jax.tree.leaves(again), strict=True):
            held[here] = new
        if c < len(wrong):
            wrong[c] = not agree(_take(ends, here), _take(begun, following))[0]


def agree(states: PyTree, others: PyTree) -> Bool[np.ndarray, " n"]:
    """Test whether states (n, ...) are the same to `TOLERANCE` of a deviation, and to some roundings of each number."""
    x, y = gaussian_of(states), gaussian_of(others)
    p, q = np.asarray(x.covariance), np.asarray(y.covariance)
    deviation = np.sqrt(np.diagonal(q, axis1=1, axis2=2))
    outer = deviation[:, :, None] * deviation[:, None, :]
    pairs = [(x.mean, y.mean, TOLERANCE * deviation), (p, q, TOLERANCE * outer)]
    rest = (jax.tree.leaves(_beside_gaussian(s)) if s is not g else [] for s, g in ((states, x), (others, y)))
    pairs += [(a, b, 0.0) for a, b in zip(*rest, strict=True)]
    result: np.ndarray = np.all([np.all(_are_near(*pair).reshape(len(p), -1), axis=1) for pair in pairs], axis=0)
    return result


def _are_near(a: np.ndarray, b: np.ndarray, within: Any) -> Bool[np.ndarray, "..."]:
    with np.errstate(invalid="ignore"):  # of numbers that overflowed
        near: np.ndarray = np.abs(a - b) <= within + ROUNDINGS * np.finfo(np.float64).eps * np.abs(b)
    near |= np.isnan(a) & np.isnan(b)
    return near


def _beside_gaussian(state: PyTree) -> PyTree:
    """Return what a state holds beside its Gaussian."""
    nothing: Any = ()
    return with_gaussian(state, nothing)


def _fill(leaf: np.ndarray, length: int) -> np.ndarray:
    """Repeat the last row until there are so many."""
    missing = length - len(leaf)
    return np.concatenate([leaf, np.repeat(leaf[-1:], missing, axis=0)]) if missing else leaf


def _repeat(state: PyTree, count: int) -> PyTree:
    return jax.tree.map(lambda leaf: np.repeat(leaf[None], count, axis=0), state)


def _take(states: PyTree, which: slice) -> PyTree:
    return jax.tree.map(lambda leaf: leaf[which], states)
