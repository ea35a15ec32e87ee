"""Log-likelihood of recorded data under a filter's model: the sum over its innovations."""

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.filters.base import AbstractFilter
from heliograph.numerics.check import array, fail, instance
from heliograph.numerics.float64 import compiled
from heliograph.numerics.types import Array, ArrayLike, Float, PyTree, Scalar


def log_likelihood(
    filter: AbstractFilter,
    measurements: Float[ArrayLike, "steps received"],
    inputs: Float[ArrayLike, "steps inputs"] | None = None,
) -> Scalar:
    """log p(z_1, z_2, ...) under the filter's model: the sum of its innovations' log-likelihoods, in nats.

    Exact for the Kalman filter of a linear Gaussian system; nominal, and still what a fit can maximise, elsewhere.
    `jax.grad` passes through it, with respect to any array of the filter, in the precision of the trace
    (`jax.enable_x64`).

    Args:
        filter: the filter.
        measurements: rows (steps, received); NaN did not arrive and adds nothing.
        inputs: rows (steps, inputs); by default a filter without inputs is assumed.

    Raises:
        ValueError: measurements or inputs of the wrong shape, infinite values, more steps than the filter covers.

    Source: Schweppe, Evaluation of likelihood functions for Gaussian signals (1965).
    """
    instance("filter", filter, AbstractFilter, "a filter")
    # Shapes of the data, which may be traced.
    z = rows("measurements", measurements, None, filter.received, missing=True)
    steps = len(z)
    if not len(filter.inputs) and inputs is None:
        inputs = np.zeros((steps, 0))
    u = rows("inputs", inputs, steps, len(filter.inputs), missing=False)
    if filter.horizon is not None and steps > filter.horizon:
        raise fail("measurements", f"at most {filter.horizon} steps, which the filter covers", steps)
    # One scan; a plain number unless it is traced.
    total = _sum(filter, z, u)
    return total if isinstance(total, jax.core.Tracer) else float(total)


def rows(name: str, value: ArrayLike | None, steps: int | None, length: int, missing: bool) -> Float[Array, "steps n"]:
    """Array of `length` numbers a step; NaN where `missing` is allowed."""
    if isinstance(value, jax.core.Tracer):
        return value
    try:
        values = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise fail(name, "an array of numbers", repr(value)[:60]) from None
    values = values[:, None] if values.ndim == 1 and length == 1 else values
    gaps = np.isnan(values) & missing
    return np.where(gaps, np.nan, array(name, np.where(gaps, 0.0, values), (steps, length)))


@compiled
def _sum(item: AbstractFilter, z: Float[Array, "steps m"], u: Float[Array, "steps inputs"]) -> jax.Array:
    def body(state: PyTree, row: tuple[jax.Array, ...]) -> tuple[PyTree, jax.Array]:
        k, z_k, u_k = row
        after, innovation = item.correct(item.predict(state, u_k, k), z_k, k)
        return after, jnp.asarray(innovation.log_likelihood)

    start = jax.tree.map(jnp.asarray, item.init())
    return jnp.sum(jax.lax.scan(body, start, (jnp.arange(len(z)), jnp.asarray(z), jnp.asarray(u)))[1])
