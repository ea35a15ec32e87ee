"""Gaussian filter: mean and covariance by a transform (cubature, Jacobian), on the channel's second moments."""

import equinox as eqx
import jax
import jax.numpy as jnp

from heliograph.factors.changes import settle
from heliograph.factors.gaussian import Gaussian
from heliograph.filters.base import (
    AbstractFilter,
    FilterAngles,
    Step,
    corrects,
    make_sizes,
)
from heliograph.filters.gaussian.belief import AbstractBeliefFilter, prior_of, second_moments_at_start
from heliograph.filters.gaussian.centred import center_filter
from heliograph.filters.gaussian.diffuse import DiffuseFilter, diffuse_filter, has_unknown_start
from heliograph.filters.gaussian.signal import (
    ArrivedInnovation,
    Signal,
    condition_on_measurement,
    make_received_noise,
    signal_of,
)
from heliograph.filters.gaussian.transform import AbstractTransform, Cubature, Linearization
from heliograph.filters.gaussian.update import AbstractUpdate, Polytope
from heliograph.filters.linear.plan import plan_filter
from heliograph.filters.wrappers.limited import keeps_limits
from heliograph.filters.wrappers.sensor_inputs import takes_sensor_inputs
from heliograph.filters.wrappers.told import takes_told
from heliograph.model.channel import Channel, check_link, find_received_angles, mean_gain, perfect
from heliograph.model.estimate import Innovation, lower_by_noise
from heliograph.model.fading import memory_matters, without_memory
from heliograph.model.over_time import OverTime, at, at_each_step, first, unstack
from heliograph.model.plant import AnyPlant, check_plant
from heliograph.model.premises.premise import Premise, believing
from heliograph.model.sensor import SEVERAL_TAKEN_BY, AbstractSensor, AnySensor, is_linear
from heliograph.numerics.angle import Angles, nearest
from heliograph.numerics.check import fail, instance
from heliograph.numerics.float64 import compile_in_float64
from heliograph.numerics.types import Array, ArrayLike, Float
from heliograph.random_affine.memory import is_modal
from heliograph.random_affine.moments.second_moments import SecondOrder, has_random_gain


class GaussianFilter(AbstractBeliefFilter):
    """Predict by a transform, redraw, measure by the same transform, correct by an update that knows the channel.

    A linear plant or sensor needs no transform: its moments are exact.

    `channel` is the filter's model; the world may have another. Its innovation covariance is M Cov(y) M' plus the
    spread of the random gain under the nominal law; its likelihood is Gaussian with it, whatever the update bounds.

    `linear`: plant and sensor are, no gain is random and nothing is an angle, so that nothing but the mean depends on
    data. `observed_angles`: which components of z are angles; z is then read within half a turn of its expectation.
    """

    sensor: AnySensor
    channel: SecondOrder | OverTime
    rule: AbstractUpdate
    linear: bool = eqx.field(static=True)
    observed_angles: Angles = eqx.field(static=True)

    @property
    def attitude(self) -> Angles:
        """Return the places of the plant's attitudes, which it turns."""
        places: Angles = first(self.plant).manifold.rotations
        return places

    def angles_used(self) -> FilterAngles:
        """Return the angles of its plant, and those that its channel delivers."""
        return FilterAngles(first(self.plant).angles, self.observed_angles)

    def predict_signal(self, state: Gaussian, k: Step) -> Signal:
        """Return the moments of the sensor's signal y at step k, from the state before its measurement."""
        plant, sensor = at(self.plant, k), at(self.sensor, k)
        return signal_of(plant, sensor, self.transform, state, second_moments_at_start(self.plant, self))

    @compile_in_float64
    def expect_signals(
        self, z: Float[Array, "*runs steps m"], u: Float[Array, "steps inputs"]
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Return mean (steps, p) and covariance (steps, p, p) of the signal before each row, and z (angles near them).

        Args:
            z: measurements of a run, or of several.
            u: inputs, the same of all runs.
        """

        def step(state: Gaussian, row: tuple[jax.Array, ...]) -> tuple[Gaussian, tuple[jax.Array, ...]]:
            k, z_k, u_k = row
            prior = self.predict(state, u_k, k)
            channel, y = at(self.channel, k), self.predict_signal(prior, k)
            near = nearest(z_k, channel.mean_gain @ y.mean + channel.offset, self.observed_angles)
            return self.correct(prior, z_k, k)[0], (y.mean, y.covariance, near)

        def expect(z: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
            start, rows = jax.tree.map(jnp.asarray, self.init()), (jnp.arange(len(z)), z, jnp.asarray(u))
            mean, covariance, near = jax.lax.scan(step, start, rows)[1]
            return mean, covariance, near

        several_runs = jnp.ndim(z) == 3
        return (jax.vmap(expect) if several_runs else expect)(jnp.asarray(z))

    @corrects
    def correct(self, state: Gaussian, z: ArrayLike, k: Step = 0) -> tuple[Gaussian, Innovation]:
        """Correct with the measurement; the points are redrawn from the prediction for both sides of the covariance."""
        channel, signal = at(self.channel, k), self.predict_signal(state, k)
        unknown = signal.about_mean() if self.linear else signal
        after, innovation = correct_signal(signal, channel, self.rule, jnp.asarray(z), self.observed_angles, unknown)
        return settle(at(self.plant, k).manifold, state.mean, after), innovation

    @property
    def is_linear(self) -> bool:
        """True where the gains depend on no data."""
        return self.linear

    def for_single_precision(self) -> AbstractFilter:
        """Return the filter about an origin that moves."""
        return center_filter(self)

    def planned(self, inputs: Float[Array, "horizon inputs"]) -> AbstractFilter:
        """Precompute all covariances and gains, where they do not depend on data."""
        return plan_filter(self, inputs) if self.linear else self


def correct_signal(
    signal: Signal,
    channel: SecondOrder,
    rule: AbstractUpdate,
    z: jax.Array,
    angles: Angles = (),
    unknown: Signal | None = None,
) -> tuple[Gaussian, Innovation]:
    """Condition a signal's prior on the components of z that arrived; without any, it stays as it is.

    `unknown`: what of the signal decides gain and covariance, where that is less than all. The innovation has the
    covariance and the density of the nominal law, whatever the rule bounds.
    """
    unknown = signal if unknown is None else unknown
    expected = jnp.asarray(channel.mean_gain @ signal.mean + channel.offset)
    # By the nominal law: the best update of a known one.
    slopes, noise = jnp.asarray(channel.mean_gain) @ unknown.slopes, make_received_noise(unknown, channel)
    nominal, innovation = condition_on_measurement(unknown.prior, slopes, noise, z, expected, angles)
    received = ArrivedInnovation(jnp.asarray(innovation.value), ~jnp.isnan(z))
    return rule.condition(unknown, channel, received, nominal), innovation


def describe_channel_moments(channel: Channel, update: AbstractUpdate) -> SecondOrder | OverTime:
    """Describe the channel's second moments in the form of the update, for each step where it varies."""
    described: SecondOrder | OverTime = at_each_step(update.describe, channel)
    return described


def make_perfect_channel(sensor: AnySensor) -> Channel:
    """Return the channel that delivers all outputs of a sensor as they are."""
    return perfect(len(instance("sensor", first(sensor), AbstractSensor, "a Sensor or LinearSensor").outputs))


def _make_gaussian_filter(
    plant: AnyPlant,
    sensor: AnySensor,
    channel: Channel | None,
    transform: AbstractTransform,
    update: AbstractUpdate,
    initial_mean: ArrayLike | None,
    initial_covariance: ArrayLike | None,
    trusted: bool,
) -> GaussianFilter:
    """Return the Gaussian filter of checked parts, on the channel's second moments without its memory, with its claim.

    `trusted`: whether the channel is the true one, so that more than "nominal" may be claimed.
    """
    start = check_plant(plant)
    instance("update", update, AbstractUpdate, "one such as Polytope()")
    channel = make_perfect_channel(sensor) if channel is None else channel
    check_link(first(sensor), first(channel), len(start.states))
    angles = find_received_angles(plant, sensor, channel)
    mean, spread, prior_given = prior_of(start, initial_mean, initial_covariance)
    # Moments of the channel, its memory ignored.
    premise = Premise(plant, sensor, channel)
    trusted = trusted and not memory_matters(channel)
    channel = without_memory(channel)
    described = describe_channel_moments(channel, update)
    pairs = zip(unstack(channel), unstack(described), strict=True)
    # The Kalman filter is exact: linear, no random gain, no angle.
    on_line = not start.circular and not first(sensor).circular  # an attitude has no linear plant
    linear = on_line and is_linear(plant, sensor) and not any(has_random_gain(c, s) for c, s in pairs)
    claim = update.claim(uncertain=False) if linear and trusted and not prior_given else "nominal"
    claim = lower_by_noise(claim, plant, sensor, channel)
    filter = GaussianFilter(
        plant=plant,
        sensor=sensor,
        channel=described,
        transform=transform,
        rule=update.described(),
        initial_mean=mean,
        initial_covariance=spread,
        linear=linear,
        observed_angles=angles,
        **make_sizes(claim, start, first(channel).outputs),
    )
    return believing(filter, premise)


@keeps_limits
@takes_sensor_inputs
@takes_told
def gaussian_filter(
    plant: AnyPlant,
    sensor: AnySensor,
    channel: Channel | None,
    transform: "AbstractTransform",
    update: "AbstractUpdate | None" = None,
    initial_mean: Float[ArrayLike, " n"] | None = None,
    initial_covariance: Float[ArrayLike, "n n"] | None = None,
) -> "GaussianFilter":
    """Return the Gaussian filter on its channel's second moments with any transform, such as `PolynomialMoments(2)`.

    Args:
        plant: the plant, n states.
        sensor: its sensor, m outputs.
        channel: from the sensor to the filter, None for one that delivers everything as it is. The memory of a
            channel is ignored: where it matters, the claim is nominal.
        transform: moments of a nonlinear function; a linear plant or sensor needs none.
        update: how an uncertain channel is bounded; `Polytope()` by default.
        initial_mean: mean (n,) of the first state; the plant's by default.
        initial_covariance: its covariance (n, n); the plant's by default.

    Claim: "nominal"; "exact" where plant and sensor are linear, no gain is random and the initial law is the plant's
    (then it is the Kalman filter).

    Raises:
        ValueError: sensor, channel and plant that do not fit, an initial covariance that is none, what is no transform
            or update.

    Source: cubature fusion under amplify-and-forward relays, Section III.
    """
    instance("transform", transform, AbstractTransform, "one such as Cubature()")
    rule = Polytope() if update is None else instance("update", update, AbstractUpdate, "one such as Polytope()")
    return _make_gaussian_filter(
        plant, sensor, channel, transform, rule, initial_mean, initial_covariance, trusted=True
    )


@keeps_limits
@takes_sensor_inputs
@takes_told
def cubature_filter(
    plant: AnyPlant,
    sensor: AnySensor,
    channel: Channel | None = None,
    update: "AbstractUpdate | None" = None,
    initial_mean: Float[ArrayLike, " n"] | None = None,
    initial_covariance: Float[ArrayLike, "n n"] | None = None,
) -> "GaussianFilter":
    """Return the cubature Kalman filter on its channel's second moments.

    Args:
        plant: the plant, n states.
        sensor: its sensor, m outputs.
        channel: from the sensor to the filter, by default all arrives as it is. The memory of a channel
            is ignored: where it matters, the claim is nominal.
        update: how an uncertain channel is bounded; `Polytope()` by default.
        initial_mean: mean (n,) of the first state; the plant's by default.
        initial_covariance: its covariance (n, n); the plant's by default.

    Claim: "nominal"; "exact" where plant and sensor are linear, no gain is random and the initial law is the plant's
    (then it is the Kalman filter).

    Raises:
        ValueError: sensor, channel and plant that do not fit, or an initial covariance that is none.

    Source: cubature fusion under amplify-and-forward relays, Section III.
    """
    return gaussian_filter(plant, sensor, channel, Cubature(), update, initial_mean, initial_covariance)


@keeps_limits
@takes_sensor_inputs
@takes_told
def extended_filter(
    plant: AnyPlant,
    sensor: AnySensor,
    channel: Channel | None = None,
    update: "AbstractUpdate | None" = None,
    initial_mean: Float[ArrayLike, " n"] | None = None,
    initial_covariance: Float[ArrayLike, "n n"] | None = None,
) -> "GaussianFilter":
    """Return the extended Kalman filter on its channel's second moments; Jacobians by automatic differentiation.

    Args:
        plant: the plant, n states.
        sensor: its sensor, m outputs.
        channel: from the sensor to the filter; by default all arrives as it is.
        update: how an uncertain channel is bounded; `Polytope()` by default.
        initial_mean: mean (n,) of the first state; the plant's by default.
        initial_covariance: its covariance (n, n); the plant's by default.

    Claim: as `cubature_filter`.

    Raises:
        ValueError: sensor, channel and plant that do not fit, or an initial covariance that is none.

    Source: cubature fusion under amplify-and-forward relays, Section IV (the filter compared with).
    """
    return gaussian_filter(plant, sensor, channel, Linearization(), update, initial_mean, initial_covariance)


@keeps_limits
def mean_gain_filter(
    plant: AnyPlant,
    sensor: AnySensor,
    channel: Channel,
    initial_mean: Float[ArrayLike, " n"] | None = None,
    initial_covariance: Float[ArrayLike, "n n"] | None = None,
) -> GaussianFilter:
    """Return the cubature filter that takes the mean gain for the gain: the naive filter, as a baseline.

    Args:
        plant: the plant, n states.
        sensor: its sensor, m outputs.
        channel: from the sensor to the filter; only its mean gain is used.
        initial_mean: mean (n,) of the first state; the plant's by default.
        initial_covariance: its covariance (n, n); the plant's by default.

    Claim: "nominal", and far too small where gains are random.

    Raises:
        ValueError: sensor, channel and plant that do not fit, or an initial covariance that is none.

    Source: cubature fusion under amplify-and-forward relays, with every gain replaced by its mean.
    """
    believed = mean_gain(without_memory(channel))
    return _make_gaussian_filter(
        plant, sensor, believed, Cubature(), Polytope(), initial_mean, initial_covariance, trusted=False
    )


def gaussian_filter_of(
    name: str, plant: AnyPlant, sensor: AnySensor, channel: Channel, transform: AbstractTransform, rule: AbstractUpdate
) -> GaussianFilter:
    """Return the Gaussian filter that another one stands on, refused behind a link of which anything is told.

    Args:
        name: of the other filter, in the refusal.
        plant: the plant.
        sensor: its sensor.
        channel: from the sensor to the filter.
        transform: moments of a nonlinear function.
        rule: how an uncertain channel is bounded.
    """
    filter = gaussian_filter(plant, sensor, channel, transform, rule)
    return instance(f"channel of a {name}", filter, GaussianFilter, "one of which nothing is told")


MATRICES = ", of matrices kalman_filter(*hg.state_space(F, H, Q, R, mean, covariance))"


@keeps_limits
@takes_sensor_inputs
def kalman_filter(
    plant: AnyPlant,
    sensor: AnySensor,
    initial_mean: Float[ArrayLike, " n"] | None = None,
    initial_covariance: Float[ArrayLike, "n n"] | None = None,
) -> GaussianFilter | DiffuseFilter:
    """Return the Kalman filter of a linear plant whose linear sensor is received directly.

    P- = A P A' + Q, S = C P- C' + R, K = P- C' S^-1, m = m- + K (z - C m- - v), P = P- - K C P-.

    Args:
        plant: a linear plant, n states.
        sensor: a linear sensor, m outputs.
        initial_mean: mean (n,) of the first state; the plant's by default.
        initial_covariance: its covariance (n, n); the plant's by default.

    From a start that nobody knows (`hg.diffuse` as the plant's initial covariance) it is the limit of ever larger
    covariances, exactly: infinite variances until enough was measured.

    Claim: "exact" from the plant's initial law, whatever the laws' shapes; "nominal" from another, and with angles.

    Raises:
        ValueError: a plant or sensor that is not linear, parts that do not fit, an initial covariance that is none.

    Source: Kalman, A new approach to linear filtering and prediction problems (1960).
    """
    if not is_linear(plant, sensor):
        got = f"{type(first(plant)).__name__} and {type(first(sensor)).__name__}"
        modal = is_modal(first(plant)) or is_modal(first(sensor))
        instead = f" of one law ({SEVERAL_TAKEN_BY})" if modal else MATRICES
        raise fail("Kalman filter", f"a LinearPlant and a LinearSensor{instead}", got)
    if has_unknown_start(plant):
        if initial_mean is not None or initial_covariance is not None:
            raise fail("initial law", "none beside a plant whose start is unknown", "one")
        return diffuse_filter(plant, sensor)
    return _make_gaussian_filter(
        plant, sensor, None, Linearization(), Polytope(), initial_mean, initial_covariance, trusted=True
    )
