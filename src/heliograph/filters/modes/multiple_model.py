"""Multiple-model filters for links with memory: modes weighted by likelihood, one Gaussian per mode or for all.

Each uses the Markov chain, updates through each mode's map with a Gaussian update, and weights modes by likelihood.
They differ in when Gaussians are merged; all reduce a mixture to two moments, so that no claim is exact.
"""

from functools import partial
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.engine.choice import compile_on_call
from heliograph.factors.columns import Columns
from heliograph.factors.gaussian import (
    Gaussian,
    from_covariance,
    merge_mixture,
    moments_of_mixture,
)
from heliograph.filters.base import (
    AbstractSizedFilter,
    FilterAngles,
    Step,
    corrects,
    estimates,
    make_sizes,
    predicts,
)
from heliograph.filters.gaussian.belief import (
    second_moments_at_start,
    smoother_step_by_transform,
)
from heliograph.filters.gaussian.signal import Signal, condition_on_measurement, noise_behind_gain, signal_of
from heliograph.filters.gaussian.transform import AbstractTransform, Cubature
from heliograph.filters.innovation import mixed_innovation, posterior_weights
from heliograph.filters.modes.mixing import (
    AbstractMerging,
    MergeAll,
    MergeByMode,
    MergeByNextMode,
    mix_and_predict,
)
from heliograph.filters.modes.patterns import SideInformation, describe_by_pattern, pattern_of
from heliograph.filters.smoother_step import SmootherStep, StepTrace
from heliograph.filters.wrappers.told import takes_told
from heliograph.model.channel import Channel, check_link, find_received_angles
from heliograph.model.estimate import Estimate, Innovation
from heliograph.model.over_time import OverTime, at, first, restack, unstack
from heliograph.model.plant import AbstractPlant, AnyPlant
from heliograph.model.premises.premise import believes
from heliograph.model.sensor import AnySensor
from heliograph.numerics.angle import Angles, nearest, wrap_angles
from heliograph.numerics.check import fail, instance
from heliograph.numerics.types import Array, ArrayLike, Bool, Float, PyTree
from heliograph.random_affine.modes import joint_modes

T = TypeVar("T", bound=PyTree)


def correct_in_every_mode(
    signal: Signal,
    channel: SideInformation,
    mode: jax.Array,
    weight: jax.Array,
    z: jax.Array,
    angles: Angles = (),
) -> tuple[Gaussian, jax.Array, Innovation]:
    """Correct each signal's prior in its mode; return posteriors, their weights, and the mixture's innovation.

    weight+ ~ weight P(what arrives | mode) N(z; ...): the likelihood of the innovation is that of z given what arrives.
    """
    # Channel moments by mode, given which components arrived.
    kind = pattern_of(channel, ~jnp.isnan(z)) if len(channel.present) > 1 else 0
    links = jax.tree.map(lambda part: jnp.asarray(part)[mode, kind], (channel.mean, channel.gain_spread, channel.noise))
    # Prior weights given which components arrived.
    chance = weight * jnp.asarray(channel.chance)[mode, kind]
    total = jnp.sum(chance)
    prior = jnp.where(total > 0, chance / jnp.where(total > 0, total, 1.0), weight)
    correct = partial(_correct_in_mode, z=z, angles=angles)
    posteriors, received = jax.vmap(correct)(signal, *links)
    # Posterior weights; beliefs stay as they are where no mode, or not this one, can produce such a value.
    weights, density, excluded = posterior_weights(prior, jnp.where(chance > 0, received.log_likelihood, -jnp.inf))
    possible = (chance > 0) & ~excluded  # a mode in which this cannot arrive has no map for it
    after = jax.tree.map(lambda a, b: jnp.where(possible[:, None], a, b), posteriors, signal.prior)
    value = nearest(jnp.asarray(received.value), received.value[jnp.argmax(prior)], angles)
    return after, weights, mixed_innovation(prior, value, received.covariance, density)


def _correct_in_mode(
    signal: Signal, mean: jax.Array, gain_spread: jax.Array, link: Columns, z: jax.Array, angles: Angles
) -> tuple[Gaussian, Innovation]:
    """Correct the prior of a signal in one mode of the channel, of moments as in `SecondOrder`."""
    expected = mean[:, :-1] @ signal.mean + mean[:, -1]
    z = nearest(z, expected, angles)
    slopes, noise = mean[:, :-1] @ signal.slopes, noise_behind_gain(signal, mean[:, :-1], gain_spread, link)
    return condition_on_measurement(signal.prior, slopes, noise, z, expected)


def describe_modes(channel: Channel, nodes: int) -> tuple[Float[Array, " M"], SideInformation | OverTime]:
    """Return the initial law of the modes, and the channel by mode and pattern of arrivals, at each step."""
    steps = [joint_modes(c, nodes) for c in unstack(channel)]
    no_flags = np.ones((len(steps[0].initial), 1))
    parts = describe_by_pattern(steps, no_flags)
    for step in parts if len(no_flags) > 1 else []:
        _check_random(step)
    return steps[0].initial, restack(parts, channel)


def _check_random(channel: SideInformation) -> None:
    """Check that z has a density in every combination of mode and pattern, for an x that has one."""
    for j, a in np.argwhere(np.asarray(channel.chance) > 0):
        rows, gain = np.flatnonzero(channel.present[a]), np.asarray(channel.mean[j, a])[:, :-1]
        random = (gain @ gain.T + np.einsum("ilaa->il", np.asarray(channel.spread[j, a])))[np.ix_(rows, rows)]
        if np.linalg.matrix_rank(random) < len(rows):
            raise fail("filter of modes", "outputs that are random in every mode (give the links noise)", f"mode {j}")


class ModalBeliefs(NamedTuple):
    """A Gaussian for each of M components, and weight[i, j], the probability of component i and present mode j.

    Shapes: the Gaussians (M, n), weight (M, M). `moved` is true from the first prediction on.
    """

    gaussian: Gaussian
    weight: Float[jax.Array, "M M"]
    moved: Bool[jax.Array, ""]

    @property
    def components(self) -> tuple[jax.Array, Gaussian]:
        """The mixture: probabilities (M,) of the components, and these."""
        return jnp.sum(self.weight, axis=1), self.gaussian


NODES = 3  # modes that stand for a gain that drifts


class MultipleModelFilter(AbstractSizedFilter):
    """Filter of the state and of the mode of links with memory; built by `imm_filter`, `gpb1_filter` and `gpb2_filter`.

    Nominal: mixtures are reduced to two moments. The innovation is that of the mixture, as is its log-likelihood.
    """

    plant: AnyPlant
    sensor: AnySensor
    channel: SideInformation | OverTime
    initial: Float[Array, " M"]
    merging: AbstractMerging
    transform: AbstractTransform
    observed_angles: Angles = eqx.field(static=True)

    def angles_used(self) -> FilterAngles:
        """Return the angles of its plant, and those that its channel delivers."""
        return FilterAngles(first(self.plant).angles, self.observed_angles)

    @compile_on_call
    def init(self) -> ModalBeliefs:
        """Return the prior in every component, and the initial law of the modes."""
        start = at(self.plant, 0)
        parts = replicate(from_covariance(start.initial_mean, start.initial_covariance), len(self.initial))
        return ModalBeliefs(parts, jnp.diag(jnp.asarray(self.initial)), jnp.asarray(False))

    @predicts
    def predict(self, state: ModalBeliefs, u: ArrayLike = (), k: Step = 0) -> ModalBeliefs:
        """Move the chain, then the plant in each component; at the first prediction the chain has its initial law."""
        plant, u = at(self.plant, k), jnp.asarray(u)
        rows = jnp.where(state.moved, jnp.asarray(at(self.channel, k).transition), jnp.eye(len(self.initial)))
        mixing, weight = self.merging.mixing_weights(state.weight, rows)
        moved = mix_and_predict(plant, self.transform, state.gaussian, mixing, u, second_moments_at_start(self.plant))
        parts: Gaussian = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (len(rows), leaf.shape[1])), moved)
        parts = parts._replace(mean=align_angles(plant, parts.mean, jnp.sum(weight, axis=1)))
        return ModalBeliefs(parts, weight, jnp.asarray(True))

    @corrects
    def correct(self, state: ModalBeliefs, z: ArrayLike, k: Step = 0) -> tuple[ModalBeliefs, Innovation]:
        """Correct each component in each mode with z, and weight them by their likelihood."""
        (plant, sensor, channel), z = at((self.plant, self.sensor, self.channel), k), jnp.asarray(z)
        i, j = self.merging.update_pairs(len(self.initial))
        start = second_moments_at_start(self.plant)
        signals = jax.vmap(lambda x: signal_of(plant, sensor, self.transform, x, start))(state.gaussian)
        signal = jax.tree.map(lambda leaf: leaf[i], signals)
        after, weight, mixed = correct_in_every_mode(
            signal, channel, jnp.asarray(j), state.weight[i, j], z, self.observed_angles
        )
        parts, law = self.merging.kept(after._replace(mean=align_angles(plant, after.mean, weight)), weight)
        return ModalBeliefs(parts, jnp.diag(law), state.moved), mixed

    @estimates
    def estimate(self, state: ModalBeliefs) -> Estimate:
        """Return the mean and covariance of the whole mixture, angles between -pi and pi."""
        weights, parts = state.components
        mean, covariance = moments_of_mixture(parts.mean, parts.covariance, weights)
        return Estimate(wrap_angles(mean, first(self.plant).angles), covariance, self.claim)

    def smoother_step(self, step: StepTrace) -> SmootherStep:
        """Return that of the whole mixture's moments around the update; modes are not smoothed."""
        return smoother_step_by_transform(self, step.map_states(_merge_mixture), first(self.plant))


def _merge_mixture(state: ModalBeliefs) -> Gaussian:
    """Merge the mixture: mean and covariance of the state."""
    weights, parts = state.components
    return merge_mixture(parts, weights)


def replicate(x: T, count: int) -> T:
    """Replicate an object `count` times along a new first axis."""
    every: T = jax.tree.map(lambda leaf: jnp.repeat(jnp.asarray(leaf)[None], count, axis=0), x)
    return every


def align_angles(plant: AbstractPlant, mean: jax.Array, weight: jax.Array) -> jax.Array:
    """Unwrap the angles of means (components, n) to lie near those of the most probable, so that they average."""
    return plant.near(mean, mean[jnp.argmax(weight)]) if plant.circular else mean


def fields_of_mode_filters(
    plant: AnyPlant, sensor: AnySensor, channel: Channel, transform: AbstractTransform | None, nodes: int
) -> dict[str, Any]:
    """Return the fields that all filters behind a channel with modes share; a gain that drifts has `nodes` modes."""
    start = instance("plant", first(plant), AbstractPlant, "a plant")
    check_link(first(sensor), first(channel), len(start.states))
    angles, (initial, described) = find_received_angles(plant, sensor, channel), describe_modes(channel, nodes)
    return {
        "plant": plant, "sensor": sensor, "channel": described, "initial": initial, "observed_angles": angles,
        "transform": Cubature() if transform is None else transform,
        **make_sizes("nominal", start, first(channel).outputs),
    }  # fmt: skip


@believes
@takes_told
def imm_filter(
    plant: AnyPlant, sensor: AnySensor, channel: Channel, transform: AbstractTransform | None = None, nodes: int = NODES
) -> MultipleModelFilter:
    """Return the interacting multiple model filter of a plant behind links with memory: one Gaussian per mode.

    Before each step they are mixed by the mode that the next one comes from, mu_(i|j) = Pi_ij mu_i / c_j; after it the
    modes are weighted by the likelihood of z. A gain that is random within a mode enters by its second moments;
    erasures inside the channel are information on the mode too.

    Args:
        plant: the plant, n states.
        sensor: its sensor, m outputs.
        channel: from the sensor to the filter, with memory.
        transform: moments of a nonlinear function; `Cubature()` by default, not used for linear parts.
        nodes: number of modes that stand for a gain that drifts; 3 by default.

    Claim: "nominal". It tends to be too small where modes are hard to distinguish for many steps. With next to no
    noise in plant and link the merged Gaussian may leave out the true mode: squared errors were 1e11 times the claim.

    Raises:
        ValueError: parts that do not fit, more modes than can be listed, a mode whose output is certain among others.

    Source: Blom and Bar-Shalom, The interacting multiple model algorithm (1988).
    """
    return MultipleModelFilter(
        merging=MergeByNextMode(), **fields_of_mode_filters(plant, sensor, channel, transform, nodes)
    )


@believes
@takes_told
def gpb1_filter(
    plant: AnyPlant, sensor: AnySensor, channel: Channel, transform: AbstractTransform | None = None, nodes: int = NODES
) -> MultipleModelFilter:
    """First-order generalised pseudo-Bayes filter behind links with memory: one Gaussian and the modes' probabilities.

    M updates a step; the correlation of state and mode is not propagated.

    Args:
        plant: the plant, n states.
        sensor: its sensor, m outputs.
        channel: from the sensor to the filter, with memory.
        transform: moments of a nonlinear function; `Cubature()` by default, not used for linear parts.
        nodes: number of modes that stand for a gain that drifts; 3 by default.

    Claim: "nominal", and too small where fading is slow: the correlation of state and mode is dropped at each step.
    With next to no noise it may leave out the true mode, as `imm_filter`.

    Raises:
        ValueError: as for `imm_filter`.

    Source: Ackerson and Fu, On state estimation in switching environments (1970).
    """
    return MultipleModelFilter(merging=MergeAll(), **fields_of_mode_filters(plant, sensor, channel, transform, nodes))


@believes
@takes_told
def gpb2_filter(
    plant: AnyPlant, sensor: AnySensor, channel: Channel, transform: AbstractTransform | None = None, nodes: int = NODES
) -> MultipleModelFilter:
    """Second-order generalised pseudo-Bayes filter: a Gaussian per mode, each updated in every next mode, M^2 updates.

    Args:
        plant: the plant, n states.
        sensor: its sensor, m outputs.
        channel: from the sensor to the filter, with memory.
        transform: moments of a nonlinear function; `Cubature()` by default, not used for linear parts.
        nodes: number of modes that stand for a gain that drifts; 3 by default.

    Claim: "nominal". With few modes that the data distinguish it is close to the best filter; behind slow fading of
    many modes it is too small, as for the others. With next to no noise in plant and link squared errors were 17 times
    the claim.

    Raises:
        ValueError: as for `imm_filter`.

    Source: Chang and Athans, State estimation for discrete systems with switching parameters (1978).
    """
    return MultipleModelFilter(
        merging=MergeByMode(), **fields_of_mode_filters(plant, sensor, channel, transform, nodes)
    )
