"""Linear models of motion: constant velocity and acceleration, Singer's, Gauss-Markov, and a turn of known rate."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from heliograph.model.plant import LinearPlant
from heliograph.models.continuous_time import continuous_plant
from heliograph.numerics.check import fail, name_list, scalar
from heliograph.numerics.numpy_or_jax import block_diagonal, library
from heliograph.numerics.types import ArrayLike, Float, Names, rename
from heliograph.random_affine.noises.noise import NoiseLike

WIDE = 1e8  # variance of what nobody knows before the first measurement, unless one says it
LARGEST = 1e100  # deviation, of which the square is a number


def constant_velocity(
    intensity: "Float[ArrayLike, '']",
    dt: "Float[ArrayLike, ''] | None" = None,
    axes: Names = ("position",),
    initial_mean: "Float[ArrayLike, ' n'] | None" = None,
    initial_covariance: NoiseLike | None = None,
) -> LinearPlant:
    """Return the plant of a nearly constant velocity on each axis: dv = dW.

    Each axis has the states AXIS (its position) and "AXIS_velocity"; for the axis "position" it is "velocity". Over a
    step, Q of an axis is q [[dt^3/3, dt^2/2], [dt^2/2, dt]].

    Args:
        intensity: q, the variance that a velocity gains in a unit of time.
        dt: length of every step; by default it is the input "dt".
        axes: names of the positions, or a mapping of them to units; "position" by default.
        initial_mean: mean before the first step (n,); zero by default.
        initial_covariance: covariance before the first step; by default variances of 1e8: nothing is known.

    Raises:
        ValueError: a negative intensity, a step that goes backwards, an initial law of another size.

    Source: Bar-Shalom, Li and Kirubarajan, Estimation with applications to tracking (2001), 6.2.2.
    """
    return _repeat_on_axes([[0, 1], [0, 0]], _make_intensity(2, intensity), axes, dt, initial_mean, initial_covariance)


def constant_acceleration(
    intensity: "Float[ArrayLike, '']",
    dt: "Float[ArrayLike, ''] | None" = None,
    axes: Names = ("position",),
    initial_mean: "Float[ArrayLike, ' n'] | None" = None,
    initial_covariance: NoiseLike | None = None,
) -> LinearPlant:
    """Return the plant of a nearly constant acceleration on each axis: da = dW.

    Each axis has the states AXIS (its position), "AXIS_velocity" and "AXIS_acceleration".

    Args:
        intensity: variance that an acceleration gains in a unit of time.
        dt: length of every step; by default it is the input "dt".
        axes: names of the positions, or a mapping of them to units; "position" by default.
        initial_mean: mean before the first step (n,); zero by default.
        initial_covariance: its covariance; by default a variance of 1e8 of each state: nothing is known.

    Raises:
        ValueError: a negative intensity, a step that goes backwards, an initial law of another size.

    Source: Bar-Shalom, Li and Kirubarajan, Estimation with applications to tracking (2001), 6.2.3.
    """
    motion = [[0, 1, 0], [0, 0, 1], [0, 0, 0]]
    return _repeat_on_axes(motion, _make_intensity(3, intensity), axes, dt, initial_mean, initial_covariance)


def singer(
    deviation: "Float[ArrayLike, '']",
    time: "Float[ArrayLike, '']",
    dt: "Float[ArrayLike, ''] | None" = None,
    axes: Names = ("position",),
    initial_mean: "Float[ArrayLike, ' n'] | None" = None,
    initial_covariance: NoiseLike | None = None,
) -> LinearPlant:
    """Return Singer's plant of a vehicle that manoeuvres: the acceleration of each axis is a Gauss-Markov process.

    The acceleration a follows da = -a / T dt + dW, with the same deviation at all times. Each axis has the states AXIS
    (its position), "AXIS_velocity" and "AXIS_acceleration".

    Args:
        deviation: standard deviation of an acceleration.
        time: T, in which an acceleration is forgotten to 1/e.
        dt: length of every step; by default the input "dt" says it.
        axes: names of the positions, or a mapping of them to units; "position" by default.
        initial_mean: mean before the first step (n,); zero by default.
        initial_covariance: its covariance; by default a variance of 1e8 of positions and velocities, and that of the
            process of accelerations.

    Raises:
        ValueError: a negative deviation, a time that is not positive, an initial law of another size.

    Source: Singer, Estimating optimal tracking filter performance for manned maneuvering targets (1970).
    """
    # d(position, velocity, a) = motion (position, velocity, a) dt + (0, 0, dW), rate = 1 / T. Var a = deviation^2
    # stays the same if dW has the variance 2 deviation^2 / T in a unit of time.
    size, rate = _read_deviation_and_rate(deviation, time)
    motion = library(rate).asarray([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, -rate]])
    start = library(size).asarray([WIDE, WIDE, size**2])
    intensity = _make_intensity(order=3, value=2 * size**2 * rate)  # of the acceleration alone
    return _repeat_on_axes(motion, intensity, axes, dt, initial_mean, initial_covariance, start)


def gauss_markov(
    deviation: "Float[ArrayLike, '']",
    time: "Float[ArrayLike, '']",
    dt: "Float[ArrayLike, ''] | None" = None,
    states: Names = ("x",),
) -> LinearPlant:
    """Return first-order Gauss-Markov processes dx = -x / T dt + dW, independent, stationary from the start.

    The autocovariance over a time t is deviation^2 exp(-|t| / T).

    Args:
        deviation: standard deviation of each process, at all times.
        time: T, after which the autocorrelation is 1/e.
        dt: length of every step; by default it is the input "dt".
        states: names of the processes, or a mapping of them to units; "x" by default.

    Raises:
        ValueError: a negative deviation, a time that is not positive, a step that goes backwards.

    Source: Gelb, Applied optimal estimation (1974), 3.8.
    """
    size, rate = _read_deviation_and_rate(deviation, time)  # rate: 1 / T
    names = name_list("states", states)
    identity = np.eye(len(names))
    # A = -1/T I. Stationary variance s^2 needs noise of intensity 2 s^2 / T, and s^2 at the start, s the deviation.
    matrix, intensity, initial_covariance = -rate * identity, 2 * size**2 * rate * identity, size**2 * identity
    return continuous_plant(
        matrix, intensity, np.zeros(len(names)), initial_covariance, dt=dt, states=_keep_units(names)
    )


def known_turn(
    intensity: "Float[ArrayLike, '']",
    turn_rate: "Float[ArrayLike, '']",
    dt: "Float[ArrayLike, ''] | None" = None,
    axes: Names = ("x", "y"),
    initial_mean: "Float[ArrayLike, ' n'] | None" = None,
    initial_covariance: NoiseLike | None = None,
) -> LinearPlant:
    """Return the plant of a coordinated turn of known rate: velocities turn by it, and gain white noise.

    States: "x", "x_velocity", "y", "y_velocity". It is linear; of an unknown rate take `coordinated_turn`.

    Args:
        intensity: variance that each velocity gains in a unit of time.
        turn_rate: radians in a unit of time, positive from the first axis to the second.
        dt: length of every step; by default the input "dt" says it.
        axes: names of both positions, or a mapping of them to units; "x" and "y" by default.
        initial_mean: mean before the first step (4,); zero by default.
        initial_covariance: its covariance; by default a variance of 1e8 of each state.

    Raises:
        ValueError: other than two axes, a negative intensity, a step that goes backwards.

    Source: Bar-Shalom, Li and Kirubarajan, Estimation with applications to tracking (2001), 11.7.1.
    """
    rate, q = scalar("turn rate", turn_rate), scalar("noise intensity", intensity, 0.0)
    # dx/dt = A x: the derivative of a position is its velocity; velocities turn, vx' = -rate vy and vy' = rate vx.
    motion = library(rate).asarray([[0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, -rate], [0.0, 0.0, 0.0, 1.0],
                                    [0.0, rate, 0.0, 0.0]])  # fmt: skip
    named = read_two_axes(axes)
    mean = np.zeros(4) if initial_mean is None else initial_mean
    start = WIDE * np.eye(4) if initial_covariance is None else initial_covariance
    states = _keep_units(_name_states(named, order=2))  # a position and a velocity for each axis
    return continuous_plant(motion, q * np.diag([0.0, 1.0, 0.0, 1.0]), mean, start, dt=dt, states=states)


def read_two_axes(axes: Names) -> list[str]:
    """Return the names of two axes, as a list, after a check that they are two.

    Raises:
        ValueError: another number of them.
    """
    names = name_list("axes", axes)
    if len(names) != 2:
        raise fail("axes", "two, such as ['x', 'y']", names)
    return names


def _read_deviation_and_rate(deviation: ArrayLike, time: ArrayLike) -> tuple[Any, Any]:
    """Return a standard deviation, and the rate 1 / T of a process whose autocorrelation is exp(-t / T), T = `time`.

    Raises:
        ValueError: a negative deviation, or a time that is not positive.
    """
    return scalar("deviation", deviation, 0.0, LARGEST), 1 / scalar("time", time, 1 / LARGEST)


def _make_intensity(order: int, value: ArrayLike) -> Any:
    """Return the intensity (order, order) of a noise of variance `value` per unit of time on the last state alone."""
    q = scalar("noise intensity", value, 0.0)
    return q * np.diag([0.0] * (order - 1) + [1.0])


def _name_states(axes: Sequence[str], order: int) -> list[str]:
    """Return the names of the states, axis by axis: the first `order` of position, velocity and acceleration.

    They are "x", "x_velocity" and so on. For the axis "position" the derivatives are only "velocity" and
    "acceleration".
    """
    names, derivatives = list[str](), ("velocity", "acceleration")[: order - 1]
    for axis in axes:
        prefix = "" if axis == "position" else f"{axis}_"
        names += [axis, *(f"{prefix}{derivative}" for derivative in derivatives)]
    return names


def _keep_units(states: Sequence[str]) -> Sequence[str]:
    """Return the names of states, each as a name that carries its unit, if it had one when the user gave it."""
    return [rename(name, str(name)) for name in states]


def _repeat_on_axes(
    motion: Any,
    intensity: Any,
    axes: Names,
    dt: ArrayLike | None,
    initial_mean: ArrayLike | None,
    initial_covariance: NoiseLike | None,
    start: Any = None,
) -> LinearPlant:
    """Return the plant of the same motion dx = A x dt + dW on each axis, independently of the others.

    An axis has `order` states: its position, velocity and so on. The plant's states are those of all axes, axis by
    axis.

    Args:
        motion: A (order, order) of one axis.
        intensity: intensity of the noise W on one axis (order, order): its covariance per unit of time.
        axes: names of the positions.
        dt: length of every step; None where the input "dt" says it.
        initial_mean: mean of all states before the first step, axis by axis; None for zero.
        initial_covariance: covariance of all states before the first step; None for `start` on each axis.
        start: variances of one axis before the first step (order,); None for WIDE ones.
    """
    # At least one axis.
    named = name_list("axes", axes)
    if not named:
        raise fail("axes", "at least one name", "none")
    # Block-diagonal matrices, one block for each axis. Without a start the variances are WIDE: next to nothing is
    # known.
    order, count = len(intensity), len(named)
    variances = np.full(order, WIDE) if start is None else start
    xp = library(variances)
    return continuous_plant(
        block_diagonal([library(motion).asarray(motion)] * count),
        block_diagonal([intensity] * count),
        np.zeros(order * count) if initial_mean is None else initial_mean,
        block_diagonal([xp.diag(variances)] * count) if initial_covariance is None else initial_covariance,
        dt=dt,
        states=_name_states(named, order),
    )
