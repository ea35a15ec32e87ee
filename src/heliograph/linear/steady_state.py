"""Long run of Kalman filters: steady covariances and gains, and how often packets must arrive for them to exist."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.linalg import LinAlgError, solve_discrete_are

from heliograph.factors.square_root_update import covariance_of_root, observe_root, roots_of
from heliograph.linear.known_loss_stability import BELOW_ONE, KnownLossSystem, certify_radius, find_gains
from heliograph.linear.lmmse_recursion import find_noise_roots, step_covariance_roots
from heliograph.linear.system import Steps
from heliograph.model.over_time import OverTime, first
from heliograph.model.plant import AnyPlant, LinearPlant, MatrixOfInputs
from heliograph.model.sensor import AnySensor, LinearSensor, check_sensor, refuse_angles
from heliograph.numerics.check import array, fail, standard_deviations
from heliograph.numerics.lapack import spectral_radius
from heliograph.numerics.module import readable
from heliograph.numerics.types import ArrayLike, Float
from heliograph.random_affine.noises.noise import AbstractNoise

RESOLUTION = 1e-8  # of an arrival probability


@readable
class CriticalArrival(NamedTuple):
    """Arrival probabilities: at `lower` and below the mean error of every filter diverges, above `upper` it is bounded.

    Between the two, nothing is proved here. `gain` K (n, m) of xhat+ = A xhat + K (z - C xhat) is certified from
    `upper` on. (0, 0) for a stable plant.
    """

    lower: float
    upper: float
    gain: Float[np.ndarray, "n m"]


def critical_arrival(
    plant: AnyPlant, sensor: AnySensor, gain: "Float[ArrayLike, 'n m'] | None" = None
) -> CriticalArrival:
    """Return critical probabilities that a packet of all outputs arrives, independently at each step.

    The receiver knows of losses. lower = 1 - 1/rho(A)^2: while nothing arrives P grows by rho(A)^2 a step. upper: the
    smallest arrival at which some K passes rho((1 - arrival) A x A + arrival (A - K C) x (A - K C)) < 1. With as many
    independent outputs as states they meet. Known in the field, and not proved here: where the unstable eigenvalues
    have distinct moduli, `lower` is the truth (You, Fu and Xie, 2011; Mo and Sinopoli, 2012). Process noise must reach
    the unstable modes for anything to diverge.

    Args:
        plant: linear plant, constant over time.
        sensor: linear sensor, constant over time.
        gain: constant filter gain K (n, m) of xhat+ = A xhat + K (z - C xhat); both probabilities are then the arrival
            from which on its error is bounded. None: the best gains.

    Raises:
        ValueError: a plant or sensor that is not linear or varies, a sensor that misses an unstable mode, a gain that
            does not stabilise where everything arrives.
    Source: Sinopoli et al., Kalman filtering with intermittent observations, IEEE TAC 49 (2004), Theorems 2 to 5.
    """
    a, q = plant_matrices(plant)
    c, r = sensor_matrices(sensor, len(a))
    fixed = None if gain is None else np.asarray(array("gain", gain, (len(a), len(c))))
    no_outputs = np.zeros((0, len(a)))  # C of a lost packet

    def certified_gain(arrival: float) -> Float[np.ndarray, "n m"] | None:
        """Return a gain that is certified to keep the error bounded at this probability of arrival, or None.

        a, q: A and Cov(w) of the plant; c, r: C and Cov(v) of the sensor, `no_outputs` the C of a lost packet. `fixed`
        is the gain that the user gave, which then is the only one tried. A gain is certified if the step of its error
        covariance has a spectral radius below 1.
        """
        # Independent losses as a chain of two modes with equal rows: mode 0 arrived, mode 1 lost, of no outputs.
        chain = np.array([[arrival, 1 - arrival]] * 2)
        system = KnownLossSystem(
            transition=a,
            process=q,
            chain=chain,
            law=chain[0],
            known=np.array([0, 1]),
            outputs=(c, no_outputs),
            noises=(r, np.zeros((0, 0))),
        )
        gains = find_gains(system) if fixed is None else (fixed, no_outputs.T)
        return gains[0] if certify_radius(system, gains) < BELOW_ONE else None

    # A stable plant's error is bounded without data.
    radius = spectral_radius(a)
    if radius < BELOW_ONE and fixed is None:
        return CriticalArrival(0.0, 0.0, np.zeros((len(a), len(c))))
    # Lower bound 1 - rho(A)^-2.
    lower = max(1 - radius**-2, 0.0)
    if certified_gain(1.0) is None:
        what = "sensor" if fixed is None else "gain"
        raise fail(what, "one that keeps the error bounded where everything arrives", "an unstable mode that stays")
    # Upper bound: bisection over certified gains.
    upper, gain_at_upper = _bisect_critical_arrival(certified_gain, lower)
    return CriticalArrival(lower if fixed is None else upper, upper, gain_at_upper)


def _bisect_critical_arrival(gain_at: Callable[[float], np.ndarray | None], lower: float) -> tuple[float, np.ndarray]:
    """Find the smallest probability of arrival with a certified gain, by bisection, and that gain.

    `gain_at` gives one for a probability, None where none is certified; with probability 1 there is one. `lower` is a
    bound below which there is none: where one is certified just above it, it is the answer.
    """
    gain_just_above_bound, gain = gain_at(min(lower + RESOLUTION, 1.0)), gain_at(1.0)
    if gain_just_above_bound is not None:
        return lower, gain_just_above_bound
    low, high = lower, 1.0
    while high - low > RESOLUTION / 10:
        middle = (low + high) / 2
        candidate = gain_at(middle)
        if candidate is None:
            low = middle
        else:
            high, gain = middle, candidate
    assert gain is not None
    return high, gain


def plant_matrices(plant: AnyPlant, what: str = "plant") -> tuple[Float[np.ndarray, "n n"], Float[np.ndarray, "n n"]]:
    """Return A (n, n) and Cov(w) (n, n) of a constant linear plant; refuse any other plant, and states that are angles.

    `what` names in the error message what needs such a plant.
    """
    # A noise that is no AbstractNoise, and a MatrixOfInputs, vary with the plant's inputs.
    if (
        not isinstance(plant, LinearPlant)
        or not isinstance(plant.noise, AbstractNoise)
        or isinstance(plant.matrix, MatrixOfInputs)
    ):
        raise fail(what, "a LinearPlant that does not vary", _describe_type(plant))
    refuse_angles(what, plant)
    return np.asarray(plant.matrix), np.asarray(plant.noise.covariance)


def sensor_matrices(
    sensor: AnySensor, states: int, what: str = "sensor"
) -> tuple[Float[np.ndarray, "m n"], Float[np.ndarray, "m m"]]:
    """Return C (m, n) and Cov(v) (m, m) of a constant linear sensor of n states; refuse any other, and angles.

    `what` names in the error message what needs such a sensor.
    """
    if isinstance(sensor, OverTime) or not isinstance(sensor, LinearSensor):
        raise fail(what, "a LinearSensor that does not vary", _describe_type(sensor))
    check_sensor(sensor, states)
    refuse_angles(what, sensor)
    return np.asarray(sensor.matrix), np.asarray(sensor.noise.covariance)


def _describe_type(model: AnyPlant | AnySensor) -> str:
    """Return words for a model in an error message: that it varies over time or by inputs, else its class."""
    if isinstance(model, OverTime):
        return "one that varies"
    if isinstance(model, LinearPlant):
        return f"one that varies with {list(model.inputs)}"
    return type(model).__name__


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
    a, q = plant_matrices(plant, what)  # F and Q
    c, r = sensor_matrices(sensor, len(first(plant).states), what)  # H and R
    step = Steps(transition=a, drift=np.zeros(len(a)), process=q, output=c, offset=np.zeros(len(c)), noise=r)
    # P- solves the Riccati equation of the prediction, which is that of control with transposed matrices.
    try:
        prior = solve_discrete_are(a.T, c.T, q, r)
    except (LinAlgError, ValueError) as error:
        raise _make_no_steady_state_error(str(error)) from None
    # One more correction and prediction gives the gain, and must come back to where it began.
    noises = find_noise_roots(step, np.diag(prior))
    gain, root = observe_root(roots_of(prior), c, noises.received)
    again = covariance_of_root(step_covariance_roots(root, step, noises).predicted)
    # Refuse a solution that moves by more than CLOSE, relative to its deviations, or whose errors do not decay: they
    # move by F (I - K H).
    unit = standard_deviations(prior)
    moved = np.abs(again - prior) / (unit[:, None] * unit)
    if not np.all(np.isfinite(prior)) or np.max(moved) > CLOSE or spectral_radius(a - a @ gain @ c) >= 1:
        raise _make_no_steady_state_error("none that is approached")
    return SteadyState((prior + prior.T) / 2, covariance_of_root(root), gain)


def _make_no_steady_state_error(got: str) -> Exception:
    """Return the ValueError of a plant and sensor without a steady state, to be raised; `got` says what was found."""
    expected = "unstable modes that the sensor sees, and noise in all those on the unit circle"
    return fail("steady state", expected, " ".join(got.split()).rstrip("."))
