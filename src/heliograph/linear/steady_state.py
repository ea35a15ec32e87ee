"""Steady state of the Kalman filter: its covariances and its gain in the long run, before any data."""

from typing import NamedTuple

import numpy as np
from scipy.linalg import LinAlgError, solve_discrete_are

from heliograph.linear.arrival import plant_matrices, sensor_matrices
from heliograph.linear.known_losses import spectral_radius
from heliograph.linear.recursion import covariance_step
from heliograph.linear.system import Steps
from heliograph.model.over_time import first
from heliograph.model.plant import AnyPlant
from heliograph.model.sensor import AnySensor
from heliograph.numerics.check import fail, own_units
from heliograph.numerics.readable import readable
from heliograph.numerics.types import Float

CLOSE = 1e-8  # relative: what one more step of the Riccati recursion may change


@readable
class SteadyState(NamedTuple):
    """Limits of a Kalman filter.

    Args:
        prior_covariance: P- after a prediction (n, n).
        covariance: P after a correction (n, n).
        gain: K (n, m) of m = m- + K (z - H m-).
    """

    prior_covariance: Float[np.ndarray, "n n"]
    covariance: Float[np.ndarray, "n n"]
    gain: Float[np.ndarray, "n m"]


def steady_state(plant: AnyPlant, sensor: AnySensor) -> SteadyState:
    """Return the steady state of the Kalman filter of a linear plant whose linear sensor is received directly.

    P- = F (P- - P- H' (H P- H' + R)^-1 H P-) F' + Q, the stabilising solution; K = P- H' (H P- H' + R)^-1, and
    P = (I - K H) P-. Behind a channel: `hg.linear_filter(...).planned(inputs)`, or `hg.simulation.fused_covariances`.

    Args:
        plant: a linear plant, constant over time.
        sensor: a linear sensor, constant over time.

    Raises:
        ValueError: a plant or sensor that is not linear or varies, or no steady state that every start leads to: an
            unstable mode that the sensor does not see, or one on the unit circle that no noise reaches.

    Source: Anderson and Moore, Optimal filtering (1979), chapter 4.
    """
    what = "steady state"
    (a, q), (c, r) = plant_matrices(plant, what), sensor_matrices(sensor, len(first(plant).states), what)
    zero = np.zeros(len(a)), np.zeros(len(c))
    step = Steps(a, zero[0], q, c, zero[1], r)
    try:
        prior = solve_discrete_are(a.T, c.T, q, r)
    except (LinAlgError, ValueError) as error:
        raise _none(str(error)) from None
    # One more correction and prediction gives the gain, and must come back to where it began.
    start = covariance_step(prior, Steps(np.eye(len(a)), zero[0], np.zeros_like(q), c, zero[1], r))
    again = covariance_step(start.covariance, step).predicted
    unit = own_units(prior)
    moved = np.abs(again - prior) / (unit[:, None] * unit)
    if not np.all(np.isfinite(prior)) or np.max(moved) > CLOSE or spectral_radius(a - a @ start.gain @ c) >= 1:
        raise _none("none that is approached")
    return SteadyState((prior + prior.T) / 2, start.covariance, start.gain)


def _none(got: str) -> Exception:
    expected = "unstable modes that the sensor sees, and noise in all those on the unit circle"
    return fail("steady state", expected, " ".join(got.split()).rstrip("."))
