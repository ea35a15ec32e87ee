"""Plain Kalman filter: a linear plant and a linear sensor without a channel."""

from heliograph.filters.gaussian.gaussian import GaussianFilter, gaussian_filter
from heliograph.filters.gaussian.transform import Linearization
from heliograph.model.channel import perfect
from heliograph.model.over_time import first
from heliograph.model.plant import AnyPlant
from heliograph.model.sensor import AnySensor, is_linear
from heliograph.numerics.check import fail
from heliograph.numerics.types import ArrayLike, Float

MATRICES = ", of matrices kalman_filter(*hg.state_space(F, H, Q, R, mean, covariance))"


def kalman_filter(
    plant: AnyPlant,
    sensor: AnySensor,
    initial_mean: Float[ArrayLike, " n"] | None = None,
    initial_covariance: Float[ArrayLike, "n n"] | None = None,
) -> GaussianFilter:
    """Kalman filter of a linear plant whose linear sensor is received directly.

    P- = A P A' + Q, S = C P- C' + R, K = P- C' S^-1, m = m- + K (z - C m- - v), P = P- - K C P-.

    Args:
        plant: a linear plant, n states.
        sensor: a linear sensor, m outputs.
        initial_mean: mean (n,) of the first state; the plant's by default.
        initial_covariance: its covariance (n, n); the plant's by default.

    Claim: "exact" from the plant's initial law, whatever the laws' shapes; "nominal" from another, and with angles.

    Raises:
        ValueError: a plant or sensor that is not linear, parts that do not fit, an initial covariance that is none.

    Source: Kalman, A new approach to linear filtering and prediction problems (1960).
    """
    if not is_linear(plant, sensor):
        got = f"{type(first(plant)).__name__} and {type(first(sensor)).__name__}"
        raise fail("Kalman filter", f"a LinearPlant and a LinearSensor{MATRICES}", got)
    channel = perfect(len(first(sensor).outputs))
    return gaussian_filter(plant, sensor, channel, Linearization(), None, initial_mean, initial_covariance)
