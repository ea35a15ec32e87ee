"""Log-likelihood of rows under a linear filter of traced numbers: of few operations where JAX differentiates it."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from heliograph.filters.derivatives_of_likelihood import take_derivatives_from
from heliograph.filters.linear.linear_filter_state import MomentsBeforeData
from heliograph.filters.linear.step_by_covariances import (
    FactoredStep,
    StateMoments,
    find_model_matrices,
    find_moments_at_start,
    step_by_covariances,
    take_derivatives_of_log_density,
)
from heliograph.filters.smoother_step import gaussian_of
from heliograph.numerics.numpy_or_jax import is_traced
from heliograph.numerics.types import Array, Float, PyTree

# The filter's state; the moments of its estimate; those before any data, None behind a known gain.
Carried = tuple[PyTree, StateMoments, MomentsBeforeData | None]


def trace_log_likelihood(
    plain: Callable[..., jax.Array], filter: Any, z: Float[Array, "steps m"], u: Float[Array, "steps inputs"]
) -> jax.Array:
    """Return the log-likelihood of rows: its value by factored covariances, its derivatives by the covariances.

    Values by factors L diag(d) L' are more exact; derivatives of the covariance matrices themselves are cheaper.

    Args:
        plain: the log-likelihood by the factors, a function of filter, z and u.
        filter: one of which some numbers are traced, and as `_sum_by_covariances` takes it.
        z: measurements, NaN for what did not arrive.
        u: inputs.
    """
    return take_derivatives_from(plain, _sum_by_covariances, (filter, z, u))


def _sum_by_covariances(filter: Any, z: Float[Array, "steps m"], u: Float[Array, "steps inputs"]) -> jax.Array:
    """Return the log-likelihood of all rows; NaN where the estimate is no number, as such a row looks lost.

    The likelihood is maximised over free numbers of the model, so it has derivatives by them. Its values come from the
    filter's own steps, by factors of covariances; the derivatives from the same steps written by covariances.

    Args:
        filter: the best linear one of a linear plant and sensor behind a channel of known law, without angles: a
            `LinearFilter`, or a Kalman filter, whose gain is known.
        z: measurements, NaN for what did not arrive.
        u: inputs.
    """
    constant = _hold_constant(filter)

    def step(before: Carried, row: tuple[jax.Array, ...]) -> tuple[Carried, jax.Array]:
        """Filter a row (number, measurement, input) twice: by factors, and by covariances for the derivatives.

        The values are those by factors, which are more exact but are not differentiated; the same numbers by
        covariances give them their derivatives. Returns what is carried to the next row (`Carried`), and the
        log-likelihood of this one.
        """
        (state, moments, before_data), (k, z, u) = before, row
        prior = constant.predict(state, _hold_constant(u), k)
        after, innovation = constant.correct(prior, _hold_constant(z), k)
        corrected = gaussian_of(after)
        factored = FactoredStep(gaussian_of(prior), corrected, innovation.value, innovation.covariance)
        # The same step by covariances: innovation e, its covariance S, and log N(e; 0, S) with the value by factors.
        matrices, before_data = find_model_matrices(filter, before_data, u, k)
        moments, e, S = step_by_covariances(matrices, moments, z, factored)
        lost = jnp.any(jnp.isnan(corrected.mean))
        density = take_derivatives_of_log_density(e, S, innovation.log_likelihood)
        return (after, moments, before_data), jnp.where(lost, jnp.nan, density)

    moments = find_moments_at_start(filter)
    start = jax.tree.map(jnp.asarray, constant.init())
    before_data = None if filter.has_known_gain else MomentsBeforeData(*moments)
    rows = jnp.arange(len(z)), jnp.asarray(z), jnp.asarray(u)
    _, log_densities = jax.lax.scan(step, (start, moments, before_data), rows)
    return jnp.sum(log_densities)


def _hold_constant(tree: PyTree) -> PyTree:
    """Return the same tree of numbers as constants: JAX does not differentiate by those that are traced.

    Numbers that are known while tracing are left as they are, so that they stay known.
    """
    return jax.tree.map(lambda leaf: jax.lax.stop_gradient(leaf) if is_traced(leaf) else leaf, tree)
