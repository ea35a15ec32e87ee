"""Gaussian filters of plant, sensor and channel: Kalman's, the extended and the cubature filter, and a naive one."""

from heliograph.filters.base import make_sizes
from heliograph.filters.gaussian.diffuse import DiffuseFilter, diffuse_filter, has_unknown_start
from heliograph.filters.gaussian.gaussian import GaussianFilter, describe_channel_moments, make_perfect_channel
from heliograph.filters.gaussian.gaussian_prediction import choose_initial_moments
from heliograph.filters.gaussian.moment_transforms import AbstractTransform, Cubature, Linearization
from heliograph.filters.gaussian.uncertain_channel_updates import AbstractUpdate, Polytope
from heliograph.filters.wrappers.accepted_models import accept_limits, accept_sensor_inputs, accept_told_numbers
from heliograph.model.assumed.assumed_model import AssumedModel, with_assumed
from heliograph.model.channel import Channel, check_link, find_received_angles, mean_gain
from heliograph.model.estimate import lower_claim_by_noise
from heliograph.model.fading import memory_matters, without_memory
from heliograph.model.over_time import first, unstack
from heliograph.model.plant import AnyPlant, read_first_plant
from heliograph.model.sensor import SEVERAL_TAKEN_BY, AnySensor, is_linear
from heliograph.numerics.check import fail, instance
from heliograph.numerics.types import ArrayLike, Float
from heliograph.random_affine.memories_of_channels import is_memory_dependent
from heliograph.random_affine.moments.second_moments import has_random_gain

MATRICES = ", of matrices kalman_filter(*hg.state_space(F, H, Q, R, mean, covariance))"


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
    """Check the parts, and return their Gaussian filter on the channel's second moments without its memory.

    Args:
        plant: the plant, n states.
        sensor: its sensor.
        channel: from the sensor to the filter; None for one that delivers everything as it is.
        transform: moments of a nonlinear function.
        update: how an uncertain channel is bounded.
        initial_mean: mean (n,) of the first state; None for the plant's.
        initial_covariance: its covariance (n, n); None for the plant's.
        trusted: whether the channel is the true one, so that more than "nominal" may be claimed.
    """
    start = read_first_plant(plant)
    instance("update", update, AbstractUpdate, "one such as Polytope()")
    channel = make_perfect_channel(sensor) if channel is None else channel
    check_link(first(sensor), first(channel), len(start.states))
    angles = find_received_angles(plant, sensor, channel)  # indices of the components of z that are angles
    mean, covariance, prior_given = choose_initial_moments(start, initial_mean, initial_covariance)
    assumed = AssumedModel(plant, sensor, channel)  # what the claim rests on: the channel with its memory
    # Moments of the channel without its memory: where that matters, the described channel is not the true one.
    trusted = trusted and not memory_matters(channel)
    channel = without_memory(channel)
    described = describe_channel_moments(channel, update)  # M = E G, Cov G, Cov n and their bounds
    pairs = zip(unstack(channel), unstack(described), strict=True)
    # The Kalman filter is exact: linear, no random gain, no angle (and so no attitude: that has no linear plant).
    without_angles = not start.circular and not first(sensor).circular
    linear = without_angles and is_linear(plant, sensor) and not any(has_random_gain(c, s) for c, s in pairs)
    claim = update.claim(uncertain=False) if linear and trusted and not prior_given else "nominal"
    claim = lower_claim_by_noise(claim, plant, sensor, channel)
    filter = GaussianFilter(
        plant=plant,
        sensor=sensor,
        channel=described,
        transform=transform,
        rule=update.described(),
        initial_mean=mean,
        initial_covariance=covariance,
        linear=linear,
        observed_angles=angles,
        **make_sizes(claim, start, first(channel).outputs),
    )
    return with_assumed(filter, assumed)


@accept_limits
@accept_sensor_inputs
@accept_told_numbers
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

    Claim (what the covariance is said to be): "nominal"; "exact" where plant and sensor are linear, no gain is random
    and the initial law is the plant's (then it is the Kalman filter).

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


@accept_limits
@accept_sensor_inputs
@accept_told_numbers
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

    Claim (what the covariance is said to be): "nominal"; "exact" where plant and sensor are linear, no gain is random
    and the initial law is the plant's (then it is the Kalman filter).

    Raises:
        ValueError: sensor, channel and plant that do not fit, or an initial covariance that is none.

    Source: cubature fusion under amplify-and-forward relays, Section III.
    """
    return gaussian_filter(plant, sensor, channel, Cubature(), update, initial_mean, initial_covariance)


@accept_limits
@accept_sensor_inputs
@accept_told_numbers
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

    Claim (what the covariance is said to be): "nominal"; "exact" where plant and sensor are linear, no gain is random
    and the initial law is the plant's.

    Raises:
        ValueError: sensor, channel and plant that do not fit, or an initial covariance that is none.

    Source: cubature fusion under amplify-and-forward relays, Section IV (the filter compared with).
    """
    return gaussian_filter(plant, sensor, channel, Linearization(), update, initial_mean, initial_covariance)


@accept_limits
def mean_gain_filter(
    plant: AnyPlant,
    sensor: AnySensor,
    channel: Channel,
    initial_mean: Float[ArrayLike, " n"] | None = None,
    initial_covariance: Float[ArrayLike, "n n"] | None = None,
) -> GaussianFilter:
    """Return the cubature filter that uses the mean gain as if it were certain, a naive baseline.

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
    # The channel that the filter assumes: its mean gain as a known one. `trusted=False` makes the claim "nominal".
    believed = mean_gain(without_memory(channel))
    return _make_gaussian_filter(
        plant, sensor, believed, Cubature(), Polytope(), initial_mean, initial_covariance, trusted=False
    )


def make_base_gaussian_filter(
    name: str, plant: AnyPlant, sensor: AnySensor, channel: Channel, transform: AbstractTransform, rule: AbstractUpdate
) -> GaussianFilter:
    """Return the Gaussian filter that another filter holds inside, of a plant, a sensor and a channel.

    Behind a link that reports its state (a gain, say) with each message, `gaussian_filter` makes another kind of
    filter, which those others cannot hold.

    Args:
        name: of the other filter, for the message.
        plant: the plant.
        sensor: its sensor.
        channel: from the sensor to the filter.
        transform: moments of a nonlinear function.
        rule: how an uncertain channel is bounded.

    Raises:
        ValueError: a channel that reports its state to the receiver; what `gaussian_filter` refuses.
    """
    filter = gaussian_filter(plant, sensor, channel, transform, rule)
    return instance(f"channel of a {name}", filter, GaussianFilter, "one of which nothing is told")


@accept_limits
@accept_sensor_inputs
def kalman_filter(
    plant: AnyPlant,
    sensor: AnySensor,
    initial_mean: Float[ArrayLike, " n"] | None = None,
    initial_covariance: Float[ArrayLike, "n n"] | None = None,
) -> GaussianFilter | DiffuseFilter:
    """Return the Kalman filter of a linear plant whose linear sensor is received directly.

    m- = A m + B u + E w, P- = A P A' + Q, S = C P- C' + R, K = P- C' S^-1, m = m- + K (z - C m- - E v) and
    P = P- - K C P-, for x+ = A x + B u + w and z = C x + v with Cov w = Q and Cov v = R.

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
        modal = is_memory_dependent(first(plant)) or is_memory_dependent(first(sensor))
        instead = f" of one law ({SEVERAL_TAKEN_BY})" if modal else MATRICES
        raise fail("Kalman filter", f"a LinearPlant and a LinearSensor{instead}", got)
    if has_unknown_start(plant):
        if initial_mean is not None or initial_covariance is not None:
            raise fail("initial law", "none beside a plant whose start is unknown", "one")
        return diffuse_filter(plant, sensor)
    return _make_gaussian_filter(
        plant, sensor, None, Linearization(), Polytope(), initial_mean, initial_covariance, trusted=True
    )
