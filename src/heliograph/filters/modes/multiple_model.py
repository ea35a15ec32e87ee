"""Multiple-model filters for links with memory: modes weighted by likelihood, one Gaussian per mode or for all.

Each uses the Markov chain, updates through each mode's map with a Gaussian update, and weights modes by likelihood.
They differ in when Gaussians are merged; all reduce a mixture to two moments, so that no claim is exact.
"""

from functools import partial
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.engine.choice import compile_on_call
from heliograph.factors.covariance_factors import WeightedColumns
from heliograph.factors.factored_gaussian import (
    BackwardGain,
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
    predicts,
)
from heliograph.filters.gaussian.gaussian_prediction import (
    second_moments_at_start,
    smoother_step_by_transform,
)
from heliograph.filters.gaussian.moment_transforms import AbstractTransform
from heliograph.filters.gaussian.signal_moments import (
    Signal,
    condition_on_measurement,
    find_signal_moments,
    noise_behind_gain,
)
from heliograph.filters.innovation import mixed_innovation, posterior_weights
from heliograph.filters.modes.arrival_patterns import ChannelByPattern, pattern_of
from heliograph.filters.modes.mixing import (
    AbstractMerging,
    MergeAll,
    MergeByMode,
    MergeByNextMode,
    MergePairs,
    align_angles,
    mix_and_predict_by_mode,
    replicate,
)
from heliograph.filters.modes.mode_pair_smoother import ModalLaw, ModalSmootherStep, move_pairs
from heliograph.filters.modes.models_by_mode import fields_of_mode_filters
from heliograph.filters.smoother_step import SmootherStep, StepTrace
from heliograph.filters.wrappers.accepted_models import accept_limits, accept_sensor_inputs, accept_told_numbers
from heliograph.model.channel import Channel
from heliograph.model.estimate import Estimate, Innovation
from heliograph.model.markov_jump_models import ModalPlant, list_mode_models, transition_over
from heliograph.model.over_time import OverTime, at, first
from heliograph.model.plant import AnyPlant
from heliograph.model.premises.premise import believes
from heliograph.model.sensor import AnySensor
from heliograph.numerics.angles.angle import Angles, wrap_angles, wrap_near
from heliograph.numerics.types import Array, ArrayLike, Bool, Float


def correct_in_every_mode(
    signal: Signal,
    channel: ChannelByPattern,
    mode: jax.Array,
    weight: jax.Array,
    z: jax.Array,
    angles: Angles = (),
) -> tuple[Gaussian, jax.Array, Innovation]:
    """Return the posteriors of several Gaussians, each corrected in its mode, their weights, the mixture's innovation.

    The weight becomes proportional to weight P(what arrives | mode) N(z; ...). The innovation's likelihood is that of z
    given which components arrive.

    Args:
        signal: moments of the sensor's signal under each Gaussian (K, ...).
        channel: by mode and pattern of arrivals.
        mode: in which each Gaussian is corrected (K,).
        weight: probability of each Gaussian and its mode (K,).
        z: measurement (m,), NaN for what did not arrive.
        angles: components of z that are angles.
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
    value = wrap_near(jnp.asarray(received.value), received.value[jnp.argmax(prior)], angles)
    return after, weights, mixed_innovation(prior, value, received.covariance, density)


def _correct_in_mode(
    signal: Signal, mean: jax.Array, gain_spread: jax.Array, link: WeightedColumns, z: jax.Array, angles: Angles
) -> tuple[Gaussian, Innovation]:
    """Correct the prior of a signal y with z = G y + n in one mode of the channel.

    In this mode `mean` is E[(G, n)], `gain_spread` is Cov G and `link` holds columns of Cov n; `angles` are those of z.
    """
    gain = mean[:, :-1]
    expected = gain @ signal.mean + mean[:, -1]
    z = wrap_near(z, expected, angles)
    slopes, noise = gain @ signal.slopes, noise_behind_gain(signal, gain, gain_spread, link)
    return condition_on_measurement(signal.prior, slopes, noise, z, expected)


class ModalBeliefs(NamedTuple):
    """A Gaussian for each of K components, and weight[c, j], the probability of component c and present mode j of M.

    Shapes: the Gaussians (K, n), weight (K, M). `moved` is true from the first prediction on.
    """

    gaussian: Gaussian
    weight: Float[jax.Array, "K M"]
    moved: Bool[jax.Array, ""]

    @property
    def law(self) -> jax.Array:
        """Probabilities (M,) of the present modes."""
        return jnp.sum(self.weight, axis=0)

    @property
    def components(self) -> tuple[jax.Array, Gaussian]:
        """The mixture: probabilities (M,) of the components, and these."""
        return jnp.sum(self.weight, axis=1), self.gaussian


NODES = 3  # modes that stand for a gain that drifts


class _PairSmootherTerms(NamedTuple):
    """What a smoother by pairs (mode i before, mode j after) needs of a step of M modes.

    `known`: the Gaussian of each mode j that the smoothed one is compared with, predicted, or filtered where pairs take
    z before they are merged. `pairs` (M^2, n): those that observe what the future says; `weights` (M, M): their
    probabilities; `ways`: smoother gains back.
    """

    known: Gaussian
    pairs: Gaussian
    weights: jax.Array
    ways: BackwardGain


class MultipleModelFilter(AbstractSizedFilter):
    """Filter of the state and of the mode of links with memory; built by `imm_filter`, `gpb1_filter` and `gpb2_filter`.

    Nominal: mixtures are reduced to two moments. The innovation is that of the mixture, as is its log-likelihood.
    """

    plant: AnyPlant
    sensor: AnySensor
    channel: ChannelByPattern | OverTime
    initial: Float[Array, " M"]
    merging: AbstractMerging
    transform: AbstractTransform
    observed_angles: Angles = eqx.field(static=True)
    plant_modes: tuple[int, ...] = eqx.field(static=True)  # which of the plant's models each mode has
    sensor_modes: tuple[int, ...] = eqx.field(static=True)
    takes_rates: ClassVar[bool] = True

    def angles_used(self) -> FilterAngles:
        """Return the angles of its plant, and those that its channel delivers."""
        return FilterAngles(first(self.plant).angles, self.observed_angles)

    @compile_on_call
    def init(self) -> ModalBeliefs:
        """Return the prior in every component, and the initial law of the modes; `moved` is False before any step."""
        start, weight = at(self.plant, k=0), self.merging.initial_weights(jnp.asarray(self.initial))
        gaussians = replicate(from_covariance(start.initial_mean, start.initial_covariance), len(weight))
        return ModalBeliefs(gaussians, weight, moved=jnp.asarray(False))

    @predicts
    def predict(self, state: ModalBeliefs, u: ArrayLike = (), k: Step = 0) -> ModalBeliefs:
        """Move the chain, then the plant in each component; at the first prediction the chain has its initial law."""
        plants, u, modes = list_mode_models(at(self.plant, k)), jnp.asarray(u), len(self.initial)
        mixing, weight = self.merging.mixing_weights(state.weight, self.transition_matrix(state, u, k))
        parts = mix_and_predict_by_mode(
            plants=plants,
            plant_of=np.array(self.plant_modes),
            transform=self.transform,
            parts=state.gaussian,
            weight=mixing,
            moves=self.merging.list_moves(modes),
            u=u,
            initial_power=second_moments_at_start(self.plant),
        )
        parts = parts._replace(mean=align_angles(plants[0], parts.mean, jnp.sum(weight, axis=1)))
        return ModalBeliefs(parts, weight, jnp.asarray(True))

    def transition_matrix(self, state: ModalBeliefs, u: jax.Array, k: Step) -> jax.Array:
        """Return the transition matrix (M, M) of the chain; the identity before the first prediction."""
        rows = transition_over(at(self.plant, k), u, jnp.asarray(at(self.channel, k).transition))
        return jnp.where(state.moved, rows, jnp.eye(len(self.initial)))

    @corrects
    def correct(self, state: ModalBeliefs, z: ArrayLike, k: Step = 0) -> tuple[ModalBeliefs, Innovation]:
        """Correct each component in each mode with z, and weight them by their likelihood.

        There is an update for each pair (component, mode), and `updating_mode` holds the mode of each.
        """
        channel, z, modes = at(self.channel, k), jnp.asarray(z), len(self.initial)
        _, updating_mode = self.merging.list_update_pairs(modes)
        signal, weights = self.prior_signals(state, k)
        plant = list_mode_models(at(self.plant, k))[0]  # all models have the same angles
        after, weight, innovation = correct_in_every_mode(
            signal, channel, jnp.asarray(updating_mode), weights, z, self.observed_angles
        )
        gaussians = after._replace(mean=align_angles(plant, after.mean, weight))
        return ModalBeliefs(*self.merging.keep_components(gaussians, weight, modes), state.moved), innovation

    def prior_signals(self, state: ModalBeliefs, k: Step) -> tuple[Signal, jax.Array]:
        """Return the signal of each pair (component, mode) that is corrected, and its weight before."""
        i, j = self.merging.list_update_pairs(len(self.initial))
        return self.signals_of_pairs(state.gaussian, (i, j), k), state.weight[i, j]

    def signals_of_pairs(self, parts: Gaussian, pairs: tuple[np.ndarray, np.ndarray], k: Step) -> Signal:
        """Return the signal of each pair (component, mode): of the mode's sensor under the component's prior."""
        plant, sensors = list_mode_models(at(self.plant, k))[0], list_mode_models(at(self.sensor, k))
        (component, mode), start = pairs, second_moments_at_start(self.plant)
        sensor_of_pair, results = np.array(self.sensor_modes)[mode], list[Signal]()
        # Sensor after sensor: of each component once, then one for each of the sensor's pairs.
        for number, sensor in enumerate(sensors):
            of_pairs = component[sensor_of_pair == number]
            once = np.unique(of_pairs)
            priors = parts if len(once) == len(parts.mean) else jax.tree.map(lambda leaf, i=once: leaf[i], parts)
            measure = partial(find_signal_moments, plant, sensor, self.transform)
            signals = jax.vmap(lambda x, measure=measure: measure(x, start))(priors)
            index = np.searchsorted(once, of_pairs)
            results.append(jax.tree.map(lambda leaf, index=index: leaf[index], signals))
        if len(results) == 1:
            return results[0]
        # The place of each pair among the results: the inverse of the permutation in which these are listed.
        listed = np.concatenate([np.flatnonzero(sensor_of_pair == number) for number in range(len(sensors))])
        place = np.argsort(listed)
        joined: Signal = jax.tree.map(lambda *leaves: jnp.concatenate(leaves)[place], *results)
        return joined

    @estimates
    def estimate(self, state: ModalBeliefs) -> Estimate:
        """Return the mean and covariance of the whole mixture, angles between -pi and pi, and the modes' law."""
        weights, gaussians = state.components
        mean, covariance = moments_of_mixture(gaussians.mean, gaussians.covariance, weights)
        return Estimate(wrap_angles(mean, first(self.plant).angles), covariance, self.claim, state.law)

    def smoother_step(self, step: StepTrace) -> SmootherStep:
        """Return the step of smoothing by pairs of modes, with the moments of the whole mixture around the update."""
        plants, modes = list_mode_models(at(self.plant, step.k)), len(self.initial)
        law = self._find_law_by_mode(step.after)
        pairs_of_modes = self._describe_pairs(step, law)
        merged = step.map_states(_merge_mixture)
        # With several plants no single function moves the whole mixture, so it has no smoother step of its own.
        moments: Any = None
        if len(plants) == 1:
            moments = smoother_step_by_transform(self, merged, first(self.plant)).before
        return ModalSmootherStep(
            merged.after, moments, claim=self.claim, manifold=first(self.plant).manifold, law=law,
            known=pairs_of_modes.known, ways=pairs_of_modes.ways, weights=pairs_of_modes.weights,
            pairs=jax.tree.map(lambda leaf: leaf.reshape(modes, modes, *leaf.shape[1:]), pairs_of_modes.pairs),
        )  # fmt: skip

    def _find_law_by_mode(self, state: ModalBeliefs) -> ModalLaw:
        """Return the law of a state after a correction, mode by mode."""
        return ModalLaw(self.merging.merge_by_mode(state.gaussian, state.weight), state.law)

    def _describe_pairs(self, step: StepTrace, after: ModalLaw) -> _PairSmootherTerms:
        """Return what a smoother by pairs of modes needs of a step; `after`: the law by mode after its correction."""
        modes, k, before = len(self.initial), step.k, self._find_law_by_mode(step.before)
        plants, start = list_mode_models(at(self.plant, k)), second_moments_at_start(self.plant)
        moved = move_pairs(
            plants, np.array(self.plant_modes), self.transform, before.gaussian, jnp.asarray(step.u), start
        )
        pairs = jax.tree.map(lambda leaf: leaf.reshape(modes**2, *leaf.shape[2:]), moved.gaussian)
        weights = before.law[:, None] * self.transition_matrix(step.before, jnp.asarray(step.u), k)
        known = after.gaussian if self.merging.corrects_pairs else step.prior.gaussian
        pairs = pairs._replace(mean=plants[0].near(pairs.mean, jnp.tile(known.mean, (modes, 1))))
        if not self.merging.corrects_pairs:
            return _PairSmootherTerms(known=known, pairs=pairs, weights=weights, ways=moved.back)
        j = np.tile(np.arange(modes), modes)
        signal = self.signals_of_pairs(pairs, (np.arange(modes**2), j), k)
        pairs, weight, _ = correct_in_every_mode(
            signal, at(self.channel, k), jnp.asarray(j), weights.reshape(-1), jnp.asarray(step.z), self.observed_angles
        )
        return _PairSmootherTerms(known=known, pairs=pairs, weights=weight.reshape(modes, modes), ways=moved.back)


def _merge_mixture(state: ModalBeliefs) -> Gaussian:
    """Return one Gaussian with the mean and covariance of the mixture."""
    weights, parts = state.components
    return merge_mixture(parts, weights)


@accept_limits
@believes
@accept_sensor_inputs
@accept_told_numbers
def imm_filter(
    plant: AnyPlant, sensor: AnySensor, channel: Channel, transform: AbstractTransform | None = None, nodes: int = NODES
) -> MultipleModelFilter:
    """Return the interacting multiple model filter of a plant behind links with memory: one Gaussian per mode.

    Before a step the Gaussians are mixed for each next mode j by the shares mu_(i|j) = Pi_ij mu_i / c_j. After it the
    modes are weighted by the likelihood of z. A gain that is random within a mode enters by its second moments, and
    erasures inside the channel are information on the mode.

    Args:
        plant: the plant, n states.
        sensor: its sensor, m outputs.
        channel: from the sensor to the filter, with memory.
        transform: moments of a nonlinear function; `Cubature()` by default, not used for linear parts.
        nodes: number of modes that stand for a gain that drifts; 3 by default.

    Claim: "nominal". It tends to be too small where modes are hard to distinguish for many steps. With almost no noise
    in plant and link the merged Gaussian may leave out the true mode: squared errors were 1e11 times the claim.

    Raises:
        ValueError: parts that do not fit, more modes than can be listed, a mode whose output is certain among others.

    Source: Blom and Bar-Shalom, The interacting multiple model algorithm (1988).
    """
    return MultipleModelFilter(
        merging=MergeByNextMode(), **fields_of_mode_filters(plant, sensor, channel, transform, nodes)
    )


@accept_limits
@believes
@accept_sensor_inputs
@accept_told_numbers
def gpb1_filter(
    plant: AnyPlant, sensor: AnySensor, channel: Channel, transform: AbstractTransform | None = None, nodes: int = NODES
) -> MultipleModelFilter:
    """Return the first-order generalised pseudo-Bayes filter behind links with memory: one Gaussian, and modes' law.

    It makes M updates a step for M modes. The correlation of state and mode is not propagated.

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


@accept_limits
@believes
@accept_sensor_inputs
@accept_told_numbers
def gpb2_filter(
    plant: AnyPlant, sensor: AnySensor, channel: Channel, transform: AbstractTransform | None = None, nodes: int = NODES
) -> MultipleModelFilter:
    """Return the second-order generalised pseudo-Bayes filter: a Gaussian per mode, updated in every next mode.

    It makes M^2 updates a step for M modes.

    Args:
        plant: the plant, n states.
        sensor: its sensor, m outputs.
        channel: from the sensor to the filter, with memory.
        transform: moments of a nonlinear function; `Cubature()` by default, not used for linear parts.
        nodes: number of modes that stand for a gain that drifts; 3 by default.

    Claim: "nominal". With few modes that the data distinguish it is close to the best filter; behind slow fading of
    many modes it is too small, as for the others. With almost no noise in plant and link squared errors were 17 times
    the claim.

    Raises:
        ValueError: as for `imm_filter`.

    Source: Chang and Athans, State estimation for discrete systems with switching parameters (1978).
    """
    return MultipleModelFilter(
        merging=MergePairs() if isinstance(plant, ModalPlant) else MergeByMode(),
        **fields_of_mode_filters(plant, sensor, channel, transform, nodes),
    )
