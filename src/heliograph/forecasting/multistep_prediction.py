"""Prediction several steps ahead without data: states, what the sensor would measure, and what would arrive.

A filter's claim is what it says of its covariance: "exact", "upper", "nominal" or "none". Mixtures have K Gaussians.
"""

from dataclasses import replace
from typing import Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp

from heliograph.engine.choice import compile_on_call
from heliograph.factors.covariance_factors import WeightedColumns
from heliograph.factors.diffuse_gaussian import Diffuse, mark_unknown, project_diffuse
from heliograph.factors.factored_gaussian import Gaussian, from_covariance, take_leading
from heliograph.filters.base import AbstractFilter
from heliograph.filters.gaussian.adaptive import AdaptiveFilter
from heliograph.filters.gaussian.gaussian_prediction import second_moments_at_start
from heliograph.filters.gaussian.moment_transforms import AbstractTransform, Cubature
from heliograph.filters.gaussian.robust import RobustFilter
from heliograph.filters.gaussian.signal_moments import find_signal_moments
from heliograph.filters.modes.mode_observed import ModeObservedFilter
from heliograph.filters.modes.multiple_model import MultipleModelFilter
from heliograph.filters.modes.side_information import SideInformationFilter
from heliograph.filters.received_outlier_noise import ReceivedNoise, separate_outlier_noise
from heliograph.filters.truncation import PlacedLimits
from heliograph.filters.wrappers.sensor_inputs import FilterOfInputs
from heliograph.filters.wrappers.state_limits import LimitedFilter
from heliograph.filters.wrappers.told_link_law import ToldFilter
from heliograph.forecasting.mixture_moments import MarginalLaws, Moments, has_branches, spread_over_branches
from heliograph.model.estimate import Innovation
from heliograph.model.fading import without_memory
from heliograph.model.over_time import OverTime, at, at_each_step, first
from heliograph.model.plant import AbstractPlant, AnyPlant
from heliograph.model.sensor import AbstractSensor, AnySensor, LinearSensor
from heliograph.numerics.module import Module
from heliograph.numerics.types import PyTree
from heliograph.random_affine.memories_of_channels import memories
from heliograph.random_affine.moments.mixture_components import GaussianBranches
from heliograph.random_affine.noises.noise import AbstractNoise
from heliograph.random_affine.noises.outlier_noise import StudentT


@runtime_checkable
class HasComponents(Protocol):
    """A filter's state that is a mixture: weights (K,), and Gaussians (K, ...) whose first numbers are the states."""

    @property
    def components(self) -> tuple[jax.Array, Gaussian]:
        """Weights of a mixture's components, and the components as Gaussians."""


class MultistepPredictor(Module):
    """Predicts a filter's state step by step without data, and reads moments from it.

    Three kinds of numbers are predicted: the plant's states, the outputs that its sensor would measure, and the numbers
    that would be received of these through the channel.

    Args:
        filter: the filter whose state is predicted.
        plant: the plant, for the outputs; None if it is not known.
        sensor: the sensor of the outputs; None if it is not known, and no outputs are predicted.
        transform: takes mean and covariance through a nonlinear sensor.
        receives: whether received numbers are predicted.
        received_noise: noise in the received numbers if it has outliers, else None.
    """

    filter: AbstractFilter
    plant: AnyPlant | None
    sensor: AnySensor | None
    transform: AbstractTransform
    receives: bool = eqx.field(static=True)
    received_noise: ReceivedNoise | OverTime | None

    def compute_state_moments(self, state: PyTree) -> Moments:
        """Return the moments of the plant's states as a mixture of K Gaussians: K = 1 unless the filter has a mixture.

        Covariances are zero if the filter claims none. If states have limits, the moments are those given that all
        limits hold. `state`: the filter's state.
        """
        filter = self.filter
        if not isinstance(filter, LimitedFilter):
            return self._read_moments(filter, state)
        moments = self._read_moments(filter.base, filter.condition_on_limits(state))
        # The law of each limited state: Gaussians given the limits of the other states, later cut to its own limits.
        means = moments.means
        variances = jnp.diagonal(moments.covariances, axis1=-2, axis2=-1)
        for i, *_ in filter.limits:
            given_other_limits = filter.condition_on_limits(filter.hold(state), without=i)
            moments_before_own_limit = self._read_moments(filter.base, given_other_limits)
            means = means.at[:, i].set(moments_before_own_limit.means[:, i])
            variances = variances.at[:, i].set(moments_before_own_limit.covariances[:, i, i])
        weights = jnp.broadcast_to(moments.weights[:, None], means.shape)
        return moments._replace(laws=MarginalLaws(weights=weights, means=means, variances=variances))

    def compute_moments_before_limits(self, state: PyTree) -> Moments:
        """Return the moments of the states before they are conditioned on their limits, for a sampler that cuts draws.

        Only means beyond a limit are moved to it (`hold`), as in the filter's own correction. The weights of the K
        Gaussians are those given that the limits hold: one that lies mostly beyond them is less probable. `state`: the
        filter's state.
        """
        filter = self.filter
        if not isinstance(filter, LimitedFilter):
            return self._read_moments(filter, state)
        weights = self._read_moments(filter.base, filter.condition_on_limits(state)).weights
        return self._read_moments(filter.base, filter.hold(state))._replace(weights=weights)

    def _read_moments(self, filter: AbstractFilter, state: PyTree) -> Moments:
        """Return weights (K,), means (K, n) and covariances (K, n, n) of the plant's n states from a filter's state.

        `filter` is self.filter, or the filter inside it that takes such a state. If self.filter claims no covariance
        (claim "none"), zeros stand for it.
        """
        if isinstance(state, HasComponents):
            weights, components = state.components
            components = take_leading(components, len(self.filter.states))  # the first numbers are the plant's states
            covariances = jnp.asarray(jax.vmap(lambda component: component.covariance)(components))
            return Moments(weights=weights, means=components.mean, covariances=covariances)
        estimate = filter.estimate(state)
        covariance = jnp.asarray(estimate.covariance)
        covariance = covariance if self.filter.claim != "none" else jnp.zeros_like(covariance)
        return Moments(weights=jnp.ones(1), means=jnp.asarray(estimate.mean)[None], covariances=covariance[None])

    @property
    def limits(self) -> PlacedLimits:
        """Index, lowest and highest value of each state with limits that the filter knows."""
        return self.filter.limits if isinstance(self.filter, LimitedFilter) else ()

    def moments(self, state: PyTree) -> Moments:
        """Return the moments of the states of a filter's state, before they are conditioned on limits, in NumPy."""
        return _compute_moments_now(self, state)

    def predict_measured(self, prior: PyTree, states: Moments, u: jax.Array, k: jax.Array) -> Moments | None:
        """Return the moments of what the sensor would measure at step k, as a mixture; None where there is no sensor.

        It has a Gaussian for each one of the states' mixture, or for each mode if modes change what is measured.

        Args:
            prior: the filter's state, predicted for step k.
            states: moments of the states then.
            u: inputs of the step (inputs,).
            k: the step.
        """
        if self.sensor is None or self.plant is None:
            return None
        # Modes that change what is measured: the filter expects a signal in each.
        filter, prior_within_limits = _condition_on_limits(self.filter, prior)
        if isinstance(filter, MultipleModelFilter) and memories((self.plant, self.sensor)):
            return _measure_in_each_mode(filter, prior_within_limits, k)
        # The models of step k; `under` gives the sensor for these inputs.
        plant = at(self.plant, k)
        sensor = at(self.sensor, k).under(plant.inputs, u)
        # Of a start that is not known yet some outputs have infinite variances; sensors are linear there.
        if isinstance(prior, Diffuse):
            return _measure_unknown_state(prior, sensor)

        # The sensor's noise, as it was learned where the filter learns it.
        deviations = learned_noise = None
        if isinstance(self.filter, AdaptiveFilter):
            deviations = jnp.asarray(self.filter.noise_deviations(prior, k))
            learned_noise = sensor.noise.columns.through(jnp.diag(deviations))
        initial_power = second_moments_at_start(self.plant)
        outputs = self._measure_each_component(plant, sensor, states, initial_power, learned_noise)
        laws = self._find_output_laws(states, outputs, sensor.noise, deviations)
        # Student's law of at most two degrees has no variance.
        covariances = outputs.covariances
        if isinstance(sensor.noise, StudentT):
            has_no_variance = jnp.full(len(sensor.outputs), jnp.asarray(sensor.noise.degrees) <= 2)
            covariances = jax.vmap(lambda covariance: mark_unknown(covariance, has_no_variance))(covariances)
        return outputs._replace(covariances=covariances, laws=laws)

    def _measure_each_component(
        self,
        plant: AbstractPlant,
        sensor: AbstractSensor,
        states: Moments,
        initial_power: jax.Array,
        learned_noise: WeightedColumns | None,
    ) -> Moments:
        """Return the moments of the sensor's outputs, for each of K Gaussians of the states, with the same weights.

        Args:
            plant: the plant at this step.
            sensor: the sensor at this step.
            states: moments of the states: means (K, n) and covariances (K, n, n).
            initial_power: E[x_i^2] of each state before any data (n,), by which rounding is judged.
            learned_noise: the sensor's noise as the filter has learned it; None for that of the sensor.
        """

        def predict_outputs(mean: jax.Array, covariance: jax.Array) -> tuple[jax.Array, jax.Array]:
            """Return mean and covariance of the outputs from those of the states, for one Gaussian.

            The other arguments of `find_signal_moments`, such as `plant`, `sensor` and `learned_noise`, are those of
            `_measure_each_component`.
            """
            states_law = from_covariance(mean, covariance)
            signal = find_signal_moments(plant, sensor, self.transform, states_law, initial_power, learned_noise)
            return signal.mean, signal.covariance

        means, covariances = jax.vmap(predict_outputs)(states.means, states.covariances)
        return Moments(states.weights, means, covariances)

    def _find_output_laws(
        self, states: Moments, outputs: Moments, noise: AbstractNoise, deviations: jax.Array | None
    ) -> MarginalLaws | None:
        """Return the law of each output if the sensor's noise is a mixture of Gaussians; None if it is Gaussian.

        An output is what is measured without noise, with the variances of `outputs` less those of the noise, plus the
        noise: a Gaussian for each pair of a Gaussian of the states and one of the noise ("branches").

        Args:
            states: moments of the states.
            outputs: moments of the outputs, with the noise.
            noise: the sensor's noise at this step.
            deviations: factors (m,) of its deviations, if the filter learns them; else None.
        """
        branches = noise.branches()
        if not has_branches(branches):
            return None
        noise_variances = noise.columns.diagonal
        if deviations is not None:
            noise_variances = noise_variances * deviations**2
            factor = jnp.asarray(deviations)[:, None]
            branches = branches._replace(mean=branches.mean * factor, variance=branches.variance * factor**2)
        variances = jnp.diagonal(outputs.covariances, axis1=-2, axis2=-1)
        variances_without_noise = jnp.maximum(variances - noise_variances, 0.0)
        return spread_over_branches(states.weights, outputs.means, variances_without_noise, branches)

    def predict_received(self, prior: PyTree, outputs: Moments | None, k: jax.Array) -> Moments | None:
        """Return the moments of the numbers z that would arrive at step k; None if the filter does not predict them.

        The filter's innovation z - E[z] at z = 0 has the value -E[z] and the covariance of z. Noise with outliers is a
        mixture of Gaussians ("branches"), and so is then the law of each number of z (`laws`): a Gaussian with the
        variance of z less that of the noise, plus this noise.

        Args:
            prior: the filter's state, predicted for step k.
            outputs: moments of what the sensor would measure then, or None.
            k: the step.
        """
        if not self.receives:
            return None
        innovation = _find_innovation_of_zero(self.filter, prior, k)
        mean = -jnp.asarray(innovation.value)
        covariance = jnp.asarray(innovation.covariance)
        moments = Moments(weights=jnp.ones(1), means=mean[None], covariances=covariance[None])
        noise = self.received_noise
        if noise is None or outputs is None:
            return moments
        branches = at(noise, k).find_branches(outputs.weights @ outputs.means)
        noise_mean, noise_variance = branches.mean_and_variance()
        variance_without_noise = jnp.maximum(jnp.diagonal(covariance) - noise_variance, 0.0)
        gaussians = GaussianBranches(branches.log_share, branches.mean, branches.variance)
        mean_without_noise = mean - noise_mean  # the branches have means of their own
        laws = spread_over_branches(moments.weights, mean_without_noise[None], variance_without_noise[None], gaussians)
        return moments._replace(laws=laws)

    def predict_step(self, state: PyTree, u: jax.Array, k: jax.Array) -> tuple[PyTree, tuple[Moments | None, ...]]:
        """Return the filter's state predicted over step k, and the moments of the plant there.

        The moments are those of the states, the sensor's outputs and the received numbers, in this order; the last two
        are None where they are not predicted. `u`: inputs of the step (inputs,).
        """
        prior = self.filter.predict(state, u, k)
        states = self.compute_state_moments(prior)
        outputs = self.predict_measured(prior, states, u, k)
        # With an unknown start the outputs are received as they are, since no innovation can be formed.
        received = outputs if isinstance(prior, Diffuse) else self.predict_received(prior, outputs, k)
        return prior, (states, outputs, received)


def _condition_on_limits(filter: AbstractFilter, state: PyTree) -> tuple[AbstractFilter, PyTree]:
    """Return the filter within limits of states, and its state given that these hold; any other filter as it is."""
    return (filter.base, filter.condition_on_limits(state)) if isinstance(filter, LimitedFilter) else (filter, state)


def _measure_in_each_mode(filter: MultipleModelFilter, prior: PyTree, k: jax.Array) -> Moments:
    """Return the moments of the outputs at step k, a mixture with a Gaussian for each mode of the filter.

    Args:
        filter: the filter, which weighs modes by their probability.
        prior: the filter's state, predicted for step k.
        k: the step.
    """
    signal, weights = filter.prior_signals(prior, k)
    covariances = jax.vmap(lambda of_mode: of_mode.covariance)(signal)
    return Moments(weights=weights, means=signal.mean, covariances=covariances)


def _measure_unknown_state(prior: Diffuse, sensor: LinearSensor) -> Moments:
    """Return the moments of the outputs if part of the state is unknown; some variances are then infinite.

    Before the first measurements nothing is known of some states; what a sensor would measure of these has an infinite
    variance.

    Args:
        prior: the filter's predicted state, with a mean, a covariance and the directions that are unknown.
        sensor: the sensor of the step.
    """
    covariance, unknown = project_diffuse(prior, jnp.asarray(sensor.matrix))
    noise = jnp.asarray(sensor.noise.covariance)
    mean = jnp.asarray(sensor.matrix) @ prior.mean + jnp.asarray(sensor.noise.mean)
    return Moments(jnp.ones(1), mean[None], mark_unknown(covariance + noise, unknown)[None])


def _find_innovation_of_zero(filter: AbstractFilter, prior: PyTree, k: jax.Array) -> Innovation:
    """Return the innovation z - E[z] of z = 0, that is -E[z], with the covariance of z, for the predicted state.

    A filter has no function that predicts z, but its correction compares z with that prediction: by z = 0 it becomes
    visible. Filters that are wrapped around another one are taken apart until one predicts z itself.

    Args:
        filter: the filter.
        prior: its state, predicted for step k.
        k: the step.
    """
    filter, prior = _condition_on_limits(filter, prior)
    if isinstance(filter, FilterOfInputs):
        return _find_innovation_of_zero(filter.make_filter_under(prior.u, k), prior.base, k)
    if isinstance(filter, ToldFilter):  # part of z reports the law of the noise, so that z = 0 would report a wrong one
        return filter.expect(prior, k)
    _, innovation = filter.correct(prior, jnp.zeros(filter.received), k)
    if isinstance(filter, RobustFilter):  # Student's noise of at most 2 degrees of freedom has no variance
        has_no_variance = jnp.asarray(at(filter.noise, k).least_degrees) <= 2
        return replace(innovation, covariance=mark_unknown(jnp.asarray(innovation.covariance), has_no_variance))
    return innovation


def make_multistep_predictor(
    filter: AbstractFilter, sensor: AnySensor | None = None, plant: AnyPlant | None = None
) -> MultistepPredictor:
    """Return what predicts a filter's states, the sensor's outputs and the received numbers several steps ahead.

    It takes the plant and sensor for which the filter was made, or the arguments if the filter does not know them.
    Received numbers z are not predicted if the filter receives none, or if it also uses that nothing arrives (a sender
    that decides when to send). Nor are they if z has the number of the channel's mode in it: E[z] is found by a
    correction with z = 0, which would stand for a mode.
    """
    assumed = filter.assumed  # the models for which the filter was made
    plant = plant if assumed is None else assumed.plant
    sensor = sensor if assumed is None or assumed.sensor is None else assumed.sensor
    has_flag_in_z = isinstance(filter, SideInformationFilter) and filter.flagged
    receives_mode = isinstance(filter, ModeObservedFilter) or has_flag_in_z
    transform = getattr(filter, "transform", None)
    return MultistepPredictor(
        filter=filter,
        plant=plant,
        sensor=sensor if plant is not None else None,
        transform=transform if isinstance(transform, AbstractTransform) else Cubature(),
        receives=bool(filter.received) and not filter.silence_tells and not receives_mode,
        received_noise=_find_received_noise(filter),
    )


def _find_received_noise(filter: AbstractFilter) -> ReceivedNoise | OverTime | None:
    """Return the noise with outliers in what a filter receives: that of the sensor and of the channel's last hop.

    Return None if neither has outliers, or if they cannot be separated from the rest of z: the sensor depends on modes
    or inputs, or the channel mixes the noises of several outputs, delays them, or reports more numbers after them.
    """
    assumed = filter.assumed  # the models for which the filter was made
    sensor, channel = (None, None) if assumed is None else (assumed.sensor, assumed.channel)
    if sensor is None or channel is None or memories(sensor):
        return None
    link, sensor_noise = first(channel), first(sensor).noise
    if not isinstance(sensor_noise, AbstractNoise) or link.past or first(sensor).inputs:
        return None
    _, channel_noise = link.detach_outliers()  # the noise of the last hop if it has outliers
    if not sensor_noise.has_outliers and channel_noise is None:
        return None
    try:
        memoryless = without_memory(channel)
        if_it_arrives = at_each_step(lambda step: step.condition_on_arrival() if step.erases else step, memoryless)
        _, noise = separate_outlier_noise(sensor, if_it_arrives, independent=False)
    except ValueError:
        return None
    return noise if len(first(noise).center) == filter.received else None


@compile_on_call
def _compute_moments_now(predictor: MultistepPredictor, state: PyTree) -> Moments:
    """Return the moments of the plant's states in a filter's `state`, before they are conditioned on limits."""
    return predictor.compute_moments_before_limits(state)
