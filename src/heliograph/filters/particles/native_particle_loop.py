"""Particle filters row by row in native code: compiled for one particle, called on all in the lanes of vectors.

Native code takes small arrays, so it holds the program of one particle, not of all. Random keys and the particles'
indices say what each draws. A row makes three calls: particles move and are weighed, one in each SIMD lane; first sums
over them, GROUP particles in each lane; second sums about the means. Before these particles may be resampled.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.engine.choice import choose_code, compute_once
from heliograph.filters.particles.expected_measurement import find_reference_particle
from heliograph.filters.particles.moments import pack_sums, unpack_sums
from heliograph.filters.particles.resampling import (
    KeysOfRows,
    draw_keys_of_rows,
    draw_keys_of_rows_by_xla,
    resample_concrete_weights,
)
from heliograph.filters.rows.chunks import ScanResult
from heliograph.numerics.types import Array, PyTree

Call = Callable[..., Any]
GROUP = 16  # particles that a SIMD lane adds up


class DataRow(NamedTuple):
    """A row of data, or rows along a first axis: step k, z, u and random keys; `moved`: False for the first step."""

    k: Array
    z: Array
    u: Array
    noise_key: Array
    proposal_key: Array
    moved: Array


class ParticleGroup(NamedTuple):
    """Particles along a first axis: weights before and after z, the particles, and what each expected of z."""

    prior: Array
    weight: Array
    particles: PyTree
    predicted: tuple[Array, ...]


class ParticleSums(NamedTuple):
    """Sums over the particles of a row: first sums of states, and of innovations, as vectors; second sums (n, n).

    The innovation of `reference`, what one particle expected of z, is subtracted from all. `density` is
    log p(z | earlier rows).
    """

    states: np.ndarray
    received: np.ndarray
    second: np.ndarray
    reference: tuple[np.ndarray, ...]
    density: np.ndarray


def filter_particles(
    filter: Any, z: Array, u: Array, state: PyTree | None = None, begin: Array | int = 0
) -> ScanResult | None:
    """Filter rows in native code, a SIMD lane for each particle; None if there are no rows, or no native code.

    Args:
        filter: the filter.
        z: measurements (rows, received), NaN for what did not arrive.
        u: inputs (rows, inputs).
        state: the state before the first row; by default that before any data.
        begin: number of the first row.

    Returns:
        The last state, and for each row the mean, the covariance, the innovation, None and the effective number.
    """
    if not len(z):
        return None
    with jax.enable_x64(True):
        return _filter_rows(filter, np.asarray(z), np.asarray(u), state, begin=int(begin))


class _RowArrays(NamedTuple):
    """Arrays that the programs of a row read in place: the row, particles before it, and sums over them.

    `log_weight`: of the particles, the largest 0; `prior`: the weights themselves; `weight`: those after z, the largest
    1; `used`: whether z is used; `reference`: what one particle expected of z; `states`: first sums. Copies of the
    first particle with weight 0 fill the last group.
    """

    row: DataRow
    used: np.ndarray
    particles: PyTree
    log_weight: np.ndarray
    numbers: np.ndarray
    prior: np.ndarray
    weight: np.ndarray
    reference: tuple[np.ndarray, ...]
    states: np.ndarray


class _ParticlePrograms(NamedTuple):
    """Compiled programs of a row, and their arrays.

    `memory`: what they read. `particles`, `log_weight`, `predicted`: what `advance` writes, the particles after the
    row, their log weights, and what each expected of z. `first`, `second`: programs of first and second sums.
    """

    memory: _RowArrays
    particles: PyTree
    log_weight: np.ndarray
    predicted: tuple[np.ndarray, ...]
    advance: Any
    first: Any
    second: Any


def _compile_programs(
    filter: Any, z: np.ndarray, u: np.ndarray, keys: tuple[np.ndarray, np.ndarray]
) -> _ParticlePrograms | None:
    """Return the three programs of a row, compiled with the arrays that they share; None without native code.

    Args:
        filter: the filter.
        z: measurements, of which the first row gives the shape, as of `u` and `keys`.
        u: inputs.
        keys: of noises and of proposals, (rows, ...) each.
    """
    # Their number rounded up to whole groups, and the arrays that several programs read: row, particles, weights.
    length = -(-filter.particles // GROUP) * GROUP
    numbers = np.arange(length, dtype=np.uint32)
    noise_key, proposal_key = (np.zeros_like(part[0]) for part in keys)
    row = DataRow(
        k=np.zeros((), int), z=np.zeros_like(z[0]), u=np.zeros_like(u[0]), noise_key=noise_key,
        proposal_key=proposal_key, moved=np.ones((), bool),
    )  # fmt: skip
    used, particles = np.ones((), bool), filter.allocate_particles(length)
    log_weight, prior, weight = np.zeros((3, length))
    # First program: a particle moved and weighed in each lane. It returns the particle's arrays, its log weight, and
    # what it expected of z. Booleans say which arguments differ from lane to lane.
    inputs = row, used, particles, log_weight, numbers
    advance = _compile_in_place(_advance_particle, filter, inputs, (False, False, True, True, True), length)
    if advance is None:
        return None
    leaves, structure = jax.tree.flatten(particles)
    advanced = jax.tree.unflatten(structure, advance.outputs[: len(leaves)])
    log_weight_after, predicted = advance.outputs[len(leaves)], tuple(advance.outputs[len(leaves) + 1 :])
    # Second and third: sums over the particles of a group in each lane.
    reference = tuple(np.zeros(part.shape[1:]) for part in predicted)
    group: ParticleGroup = jax.tree.map(
        lambda part: part.reshape(length // GROUP, GROUP, *part.shape[1:]),
        ParticleGroup(prior, weight, advanced, predicted),
    )
    first = _compile_in_place(_sum_for_mean, filter, (row, reference, group), (False, False, True), len(group.weight))
    if first is None:
        return None
    states = np.zeros(first.outputs[0].shape[1])
    arguments = states, group.weight, group.particles
    second = _compile_in_place(_sum_for_covariance, filter, arguments, (False, True, True), len(group.weight))
    if second is None:
        return None
    memory = _RowArrays(*inputs, prior=prior, weight=weight, reference=reference, states=states)
    return _ParticlePrograms(memory, advanced, log_weight_after, predicted, advance=advance, first=first, second=second)


def _compile_in_place(
    function: Call, filter: Any, arguments: tuple[Any, ...], differs_by_run: tuple[bool, ...], runs: int
) -> Any:
    """Return a call that computes function(filter, *arguments) for all `runs`, and reads these arrays in place.

    `differs_by_run` says which arguments have an entry for each run. Returns None without native code.
    """
    code = _compile_call(function, filter, arguments, differs_by_run)
    if code is None:
        return None
    arrays_by_number = dict(enumerate(jax.tree.leaves(arguments)))
    return code.make_in_place_code(runs, arrays_by_number)


def _compile_call(function: Call, filter: Any, arguments: tuple[Any, ...], differs_by_run: tuple[bool, ...]) -> Any:
    """Return compiled code of function(filter, *arguments) that takes the arguments; None without native code."""
    choice = choose_code(function, (filter, *arguments), differs_by_run=[False, *differs_by_run])
    if choice.code is None:
        return None
    arrays_of_filter = choice.arrays[: len(choice.arrays) - len(jax.tree.leaves(arguments))]
    return choice.code.with_first_arguments(*arrays_of_filter)


def _draw_start(filter: Any, key: Array, number: Array) -> PyTree:
    """Return the particle of this number at the start, drawn from the law of x_0 with the key."""
    return _take_first(filter.draw_start(key, number[None]))


def _take_first(tree: PyTree) -> PyTree:
    """Return the first entry of each array of a tree along its leading axis: one particle of several."""
    return jax.tree.map(lambda leaf: leaf[0], tree)


def _advance_particle(
    filter: Any, row: DataRow, is_used: Array, particle: PyTree, log_weight: Array, number: Array
) -> tuple[PyTree, jax.Array, tuple[jax.Array, ...]]:
    """Move a particle and weigh it by z; return it, its log weight, and what it expected of z.

    If z is not used (`is_used` False: it is empty, or no particle explains it), the particle is moved but not weighed,
    and not drawn again with z. Its random numbers depend on its `number`. The filter's methods take arrays of
    particles, so it gets a first axis of length 1 here.
    """
    numbers = jnp.asarray(number)[None]
    one_particle = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], particle)
    moved_particle, law = filter.move_particles(one_particle, numbers, row.noise_key, row.u, row.k, row.moved)
    weighed = filter.weigh_particles(moved_particle, law, numbers, row.proposal_key, row.z, row.k)
    log_likelihood = jnp.where(is_used, weighed.log_likelihood[0], 0.0)
    after = jax.tree.map(lambda new, old: jnp.where(is_used, new, old), weighed.particles, moved_particle)
    return _take_first(after), jnp.asarray(log_weight) + log_likelihood, _take_first(weighed.predicted)


def _sum_for_mean(
    filter: Any, row: DataRow, reference: tuple[Array, ...], group: ParticleGroup
) -> tuple[jax.Array, jax.Array]:
    """Return as vectors the filter's sums for the mean of x, by weights after z, and for that of z, by those before."""
    group = jax.tree.map(jnp.asarray, group)
    states = filter.sum_for_mean(group.weight, group.particles)
    received = filter.sum_received(reference, group.prior, group.predicted, row.z, row.k)
    return pack_sums(states), pack_sums(received)


def _sum_for_covariance(filter: Any, states: Array, weight: Array, particles: PyTree) -> jax.Array:
    """Return second sums of a group's states about the means of all particles, whose first sums are in `states`."""
    weight, particles = jax.tree.map(jnp.asarray, (weight, particles))
    sums = unpack_sums(states, filter.sum_for_mean, weight, particles)
    second: jax.Array = filter.sum_for_covariance(weight, particles, sums)
    return second


def _make_outputs_of_row(filter: Any, row: DataRow, sums: ParticleSums) -> tuple[Any, ...]:
    """Return estimate, innovation and effective number of particles of a row, from sums over its particles.

    The sums are vectors. Their fields have the shapes of the same sums over a single particle.
    """
    one_particle, weight = jax.tree.map(jnp.asarray, filter.allocate_particles(1)), jnp.ones(1)
    states = unpack_sums(sums.states, filter.sum_for_mean, weight, one_particle)
    predicted = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], sums.reference)
    received = unpack_sums(sums.received, filter.sum_received, sums.reference, weight, predicted, row.z, row.k)
    estimate = filter.estimate_from_sums(states, sums.second)
    innovation = filter.innovation_from_sums(received, sums.reference, row.z, row.k, sums.density)
    effective_number = states.first.weight**2 / states.first.square  # (sum of w)^2 / sum of w^2
    return estimate, innovation, effective_number


def _filter_rows(filter: Any, z: np.ndarray, u: np.ndarray, state: PyTree | None, begin: int) -> ScanResult | None:
    """Return last state and outputs of rows of data, the first with number `begin`; None without native code.

    `filter`: a particle filter. `z`: (rows, received), NaN for what did not arrive; `u`: inputs (rows, inputs).
    `state`: the filter's state after the row before; None at the start, where particles are drawn.
    """
    # Random keys of all rows at once: they depend on the data, and on no particle.
    key = None if state is None else np.asarray(state.key)
    keys: KeysOfRows = compute_once(draw_keys_of_rows, draw_keys_of_rows_by_xla, (filter, z, key))
    # Number of each step, and whether particles move before it: in all rows but the very first.
    k = begin + np.arange(len(z))
    moved = (np.arange(len(z)) > 0) | (state is not None and bool(state.moved))
    rows = DataRow(k=k, z=z, u=u, noise_key=keys.noises, proposal_key=keys.proposals, moved=moved)
    programs = _compile_programs(filter, z, u, (np.asarray(keys.noises), np.asarray(keys.proposals)))
    if programs is None:
        return None
    # The particles before the first row: drawn, or taken from the state.
    loop = _ParticleLoop(filter, programs)
    if state is None:
        numbers = programs.memory.numbers[: filter.particles]
        draw = _compile_call(_draw_start, filter, (keys.start, numbers), (False, True))
        if draw is None:
            return None
        loop.set_particles(draw(keys.start, numbers), np.zeros(filter.particles))
    else:
        loop.set_particles(jax.tree.map(np.asarray, filter.get_particles(state)), np.asarray(state.log_weight))
    # Row by row the sums over particles; then the outputs of all rows from these sums, computed side by side.
    steps = [
        loop.filter_row(DataRow(*row), choice_start)
        for row, choice_start in zip(zip(*rows, strict=True), keys.choice_starts.tolist(), strict=True)
    ]
    sums: ParticleSums = jax.tree.map(lambda *parts: np.stack(parts), *steps)
    outputs = choose_code(_make_outputs_of_row, (filter, rows, sums), differs_by_run=[False, True, True])
    if outputs.code is None:
        return None
    return ScanResult(loop.last_state(np.asarray(keys.last)), outputs.results())


class _ParticleLoop:
    """Particles that are moved and weighed row by row, and sums of their weights that the next row needs."""

    def __init__(self, filter: Any, programs: _ParticlePrograms):
        """Keep the filter, and the compiled programs with the arrays that they read and write in place.

        A program writes particles to other arrays than it reads: `array_pairs` holds (written, read) of each leaf.
        """
        self.filter, self.count = filter, filter.particles
        self.programs, self.memory = programs, programs.memory
        self.resample = float(filter.resample)
        self.sum_of_weights, self.sum_of_squares = 0.0, 0.0
        self.particles, self.log_weight, self.predicted = programs.particles, programs.log_weight, programs.predicted
        self.particle_arrays = jax.tree.leaves(self.particles)
        self.array_pairs = list(zip(self.particle_arrays, jax.tree.leaves(self.memory.particles), strict=True))

    def set_particles(self, particles: PyTree, log_weight: np.ndarray) -> None:
        """Set the particles (N, ...) before the next row, and their log weights, of which the largest must be 0."""
        memory, count = self.memory, self.count
        for array, values in zip(self.particle_arrays, jax.tree.leaves(particles), strict=True):
            array[:count], array[count:] = values, values[0]  # copies of the first particle fill the last lanes
        memory.log_weight[:count], memory.log_weight[count:] = log_weight, -np.inf
        np.exp(memory.log_weight, out=memory.weight)
        self.sum_of_weights, self.sum_of_squares = float(memory.weight.sum()), float(memory.weight @ memory.weight)

    def filter_row(self, row: DataRow, choice_start: float) -> ParticleSums:
        """Resample the particles if needed, move and weigh them, in place; return the sums over them.

        Mean, covariance and likelihood follow from the sums. The work is done by compiled programs, which read and
        write arrays of one memory. `row`: data of one step, z NaN where missing, inputs u, random keys and number of
        the step. `choice_start`: a uniform number, at which systematic resampling starts.
        """
        # Copy the row to where the programs read it, and resample.
        memory, programs = self.memory, self.programs
        for array, value in zip(memory.row, row, strict=True):
            array[...] = value
        self._choose_particles(choice_start)
        # Move and weigh; a row that no particle explains is not used: they are only moved.
        used = self.filter.uses_empty_rows or not np.isnan(row.z).all()
        largest = self._advance(used)  # the largest log weight
        excluded = used and not largest > -np.inf
        if excluded:
            largest = self._advance(False)
        # weight = exp(log weight - largest).
        np.subtract(self.log_weight, largest, out=memory.log_weight)
        np.exp(memory.log_weight, out=memory.weight)
        # First sums of all groups of particles (the programs sum each group, NumPy all groups), then second sums about
        # the means (einsum: in half of the time of add.reduce).
        self._find_reference()
        programs.first()
        states = np.einsum("ij->j", programs.first.outputs[0], out=memory.states)
        received = np.einsum("ij->j", programs.first.outputs[1])
        programs.second()
        second = np.einsum("ijk->jk", programs.second.outputs[0])
        # The first sums begin with the sums of weights and of their squares. p(z) is the sum of weights after z divided
        # by the sum of weights before z: log p(z) = log(sum after) + largest - log(sum before).
        sum_before_z = self.sum_of_weights
        self.sum_of_weights, self.sum_of_squares = float(states[0]), float(states[1])
        density = -np.inf if excluded else math.log(self.sum_of_weights) + largest - math.log(sum_before_z)
        reference = tuple(part.copy() for part in memory.reference)
        return ParticleSums(states.copy(), received, second, reference=reference, density=np.asarray(density))

    def _choose_particles(self, start: float) -> None:
        """Copy the particles after the last row to those before the next, resampled if too few have weight.

        `start`: a uniform number, which is where systematic resampling starts. Resampled particles have weight 1.
        """
        memory, count = self.memory, self.count
        effective_number = self.sum_of_weights**2 / self.sum_of_squares
        if not effective_number < self.resample * count:
            for written, read in self.array_pairs:
                read[...] = written
            memory.prior[...] = memory.weight  # weights before z
            return
        indices = resample_concrete_weights(memory.weight[:count], start)
        for written, read in self.array_pairs:
            np.take(written, indices, axis=0, out=read[:count], mode="clip")
        memory.log_weight[:count], memory.prior[:count], self.sum_of_weights = 0.0, 1.0, float(count)

    def _advance(self, is_used: bool) -> float:
        """Move all particles, and weigh them by z if it is used; return the largest log weight.

        The program computes as many particles as fill whole SIMD lanes; those beyond the last are set to the first.
        """
        self.memory.used[...] = is_used
        self.programs.advance()
        for array in (*self.particle_arrays, *self.predicted):
            array[self.count :] = array[0]
        return float(self.log_weight.max())

    def _find_reference(self) -> None:
        """Write what the heaviest particle before z expected of z: its innovation is subtracted before all are summed.

        It is the heaviest particle with finite expectations, if any has them.
        """
        prior: Any = self.memory.prior
        heaviest: Any = np.argmax(prior)
        if not all(np.isfinite(array_of_expectations[heaviest]).all() for array_of_expectations in self.predicted):
            predicted = tuple(array_of_expectations[: self.count] for array_of_expectations in self.predicted)
            heaviest = find_reference_particle(prior[: self.count], predicted)
        for array, expectations_of_all in zip(self.memory.reference, self.predicted, strict=True):
            array[...] = expectations_of_all[heaviest]

    def last_state(self, key: np.ndarray) -> Any:
        """Return the state of the filter after the last row, given the key of what follows."""
        particles = jax.tree.map(lambda leaf: np.array(leaf[: self.count]), self.particles)
        return self.filter.make_state(particles, np.array(self.memory.log_weight[: self.count]), key)
