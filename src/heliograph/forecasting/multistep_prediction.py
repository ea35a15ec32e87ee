"""Prediction several steps ahead without data: states, what the sensor would measure, and what would arrive.

A filter's claim is what it says of its covariance: "exact", "upper", "nominal" or "none". Mixtures have K parts.
"""

from dataclasses import replace
from typing import NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.engine.choice import choose_code, compile_on_call, compute_once
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
from heliograph.filters.wrappers.state_limits import LimitedFilter
from heliograph.filters.wrappers.told_link_law import ToldFilter
from heliograph.forecasting.forecast_result import Prediction
from heliograph.model.estimate import Claim, Innovation, weakest
from heliograph.model.over_time import at, first
from heliograph.model.plant import AnyPlant
from heliograph.model.sensor import AnySensor, LinearSensor
from heliograph.numerics.angle import Angles, wrap_angles, wrap_near
from heliograph.numerics.float64 import quickly_compiled, to_numpy
from heliograph.numerics.module import Module
from heliograph.numerics.types import PyTree
from heliograph.random_affine.memories_of_channels import memories
from heliograph.random_affine.outlier_noise import StudentT

BLOCK = 128  # plants side by side under XLA


@runtime_checkable
class HasComponents(Protocol):
    """A filter's state that is a mixture: weights (K,), and Gaussians (K, ...) whose first numbers are the states."""

    @property
    def components(self) -> tuple[jax.Array, Gaussian]:
        """Weights of a mixture's components, and the components as Gaussians."""


class Moments(NamedTuple):
    """Weights (K,), means (K, m) and covariances (K, m, m) of a mixture."""

    weights: jax.Array
    means: jax.Array
    covariances: jax.Array


class MultistepPredictor(Module):
    """How a filter's states are read ahead: by its plant and sensor (None: outputs are not), and its own correction."""

    filter: AbstractFilter
    plant: AnyPlant | None
    sensor: AnySensor | None
    transform: AbstractTransform
    receives: bool = eqx.field(static=True)

    def compute_state_moments(self, state: PyTree) -> Moments:
        """Return the moments of the states as a mixture: the filter's own if it has one, else of one part.

        Covariances are zero where the filter claims nothing.
        """
        filter = self.filter
        if isinstance(filter, LimitedFilter):  # each part within the limits
            state, filter = filter.condition_on_limits(state), filter.base
        if isinstance(state, HasComponents):
            weights, parts = state.components
            parts = take_leading(parts, len(self.filter.states))
            covariances = jnp.asarray(jax.vmap(lambda part: part.covariance)(parts))
            return Moments(weights=weights, means=parts.mean, covariances=covariances)
        estimate = filter.estimate(state)
        covariance = jnp.asarray(estimate.covariance)
        claimed = covariance if self.filter.claim != "none" else jnp.zeros_like(covariance)
        return Moments(weights=jnp.ones(1), means=jnp.asarray(estimate.mean)[None], covariances=claimed[None])

    def moments(self, state: PyTree) -> Moments:
        """Return the moments of the states as they are now, as NumPy arrays."""
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
        if isinstance(self.filter, MultipleModelFilter) and memories((self.plant, self.sensor)):
            signal, weights = self.filter.prior_signals(prior, k)
            covariances = jax.vmap(lambda of_mode: of_mode.covariance)(signal)
            return Moments(weights=weights, means=signal.mean, covariances=covariances)
        plant, initial_moments = at(self.plant, k), second_moments_at_start(self.plant)
        sensor = at(self.sensor, k).under(plant.inputs, u)
        # Of a start that is not known yet some outputs have infinite variances; sensors are linear there.
        if isinstance(prior, Diffuse):
            covariance, unknown = project_diffuse(prior, jnp.asarray(sensor.matrix))
            noise = jnp.asarray(sensor.noise.covariance)
            mean = jnp.asarray(sensor.matrix) @ prior.mean + jnp.asarray(sensor.noise.mean)
            return Moments(jnp.ones(1), mean[None], mark_unknown(covariance + noise, unknown)[None])

        # The sensor's noise, as it was learned where the filter learns it.
        learned_noise: WeightedColumns | None = None
        if isinstance(self.filter, AdaptiveFilter):
            learned_noise = sensor.noise.columns.through(jnp.diag(self.filter.noise_deviations(prior, k)))

        def predict_outputs(mean: jax.Array, covariance: jax.Array) -> tuple[jax.Array, jax.Array]:
            """Return mean and covariance of the outputs, from those of the states, one component of the mixture.

            By the plant and the sensor of step k, and the rule by which moments pass a function that is not linear
            (`self.transform`). `initial_moments`: second moments of the plant's initial law; `learned_noise`: the
            sensor's noise as the filter has learned it, None where it does not.
            """
            states_law = from_covariance(mean, covariance)
            signal = find_signal_moments(plant, sensor, self.transform, states_law, initial_moments, learned_noise)
            return signal.mean, signal.covariance

        means, covariances = jax.vmap(predict_outputs)(states.means, states.covariances)
        # Student's law of at most two degrees has no variance.
        if isinstance(sensor.noise, StudentT):
            endless = jnp.full(len(sensor.outputs), jnp.asarray(sensor.noise.degrees) <= 2)
            covariances = jax.vmap(lambda covariance: mark_unknown(covariance, endless))(covariances)
        return Moments(weights=states.weights, means=means, covariances=covariances)

    def predict_received(self, prior: PyTree, k: jax.Array) -> Moments | None:
        """Return the moments of what would arrive at step k, by the predicted state; None if the filter cannot tell."""
        if not self.receives:
            return None
        innovation = _expect(self.filter, prior, k)  # of z = 0
        mean, covariance = -jnp.asarray(innovation.value), jnp.asarray(innovation.covariance)
        return Moments(weights=jnp.ones(1), means=mean[None], covariances=covariance[None])

    def predict_step(self, state: PyTree, u: jax.Array, k: jax.Array) -> tuple[PyTree, tuple[Moments | None, ...]]:
        """Predict over step k; return the state there, and the moments of states, outputs and received numbers."""
        prior = self.filter.predict(state, u, k)
        states = self.compute_state_moments(prior)
        outputs = self.predict_measured(prior, states, u, k)
        # From an unknown start the sensor is received as it is, and there is no innovation of what nobody knows.
        received = outputs if isinstance(prior, Diffuse) else self.predict_received(prior, k)
        return prior, (states, outputs, received)


def _expect(filter: AbstractFilter, prior: PyTree, k: jax.Array) -> Innovation:
    """Return the innovation of z = 0 at step k: minus what is expected, with the covariance of what arrives."""
    if isinstance(filter, LimitedFilter):
        return _expect(filter.base, filter.hold(prior), k)
    if isinstance(filter, ToldFilter):  # part of z says which law of noise holds: zeros would say one
        return filter.expect(prior, k)
    _, innovation = filter.correct(prior, jnp.zeros(filter.received), k)
    if isinstance(filter, RobustFilter):  # whose law of noise may have no variance
        has_none = jnp.asarray(at(filter.noise, k).degrees) <= 2
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
    )


@compile_on_call
def _compute_moments_now(outlook: MultistepPredictor, state: PyTree) -> Moments:
    """Return the moments of the states at the row where the outlook begins."""
    return outlook.compute_state_moments(state)


def predict_moments(
    outlook: MultistepPredictor, state: PyTree, u: np.ndarray, step: int | np.ndarray
) -> tuple[Moments | None, ...]:
    """Return the moments of states, outputs and what arrives at each row ahead (rows, K, ...).

    By native code where it supports the filter. `state`: that of the filter at `step`; `u`: inputs (rows, inputs).
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
        choice = choose_code(_predict_moments, (outlook, *arguments), [False, True, True, True])
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

    From a state at `step`, under inputs `u` (steps, inputs).
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


def make_prediction(moments: Moments, names: tuple[str, ...], claim: Claim, angles: Angles) -> Prediction:
    """Return the prediction of a mixture of K Gaussians at each horizon, its angles between -pi and pi.

    `moments`: weights (..., horizons, K), means (..., horizons, K, m) and covariances (..., horizons, K, m, m).
    """
    weights, means, covariances = map(np.asarray, moments)
    variances = np.maximum(np.diagonal(covariances, axis1=-2, axis2=-1), 0.0)
    means = wrap_near(means, means[..., :1, :], angles)  # within half a turn of the first part, to be averaged
    # First two moments of the mixture: within its parts, and between their means.
    mean = np.einsum("...k,...km->...m", weights, means)
    apart = means - mean[..., None, :]
    within = np.einsum("...k,...kij->...ij", weights, covariances)
    covariance = within + np.einsum("...k,...ki,...kj->...ij", weights, apart, apart)
    if claim == "none":
        covariance, variances = np.full_like(covariance, np.nan), np.full_like(variances, np.nan)
    wrapped = wrap_angles(mean, angles)
    whole_turns = (wrapped - mean)[..., None, :]
    return Prediction(
        names=names,
        mean=wrapped,
        covariance=covariance,
        claim=claim,
        weights=weights,
        part_means=means + whole_turns,
        part_variances=variances,
    )


def find_output_claim(filter: AbstractFilter, outlook: MultistepPredictor) -> Claim:
    """Return the claim of predicted outputs: that of the states behind a linear sensor, else nominal at most.

    A claim says how far the covariance holds: by a sensor that is not linear, or by angles, it is approximate.
    """
    sensor = first(outlook.sensor)
    is_exact = isinstance(sensor, LinearSensor) and not sensor.circular
    return filter.claim if is_exact or filter.claim == "none" else weakest([filter.claim, "nominal"])


def find_received_claim(filter: AbstractFilter) -> Claim:
    """Return the claim of what is predicted to arrive: the filter's, but nominal by numbers that are only typical.

    ToldFilter: some of the numbers that arrive say the law of noise. What they will be is not known ahead; typical
    ones are put for them unless their own law is known.
    """
    base = filter.base if isinstance(filter, LimitedFilter) else filter
    if isinstance(base, ToldFilter) and not base.knows_law_of_numbers and filter.claim != "none":
        return weakest([filter.claim, "nominal"])
    return filter.claim
