"""Rules of the incomplete gamma functions: a power series below the law's mean, a continued fraction above it."""

from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, JaxprEqn

from heliograph.codegen.lowering import IN_MEMORY, Lowering, Value, like
from heliograph.codegen.nodes import Unsupported

EPSILON = float(np.finfo(np.float64).eps)
TINY = float(np.finfo(np.float64).tiny) / EPSILON
Fraction = tuple[jax.Array, jax.Array, jax.Array, jax.Array, jax.Array]  # turn, Lentz's C and D, value, last change


def gamma_masses(a: jax.Array, x: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Compute the mass below and above x of the gamma law of shape a: P(a, x) and Q(a, x) = 1 - P; NaN below zero.

    P = x^a e^-x / Gamma(a) sum_n x^n / (a (a + 1) ... (a + n)) converges fast below a + 1; above it Q's fraction does,
    x^a e^-x / Gamma(a) / (x + 1 - a - 1 (1 - a) / (x + 3 - a - ...)), evaluated from the front.

    Source: Abramowitz and Stegun, Handbook of mathematical functions, 6.5.29 and 6.5.31; Lentz, Generating Bessel
    functions in Mie scattering calculations using continued fractions (1976).
    """
    above = x > a + 1
    density = jnp.exp(a * jnp.log(x) - x - jax.lax.lgamma(a))

    # Below the mean the series; each loop ends at once where the other serves.
    def add(state: tuple[jax.Array, jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array, jax.Array]:
        shape, term, total = state
        term = term * x / (shape + 1)
        return shape + 1, term, total + term

    first = jnp.where(above, 0.0, 1 / a)
    lower = density * jax.lax.while_loop(lambda s: s[1] > EPSILON * s[2], add, (a, first, first))[2]

    # Above it the continued fraction by Lentz's two quotients C and D.
    def continue_fraction(state: Fraction) -> Fraction:
        n, c, d, fraction, _ = state
        numerator, b = n * (a - n), x + 2 * n + 1 - a
        c, d = b + numerator / c, 1 / _apart(b + numerator * d)
        return n + 1, _apart(c), d, fraction * c * d, jnp.abs(c * d - 1)

    start = 1 / jnp.where(above, x + 1 - a, 1.0)
    state = (jnp.ones_like(x), jnp.full_like(x, 1 / TINY), start, start, jnp.where(above, 1.0, 0.0))
    upper = density * jax.lax.while_loop(lambda s: s[4] > EPSILON, continue_fraction, state)[3]

    # Both masses, the smaller one to all its digits.
    p = jnp.where(x == jnp.inf, 1.0, jnp.where(above, 1 - upper, lower))
    valid = (a > 0) & (x >= 0)
    return jnp.where(valid, p, jnp.nan), jnp.where(valid, jnp.where(above & (x < jnp.inf), upper, 1 - p), jnp.nan)


def _apart(x: jax.Array) -> jax.Array:
    """Return x, a tiny number for zero."""
    return jnp.where(x == 0, TINY, x)


def _masses(lowering: Lowering, equation: JaxprEqn, inputs: list[Value]) -> list[Value]:
    avals: list[Any] = [v.aval for v in equation.invars]
    if avals[0].dtype != np.float64:
        raise Unsupported(f"incomplete gamma functions of numbers of type {avals[0].dtype}")
    both = lowering.inline(_program(avals[0].shape), inputs)
    return [both[equation.primitive.name == "igammac"]]


@cache
def _program(shape: tuple[int, ...]) -> ClosedJaxpr:
    over = gamma_masses
    for _ in shape:
        over = jax.vmap(over)
    with jax.enable_x64(True):
        return jax.make_jaxpr(over)(like(shape, np.float64), like(shape, np.float64))


IN_MEMORY |= {"igamma": _masses, "igammac": _masses}
