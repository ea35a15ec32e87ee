"""A long recording filtered in chunks of rows side by side, where a filter forgets how it began.

The estimate after row k of a linear filter depends on its state W rows before by the product of W closed loops
(I - K H) F. Where that is nothing, a chunk may begin with any state W rows ahead of its first row, and chunks are runs
of one program, a lane each. Nothing is taken on trust: the state in which a chunk ends, which has all data, and that
with which the next one began agree to `TOLERANCE` of a deviation, or the latter is filtered again from the former. The
difference e that is left between two means has an e' P^-1 e that never grows, P the covariance that the filter claims.

Products of a row, of 4 states and 2 outputs: 257. The elements (A, b, C, eta, J) of a scan by an associative operation,
which need no forgetting, take 257, 128 for the columns of A and 120 for the factors of J, before the row is filtered
with the state that they give: 3.0 times as many, and W rows ahead of L chunks 1 + W / L times.

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
from heliograph.numerics.module import Module, unwritten
from heliograph.numerics.types import Array, Bool, Int, PyTree

TOLERANCE = 1e-11  # of a deviation, between two states that should be the same
ROUNDINGS = 16  # of a number, by which two ways to it differ; of means a million deviations from 0 twice were seen
ROUNDING = ROUNDINGS * float(np.finfo(np.float64).eps)
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


class Recursion(Module):
    """Linear filters over rows (z, u): of their state, Gaussians and what no data change, only means depend on data."""

    def step(self, state: PyTree, row: tuple[PyTree, Array], k: Array) -> tuple[PyTree, PyTree]:
        """Return the state after row k, and what is kept of the row."""
        raise unwritten(self, "step")

    def predict(self, state: PyTree, row: tuple[PyTree, Array], k: Array) -> PyTree:
        """Return the state after row k where none of its data arrived."""
        missing = jax.tree.map(lambda leaf: jnp.full_like(leaf, jnp.nan), row[0])
        return self.step(state, (missing, row[1]), k)[0]


class FilterRows(Recursion):
    """A filter over rows, and what is kept of each: output(filter, state, innovation, k)."""

    filter: Any
    output: Callable[..., PyTree] = eqx.field(static=True)

    def step(self, state: PyTree, row: tuple[Array, Array], k: Array) -> tuple[PyTree, PyTree]:
        """Predict and correct."""
        z, u = row
        after, innovation = self.filter.correct(self.filter.predict(state, u, k), z, k)
        return after, self.output(self.filter, after, innovation, k)


class Pass(NamedTuple):
    """The state after the last row, and what is kept of each row (rows, ...)."""

    last: PyTree
    outputs: PyTree


class Begun(NamedTuple):
    """The state with which each chunk begins (chunks, ...), its first row (chunks,), and how long chunks are."""

    states: PyTree
    first: Int[np.ndarray, " chunks"]
    lengths: Lengths


def filter_in_chunks(filter: Any, z: Array, u: Array, output: Callable[..., PyTree]) -> Pass | None:
    """Filter rows in chunks side by side; None where rows are few, or the filter is not linear or forgets too late.

    Args:
        filter: the filter.
        z: measurements (rows, received), NaN for what did not arrive.
        u: inputs (rows, inputs).
        output: what is kept of a row, a function of the filter, its state, the innovation and the row's number.
    """
    start = linear_start(filter)
    return None if start is None else scan_in_chunks(FilterRows(filter, output), start, (np.asarray(z), np.asarray(u)))


def linear_start(filter: Any) -> PyTree | None:
    """Return the state of a filter before any row; None of one of which more than the mean depends on data."""
    start = jax.tree.map(np.asarray, filter.init()) if getattr(filter, "is_linear", False) else ()
    return start if _gaussians_of(start) else None


def scan_in_chunks(recursion: Recursion, start: PyTree, rows: PyTree) -> Pass | None:
    """Step a recursion over rows in chunks side by side; None where rows are few, or it forgets too late."""
    with jax.enable_x64(True):
        begun = begin_chunks(recursion, start, rows)
        return None if begun is None else _scan_all(recursion, begun, rows)


def begin_chunks(recursion: Recursion, start: PyTree, rows: PyTree) -> Begun | None:
    """Find the state with which each chunk of rows begins; None where rows are few, or it is forgotten too late."""
    total = len(jax.tree.leaves(rows)[0])
    for lengths in LADDER:
        if total >= CHUNKS * lengths.chunk:
            states = _begin_with(recursion, start, rows, lengths)
            if states is not None:
                return Begun(states, np.arange(0, total, lengths.chunk), lengths)
    return None


def scan_chunk(recursion: Recursion, state: PyTree, rows: PyTree, first: Array, count: Array) -> tuple[PyTree, PyTree]:
    """Scan rows from number `first` on; from row `count` on, behind the end of the data, the state stays."""

    def body(state: PyTree, row: tuple[PyTree, Array]) -> tuple[PyTree, PyTree]:
        data, k = row
        after, output = recursion.step(state, data, k)
        return select_state(k < count, after, state), output

    length = len(jax.tree.leaves(rows)[0])
    return jax.lax.scan(body, jax.tree.map(jnp.asarray, state), (rows, first + jnp.arange(length)))


def select_state(condition: Array, one: PyTree, other: PyTree) -> PyTree:
    """Return one state where a condition holds, else the other."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), one, other)


def _end_of_rows(recursion: Recursion, state: PyTree, rows: PyTree, first: Array) -> PyTree:
    """Return the state after some rows alone."""

    def body(state: PyTree, row: tuple[PyTree, Array]) -> tuple[PyTree, None]:
        return recursion.step(state, *row)[0], None

    length = len(jax.tree.leaves(rows)[0])
    return jax.lax.scan(body, jax.tree.map(jnp.asarray, state), (rows, first + jnp.arange(length)))[0]


def _predict_blocks(recursion: Recursion, state: PyTree, rows: PyTree, first: Array) -> tuple[PyTree, PyTree]:
    """Return what a state holds beside its Gaussians, which no data change, after all blocks, and before each."""

    def predict(state: PyTree, row: tuple[PyTree, Array]) -> tuple[PyTree, None]:
        return recursion.predict(state, *row), None

    def block(state: PyTree, now: tuple[PyTree, Array]) -> tuple[PyTree, PyTree]:
        return jax.lax.scan(predict, state, now)[0], _beside_gaussians(state)

    blocks, size = jax.tree.leaves(rows)[0].shape[:2]
    k = (first + jnp.arange(blocks * size)).reshape(blocks, size)
    last, before = jax.lax.scan(block, jax.tree.map(jnp.asarray, state), (rows, k))
    return _beside_gaussians(last), before


def _begin_with(recursion: Recursion, start: PyTree, rows: PyTree, lengths: Lengths) -> PyTree | None:
    """Return the state with which each chunk begins (chunks, ...); None where probes do not agree on theirs.

    What a state holds beside its Gaussians, moments before any data, may never forget: then it is computed of all rows.
    """
    total = len(jax.tree.leaves(rows)[0])
    first = np.arange(lengths.chunk, total, lengths.chunk)
    starts = _repeat(start, total // lengths.ahead)  # one each `ahead` rows
    forgets = _is_forgotten(recursion, starts, rows, first, lengths.ahead)
    if forgets is False and jax.tree.leaves(_beside_gaussians(start)):
        starts = _with_moments_before_data(recursion, start, rows, lengths.ahead)
        forgets = starts is not None and _is_forgotten(recursion, starts, rows, first, lengths.ahead)
    if not forgets:
        return None
    reached = _reach(recursion, starts, rows, first, lengths.ahead)
    return jax.tree.map(lambda one, others: np.concatenate([one[None], others]), start, reached)


def _is_forgotten(
    recursion: Recursion, starts: PyTree, rows: PyTree, first: Int[np.ndarray, " chunks"], ahead: int
) -> bool | None:
    """Test at some joints whether most have forgotten their start `ahead` rows later; None without native code.

    Begun twice as many rows ahead, half of them leave of the start as much as the other half has to forget.
    """
    probes = first[:: -(-len(first) // PROBES)]
    once, early = (_reach(recursion, starts, rows, places, ahead) for places in (probes, probes - ahead))
    if once is None:
        return None
    twice = _reach(recursion, early, rows, probes, ahead, begun=True)
    return bool(np.mean(agree(once, twice)) > 0.5)


def _reach(
    recursion: Recursion, starts: PyTree, rows: PyTree, places: Int[np.ndarray, " n"], ahead: int, begun: bool = False
) -> PyTree:
    """Return the states before these rows, begun `ahead` rows before them; None without native code.

    `starts` has a state for each `ahead` rows of the recording, or, where they have `begun`, for each place.
    """
    begin = places - ahead
    taken = take_windows(rows, begin, ahead)
    states = starts if begun else jax.tree.map(lambda leaf: leaf[begin // ahead], starts)
    choice = choose_code(_end_of_rows, (recursion, states, taken, begin), [False, True, True, True])
    return None if choice.code is None else choice.results()


def _with_moments_before_data(recursion: Recursion, start: PyTree, rows: PyTree, ahead: int) -> PyTree | None:
    """Return starts, one each `ahead` rows, with what a state holds there beside its Gaussians."""
    parts, state, size = list[PyTree](), start, BLOCKS * ahead
    for begin in range(0, len(jax.tree.leaves(rows)[0]), size):
        now = jax.tree.map(lambda leaf: leaf.reshape(BLOCKS, ahead, *leaf.shape[2:]),
                           take_windows(rows, np.array([begin]), size))  # fmt: skip
        choice = choose_code(_predict_blocks, (recursion, state, now, np.asarray(begin)), [False] * 4)
        if choice.code is None:
            return None
        last, before = jax.tree.map(lambda leaf: leaf[0, ...], choice.results())
        state = _with_gaussians(last, start)
        parts.append(before)
    joined = jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)
    return _with_gaussians(joined, _repeat(start, BLOCKS * len(parts)))


def _scan_all(recursion: Recursion, begun: Begun, rows: PyTree) -> Pass | None:
    """Scan all chunks from the states with which they begin, and again those that the one before contradicts."""
    length, total = begun.lengths.chunk, np.asarray(len(jax.tree.leaves(rows)[0]))
    split = take_windows(rows, begun.first, length)

    def scan(states: PyTree, which: slice) -> PyTree:
        arguments = recursion, states, take(split, which), begun.first[which], total
        choice = choose_code(scan_chunk, arguments, [False, True, True, True, False])
        return None if choice.code is None else choice.results()

    results = scan(begun.states, slice(None))
    if results is None:
        return None
    last, outputs = results
    mend_chunks(scan, begun.states, lambda results: results[0], results)
    joined = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:])[:total], outputs)
    return Pass(jax.tree.map(lambda leaf: leaf[-1, ...], last), joined)


def mend_chunks(
    scan: Callable[[PyTree, slice], PyTree], begun: PyTree, ends_of: Callable[[PyTree], PyTree], results: PyTree
) -> None:
    """Scan those chunks again, in their order, that began otherwise than the one before them ends; change `results`.

    Args:
        scan: results of some chunks, from the states with which these begin.
        begun: states with which the chunks began, (chunks, ...).
        ends_of: the states in which chunks end, of their results.
        results: of all chunks, (chunks, ...).
    """
    ends = ends_of(results)
    wrong = ~agree(take(ends, slice(None, -1)), take(begun, slice(1, None)))
    for c in range(1, len(wrong) + 1):
        if not wrong[c - 1]:
            continue
        here = slice(c, c + 1)
        replace_chunk(results, here, scan(take(ends, slice(c - 1, c)), here))
        if c < len(wrong):
            wrong[c] = not agree(take(ends, here), take(begun, slice(c + 1, c + 2)))[0]


def replace_chunk(results: PyTree, here: slice, again: PyTree) -> None:
    """Put results of a chunk that was computed again in the place of those it had."""
    for held, new in zip(jax.tree.leaves(results), jax.tree.leaves(again), strict=True):
        held[here] = new


def agree(states: PyTree, others: PyTree) -> Bool[np.ndarray, " n"]:
    """Test whether states (n, ...) are the same to `TOLERANCE` of a deviation, and to some roundings of each number.

    Those of a mean that is far from zero enter all others, by the innovations.
    """
    pairs = [(a, b, np.zeros(())) for a, b in zip(*map(_leaves_beside, (states, others)), strict=True)]
    for x, y in zip(_gaussians_of(states), _gaussians_of(others), strict=True):
        p, q = np.asarray(x.covariance), np.asarray(y.covariance)
        deviation = np.sqrt(np.diagonal(q, axis1=-2, axis2=-1))
        outer = deviation[..., :, None] * deviation[..., None, :]
        far = np.max(np.abs(y.mean) / np.where(deviation > 0, deviation, np.inf), axis=-1, keepdims=True, initial=0.0)
        pairs += [(x.mean, y.mean, (TOLERANCE + ROUNDING * far) * deviation), (p, q, TOLERANCE * outer)]
    near = [_are_near(*pair).reshape(len(pair[0]), -1).all(axis=1) for pair in pairs]
    result: np.ndarray = np.all(near, axis=0)
    return result


def _are_near(a: np.ndarray, b: np.ndarray, within: np.ndarray) -> Bool[np.ndarray, "..."]:
    with np.errstate(invalid="ignore"):  # of numbers that overflowed
        near: np.ndarray = np.abs(a - b) <= within + ROUNDING * np.abs(b)
    near |= np.isnan(a) & np.isnan(b)
    return near


def _is_gaussian(part: Any) -> bool:
    return isinstance(part, Gaussian)


def _gaussians_of(state: PyTree) -> list[Gaussian]:
    return [part for part in jax.tree.leaves(state, is_leaf=_is_gaussian) if _is_gaussian(part)]


def _beside_gaussians(state: PyTree) -> PyTree:
    """Return what a state holds beside its Gaussians, in their place nothing."""
    return jax.tree.map(lambda part: () if _is_gaussian(part) else part, state, is_leaf=_is_gaussian)


def _leaves_beside(state: PyTree) -> list[np.ndarray]:
    leaves: list[np.ndarray] = jax.tree.leaves(_beside_gaussians(state))
    return leaves


def _with_gaussians(beside: PyTree, state: PyTree) -> PyTree:
    """Return the Gaussians of a state, and beside them what another one holds there."""
    parts = iter(_leaves_beside(beside))
    return jax.tree.map(lambda part: part if _is_gaussian(part) else next(parts), state, is_leaf=_is_gaussian)


def take_windows(rows: PyTree, begin: Int[np.ndarray, " n"], length: int) -> PyTree:
    """Return windows of rows (n, length, ...), the last row repeated behind the end of the data."""

    one_by_one = np.array_equal(begin, np.arange(len(begin)) * length)

    def take_from(leaf: np.ndarray) -> np.ndarray:
        if not one_by_one:
            windows: np.ndarray = leaf[np.minimum(begin[:, None] + np.arange(length), len(leaf) - 1)]
            return windows
        missing = len(begin) * length - len(leaf)
        filled = np.concatenate([leaf, np.repeat(leaf[-1:], missing, axis=0)]) if missing > 0 else leaf
        return filled[: len(begin) * length].reshape(len(begin), length, *leaf.shape[1:])

    return jax.tree.map(take_from, rows)


def _repeat(state: PyTree, count: int) -> PyTree:
    return jax.tree.map(lambda leaf: np.repeat(leaf[None], count, axis=0), state)


def take(states: PyTree, which: slice) -> PyTree:
    """Take some of what has a leading axis."""
    return jax.tree.map(lambda leaf: leaf[which], states)
