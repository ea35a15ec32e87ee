"""Maps whose law depends on a memory, any combination of them as one chain, and the same drawn anew at each step."""

from collections.abc import Sequence
from functools import reduce
from itertools import product
from math import prod
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.numerics.angles.angle import Angles
from heliograph.numerics.check import array, check_count, fail, instance, scalar, show_value
from heliograph.numerics.module import Module
from heliograph.numerics.numpy_or_jax import library, stack_parts
from heliograph.numerics.types import ArrayLike, Float, PyTree
from heliograph.random_affine.base import AbstractModal, AbstractRandomAffine, SameNoise, check_forgets, check_maps
from heliograph.random_affine.composite import DIRECT, AbstractMapWrapper, AbstractOneOfSeveralMaps
from heliograph.random_affine.hop import AbstractHop, GainAndNoise, known
from heliograph.random_affine.laws.law import Constant
from heliograph.random_affine.markov_chain_and_autoregression import (
    AbstractMemory,
    Autoregression,
    Law,
    MarkovChain,
    MemoryStates,
    Rows,
)
from heliograph.random_affine.memories_of_channels import condition_on_states, memories, select_model_of_equal_structure
from heliograph.random_affine.mixture import Mixture
from heliograph.random_affine.moments.monomials import JointMoments
from heliograph.random_affine.moments.signal_path import ChannelPosition, Visit
from heliograph.random_affine.noises.noise import AbstractNoise, Matrix, as_noise

MODES = 1024  # most joint modes of all memories: a filter's matrices have as many blocks in a row


class Modes(AbstractOneOfSeveralMaps, AbstractModal):
    """One map for each mode of a chain: at each step it is drawn from the map of the present mode.

    Links that name one chain are in one mode at a time; everything else in them is independent. In series, stacked,
    mixed or erased they stay maps for each mode.

    Raises:
        ValueError: not one map for each mode, maps of several shapes, a map that itself remembers.
    """

    memory: MarkovChain
    maps: tuple[AbstractRandomAffine, ...]

    def __init__(self, chain: MarkovChain, maps: Sequence[AbstractRandomAffine]):
        """Hold the Markov chain and one map for each of its modes, all of one shape and without memory of their own."""
        if not isinstance(chain, MarkovChain):
            raise fail("chain", "a MarkovChain", show_value(chain))
        self.memory = chain
        self.maps = check_maps("maps of the modes", maps)
        if len(self.maps) != chain.modes:
            raise fail("maps of the modes", f"{chain.modes}, one for each mode", len(self.maps))
        self.check_shapes("maps of the modes")
        for m in self.maps:
            check_forgets("map of a mode", m)

    def given(self, state: int | float | jax.Array | np.ndarray) -> AbstractRandomAffine:
        """Return the map of the mode with the number `state`.

        If JAX traces the number and the maps differ only in numbers, it is one map with the chosen numbers. If they
        differ in structure, it is a map that holds all of them and chooses what they return.
        """
        if isinstance(state, int | np.integer):
            return self.maps[state]
        present = select_model_of_equal_structure(self.maps, jnp.asarray(state))
        return _MapOfTracedIndex(self.maps, jnp.asarray(state)) if present is None else present

    def covers_kind(self, actual: AbstractRandomAffine, same_noise: SameNoise) -> bool:
        """Return whether all laws that `actual` may have are possible here: those of its chain and of each mode's map.

        `same_noise` tests whether two noises agree.
        """
        if not isinstance(actual, Modes) or len(actual.maps) != len(self.maps):
            return False
        if not self.memory.covers(actual.memory):
            return False
        pairs = zip(self.maps, actual.maps, strict=True)
        return all(assumed_map.covers(actual_map, same_noise) for assumed_map, actual_map in pairs)

    def in_words(self) -> str:
        """Return a text such as "'state': modes (hop or nothing sent)", with the name of the memory and the maps."""
        return f"{self.memory_in_words}modes ({' or '.join(affine.in_words() or DIRECT for affine in self.maps)})"


class _MapOfTracedIndex(AbstractOneOfSeveralMaps):
    """The map maps[index], for an index that JAX traces and maps that differ in structure."""

    maps: tuple[AbstractRandomAffine, ...]
    index: jax.Array

    def sample(self, key: jax.Array) -> jax.Array:
        """Draw H of every map, and return that of maps[index]."""
        return jnp.stack([m.sample(key) for m in self.maps])[self.index]

    def moments(self, order: int) -> JointMoments:
        """Return the moments of maps[index], by computing those of every map."""
        matrices = [jnp.asarray(m.moments(order).matrix) for m in self.maps]
        return JointMoments(jnp.stack(matrices)[self.index], self.outputs, self.inputs, order)


class ModeOutput(AbstractModal):
    """Side information: z are the values that a message reports of a memory's state, such as the mode; y has gain 0."""

    memory: AbstractMemory
    sent: int = eqx.field(static=True)

    @property
    def outputs(self) -> int:
        """Length of z, the number of values that a message reports of the memory's state; one for a mode's number."""
        return self.memory.announced

    @property
    def inputs(self) -> int:
        """Length of y, none of which is in z."""
        return self.sent

    def carry_angles(self, sent: Angles) -> Angles:
        """Return no index: z is the number of a mode, and no angle, whatever is sent."""
        return ()

    def visit_hops(self, visit: Visit, position: ChannelPosition) -> tuple[AbstractRandomAffine, ChannelPosition]:
        """Return the map and the position unchanged: side information is read off the receiver, and no hop sends it."""
        return self, position

    def given(self, state: int | float | jax.Array | np.ndarray) -> GainAndNoise:
        """Return the map z = 0 y + b, b the values that a message reports of this state."""
        return known(np.zeros((self.outputs, self.sent)), self.memory.announce(state))


class OneStepLate(AbstractMapWrapper):
    """Map z_k = G_(k-1) y_k + n_(k-1), with what `base` drew one step earlier; z_0 is NaN.

    It delivers side information, such as a mode's number, that is known one step late.
    """

    base: AbstractRandomAffine

    @property
    def erases(self) -> bool:
        """Always True: nothing was drawn before the first step, whose z is NaN."""
        return True

    @property
    def remembers(self) -> bool:
        """Always True: the [G, n] drawn last is the map of the next step."""
        return True

    def _init(self, key: jax.Array) -> PyTree[jax.Array]:
        """Return the first state of `base`, and rows [G, n] of NaN, since nothing is drawn yet."""
        return self.base.init(key), jnp.full((self.outputs, self.inputs + 1), jnp.nan)

    def _draw(self, state: PyTree[jax.Array], key: jax.Array) -> tuple[PyTree[jax.Array], jax.Array]:
        """Return the new state, and the H that was drawn at the step before; draw that of the next step.

        The state holds the state of the map `base`, and the rows [G, n] that it drew last.
        """
        base_state, rows_before = state
        base_state, matrix = self.base.draw(base_state, key)
        rows, last_row = matrix[:-1], matrix[-1:]  # [G, n] and [0, 1]
        return (base_state, rows), jnp.concatenate([rows_before, last_row])

    def carry_angles(self, sent: Angles) -> Angles:
        """Return the indices of the outputs of `base` that are angles: a step of delay changes none."""
        return self.base.carry_angles(sent)

    def visit_hops(self, visit: Visit, position: ChannelPosition) -> tuple[AbstractRandomAffine, ChannelPosition]:
        """Return the map with visit(name, hop, signal) in place of each hop of `base`, and the position behind it.

        A hop is a transmitter with its link. `position` has the name and number of the next one, and the signal there.
        """
        base, position = self.base.visit_hops(visit, position)
        return self.rebuilt(base), position


class Faded(AbstractHop, AbstractModal):
    """Drifting fading z = (mean + deviation c) A y + n, with c a standard Gaussian that drifts (`Autoregression`).

    Args:
        drift: the memory c.
        mean: mean of the gain.
        deviation: standard deviation of the gain.
        matrix: A (m, p).
        noise: law of n with m components, its covariance (m, m), or a variance that all components have.

    Raises:
        ValueError: a negative deviation, shapes that do not fit, numbers that are not finite.
    """

    memory: Autoregression
    mean: Float[jax.Array | np.ndarray, ""]
    deviation: Float[jax.Array | np.ndarray, ""]
    matrix: Matrix
    noise: AbstractNoise

    def __init__(
        self,
        drift: Autoregression,
        mean: "Float[ArrayLike, '']",
        deviation: "Float[ArrayLike, '']",
        matrix: "Float[ArrayLike, 'm p']",
        noise: "AbstractNoise | Float[ArrayLike, '*m']",
    ):
        """Hold the drift c, mean and deviation of the gain mean + deviation c, the matrix A and the noise's law."""
        if not isinstance(drift, Autoregression):
            raise fail("drift", "an Autoregression", show_value(drift))
        self.memory, self.mean = drift, scalar("mean gain", mean)
        self.deviation = scalar("deviation of the gain", deviation, low=0.0)
        self.matrix = array("gain matrix", matrix, ("outputs", "inputs"))
        self.noise = as_noise("channel noise", noise, self.matrix.shape[0])

    def in_words(self) -> str:
        """Return a text such as "'fading': drifting hop", with the name of the memory if it has one."""
        return f"{self.memory_in_words}drifting hop"

    def given(self, state: int | float | jax.Array | np.ndarray) -> GainAndNoise:
        """Return the hop z = (mean + deviation c) A y + n, where c is the `state` of the memory."""
        drift = self.deviation * state
        gain = self.mean + drift
        return GainAndNoise(Constant(gain), self.matrix, self.noise)


class JointModes(Module):
    """A channel with memories as one Markov chain (its joint modes), and one map without memory for each mode.

    A mode is a combination of one state of each memory. For a drifting fading these states are the quadrature nodes of
    `AbstractMemory.nodes`: expectations are right, but `initial` and `transition` may be negative, and then are no
    probabilities. A channel without memory has one mode.

    Args:
        initial: law of the mode at the first step (modes,).
        transition: law of the next mode by present mode (modes, modes).
        radius: how far each transition may be off, differently at each step (modes, modes).
        maps: the map in each mode.
        beside: other models that depend on the same memories, such as plant and sensor, given each mode (modes,).
    """

    initial: Law
    transition: Rows
    radius: Rows
    maps: tuple[AbstractRandomAffine, ...]
    beside: tuple[PyTree, ...]

    def moments(self, order: int) -> Float[jax.Array | np.ndarray, "modes rows columns"]:
        """Return E[Sym^order(H) | mode j] at [j]; block (j, i) of the joint moments is transition[i, j] times it."""
        return stack_parts([m.moments(order).matrix for m in self.maps])


def joint_modes(
    channel: AbstractRandomAffine, nodes: int | None = None, order: int = 1, beside: PyTree = ()
) -> JointModes:
    """Combine the memories of a channel in one Markov chain, and return it with the channel's map in each joint mode.

    A joint mode is one state of each memory; that of the first memory varies slowest. Independent chains with the
    transitions Pi_a and Pi_b have together the Kronecker product Pi_a x Pi_b. Maps that share a memory share its state.

    Args:
        channel: any map.
        nodes: number of modes of a drifting fading, which then becomes the chain with the same mean, variance and
            correlation, with probabilities. None (default): as many nodes as make the means in each mode and the
            products over time exact for monomials of H up to `order`; their transition may have negative entries.
        order: degree of H for which expectations are exact, 1 unless given.
        beside: a tree of models, such as plant and sensor, whose memories come before the channel's; none unless given.

    Raises:
        ValueError: more than MODES modes, or a map inside with a memory of another kind.
    """
    check_count("order", order)
    instance("channel", channel, AbstractRandomAffine, "a channel, such as hop(...)")
    # Each memory as finitely many states.
    by_identity = memories((beside, channel))
    chains = [
        _represent_memory_by_nodes(memory, order * channel.degree_in(identity), nodes)
        for identity, memory in by_identity.items()
    ]
    total = prod(len(chain.initial) for chain in chains)
    if total > MODES:
        raise fail("memories of a channel", f"at most {MODES:,} modes together", f"{total:,}")
    joint = _combine_independent_chains(chains)
    # The state of each memory in each joint mode, and the maps given these.
    states_by_mode = [
        dict(zip(by_identity, [state.item() for state in states], strict=True))
        for states in product(*(chain.states for chain in chains))
    ]
    maps = tuple(condition_on_states(channel, states) for states in states_by_mode)
    for m in maps:
        check_forgets("channel of a filter", m)
    return JointModes(
        *joint,  # initial, transition, radius
        maps=maps,
        beside=tuple(condition_on_states(beside, states) for states in states_by_mode),
    )


class _JointChain(NamedTuple):
    """Initial law, transition and its radius of uncertainty of several chains together."""

    initial: Law
    transition: Rows
    radius: Rows


def _combine_independent_chains(chains: Sequence[MemoryStates]) -> _JointChain:
    """Return the chain of all combinations of one state of each independent chain: probabilities are multiplied."""
    xp = library(chains)
    initial = reduce(xp.kron, [chain.initial for chain in chains], np.ones(1))
    transition = reduce(xp.kron, [chain.transition for chain in chains], np.ones((1, 1)))
    # Upper end of each joint transition probability: the product of the upper ends.
    largest = reduce(xp.kron, [chain.transition + chain.radius for chain in chains], np.ones((1, 1)))
    return _JointChain(initial, transition, largest - transition)


def _represent_memory_by_nodes(memory: AbstractMemory, degree: int, nodes: int | None) -> MemoryStates:
    """Return a memory as finitely many states.

    A drifting fading (Autoregression) gets `nodes` states, unless `nodes` is None. Any other memory gets as many states
    as polynomials of this degree in its state need.
    """
    if nodes is not None and isinstance(memory, Autoregression):
        return memory.chain(nodes)
    return memory.nodes(degree)


ROUNDING = 1e-12  # relative: of sums over modes that cancel
DOUBLINGS = 60  # 2^60 steps, after which the law of the modes is that of the long run


def redraw_modes_each_step(channel: AbstractRandomAffine) -> AbstractRandomAffine:
    """Return the channel with its modes drawn anew at each step by their long-run law, so that it has no memory.

    A channel without memory is returned as it is.
    """
    if not channel.remembers:
        return channel
    return mix_maps_of_modes(joint_modes(channel, order=2))


def mix_maps_of_modes(modes: JointModes, law: np.ndarray | None = None) -> AbstractRandomAffine:
    """Return the mixture that is the map of mode i with probability law[i]; by default the chain's long-run law."""
    if law is None:
        in_the_long_run = long_run_law(np.asarray(modes.initial), np.asarray(modes.transition))
        law = in_the_long_run / in_the_long_run.sum()
    return Mixture(modes.maps, law)


def long_run_law(initial: Float[np.ndarray, " modes"], chain: Float[np.ndarray, "modes modes"]) -> np.ndarray:
    """Return the mean of a chain's laws over all steps, p ((I + Pi) / 2)^n with n = 2^DOUBLINGS.

    p is the `initial` law, and Pi the `chain` of transitions. A periodic chain has no limit of p Pi^n. Staying with
    probability 1/2 makes it converge, and does not change the mean.
    """
    transition = (np.eye(len(chain)) + chain) / 2
    for _ in range(DOUBLINGS):
        transition = transition @ transition  # n doubles
        transition = transition / transition.sum(axis=1, keepdims=True)
    return np.asarray(initial @ transition)


def mode_laws_over_time(steps: Sequence[JointModes]) -> list[np.ndarray]:
    """Return the probabilities (modes,) of the modes at each step: p_(k+1) = p_k Pi_k with the transitions Pi_k."""
    laws = [np.asarray(steps[0].initial)]
    for step in steps[:-1]:
        laws.append(laws[-1] @ np.asarray(step.transition))
    return laws


def is_memory_irrelevant_for_linear_filter(steps: Sequence[JointModes], constant: bool) -> bool:
    """Decide whether the best linear filter may ignore memory: Cov(Hbar_k, Hbar_l) = 0 for k < l.

    A channel of random maps H_k = (G_k, n_k) has modes with the chain Pi and the law p_k. Hbar_k,i = E[H_k | mode i].
    Maps of two steps depend on each other by the modes alone, and a linear filter sees only their covariance,
    sum_ij p_k,i (Hbar_k,i - E Hbar_k) (Pi^(l - k))_ij Hbar_l,j. If nothing varies (`constant`, one step given), the
    law must be that of all steps, and lags up to the number of modes decide, since Pi^t is a combination of lower
    powers (Cayley-Hamilton). `steps`: chain, law and maps of each step.
    """
    # A step that does not vary stands for itself and as many later ones as there are modes.
    repeated = list(steps) * (len(steps[0].initial) + 1) if constant else list(steps)
    if constant and not np.allclose(steps[0].initial @ steps[0].transition, steps[0].initial, rtol=0, atol=ROUNDING):
        return False
    # Hbar of each step, its entries in a row for each mode.
    means = [np.array([np.asarray(m.moments(1).mean[:-1]).ravel() for m in step.maps]) for step in steps]
    means = means * len(repeated) if constant else means
    size = max(float(np.max(np.abs(m))) for m in means) ** 2
    # Pairs (k, l) of steps: of what does not vary only the lag counts, so k = 0 is enough.
    first_steps = 1 if constant else len(repeated)
    for k, law in enumerate(mode_laws_over_time(repeated)[:first_steps]):
        # p_k,i (Hbar_k,i - E Hbar_k); each later step multiplies it by Pi', and the sum over i and j has to be 0.
        deviations = law[:, None] * (means[k] - law @ means[k])
        for step, later in zip(repeated[k:-1], means[k + 1 :], strict=True):
            deviations = np.asarray(step.transition).T @ deviations
            if np.max(np.abs(deviations.T @ later)) > ROUNDING * size:
                return False
    return True
