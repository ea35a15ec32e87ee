"""State-space form: a linear plant and its sensor from the textbook's matrices."""

from heliograph.model.plant import LinearPlant
from heliograph.model.sensor import LinearSensor
from heliograph.numerics.types import ArrayLike, Float
from heliograph.random_affine.noise import NoiseLike


def state_space(
    F: "Float[ArrayLike, 'n n']",
    H: "Float[ArrayLike, 'm n']",
    Q: "NoiseLike",
    R: "NoiseLike",
    mean: "Float[ArrayLike, ' n']",
    covariance: "NoiseLike",
    B: "Float[ArrayLike, 'n inputs'] | None" = None,
) -> tuple[LinearPlant, LinearSensor]:
    """Return the plant x+ = F x + B u + w and the sensor z = H x + v, with Cov(w) = Q and Cov(v) = R.

    `plant, sensor = hg.state_space(F, H, Q, R, mean, covariance)`, then `hg.kalman_filter(plant, sensor)`.

    Args:
        F: transition matrix.
        H: measurement matrix.
        Q: covariance of w, a variance for all states, or a noise law.
        R: covariance of v, a variance for all outputs, or a noise law.
        mean: mean of the state before the first step; the first measurement comes one step later.
        covariance: covariance of that state, a variance for all of it, or the law of its deviation from `mean`.
        B: input matrix; a plant without inputs unless given.

    Raises:
        ValueError: shapes that do not fit, covariances that are none, numbers that are not finite.
    """
    plant = LinearPlant(F, Q, mean, covariance, B)
    sensor = LinearSensor(H, R)
    sensor.check_states(len(plant.states))
    return plant, sensor
