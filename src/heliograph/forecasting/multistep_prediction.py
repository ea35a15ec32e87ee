"""Prediction several steps ahead without data: states, what the sensor would measure, and what would arrive.

A filter's claim is what it says of its covariance: "exact", "upper", "nominal" or "none". Mixtures have K parts.
"""

from dataclasses import replace
from typing import Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.engine.choice import choose_code, compile_on_call, compute_once
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
from heliograph.model.estimate import Claim, Innovation, weakest
from heliograph.model.fading import without_memory
from heliograph.model.over_time import OverTime, at, at_each_step, first
from heliograph.model.plant import AnyPlant
from heliograph.model.sensor import AnySensor, LinearSensor
from heliograph.numerics.float64 import quickly_compiled, to_numpy
from heliograph.numerics.module import Module
from heliograph.numerics.types import PyTree
from heliograph.random_affine.memories_of_channels import memories
from heliograph.random_affine.moments.mixture_components import GaussianBranches
from heliograph.random_affine.noise import AbstractNoise
from heliograph.random_affine.outlier_noise import StudentT

BLOCK = 128  # plants side by side under XLA


@runtime_checkable
class HasComponents(Protocol):
    """A filter's state that is a mixture: weights (K,), and Gaussians (K, ...) whose first numbers are the states."""

    @property
    def components(self) -> tuple[jax.Array, Gaussian]:
        """Weights of a mixture's components, and the components as Gaussians."""


class MultistepPredictor(Module):
    """How a filter's states are read ahead: by its plant and sensor (None: outputs are not), and its own correction."""

    filter: AbstractFilter
    plant: AnyPlant | None
    sensor: AnySensor | None
    transform: AbstractTransform
    receives: bool = eqx.field(static=True)
    received_noise: ReceivedNoise | OverTime | None

    def compute_state_moments(self, state: PyTree) -> Moments:
        """Return the moments of the states as a mixture: the filter's own if it has one, else with one part.

        Covariances are zero if the filter claims nothing. For states with limits, the moments are those within the
        limits.
        """
        filter = self.filter
        if not isinstance(filter, LimitedFilter):
            return self._read_moments(filter, state)
        moments = self._read_moments(filter.base, filter.condition_on_limits(state))
        # The law of each limited state: Gaussians given the limits of other states, which are then cut to its own.
        means, variances = moments.means, jnp.diagonal(moments.covariances, axis1=-2, axis2=-1)
        for place, *_ in filter.limits:
            beside = self._read_moments(filter.base, filter.condition_on_limits(filter.hold(state), without=place))
            means = means.at[:, place].set(beside.means[:, place])
            variances = variances.at[:, place].set(beside.covariances[:, place, place])
        weights = jnp.broadcast_to(moments.weights[:, None], means.shape)
        return moments._replace(laws=MarginalLaws(weights=weights, means=means, variances=variances))

    def compute_moments_before_limits(self, state: PyTree) -> Moments:
        """Return the moments of the states without regard to their limits, except for the weights of the parts."""
        filter = self.filter
        if not isinstance(filter, LimitedFilter):
            return self._read_moments(filter, state)
        weights = self._read_moments(filter.base, filter.condition_on_limits(state)).weights
        return self._read_moments(filter.base, filter.hold(state))._replace(weights=weights)

    def _read_moments(self, filter: AbstractFilter, state: PyTree) -> Moments:
        """Return the moments of the states, as the filter's state holds them."""
        if isinstance(state, HasComponents):
            weights, parts = state.components
            parts = take_leading(parts, len(self.filter.states))
            covariances = jnp.asarray(jax.vmap(lambda part: part.covariance)(parts))
            return Moments(weights=weights, means=parts.mean, covariances=covariances)
        estimate = filter.estimate(state)
        covariance = jnp.asarray(estimate.covariance)
        claimed = covariance if self.filter.claim != "none" else jnp.zeros_like(covariance)
        return Moments(weights=jnp.ones(1), means=jnp.asarray(estimate.mean)[None], covariances=claimed[None])

    @property
    def limits(self) -> PlacedLimits:
        """Index, lowest and highest value of each state with limits that the filter knows."""
        return self.filter.limits if isinstance(self.filter, LimitedFilter) else ()

    def moments(self, state: PyTree) -> Moments:
        """Return the moments of the states as they are now, without regard to limits, as NumPy arrays."""
        return _compute_moments_now(self, state)

    def predict_measured(self, prior: PyTree, states: Moments, u: jax.Array, k: jax.Array) -> Moments | None:
        """Return the moments of what the sensor would measure at step k, as a mixture; None where there is no sensor.

        There is a part for each part of the states, or if modes change what is measured for each mode.

        Args:
            prior: the filter's state, predicted for step k.
            states: moments of the states then.
            u: inputs of the step (inputs,).
            k: the step.
        """
        if self.sensor is None or self.plant is None:
            return None
        # Modes that change what is measured: the filter expects a signal in each.
        filter, within = _condition_on_limits(self.filter, prior)
        if isinstance(filter, MultipleModelFilter) and memories((self.plant, self.sensor)):
            return _measure_in_each_mode(filter, within, k)
        plant, initial_moments = at(self.plant, k), second_moments_at_start(self.plant)
        sensor = at(self.sensor, k).under(plant.inputs, u)
        # Of a start that is not known yet some outputs have infinite variances; sensors are linear there.
        if isinstance(prior, Diffuse):
            return _measure_unknown_state(prior, sensor)

        # The sensor's noise, as it was learned where the filter learns it.
        deviations = None
        learned_noise = None
        if isinstance(self.filter, AdaptiveFilter):
            deviations = jnp.asarray(self.filter.noise_deviations(prior, k))
            learned_noise = sensor.noise.columns.through(jnp.diag(deviations))

        def predict_outputs(mean: jax.Array, covariance: jax.Array) -> tuple[jax.Array, jax.Array]:
            """Return mean and covariance of the outputs from those of the states, for one component of the mixture.

            They use the plant and the sensor of step k, and the rule by which moments pass a nonlinear function
            (`self.transform`). `initial_moments`: second moments of the plant's initial law. `learned_noise`: the
            sensor's noise as the filter has learned it, or None.
            """
            states_law = from_covariance(mean, covariance)
            signal = find_signal_moments(plant, sensor, self.transform, states_law, initial_moments, learned_noise)
            return signal.mean, signal.covariance

        means, covariances = jax.vmap(predict_outputs)(states.means, states.covariances)
        outputs = Moments(states.weights, means, covariances)
        laws = self._find_output_laws(states, outputs, sensor.noise, deviations)
        # Student's law of at most two degrees has no variance.
        if isinstance(sensor.noise, StudentT):
            endless = jnp.full(len(sensor.outputs), jnp.asarray(sensor.noise.degrees) <= 2)
            covariances = jax.vmap(lambda covariance: mark_unknown(covariance, endless))(covariances)
        return outputs._replace(covariances=covariances, laws=laws)

    def _find_output_laws(
        self, states: Moments, outputs: Moments, noise: AbstractNoise, deviations: jax.Array | None
    ) -> MarginalLaws | None:
        """Return the law of each output if the sensor's noise is a mixture of Gaussians; None if it is Gaussian.

        Args:
            states: moments of the states.
            outputs: moments of the outputs, with the noise.
            noise: the sensor's noise at this step.
            deviations: factors (m,) of its deviations, if the filter learns them; else None.
        """
        branches = noise.branches()
        if not has_branches(branches):
            return None
        variance = noise.columns.diagonal
        if deviations is not None:
            variance = variance * deviations**2
            wider = jnp.asarray(deviations)[:, None]
            branches = branches._replace(mean=branches.mean * wider, variance=branches.variance * wider**2)
        rest = jnp.maximum(jnp.diagonal(outputs.covariances, axis1=-2, axis2=-1) - variance, 0.0)
        return spread_over_branches(states.weights, outputs.means, rest, branches)

    def predict_received(self, prior: PyTree, outputs: Moments | None, k: jax.Array) -> Moments | None:
        """Return the moments of what would arrive at step k, by the predicted state; None if the filter cannot tell.

        `outputs`: moments of what the sensor would measure; None where that is not known.
        """
        if not self.receives:
            return None
        innovation = _expect(self.filter, prior, k)  # of z = 0
        mean, covariance = -jnp.asarray(innovation.value), jnp.asarray(innovation.covariance)
        moments = Moments(weights=jnp.ones(1), means=mean[None], covariances=covariance[None])
        noise = self.received_noise
        if noise is None or outputs is None:
            return moments
        # The noise's variance, which is in the covariance, in branches.
        branches = at(noise, k).find_branches(outputs.weights @ outputs.means)
        center, variance = branches.mean_and_variance()
        rest = jnp.maximum(jnp.diagonal(covariance) - variance, 0.0)
        gaussians = GaussianBranches(branches.log_share, branches.mean, branches.variance)
        laws = spread_over_branches(moments.weights, (mean - center)[None], rest[None], gaussians)
        return moments._replace(laws=laws)

    def predict_step(self, state: PyTree, u: jax.Array, k: jax.Array) -> tuple[PyTree, tuple[Moments | None, ...]]:
        """Return the state predicted over step k, and the moments of states, outputs and received numbers there."""
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
    """Return the moments of the outputs at step k, a part for each mode."""
    signal, weights = filter.prior_signals(prior, k)
    covariances = jax.vmap(lambda of_mode: of_mode.covariance)(signal)
    return Moments(weights=weights, means=signal.mean, covariances=covariances)


def _measure_unknown_state(prior: Diffuse, sensor: LinearSensor) -> Moments:
    """Return the moments of the outputs if part of the state is unknown; some variances are then infinite."""
    covariance, unknown = project_diffuse(prior, jnp.asarray(sensor.matrix))
    noise = jnp.asarray(sensor.noise.covariance)
    mean = jnp.asarray(sensor.matrix) @ prior.mean + jnp.asarray(sensor.noise.mean)
    return Moments(jnp.ones(1), mean[None], mark_unknown(covariance + noise, unknown)[None])


def _expect(filter: AbstractFilter, prior: PyTree, k: jax.Array) -> Innovation:
    """Return the innovation of z = 0 at step k, which is minus the expected z, with the covariance of what arrives."""
    filter, prior = _condition_on_limits(filter, prior)
    if isinstance(filter, FilterOfInputs):
        return _expect(filter.make_filter_under(prior.u, k), prior.base, k)
    if isinstance(filter, ToldFilter):  # part of z tells the law of noise, so that z = 0 would tell a wrong one
        return filter.expect(prior, k)
    _, innovation = filter.correct(prior, jnp.zeros(filter.received), k)
    if isinstance(filter, RobustFilter):  # its law of noise may have no variance
        has_none = jnp.asarray(at(filter.noise, k).least_degrees) <= 2
        return replace(innovation, covariance=mark_unknown(jnp.asarray(innovation.covariance), has_none))
    return innovation


def make_multistep_predictor(
    filter: AbstractFilter, sensor: AnySensor | None = None, plant: AnyPlant | None = None
) -> MultistepPredictor:
    """Return the outlook of a filter, by the plant and sensor that it believes in, or by these if it does not say."""
    premise = filter.premise
    plant = plant if premise is None else premise.plant
    believed = sensor if premise is None or premise.sensor is None else premise.sensor
    # Such a filter is told the mode in z: the zeros by which `predict_received` asks what is expected would be a mode.
    flagged = isinstance(filter, ModeObservedFilter) or (isinstance(filter, SideInformationFilter) and filter.flagged)
    transform = getattr(filter, "transform", None)
    return MultistepPredictor(
        filter=filter,
        plant=plant,
        sensor=believed if plant is not None else None,
        transform=transform if isinstance(transform, AbstractTransform) else Cubature(),
        receives=bool(filter.received) and not filter.silence_tells and not flagged,
        received_noise=_find_received_noise(filter),
    )


def _find_received_noise(filter: AbstractFilter) -> ReceivedNoise | OverTime | None:
    """Return the noise with outliers in what a filter receives, of sensor and last hop; None where there is none.

    Nor is there one to be told apart where the channel mixes the noises of several outputs, brings past ones, or
    tells numbers.
    """
    premise = filter.premise
    sensor, channel = (None, None) if premise is None else (premise.sensor, premise.channel)
    if sensor is None or channel is None or memories(sensor):
        return None
    link, law = first(channel), first(sensor).noise
    is_described = isinstance(law, AbstractNoise) and not link.past and not first(sensor).inputs
    if not is_described or not (law.has_outliers or link.detach_outliers()[1] is not None):
        return None
    try:
        # A channel that loses, as it is given that what it sends arrives.
        fresh = without_memory(channel)
        arriving = at_each_step(lambda step: step.condition_on_arrival() if step.erases else step, fresh)
        noise = separate_outlier_noise(sensor, arriving, independent=False)[1]
    except ValueError:
        return None
    return noise if len(first(noise).center) == filter.received else None


@compile_on_call
def _compute_moments_now(outlook: MultistepPredictor, state: PyTree) -> Moments:
    """Return the moments of the states at the row where the outlook begins."""
    return outlook.compute_moments_before_limits(state)


def predict_moments(
    outlook: MultistepPredictor, state: PyTree, u: np.ndarray, step: int | np.ndarray
) -> tuple[Moments | None, ...]:
    """Return the moments of states, outputs and what arrives at each row ahead (rows, K, ...).

    Native code computes them if it supports the filter. `state`: the filter's state at `step`. `u`: inputs
    (rows, inputs).
    """
    arguments = outlook, state, np.asarray(u, dtype=float), np.asarray(step)
    moments: tuple[Moments | None, ...] = compute_once(_predict_moments, _by_xla, arguments)
    return moments


def predict_moments_of_each(
    outlook: MultistepPredictor, state: PyTree, u: np.ndarray, step: int | np.ndarray
) -> tuple[Moments | None, ...]:
    """Return the moments of several plants at each row ahead (plants, rows, K, ...), computed side by side.

    state, u and step lead with an axis over the plants.
    """
    arguments = jax.tree.map(np.asarray, (state, np.asarray(u, dtype=float), step))
    with jax.enable_x64(True):
        choice = choose_code(_predict_moments, (outlook, *arguments), differs_by_run=[False, True, True, True])
        if choice.code is not None:
            found: tuple[Moments | None, ...] = choice.results()
            return found
        # By XLA in blocks of one size, the last filled up with its last plant.
        count = len(u)
        blocks = [
            to_numpy(_each_by_xla(outlook, *jax.tree.map(lambda a, rows=rows: a[rows], arguments)))
            for begin in range(0, count, BLOCK)
            for rows in (np.minimum(np.arange(begin, begin + BLOCK), count - 1),)
        ]
    return jax.tree.map(lambda *parts: np.concatenate(parts)[:count], *blocks)  # type: ignore[no-any-return]


def _predict_moments(outlook: MultistepPredictor, state: PyTree, u: jax.Array, step: jax.Array) -> PyTree:
    """Return the moments of states, outputs and what arrives at each step ahead (steps, K, ...).

    They start from a state at `step`, under inputs `u` (steps, inputs).
    """

    def predict_row(state: PyTree, row: tuple[jax.Array, jax.Array]) -> tuple[PyTree, PyTree]:
        """Return the state a row ahead, and the moments there."""
        return outlook.predict_step(state, *row)

    rows = jnp.asarray(u), jnp.asarray(step) + jnp.arange(len(u))
    _, moments = jax.lax.scan(predict_row, jax.tree.map(jnp.asarray, state), rows)
    return moments


def _predict_moments_of_each(outlook: MultistepPredictor, states: PyTree, u: jax.Array, steps: jax.Array) -> PyTree:
    """Return the moments of each step ahead for several plants, whose states, inputs and steps have a leading axis."""
    return jax.vmap(lambda *plant: _predict_moments(outlook, *plant))(states, u, steps)


_by_xla, _each_by_xla = quickly_compiled(_predict_moments), quickly_compiled(_predict_moments_of_each)


def find_output_claim(filter: AbstractFilter, outlook: MultistepPredictor) -> Claim:
    """Return the claim of predicted outputs: that of the states for a linear sensor, else "nominal" at most.

    With a nonlinear sensor, or with angles, the covariance is approximate.
    """
    sensor = first(outlook.sensor)
    is_exact = isinstance(sensor, LinearSensor) and not sensor.circular
    return filter.claim if is_exact or filter.claim == "none" else weakest([filter.claim, "nominal"])


def find_received_claim(filter: AbstractFilter) -> Claim:
    """Return the claim of what is predicted to arrive: the filter's, or "nominal" if typical numbers stand for unknown.

    A ToldFilter receives numbers that tell the law of noise. They are not known ahead, so typical ones replace them
    unless their own law is known.
    """
    base = filter
    while isinstance(base, LimitedFilter | FilterOfInputs):
        base = base.base
    if isinstance(base, ToldFilter) and not base.knows_law_of_numbers and filter.claim != "none":
        return weakest([filter.claim, "nominal"])
    return filter.claim
