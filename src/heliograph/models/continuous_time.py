"""Plants from continuous time: dx = (A x + B u) dt + dW made x+ = F x + B u + w over a step of any length."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from typing_extensions import TypeAliasType

from heliograph.model.plant import TIME_STEP, LinearPlant
from heliograph.model.readings.limit_arguments import StateLimitsLike
from heliograph.numerics.check import array, covariance, fail, name_list, names, scalar
from heliograph.numerics.module import Module, readable
from heliograph.numerics.numpy_or_jax import is_traced, library
from heliograph.numerics.types import Array, ArrayLike, Float, Names
from heliograph.random_affine.noises.noise import NoiseLike

TERMS = 18  # of the series: (2 |A| h)^18 / 19! is below 1e-17 where |A| h is at most 1/2
HALVINGS = 40  # of a step whose length is an input: up to |A| dt = 5e11
Square = TypeAliasType("Square", Float[ArrayLike, "n n"])
Start = TypeAliasType("Start", Float[ArrayLike, " n"])
Columns = TypeAliasType("Columns", Float[ArrayLike, "n inputs"])
Number = TypeAliasType("Number", Float[ArrayLike, ""])
Drift = TypeAliasType("Drift", Callable[[jax.Array, jax.Array], ArrayLike])  # dx/dt of (x, u)


@readable
class Discretized(NamedTuple):
    """A step of dx = (A x + B u) dt + dW: x+ = `matrix` x + `input_matrix` u + w with Cov w = `noise`.

    Args:
        matrix: F = exp(A dt) (n, n).
        noise: Q, the integral of exp(A s) S exp(A s)' over the step (n, n).
        input_matrix: the integral of exp(A s) over the step, times B (n, inputs): u is held meanwhile.
    """

    matrix: Array
    noise: Array
    input_matrix: Array


def discretize(
    A: "Float[ArrayLike, 'n n']",
    intensity: "Float[ArrayLike, 'n n']",
    dt: "Float[ArrayLike, '']",
    B: "Float[ArrayLike, 'n inputs'] | None" = None,
) -> Discretized:
    """Return the step of length dt of dx = (A x + B u) dt + dW: F, Q, and the matrix of a constant input.

    All three come from series over a short step that is then doubled: Q(2h) = Q(h) + F(h) Q(h) F(h)'. These are sums of
    positive terms, so that no digits cancel however long or stiff the step is. F is exact to 1e-13 of its norm.

    Args:
        A: matrix of the motion (n, n).
        intensity: S (n, n), the covariance that W gains in a unit of time; a number is a variance for each state.
        dt: length of the step.
        B: matrix of the inputs (n, inputs); none by default.

    Raises:
        ValueError: matrices of other shapes, an intensity that is no covariance, a step that goes backwards.

    Source: Van Loan, Computing integrals involving the matrix exponential (1978), its integrals.
    """
    # Check the matrices and the length, then compute the series.
    model = _read_continuous_matrices(A, intensity, B)
    step = scalar("length of a step", dt, 0.0)
    return model.discretize_over(step)


class ContinuousSystem(Module):
    """Matrices A (n, n) and B (n, inputs) of dx = (A x + B u) dt + dW, and the intensity S (n, n) of W.

    The intensity is the covariance that W gains in a unit of time.
    """

    a: Array
    b: Array
    intensity: Array

    def discretize_over(self, dt: Any) -> Discretized:
        """Return the step of length dt, known or traced: F = exp(A dt), its integral times B, and Q.

        The model is dx = (A x + B u) dt + dW, where W gains the covariance S in a unit of time; Q is the integral of
        exp(A s) S exp(A s)' over the step. Series over a short step h = dt / 2^count are doubled `count` times.
        """
        xp = library(self.a, self.b, self.intensity, dt)  # NumPy, or JAX's for traced numbers
        a = xp.asarray(self.a)
        # The short step has |A| h <= 1/2 in the 1-norm, for which the series converge fast.
        size = xp.max(xp.sum(xp.abs(a), axis=0)) * dt
        count = xp.ceil(xp.log2(xp.maximum(2 * size, 1.0)))
        short = dt / 2**count
        integral, noise = self._integrate_short_step(xp, a, short)
        growth = a @ integral  # F - I = A times the integral of F
        step = StepOfSystem(growth=growth, matrix=np.eye(len(a)) + growth, integral=integral, noise=noise)
        # Doubled `count` times: by a loop of fixed length where `count` is traced.
        if is_traced(step, count):
            step = jax.lax.fori_loop(0, HALVINGS, _make_masked_doubling(count), step)
        else:
            for _ in range(int(count)):
                step = _double_step(step)
        # There are two answers for F. I + (F - I) loses numbers small beside 1, while the squared F is off by 2^count
        # roundings of itself: it is the better one where F is small enough.
        decayed = xp.max(xp.abs(step.matrix)) * 2**count < 1
        matrix = xp.where(decayed, step.matrix, np.eye(len(a)) + step.growth)
        return Discretized(matrix, (step.noise + step.noise.T) / 2, step.integral @ self.b)

    def _integrate_short_step(self, xp: Any, a: Any, h: Any) -> tuple[Any, Any]:
        """Return the integral of exp(A s), and that of exp(A s) S exp(A s)', over s from 0 to a short step h.

        Both are summed as series of TERMS + 1 terms. `xp` is the module of arrays, NumPy or JAX's, and `a` is A.
        """

        def add_term(k: Any, parts: tuple[Any, ...]) -> tuple[Any, ...]:
            """Return the terms of order k of both series, and the sums with these terms, from `parts`, those of k - 1.

            The first series is the integral of exp(A s) from 0 to h, with terms h^k A^(k-1) / k!. The second is the
            integral of exp(A s) S exp(A s)', with terms T_k = (h / k) (A T_k-1 + T_k-1 A').
            """
            integral_term, noise_term, integral, noise = parts
            integral_term = a @ integral_term * (h / k)
            half = a @ noise_term * (h / k)
            noise_term = half + half.T
            return integral_term, noise_term, integral + integral_term, noise + noise_term

        # The terms of order 1, h I and h S, which are the sums so far too.
        first_integral_term, first_noise_term = h * xp.eye(len(a)), h * xp.asarray(self.intensity)
        parts = first_integral_term, first_noise_term, first_integral_term, first_noise_term
        if is_traced(parts):
            parts = jax.lax.fori_loop(2, TERMS + 2, add_term, parts)
        else:
            for k in range(2, TERMS + 2):
                parts = add_term(k, parts)
        _integral_term, _noise_term, integral, noise = parts
        return integral, noise


class StepOfSystem(NamedTuple):
    """A step of dx = A x dt + dW, all matrices (n, n), NumPy's or JAX's.

    Args:
        growth: F - I, which keeps digits that F loses where the step is short.
        matrix: F = exp(A h).
        integral: the integral of exp(A s) over the step.
        noise: Q, the integral of exp(A s) S exp(A s)'.
    """

    growth: Any
    matrix: Any
    integral: Any
    noise: Any


def _double_step(step: StepOfSystem) -> StepOfSystem:
    """Return the matrices of twice a step h from those of the step.

    F(2h) = F F, F(2h) - I = 2 (F - I) + (F - I)^2, integral(2h) = 2 integral + (F - I) integral, and
    Q(2h) = Q + F Q F'.
    """
    growth, F, integral, Q = step
    FQ = Q + growth @ Q
    return StepOfSystem(
        growth=2 * growth + growth @ growth,
        matrix=F @ F,
        integral=2 * integral + growth @ integral,
        noise=Q + FQ + FQ @ growth.T,  # F Q F' = F Q + F Q (F - I)'
    )


def _make_masked_doubling(count: Any) -> Callable[[Any, StepOfSystem], StepOfSystem]:
    """Return the body of a loop that doubles a step in its first `count` turns and then leaves it unchanged.

    A compiled loop has a fixed number of turns, while `count` may be traced.
    """

    def double_up_to_count(i: Any, step: StepOfSystem) -> StepOfSystem:
        """Return the matrices of twice the step in turn i of the loop if i is below `count`, else the given ones."""
        # Double zeros after the last turn, so that nothing overflows and derivatives stay finite.
        goes_on = i < count
        step_or_zeros = StepOfSystem(*(jnp.where(goes_on, matrix, 0.0) for matrix in step))
        doubled = _double_step(step_or_zeros)
        return StepOfSystem(*(jnp.where(goes_on, new, old) for new, old in zip(doubled, step, strict=True)))

    return double_up_to_count


def _read_continuous_matrices(A: ArrayLike, intensity: ArrayLike, B: ArrayLike | None) -> ContinuousSystem:
    """Return A (n, n), B (n, inputs) and the noise intensity (n, n) as one system, after a check of their shapes.

    An intensity may be a number, a variance for each state. Where B is None there are no inputs.
    """
    a = array("matrix of the motion", A, (None, None))
    n = a.shape[0]
    a = array("matrix of the motion", a, (n, n))
    b = np.zeros((n, 0)) if B is None else array("input matrix", B, (n, "inputs"))
    return ContinuousSystem(a, b, covariance("noise intensity", intensity, n))


class TransitionOverStep(Module):
    """Transition matrix F = exp(A dt) as a function of the inputs u, one of which is the length dt of the step.

    `place` is the index of dt in u.
    """

    model: ContinuousSystem
    place: int = eqx.field(static=True)

    def __call__(self, u: jax.Array) -> jax.Array:
        """Return F (n, n) for the step length among the inputs u."""
        return jnp.asarray(self.model.discretize_over(u[self.place]).matrix)


class NoiseOverStep(TransitionOverStep):
    """Noise covariance Q as a function of the inputs u, one of which is the length dt of the step."""

    def __call__(self, u: jax.Array) -> jax.Array:
        """Return Q (n, n) for the step length among the inputs u."""
        return jnp.asarray(self.model.discretize_over(u[self.place]).noise)


class InputMatrixOverStep(TransitionOverStep):
    """Input matrix (integral of exp(A s)) B as a function of the inputs u, whose last is the length dt of the step."""

    def __call__(self, u: jax.Array) -> jax.Array:
        """Return the matrix (n, inputs + 1) for the step length in u; its last column, that of dt, is zero."""
        matrix = jnp.asarray(self.model.discretize_over(u[self.place]).input_matrix)
        return jnp.concatenate([matrix, jnp.zeros((len(matrix), 1))], axis=1)


def continuous_plant(
    A: Square,
    intensity: Square,
    initial_mean: Start,
    initial_covariance: NoiseLike,
    B: Columns | None = None,
    dt: Number | None = None,
    states: Names | None = None,
    inputs: Names | None = None,
    limits: StateLimitsLike = (),
) -> LinearPlant:
    """Return the plant of dx = (A x + B u) dt + dW, exact for steps of any length.

    Without `dt` the plant has the input "dt" behind its others, the length of each step, which recorded data and live
    clocks fill by themselves; rows may be as far apart as they like. With a number, all matrices are constants.

    Args:
        A: matrix of the motion (n, n).
        intensity: S, the covariance that W gains in a unit of time (n, n); a number for that in each state.
        initial_mean: mean of the state before the first step (n,).
        initial_covariance: its covariance, a variance for all of it, or the law of its deviation.
        B: matrix of inputs that are held over a step (n, inputs); none by default.
        dt: length of every step; by default the input "dt" says it.
        states: names of the states, or a mapping of names to units; x0, x1, ... by default.
        inputs: names of the columns of B; u0, u1, ... by default.
        limits: lowest and highest values of states that filters believe possible, as of `hg.Plant`; none by default.

    Raises:
        ValueError: matrices of other shapes, an intensity that is no covariance, a step that goes backwards, an input
            that is called "dt" already, limits that exclude the initial mean.

    Source: Van Loan, Computing integrals involving the matrix exponential (1978).
    """
    model = _read_continuous_matrices(A, intensity, B)
    count = model.b.shape[1]
    named = names("input names", inputs, count, "u")
    # Steps of one length: constant matrices.
    if dt is not None:
        step = model.discretize_over(scalar("length of a step", dt, 0.0))
        return LinearPlant(
            matrix=step.matrix,
            noise=step.noise,
            initial_mean=initial_mean,
            initial_covariance=initial_covariance,
            input_matrix=step.input_matrix,
            states=states,
            inputs=named,
            limits=limits,
        )
    # Steps of a length that the last input says: matrices that are functions of it.
    return LinearPlant(
        matrix=TransitionOverStep(model, count),
        noise=NoiseOverStep(model, count),
        initial_mean=initial_mean,
        initial_covariance=initial_covariance,
        input_matrix=InputMatrixOverStep(model, count) if count else None,
        states=states,
        inputs=append_time_step(named),
        limits=limits,
    )


def append_time_step(inputs: Names) -> list[str]:
    """Return the names of inputs followed by "dt" (TIME_STEP), the length of a step; raise if "dt" is among them."""
    names = name_list("input names", inputs)
    if TIME_STEP in names:
        raise fail("input names", f"no {TIME_STEP!r}, which is added as the length of a step", names)
    return [*names, TIME_STEP]
