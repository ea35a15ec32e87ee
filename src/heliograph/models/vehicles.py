"""Nonlinear models of motion in the plane: a turn of unknown rate, a unicycle and a bicycle, exact over a step."""

from typing import Any

import jax
import jax.numpy as jnp

from heliograph.model.plant import Plant
from heliograph.models.continuous_time import append_time_step
from heliograph.models.motion import read_two_axes
from heliograph.numerics.check import TINY, covariance, scalar
from heliograph.numerics.module import Module
from heliograph.numerics.types import Array, ArrayLike, Float, Names
from heliograph.random_affine.noises.noise import NoiseLike

NEAR = 1e-4  # radians: below this, series take the place of quotients, right to the last digit


class StepLength(Module):
    """A part of a plant that depends on the length of a step: a number `dt`, or the last input where `dt` is None."""

    dt: Any

    def length(self, u: jax.Array) -> Any:
        """Return the length of the step: `dt` if it is given, else the last of the inputs u."""
        return u[-1] if self.dt is None else self.dt


class TurnMotion(StepLength):
    """The motion of (x, vx, y, vy, w) over a step: the velocity turns by the angle w dt."""

    def __call__(self, x: jax.Array, u: jax.Array) -> jax.Array:
        """Return (x, vx, y, vy, w) after a step: the velocity turned by w dt, its integral added to the position.

        w: the turn rate; `self.length(u)`: the step's length, given or an input.
        """
        dt = self.length(u)
        px, vx, py, vy, rate = x
        angle = rate * dt
        # The integral of the turning velocity over the step: `along` v + `across` (v turned by 90 degrees).
        along, across = dt * sine_ratio(angle), dt * cosine_ratio(angle)
        c, s = jnp.cos(angle), jnp.sin(angle)
        return jnp.stack(
            [px + along * vx - across * vy, c * vx - s * vy, py + across * vx + along * vy, s * vx + c * vy, rate]
        )


class TurnNoise(StepLength):
    """Q of a turn: white accelerations on both axes, and a rate that wanders."""

    intensity: Any
    turn_intensity: Any

    def __call__(self, u: jax.Array) -> jax.Array:
        """Return the covariance (5, 5) of a step's noise: position and velocity of either axis, then the turn rate.

        `intensity` and `turn_intensity`: the variance that a velocity and the rate gain in a unit of time.
        """
        dt = jnp.asarray(self.length(u))
        of_axis = self.intensity * jnp.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
        of_turn_rate = jnp.reshape(self.turn_intensity * dt, (1, 1))
        return jnp.asarray(jax.scipy.linalg.block_diag(of_axis, of_axis, of_turn_rate))


class ArcMotion(StepLength):
    """The motion of (x, y, heading) at the speed and turn rate of the inputs, over an arc of a circle.

    `wheelbase`: of a bicycle, whose second input is the angle of its front wheel; None of a unicycle.
    """

    wheelbase: Any

    def __call__(self, x: jax.Array, u: jax.Array) -> jax.Array:
        """Return (x, y, heading) after a step along an arc: its chord points in the direction halfway through the turn.

        u: the speed, and the turn rate, or with a wheelbase the steering angle (radians).
        """
        dt, speed = self.length(u), u[0]
        rate = u[1] if self.wheelbase is None else speed * jnp.tan(u[1]) / self.wheelbase
        half_turn = rate * dt / 2
        chord = speed * dt * sine_ratio(half_turn)  # an arc of length s = speed dt and angle 2 a: s sin(a) / a
        direction = x[2] + half_turn
        change = jnp.stack([chord * jnp.cos(direction), chord * jnp.sin(direction), rate * dt])
        return jnp.asarray(x + change)


class NoiseTimesStep(StepLength):
    """Covariance Q = S dt of a step's noise, with the intensity S (n, n): the covariance gained in a unit of time."""

    intensity: Array

    def __call__(self, u: jax.Array) -> jax.Array:
        """Return Q (n, n) of the step whose length is `dt`, or the last of the inputs u."""
        return jnp.asarray(jnp.asarray(self.intensity) * self.length(u))


def sine_ratio(angle: jax.Array) -> jax.Array:
    """Return sin(a) / a for an angle in radians, which is 1 at 0; below NEAR it comes from the series 1 - a^2 / 6."""
    is_small = jnp.abs(angle) < NEAR
    safe_angle = jnp.where(is_small, 1.0, angle)  # the quotient that is not taken must have finite derivatives too
    return jnp.where(is_small, 1 - angle**2 / 6, jnp.sin(safe_angle) / safe_angle)


def cosine_ratio(angle: jax.Array) -> jax.Array:
    """Return (1 - cos(a)) / a, 0 at 0: of half angles, so that no digits cancel."""
    return jnp.sin(angle / 2) * sine_ratio(angle / 2)


def coordinated_turn(
    intensity: "Float[ArrayLike, '']",
    turn_intensity: "Float[ArrayLike, '']",
    initial_mean: "Float[ArrayLike, '5']",
    initial_covariance: NoiseLike,
    dt: "Float[ArrayLike, ''] | None" = None,
    axes: Names = ("x", "y"),
) -> Plant:
    """Return the plant of a coordinated turn of unknown rate, which is a state: "turn_rate", radians in a unit of time.

    States: "x", "x_velocity", "y", "y_velocity", "turn_rate"; the turn over a step is exact, also at a rate of zero.
    Of a known rate take `known_turn`, which is linear.

    Args:
        intensity: variance q that each velocity gains in a unit of time; Q of a position and its velocity is
            q [[dt^3/3, dt^2/2], [dt^2/2, dt]].
        turn_intensity: variance that the turn rate gains in a unit of time.
        initial_mean: mean before the first step (5,).
        initial_covariance: covariance before the first step, or the law of the deviation from the mean.
        dt: length of every step; by default the input "dt" says it.
        axes: names of both positions; "x" and "y" by default.

    Raises:
        ValueError: other than two axes, a negative intensity, what `hg.Plant` refuses.

    Source: Bar-Shalom, Li and Kirubarajan, Estimation with applications to tracking (2001), 11.7.2.
    """
    q, wander = scalar("noise intensity", intensity, 0.0), scalar("intensity of the turn rate", turn_intensity, 0.0)
    first, second = read_two_axes(axes)
    step = None if dt is None else scalar("length of a step", dt, 0.0)
    states = [first, f"{first}_velocity", second, f"{second}_velocity", "turn_rate"]
    inputs = [] if dt is not None else append_time_step(())
    noise = TurnNoise(step, q, wander)
    return Plant(TurnMotion(step), noise, initial_mean, initial_covariance, states=states, inputs=inputs)


def unicycle(
    intensity: "Float[ArrayLike, '3 3']",
    initial_mean: "Float[ArrayLike, '3']",
    initial_covariance: NoiseLike,
    dt: "Float[ArrayLike, ''] | None" = None,
    axes: Names = ("x", "y"),
) -> Plant:
    """Return the plant of a vehicle that drives at a given "speed" and "turn_rate": an arc of a circle each step.

    The states are "x", "y" and the angle "heading" (circular), which is 0 along the first axis. The inputs are "speed",
    "turn_rate" in radians in a unit of time, and "dt" unless given; speed and rate are held over the step.

    Args:
        intensity: S of Q = S dt, the covariance that (x, y, heading) gain in a unit of time, (3, 3).
        initial_mean: mean before the first step (3,).
        initial_covariance: covariance before the first step, or the law of the deviation from the mean.
        dt: length of every step; by default it is the input "dt".
        axes: names of both positions; "x" and "y" by default.

    Raises:
        ValueError: other than two axes, an intensity that is no covariance, what `hg.Plant` refuses.

    Source: Thrun, Burgard and Fox, Probabilistic robotics (2005), 5.3.
    """
    return _make_vehicle_plant(None, "turn_rate", intensity, initial_mean, initial_covariance, dt, axes)


def bicycle(
    wheelbase: "Float[ArrayLike, '']",
    intensity: "Float[ArrayLike, '3 3']",
    initial_mean: "Float[ArrayLike, '3']",
    initial_covariance: NoiseLike,
    dt: "Float[ArrayLike, ''] | None" = None,
    axes: Names = ("x", "y"),
) -> Plant:
    """Return the plant of a vehicle steered by its front wheels: turn rate = speed tan(steering) / wheelbase.

    States: position "x", "y" of the middle of the rear axle, and the angle "heading" (circular). Inputs: "speed",
    "steering" (angle of the front wheel, radians), and "dt" unless given; both are held over the step.

    Args:
        wheelbase: distance of the axles.
        intensity: S of Q = S dt, the covariance that (x, y, heading) gain in a unit of time, (3, 3).
        initial_mean: mean before the first step (3,).
        initial_covariance: its covariance, or the law of its deviation.
        dt: length of every step; by default it is the input "dt".
        axes: names of both positions; "x" and "y" by default.

    Raises:
        ValueError: a wheelbase that is not positive, other than two axes, an intensity that is no covariance.

    Source: Rajamani, Vehicle dynamics and control (2012), 2.2, without slip.
    """
    length = scalar("wheelbase", wheelbase, TINY)
    return _make_vehicle_plant(length, "steering", intensity, initial_mean, initial_covariance, dt, axes)


def _make_vehicle_plant(
    wheelbase: Any,
    steered_by: str,
    intensity: ArrayLike,
    initial_mean: ArrayLike,
    initial_covariance: NoiseLike,
    dt: ArrayLike | None,
    axes: Names,
) -> Plant:
    """Return the plant of a vehicle that drives over arcs of circles; states: both axes and "heading".

    Args:
        wheelbase: distance of the axles of a bicycle, steered by the angle of its front wheel; None of a unicycle,
            which is steered by its turn rate.
        steered_by: name of the second input, by which the vehicle is steered; the first one is "speed".
        intensity: noise intensity S (3, 3): over a step of length dt the states gain the covariance Q = S dt.
        initial_mean: mean before the first step (3,).
        initial_covariance: covariance before the first step, or the law of the deviation from the mean.
        dt: length of every step; None where the input "dt" says it.
        axes: names of both positions.
    """
    # The length of a step is a number, or None where the last input says it: then the noise is a function of it.
    step = None if dt is None else scalar("length of a step", dt, 0.0)
    spread = covariance("noise intensity", intensity, 3)
    inputs = ["speed", steered_by]
    return Plant(
        transition=ArcMotion(step, wheelbase),
        noise=NoiseTimesStep(step, spread) if step is None else spread * step,
        initial_mean=initial_mean,
        initial_covariance=initial_covariance,
        states=[*read_two_axes(axes), "heading"],
        inputs=append_time_step(inputs) if step is None else inputs,
        circular=["heading"],
    )
