"""Particles of one run in the lanes of a processor's vectors: native code for one of them, called on all, row by row.

A run of many particles is no program of native code, which takes small arrays. But what is done with a particle is one,
and keys and numbers of particles say what each draws. Three calls a row: particles move and are weighed, a lane each;
first sums of them, a lane for GROUP; second sums about the means. Between them the particles that go on are chosen.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.engine.choice import choose_code, compute_once
from heliograph.filters.chunks import Pass
from heliograph.filters.particles.expected import find_reference
from heliograph.filters.particles.moments import FirstSums, first_sums, second_sums
from heliograph.filters.particles.resampling import resample_known
from heliograph.numerics.angle import wrap_angles
from heliograph.numerics.float64 import quickly_compiled
from heliograph.numerics.types import Array, PyTree

Call = Callable[..., Any]
GROUP = 16  # particles that a lane adds up


class Row(NamedTuple):
    """A row of data: its number, measurement and input; keys of its noises and proposals; whether it is not the first.

    Of rows, with a leading axis.
    """

    k: Array
    z: Array
    u: Array
    own: Array
    proposing: Array
    moved: Array


class Particles(NamedTuple):
    """Particles of a row: positions (N, n), weights (N,) before and with z, and h(x) before z was known (N, p)."""

    position: np.ndarray
    prior: np.ndarray
    weight: np.ndarray
    predicted: np.ndarray


class Sums(NamedTuple):
    """Sums over the particles of a row: `first` as `_pack` makes it, `second` ones of the states (n, n).

    `reference` is h(x) of the particle from which innovations are counted, `density` log p(z | earlier rows).
    """

    first: np.ndarray
    second: np.ndarray
    reference: np.ndarray
    density: np.ndarray


def filter_particles(
    filter: Any, z: Array, u: Array, state: PyTree | None = None, begin: Array | int = 0
) -> Pass | None:
    """Filter rows with particles in lanes; None of no rows, or without native code.

    Args:
        filter: the filter.
        z: measurements (rows, received), NaN for what did not arrive.
        u: inputs (rows, inputs).
        state: before the first row; that before any unless given.
        begin: number of the first row.

    Returns:
        The last state, and for each row the mean, the covariance, the innovation, None and the effective number.
    """
    if not len(z):
        return None
    with jax.enable_x64(True):
        return _filter_rows(filter, np.asarray(z), np.asarray(u), state, int(begin))


class _Memory(NamedTuple):
    """Arrays that the programs of a row read in place: the row, particles, and sums over them.

    `x` are positions and `log_weight` log weights before the row, the largest 0; `prior` are the weights that these
    are the logarithms of, and `weight` those with z, the largest 1. Behind the last particle others of weight 0 fill
    the last group, at the place of the first.
    """

    row: Row
    used: np.ndarray
    x: np.ndarray
    log_weight: np.ndarray
    numbers: np.ndarray
    prior: np.ndarray
    weight: np.ndarray
    reference: np.ndarray
    first: np.ndarray


class _Programs(NamedTuple):
    """Code of what is done with particles, with the filter's own arrays: calls in memory of their own."""

    memory: _Memory
    advance: Any
    first: Any
    second: Any


def _prepare(filter: Any, z: np.ndarray, u: np.ndarray) -> _Programs | None:
    """Return the code for a filter and rows like these; None if there is none."""
    length = -(-filter.particles // GROUP) * GROUP
    numbers = np.arange(length, dtype=np.uint32)
    # Programs share what of a row and of particles more than one reads.
    own, proposing = np.zeros((2, 2), np.uint32)
    row = Row(np.zeros((), int), np.zeros_like(z[0]), np.zeros_like(u[0]), own, proposing, np.ones((), bool))
    x, *weights = np.zeros((length, len(filter.states))), *np.zeros((3, length))
    log_weight, prior, weight = weights
    first = np.zeros(sum(_sizes(filter)))
    memory = _Memory(row, np.ones((), bool), x, log_weight, numbers, prior, weight, np.zeros(0), first)
    advance = _hold(_advance, filter, memory[:5], (False, False, True, True, True), length)
    if advance is None:
        return None
    position, _, predicted = advance.outputs
    memory = memory._replace(reference=np.zeros(predicted.shape[1]))
    particles = Particles(position, memory.prior, memory.weight, predicted)
    groups = Particles(*(part.reshape(-1, GROUP, *part.shape[1:]) for part in particles))
    shared = memory.row, memory.reference
    of_first = _hold(_sum_first, filter, (*shared, groups), (False, False, True), len(groups.weight))
    arguments = memory.first, groups.weight, groups.position
    second = _hold(_sum_second, filter, arguments, (False, True, True), len(groups.weight))
    return None if of_first is None or second is None else _Programs(memory, advance, of_first, second)


def _hold(function: Call, filter: Any, arguments: tuple[Any, ...], differs: tuple[bool, ...], runs: int) -> Any:
    """Return a call of function(filter, *arguments) that reads these arrays in place; None without native code."""
    code = _bind(function, filter, arguments, differs)
    return None if code is None else code.for_runs(runs, dict(enumerate(jax.tree.leaves(arguments))))


def _bind(function: Call, filter: Any, arguments: tuple[Any, ...], differs: tuple[bool, ...]) -> Any:
    """Return the code of function(filter, *arguments), to be called with the arguments; None if there is none."""
    choice = choose_code(function, (filter, *arguments), [False, *differs])
    if choice.code is None:
        return None
    return choice.code.with_first(*choice.arrays[: len(choice.arrays) - len(jax.tree.leaves(arguments))])


def _draw_start(filter: Any, key: Array, number: Array) -> jax.Array:
    """Draw x_0 (n,) of a particle."""
    drawn: jax.Array = filter.draw_start(key, number[None])[0]
    return drawn


def _advance(
    filter: Any, row: Row, used: Array, x: Array, log_weight: Array, number: Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Move a particle x (n,) and weigh it by z where the row is used; return it, its log weight, and h(x) before."""
    numbers = jnp.asarray(number)[None]
    position, law = filter.move(jnp.asarray(x)[None], numbers, row.own, row.u, row.k, row.moved)
    weighed = filter.weigh(position, law, numbers, row.proposing, row.z, row.k)
    likelihood = jnp.where(used, weighed.log_likelihood[0], 0.0)
    told: jax.Array = jnp.where(used, weighed.position[0], position[0])
    return told, jnp.asarray(log_weight) + likelihood, weighed.predicted[0]


def _sum_first(filter: Any, row: Row, reference: Array, group: Particles) -> jax.Array:
    """Return the first sums of a group of particles, and both of what their innovations are apart from the base."""
    angles = filter.angles_used().states
    sums = first_sums(jnp.asarray(group.weight), jnp.asarray(group.position), angles)
    both, apart = filter.expected(reference, row.z, row.k).apart(group.prior, group.predicted)
    return _pack(sums, first_sums(both, apart, ()), second_sums(both, apart))


def _sum_second(filter: Any, sums: Array, weight: Array, position: Array) -> jax.Array:
    """Return the second sums of the states of a group of particles, about the means of all."""
    angles = filter.angles_used().states
    apart = wrap_angles(jnp.asarray(position) - _unpack(filter, sums).state.mean(angles), angles)
    return second_sums(jnp.asarray(weight), apart)


def _tell_row(filter: Any, row: Row, sums: Sums) -> tuple[Any, ...]:
    """Return what is told of a row, by its sums."""
    state, received, spread = _unpack(filter, sums.first)
    innovation = filter.expected(sums.reference, row.z, row.k).innovation(received, spread, sums.density)
    count = state.weight**2 / state.square
    return state.mean(filter.angles_used().states), sums.second / state.weight, innovation, count


def _pack(*sums: Any) -> jax.Array:
    """Return sums as one vector."""
    return jnp.concatenate([jnp.ravel(leaf) for leaf in jax.tree.leaves(sums)])


def _sizes(filter: Any) -> tuple[int, ...]:
    """Return the lengths of the first sums of states, and of both sums of innovations."""
    angles, m = len(filter.angles_used().states), filter.received
    return 1, 1, len(filter.states), angles, angles, 1, 1, m, 0, 0, m * m


class _OfAll(NamedTuple):
    """First sums of states and of innovations, and second ones (m, m) of innovations about the base."""

    state: FirstSums
    received: FirstSums
    spread: jax.Array


def _unpack(filter: Any, vector: Array) -> _OfAll:
    """Return the sums that `_pack` made one vector of."""
    parts = iter(jnp.split(jnp.asarray(vector), np.cumsum(_sizes(filter))[:-1].tolist()))

    def take() -> FirstSums:
        weight, square, *rest = (next(parts) for _ in range(5))
        return FirstSums(weight[0], square[0], *rest)

    return _OfAll(take(), take(), next(parts).reshape(filter.received, filter.received))


def _filter_rows(filter: Any, z: np.ndarray, u: np.ndarray, state: PyTree | None, begin: int) -> Pass | None:
    """Filter rows of data, the first of number `begin` behind a state; None without native code."""
    key = None if state is None else np.asarray(state.key)
    of_start, start, last, own, proposing = compute_once(_draw_keys, _draw_keys_by_xla, (filter, z, key))
    k = begin + np.arange(len(z))
    moved = (np.arange(len(z)) > 0) | (state is not None and bool(state.moved))
    rows, programs = Row(k, z, u, own, proposing, moved), _prepare(filter, z, u)
    if programs is None:
        return None
    loop = _Loop(filter, programs)
    if state is None:
        numbers = programs.memory.numbers[: filter.particles]
        draw = _bind(_draw_start, filter, (of_start, numbers), (False, True))
        if draw is None:
            return None
        loop.begin(draw(of_start, numbers), np.zeros(filter.particles))
    else:
        loop.begin(np.asarray(state.position), np.asarray(state.log_weight))
    steps = [loop.step(Row(*row), choice) for row, choice in zip(zip(*rows, strict=True), start.tolist(), strict=True)]
    sums = Sums(*(np.array(part) for part in zip(*steps, strict=True)))
    told = choose_code(_tell_row, (filter, rows, sums), [False, True, True])
    if told.code is None:
        return None
    mean, covariance, innovation, counts = told.results()
    return Pass(loop.last_state(last), (mean, covariance, innovation, None, counts))


def _draw_keys(filter: Any, z: Array, key: Array | None) -> tuple[jax.Array, ...]:
    """Draw what no particle changes: the key of x_0; where choices start (rows,); the last key; those of rows.

    `key` is that of the state before the rows, None before any.
    """

    def draw(key: jax.Array, row: jax.Array) -> tuple[jax.Array, tuple[jax.Array, ...]]:
        key, choice, own = filter.keys_of_prediction(key)
        key, proposing = filter.keys_of_correction(key, row)
        return key, (jax.random.uniform(choice, (), float), own, proposing)

    first, of_start = filter.start_keys()
    last, (start, own, proposing) = jax.lax.scan(draw, first if key is None else jnp.asarray(key), jnp.asarray(z))
    return of_start, start, last, own, proposing


_draw_keys_by_xla = quickly_compiled(_draw_keys)


class _Loop:
    """Particles that are moved and weighed row by row, and sums of them that the next row needs."""

    def __init__(self, filter: Any, programs: _Programs):
        self.filter, self.programs, self.memory, self.count = filter, programs, programs.memory, filter.particles
        self.resample, self.sum, self.square = float(filter.resample), 0.0, 0.0
        self.position, self.log_weight, self.predicted = programs.advance.outputs

    def begin(self, x: np.ndarray, log_weight: np.ndarray) -> None:
        """Take particles (N, n) with these log weights, the largest 0."""
        memory, count = self.memory, self.count
        self.position[:count], self.position[count:] = x, x[0]
        memory.log_weight[:count], memory.log_weight[count:] = log_weight, -np.inf
        np.exp(memory.log_weight, out=memory.weight)
        self.sum, self.square = float(memory.weight.sum()), float(memory.weight @ memory.weight)

    def step(self, row: Row, start: float) -> Sums:
        """Choose the particles that go on, move and weigh them; return the sums over them."""
        memory, programs = self.memory, self.programs
        for held, new in zip(memory.row, row, strict=True):
            held[...] = new
        self._choose(start)
        # A row that no particle explains is not used.
        used = not np.isnan(row.z).all()
        largest = self._advance(used)
        excluded = used and not largest > -np.inf
        if excluded:
            largest = self._advance(False)
        np.subtract(self.log_weight, largest, out=memory.log_weight)
        np.exp(memory.log_weight, out=memory.weight)
        # First sums of all, then second sums about their means.
        memory.reference[...] = self._find_reference()
        programs.first()
        first = np.einsum("ij->j", programs.first.outputs[0], out=memory.first)  # in half of the time of add.reduce
        programs.second()
        second = np.einsum("ijk->jk", programs.second.outputs[0])
        before, self.sum, self.square = self.sum, float(first[0]), float(first[1])
        density = -np.inf if excluded else math.log(self.sum) + largest - math.log(before)
        return Sums(first.copy(), second, memory.reference.copy(), np.asarray(density))

    def _choose(self, start: float) -> None:
        """Let particles go on as they are, or resampled where the effective number is too small."""
        memory, count = self.memory, self.count
        if not self.sum**2 / self.square < self.resample * count:
            memory.x[...], memory.prior[...] = self.position, memory.weight
            return
        which = resample_known(memory.weight[:count], start)
        np.take(self.position, which, axis=0, out=memory.x[:count], mode="clip")
        memory.log_weight[:count], memory.prior[:count], self.sum = 0.0, 1.0, float(count)

    def _advance(self, used: bool) -> float:
        """Move particles, and weigh them by z if the row is used; return the largest log weight."""
        self.memory.used[...] = used
        self.programs.advance()
        for held in (self.position, self.predicted):
            held[self.count :] = held[0]
        return float(self.log_weight.max())

    def _find_reference(self) -> np.ndarray:
        """Return h(x) of the heaviest particle before z was known, of which it is a number."""
        heaviest: np.ndarray = self.predicted[np.argmax(self.memory.prior)]
        if np.isfinite(heaviest).all():
            return heaviest
        return find_reference(self.memory.prior[: self.count], self.predicted[: self.count])

    def last_state(self, key: np.ndarray) -> Any:
        """Return the state of the filter after the last row, given the key of what follows."""
        held = self.position[: self.count], self.memory.log_weight[: self.count]
        return self.filter.state_of(*(np.array(part) for part in held), key)
