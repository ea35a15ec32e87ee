"""Multiple-model filters for links with memory: modes weighted by likelihood, one Gaussian per mode or for all.

They differ in when Gaussians are merged; all reduce a mixture to two moments, so that no claim is exact.
"""

from functools import partial
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.engine.choice import compile_on_call
from heliograph.factors.factored_gaussian import (
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
    find_signal_moments,
)
from heliograph.filters.modes.arrival_patterns import ChannelByPattern
from heliograph.filters.modes.correction_by_mode import correct_in_every_mode
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
from heliograph.filters.modes.mode_pair_smoother import ModalLaw, ModalSmootherStep, PairSmootherTerms, move_pairs
from heliograph.filters.modes.models_by_mode import fields_of_mode_filters
from heliograph.filters.smoother_step import SmootherStep, StepTrace
from heliograph.filters.wrappers.accepted_models import accept_limits, accept_sensor_inputs, accept_told_numbers
from heliograph.model.assumed.assumed_model import believes
from heliograph.model.channel import Channel
from heliograph.model.estimate import Estimate, Innovation
from heliograph.model.markov_jump_models import ModalPlant, list_mode_models, transition_over
from heliograph.model.over_time import OverTime, at, first
from heliograph.model.plant import AnyPlant
from heliograph.model.sensor import AnySensor
from heliograph.numerics.angles.angle import Angles, wrap_angles
from heliograph.numerics.types import Array, ArrayLike, Bool, Float


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
        """The law of x as a mixture: the probabilities (K,) of the components, and their Gaussians."""
        return jnp.sum(self.weight, axis=1), self.gaussian


NODES = 3  # modes that stand for a gain that drifts


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
        """Return the indices of states that are angles, and of components of z that are."""
        return FilterAngles(first(self.plant).angles, self.observed_angles)

    @compile_on_call
    def init(self) -> ModalBeliefs:
        """Return K equal Gaussians, the law of x_0, with weights that give the modes their initial law.

        `moved` is False until a step is predicted: the modes of the first step have the initial law itself.
        """
        start, weight = at(self.plant, k=0), self.merging.initial_weights(jnp.asarray(self.initial))
        gaussians = replicate(from_covariance(start.initial_mean, start.initial_covariance), len(weight))
        return ModalBeliefs(gaussians, weight, moved=jnp.asarray(False))

    @predicts
    def predict(self, state: ModalBeliefs, u: ArrayLike = (), k: Step = 0) -> ModalBeliefs:
        """Merge components to mixtures by the chain, then move each mixture by the plant of its mode.

        At the first prediction the chain has its initial law.
        """
        plants, u, modes = list_mode_models(at(self.plant, k)), jnp.asarray(u), len(self.initial)
        # Weights of components in mixtures (K, mixtures), and P(component, mode) after the step (K, M).
        mixing, weight = self.merging.mixing_weights(state.weight, self.transition_matrix(state, u, k))
        predicted = mix_and_predict_by_mode(
            plants=plants,
            plant_of=np.array(self.plant_modes),  # number of each mode's plant
            transform=self.transform,
            components=state.gaussian,
            weight=mixing,
            moves=self.merging.list_moves(modes),  # which mixture each new component was, and which mode moves it
            u=u,
            initial_power=second_moments_at_start(self.plant),
        )
        predicted = predicted._replace(mean=align_angles(plants[0], predicted.mean, jnp.sum(weight, axis=1)))
        return ModalBeliefs(predicted, weight, jnp.asarray(True))

    def transition_matrix(self, state: ModalBeliefs, u: jax.Array, k: Step) -> jax.Array:
        """Return the transition matrix (M, M) of the modes over step k, which may depend on the input u (as on dt).

        Before the first prediction the modes keep their initial law, so that it is the identity.
        """
        rows = transition_over(at(self.plant, k), u, jnp.asarray(at(self.channel, k).transition))
        return jnp.where(state.moved, rows, jnp.eye(len(self.initial)))

    @corrects
    def correct(self, state: ModalBeliefs, z: ArrayLike, k: Step = 0) -> tuple[ModalBeliefs, Innovation]:
        """Correct a Gaussian for each pair (component, mode) with z, and weight the pairs by their likelihood.

        A component is one of the Gaussians of the mixture; a pair is its Gaussian in one present mode, whose sensor and
        link measured z. Which pairs there are, and which Gaussians are kept afterwards, the merging rule decides.
        """
        channel, z, modes = at(self.channel, k), jnp.asarray(z), len(self.initial)
        _, mode_of_pair = self.merging.list_update_pairs(modes)
        signal, prior_weight = self.prior_signals(state, k)
        plant = list_mode_models(at(self.plant, k))[0]  # all models have the same angles
        corrected, weight, innovation = correct_in_every_mode(
            signal, channel, jnp.asarray(mode_of_pair), prior_weight, z, self.observed_angles
        )
        gaussians = corrected._replace(mean=align_angles(plant, corrected.mean, weight))
        return ModalBeliefs(*self.merging.keep_components(gaussians, weight, modes), state.moved), innovation

    def prior_signals(self, state: ModalBeliefs, k: Step) -> tuple[Signal, jax.Array]:
        """Return for each pair (component, mode) that z corrects the moments of its signal y, and its prior weight.

        The signal is that of the mode's sensor, for x from the component's Gaussian.
        """
        component, mode = self.merging.list_update_pairs(len(self.initial))
        return self.signals_of_pairs(state.gaussian, (component, mode), k), state.weight[component, mode]

    def signals_of_pairs(self, components: Gaussian, pairs: tuple[np.ndarray, np.ndarray], k: Step) -> Signal:
        """Return for each pair (component, mode) the moments of the signal y of the mode's sensor, for x ~ component.

        Several modes may share a sensor, and several pairs a component: moments are found once for each different
        component and sensor, and copied.

        Args:
            components: Gaussians of x (components, n).
            pairs: for each pair the number of its component, and that of its mode.
            k: step.
        """
        plant, sensors = list_mode_models(at(self.plant, k))[0], list_mode_models(at(self.sensor, k))
        (component, mode), start = pairs, second_moments_at_start(self.plant)
        sensor_of_pair, results = np.array(self.sensor_modes)[mode], list[Signal]()
        for number, sensor in enumerate(sensors):
            # The different components in this sensor's pairs.
            its_components = component[sensor_of_pair == number]
            distinct = np.unique(its_components)
            are_all = len(distinct) == len(components.mean)
            priors = components if are_all else jax.tree.map(lambda leaf, i=distinct: leaf[i], components)
            measure = partial(find_signal_moments, plant, sensor, self.transform)
            signals = jax.vmap(lambda x, measure=measure: measure(x, start))(priors)
            index = np.searchsorted(distinct, its_components)
            results.append(jax.tree.map(lambda leaf, index=index: leaf[index], signals))
        if len(results) == 1:
            return results[0]
        # The results are ordered by sensor: the inverse permutation orders them by pair again.
        order_by_sensor = np.concatenate([np.flatnonzero(sensor_of_pair == number) for number in range(len(sensors))])
        inverse_order = np.argsort(order_by_sensor)
        joined: Signal = jax.tree.map(lambda *leaves: jnp.concatenate(leaves)[inverse_order], *results)
        return joined

    @estimates
    def estimate(self, state: ModalBeliefs) -> Estimate:
        """Return the mean and covariance of the whole mixture, angles between -pi and pi, and the modes' law."""
        weights, gaussians = state.components
        mean, covariance = moments_of_mixture(gaussians.mean, gaussians.covariance, weights)
        return Estimate(wrap_angles(mean, first(self.plant).angles), covariance, self.claim, state.law)

    def smoother_step(self, step: StepTrace) -> SmootherStep:
        """Return what a backward pass needs of a step: Gaussians of all pairs (mode i before, mode j after it).

        The mixtures before and after the step, merged to one Gaussian each, are given too, for uses that know no modes.
        """
        plants, modes = list_mode_models(at(self.plant, step.k)), len(self.initial)
        law = self._find_law_by_mode(step.after)
        terms = self._describe_pairs(step, law)
        merged = step.map_states(_merge_mixture)
        # With several plants no single function moves the whole mixture, so it has no smoother step of its own.
        merged_before: Any = None
        if len(plants) == 1:
            merged_before = smoother_step_by_transform(self, merged, first(self.plant)).before
        pairs = jax.tree.map(lambda leaf: leaf.reshape(modes, modes, *leaf.shape[1:]), terms.pairs)  # [i, j]
        return ModalSmootherStep(
            merged.after, merged_before, claim=self.claim, manifold=first(self.plant).manifold, law=law,
            known=terms.reference, ways=terms.smoother_gains, weights=terms.weights, pairs=pairs,
        )  # fmt: skip

    def _find_law_by_mode(self, state: ModalBeliefs) -> ModalLaw:
        """Return the Gaussian and the probability of each present mode, merged from a filter's components."""
        return ModalLaw(self.merging.merge_by_mode(state.gaussian, state.weight), state.law)

    def _describe_pairs(self, step: StepTrace, after: ModalLaw) -> PairSmootherTerms:
        """Return what a smoother needs of a step: for each pair (mode i before it, mode j after it) a Gaussian of x.

        With it the pair's probability, the smoother gain back to mode i, and for each mode j the Gaussian that a
        smoothed one is divided by, to find what later data alone say.

        Args:
            step: the filter's states before the step, after its prediction and after its correction, with k, u and z.
            after: Gaussian and probability of each mode after the correction.
        """
        modes, k, before = len(self.initial), step.k, self._find_law_by_mode(step.before)
        plants, start = list_mode_models(at(self.plant, k)), second_moments_at_start(self.plant)
        # The Gaussian of mode i moved by the plant of mode j, with P(i, j) = P(i) Pi_ij.
        moved = move_pairs(
            plants, np.array(self.plant_modes), self.transform, before.gaussian, jnp.asarray(step.u), start
        )
        pairs = jax.tree.map(lambda leaf: leaf.reshape(modes**2, *leaf.shape[2:]), moved.gaussian)
        weights = before.law[:, None] * self.transition_matrix(step.before, jnp.asarray(step.u), k)
        # Later data correct the pairs as the filter corrects: filtered pairs (GPB2), else predicted ones.
        reference = after.gaussian if self.merging.corrects_pairs else step.prior.gaussian
        pairs = pairs._replace(mean=plants[0].near(pairs.mean, jnp.tile(reference.mean, (modes, 1))))
        if self.merging.corrects_pairs:
            j = np.tile(np.arange(modes), modes)
            signal, z = self.signals_of_pairs(pairs, (np.arange(modes**2), j), k), jnp.asarray(step.z)
            pairs, weights, _ = correct_in_every_mode(
                signal, at(self.channel, k), jnp.asarray(j), weights.reshape(-1), z, self.observed_angles
            )
            weights = weights.reshape(modes, modes)
        return PairSmootherTerms(reference=reference, pairs=pairs, weights=weights, smoother_gains=moved.back)


def _merge_mixture(state: ModalBeliefs) -> Gaussian:
    """Return one Gaussian with the mean and covariance of the mixture of all components, whatever their modes."""
    weights, components = state.components
    return merge_mixture(components, weights)


@accept_limits
@believes
@accept_sensor_inputs
@accept_told_numbers
def imm_filter(
    plant: AnyPlant, sensor: AnySensor, channel: Channel, transform: AbstractTransform | None = None, nodes: int = NODES
) -> MultipleModelFilter:
    """Return the interacting multiple model filter of a plant behind links with memory: one Gaussian per mode.

    A link with memory has modes, a Markov chain with transition probabilities Pi_ij; mu_i are their probabilities given
    the data. Before a step the Gaussians are mixed for each next mode j by the shares mu_(i|j) = Pi_ij mu_i / c_j, of
    sum 1. After it the modes are weighted by the likelihood of z. A gain that is random within a mode enters by its
    second moments, and erasures inside the channel are information on the mode.

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

    A mode is a value of what the link remembers, such as good or bad. In each step the Gaussian is corrected in each of
    M modes, these are weighted by the likelihood of what arrived, and the M posteriors merged into one Gaussian.

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

    Claim: "nominal". With few modes that the data distinguish the filter is close to the best one; behind slow fading
    of many modes its covariance is too small. With almost no noise in plant and link squared errors were 17 times it.

    Raises:
        ValueError: parts that do not fit, too many modes to list, a mode whose output is certain among others.

    Source: Chang and Athans, State estimation for discrete systems with switching parameters (1978).
    """
    return MultipleModelFilter(
        merging=MergePairs() if isinstance(plant, ModalPlant) else MergeByMode(),
        **fields_of_mode_filters(plant, sensor, channel, transform, nodes),
    )
