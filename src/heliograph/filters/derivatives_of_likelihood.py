"""Derivatives of a likelihood by another program than the one that computes its value, written only where JAX asks."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero

from heliograph.factors.pivots import spoil_derivatives
from heliograph.numerics.numpy_or_jax import is_traced
from heliograph.numerics.trace_settings import write_for_derivatives

Likelihood = Callable[..., jax.Array]


def evaluate_for_derivatives(likelihood: Likelihood) -> Likelihood:
    """Return the same function, traced by JAX so that derivatives are right also where covariances are zero.

    This takes more operations than the value alone: `write_for_derivatives` makes the functions inside write them.
    """

    def evaluate(*arguments: Any) -> jax.Array:
        """Return the likelihood of these arguments, written by more operations than its value needs."""
        with write_for_derivatives():
            return likelihood(*arguments)

    return evaluate


def take_derivatives_from(plain: Likelihood, differentiated: Likelihood, arguments: tuple[Any, ...]) -> jax.Array:
    """Return plain(*arguments), a log-likelihood, with the derivatives of another function that computes it too.

    The fastest code, such as native code, often cannot be differentiated by JAX; a rule for derivatives is attached.

    Args:
        plain: the log-likelihood as it is computed best.
        differentiated: the same by a program that can be differentiated; it is traced only for a derivative.
        arguments: filter, measurements and inputs; some numbers in them are traced by JAX.
    """
    # The arguments as a list of numbers and arrays; only traced ones may have derivatives, known ones stay constants.
    leaves, form = jax.tree.flatten(arguments)
    traced = [i for i, leaf in enumerate(leaves) if is_traced(leaf)]

    @jax.custom_jvp
    def evaluate(values: list[jax.Array]) -> jax.Array:
        """Return the log-likelihood at these values of the traced arguments."""
        return plain(*jax.tree.unflatten(form, _replace_entries(leaves, traced, values)))

    def differentiate(primals: Any, tangents: Any) -> tuple[jax.Array, jax.Array]:
        """Return the log-likelihood and its derivative along the tangents.

        A tangent that is a SymbolicZero is known to be zero, so only the derivatives by the other values are computed.
        """
        (values,), (slopes,) = primals, tangents
        moving = [n for n, slope in enumerate(slopes) if not isinstance(slope, SymbolicZero)]

        def move(moved: list[jax.Array]) -> jax.Array:
            """Return the log-likelihood with the values `moved` in place of those with tangents.

            One that is not finite, of data that the model excludes, has no derivative.
            """
            all_values = _replace_entries(values, moving, moved)
            total = differentiated(*jax.tree.unflatten(form, _replace_entries(leaves, traced, all_values)))
            return spoil_derivatives(total, ~jnp.isfinite(total))

        return jax.jvp(move, ([values[n] for n in moving],), ([slopes[n] for n in moving],))

    evaluate.defjvp(differentiate, symbolic_zeros=True)
    return evaluate([leaves[i] for i in traced])


def _replace_entries(entries: list[Any], places: list[int], values: list[jax.Array]) -> list[Any]:
    """Return the list `entries` with values[n] in place of the entry at places[n]."""
    changed = dict(zip(places, values, strict=True))
    return [changed.get(i, entry) for i, entry in enumerate(entries)]
