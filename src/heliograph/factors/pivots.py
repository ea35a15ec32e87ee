"""Numbers that may be zero: their reciprocals and roots, and the pivots by which a covariance is factored.

The factors of a covariance P say nothing of its derivative where a pivot d_j is zero: column j of L is then 0 / 0, and
what P' has there is lost. Where a program is differentiated (`write_for_derivatives`) such a pivot is INFINITESIMAL
instead, of which nothing is left beside any number: L_j' = P' / d_j is then large, and d_j L_j' is P' again, so that
all that follows has the derivatives of covariances.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from heliograph.numerics.trace_settings import precision_in_use, writes_for_derivatives
from heliograph.numerics.types import Array

INFINITESIMAL = 1 / 3  # power of the least number: its square still has a reciprocal, as derivatives of 1 / d need


def is_positive(x: jax.Array) -> jax.Array:
    """Return whether x is a positive normal number: of smaller ones 1 / x may be infinite, so that they count as 0."""
    return lax.gt(x, lax.full_like(x, np.finfo(np.dtype(x.dtype)).tiny))


@jax.jit
def reciprocal_or_one(x: jax.Array) -> jax.Array:
    """Return 1 / x of a positive number, and 1 of 0: for a numerator that is 0 where x is, so that 0 / 0 is 0."""
    return lax.div(lax.full_like(x, 1.0), lax.select(is_positive(x), x, lax.full_like(x, 1.0)))


@jax.jit
def reciprocal_or_zero(x: jax.Array) -> jax.Array:
    """Return 1 / x of a positive number, and 0 of 0: of a variance that is 0, such a gain is 0."""
    positive, one = is_positive(x), lax.full_like(x, 1.0)
    return lax.select(positive, lax.div(one, lax.select(positive, x, one)), lax.full_like(x, 0.0))


@jax.jit
def square_root(x: jax.Array) -> jax.Array:
    """Return the root of x, with the derivative 0 at 0: times the infinite one a derivative of 0 would be NaN."""
    positive = lax.gt(x, lax.full_like(x, 0.0))
    return lax.select(positive, lax.sqrt(lax.select(positive, x, lax.full_like(x, 1.0))), lax.full_like(x, 0.0))


@jax.custom_jvp
def share_of_sum(part: jax.Array, rest: jax.Array) -> jax.Array:
    """Return part / (part + rest), 0 of 0, with the derivative (rest part' - part rest') / (part + rest)^2.

    Derivatives of a quotient would be differences of numbers as large as 1 / part, where the rest is zero.
    """
    share: jax.Array = part * reciprocal_or_one(part + rest)
    return share


@share_of_sum.defjvp
def _differentiate_share(primals: Any, tangents: Any) -> tuple[jax.Array, jax.Array]:
    """Return the share, and its derivative along the tangents, which has no difference of nearly equal numbers."""
    (part, rest), (d_part, d_rest) = primals, tangents
    reciprocal = reciprocal_or_one(part + rest)
    d_share = (rest * reciprocal) * (d_part * reciprocal) - (part * reciprocal) * (d_rest * reciprocal)
    return share_of_sum(part, rest), d_share


def replace_value(value: jax.Array, expression: jax.Array) -> jax.Array:
    """Return `value`, but with the derivatives of `value` plus those of `expression`.

    The term that is added, the expression less itself as a constant, is 0 but has its derivatives. If the value is
    constant, the result has those of the expression alone.
    """
    return value + (expression - lax.stop_gradient(expression))


def rounding_of_pivots(covariance: Array) -> float:
    """Return the share of its variance to which elimination of n columns knows a pivot: n eps, one for each column."""
    return len(covariance) * unit_of(covariance)


def unit_of(numbers: Array) -> float:
    """Return eps, the relative rounding error, of the precision in which these numbers are computed."""
    return max(float(np.finfo(np.dtype(numbers.dtype)).eps), float(np.finfo(precision_in_use()).eps))


def take_pivot(
    column: jax.Array, j: int | jax.Array, least: jax.Array, covariance: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return pivot j of a covariance, at least `least[j]`, the column that it divides, and its reciprocal, 0 of 0.

    Where the program is differentiated, a pivot of no more than rounding is zero but for that: it is then the larger of
    `least[j]` and an infinitesimal number, the column is 0, and both have the derivatives of what was given.

    Args:
        column: j, of what is left of the covariance (n,); its entry j is the pivot, which rounding may make negative.
        j: the column's number.
        least: the smallest pivots (n,).
        covariance: all of it (n, n).
    """
    pivot, lowest = column[j], least[j]
    if not writes_for_derivatives():
        # Not by a maximum, which halves the derivative where both are zero.
        d = lax.select(lax.ge(pivot, lowest), pivot, lowest)
        return d, column, reciprocal_or_zero(d)
    is_more = pivot > jnp.maximum(lowest, rounding_of_pivots(covariance) * abs(covariance[j, j]))
    smallest = float(np.finfo(np.dtype(pivot.dtype)).tiny) ** INFINITESIMAL
    once = differentiable_once(column, ~is_more)  # 1 / d has no digits left of a second derivative
    d = jnp.where(is_more, pivot, replace_value(jnp.maximum(lowest, smallest), once[j]))
    return d, jnp.where(is_more, column, replace_value(jnp.zeros_like(column), once)), 1 / d


def set_to_zero(numbers: jax.Array, is_rounding: jax.Array) -> jax.Array:
    """Return the numbers, with 0 in place of those that are only rounding.

    Where the program is differentiated, these zeros keep the first derivatives of the numbers.
    """
    if not writes_for_derivatives():
        return jnp.where(is_rounding, 0.0, numbers)
    once = differentiable_once(numbers, is_rounding)
    return jnp.where(is_rounding, replace_value(jnp.zeros_like(numbers), once), numbers)


def spoils_what_is_known(power: jax.Array, least: jax.Array, noise: jax.Array) -> jax.Array:
    """Return whether a measurement's slopes are only rounding, so that measuring by them would spoil the state.

    They are rounding if their variance `power` = f' diag(d) f is at most `least`. In a program that is differentiated
    they are kept all the same beside a noise variance of `least` / eps or more: they change no digit of a value then,
    and their derivatives count.
    """
    is_rounding = power <= least
    return is_rounding & (least > unit_of(least) * noise) if writes_for_derivatives() else is_rounding


@jax.custom_jvp
def spoil_derivatives(numbers: jax.Array, spoilt: jax.Array) -> jax.Array:
    """Return the numbers unchanged, with derivatives that are NaN where `spoilt` says so.

    For places where rounding leaves no digit of a derivative: NaN is seen, a wrong number is not. `spoilt` has the
    shape of the numbers, or one that broadcasts to it.
    """
    return numbers


@spoil_derivatives.defjvp
def _differentiate_spoilt(primals: Any, tangents: Any) -> tuple[jax.Array, jax.Array]:
    """Return the numbers, and their derivatives along a tangent: NaN where `spoilt`, and as they are elsewhere."""
    (numbers, spoilt), (slopes, _) = primals, tangents
    return numbers, slopes * jnp.where(spoilt, jnp.nan, 1.0)


@jax.custom_jvp
def differentiable_once(numbers: jax.Array, where: jax.Array) -> jax.Array:
    """Return the numbers unchanged, such that their second derivatives at `where` become infinite or NaN.

    Used where a first derivative is right, but rounding has taken all digits of the second.
    """
    return numbers


@differentiable_once.defjvp
def _differentiate_once(primals: Any, tangents: Any) -> tuple[jax.Array, jax.Array]:
    """Return the numbers, and their derivatives times the factor 1 + (x - c) largest^2, c the constant value of x.

    The factor is 1. Its own derivative, largest^2, is 0 except at `where`, where it overflows: so second derivatives
    are infinite or NaN there instead of wrong numbers.
    """
    (numbers, where), (slopes, _) = primals, tangents
    largest = jnp.where(where, float(np.finfo(np.dtype(numbers.dtype)).max), jnp.zeros_like(numbers))
    none = numbers - lax.stop_gradient(numbers)
    return differentiable_once(numbers, where), slopes * (1 + none * largest * largest)
