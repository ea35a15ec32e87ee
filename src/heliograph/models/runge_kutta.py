"""Nonlinear plants from continuous time: dx = f(x, u) dt + dW by a Runge-Kutta step."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.model.plant import Plant, check_shape
from heliograph.model.readings.limit_arguments import StateLimitsLike
from heliograph.models.continuous_time import ContinuousSystem, Drift, Number, Square, Start, append_time_step
from heliograph.numerics.check import array, check_count, covariance, function, name_list, scalar
from heliograph.numerics.module import Module
from heliograph.numerics.numpy_or_jax import as_real
from heliograph.numerics.types import Array, Names
from heliograph.random_affine.noises.noise import NoiseLike


class DriftAndStepLength(Module):
    """dx/dt = f(x, u), and the length of a step: a number `dt`, or the last input where `dt` is None.

    `substeps` is the number of Runge-Kutta steps that a step is cut into.
    """

    drift: Drift
    dt: Any
    substeps: int = eqx.field(static=True)

    def split(self, u: jax.Array) -> tuple[jax.Array, Any]:
        """Return the inputs of the drift f, and the length of the step, which is the last of u where `dt` is None."""
        return (u, self.dt) if self.dt is not None else (u[:-1], u[-1])


class RungeKuttaStep(DriftAndStepLength):
    """Transition x+ of dx/dt = f(x, u) by the classical step of Runge and Kutta: local error of order dt^5."""

    def __call__(self, x: jax.Array, u: jax.Array) -> jax.Array:
        """Return the state (n,) after a step from x, under inputs u that are held over the step."""
        inputs, dt = self.split(u)
        h = dt / self.substeps

        def take_substep(_: object, x: jax.Array) -> jax.Array:
            """Return the state x after a shorter step of length h, by the fourth-order Runge-Kutta rule."""
            k1 = as_real(self.drift(x, inputs))
            k2 = as_real(self.drift(x + h / 2 * k1, inputs))
            k3 = as_real(self.drift(x + h / 2 * k2, inputs))
            k4 = as_real(self.drift(x + h * k3, inputs))
            x_after: jax.Array = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
            return x_after

        moved: jax.Array = (
            take_substep(0, x) if self.substeps == 1 else jax.lax.fori_loop(0, self.substeps, take_substep, x)
        )
        return moved


class LinearizedNoise(DriftAndStepLength):
    """Q of a step: the intensity spread by the Jacobian of f at one state."""

    intensity: Array
    state: Array

    def __call__(self, u: jax.Array) -> jax.Array:
        """Return the noise covariance Q (n, n) of a step, from the drift's Jacobian at the fixed state `self.state`.

        u holds the inputs of the drift, and the step's length if no number was given for it.
        """
        inputs_of_drift, dt = self.split(u)
        jacobian = jax.jacfwd(lambda x: as_real(self.drift(x, inputs_of_drift)))(jnp.asarray(self.state))
        linearized = ContinuousSystem(jacobian, np.zeros((len(self.state), 0)), self.intensity)
        return jnp.asarray(linearized.discretize_over(dt).noise)


def runge_kutta_plant(
    drift: Drift,
    intensity: Square,
    initial_mean: Start,
    initial_covariance: NoiseLike,
    dt: Number | None = None,
    states: Names | None = None,
    inputs: Names = (),
    circular: Names = (),
    substeps: int = 1,
    linearized_at: Start | None = None,
    limits: StateLimitsLike = (),
) -> "Plant":
    """Return the plant of dx = f(x, u) dt + dW by the classical Runge-Kutta step, of order 4: local error dt^5.

    Inputs are held over a step. The noise is the integral of exp(J s) S exp(J s)' over the step, with the Jacobian J of
    f at one state: exact where f is linear in x, and off by order dt^2 where J changes from there. Steps that are long
    for either are cut by the data: rows without measurements are steps.

    Args:
        drift: f(x, u), written with jax.numpy, from (n,) and (inputs,) to (n,); without dt.
        intensity: S, the covariance that W gains in a unit of time (n, n); a number for that in each state.
        initial_mean: mean of the state before the first step (n,).
        initial_covariance: its covariance, a variance for all of it, or the law of its deviation.
        dt: length of every step; by default the input "dt" behind the others says it.
        states: names of the states, or a mapping of names to units; x0, x1, ... by default.
        inputs: names of the inputs of f; none by default.
        circular: states that are angles, in radians; none by default.
        substeps: Runge-Kutta steps to a step (default 1).
        linearized_at: state at which J is taken (n,); `initial_mean` by default.
        limits: lowest and highest values of states that filters believe possible, as of `hg.Plant`; none by default.

    Raises:
        ValueError: a drift that returns no state, an intensity that is no covariance, what `hg.Plant` refuses.

    Source: Kutta, Beitrag zur näherungsweisen Integration totaler Differentialgleichungen (1901).
    """
    function("drift", drift, "(x, u)")
    mean = array("initial mean", initial_mean, (None,))
    n, inputs_of_drift = len(mean), name_list("input names", inputs)
    check_shape("drift(x, u)", drift, (mean, np.zeros(len(inputs_of_drift))), (n,))
    # The length of a step: a number, or None where the last input says it.
    step = None if dt is None else scalar("length of a step", dt, 0.0)
    state = mean if linearized_at is None else array("state of linearization", linearized_at, (n,))
    count = check_count("substeps", substeps)
    return Plant(
        transition=RungeKuttaStep(drift, step, count),
        noise=LinearizedNoise(drift, step, count, covariance("noise intensity", intensity, n), state),
        initial_mean=mean,
        initial_covariance=initial_covariance,
        states=states,
        inputs=inputs_of_drift if step is not None else append_time_step(inputs_of_drift),
        circular=[str(name) for name in name_list("circular states", circular)],
        limits=limits,
    )
