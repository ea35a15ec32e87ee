"""Draw the leading states of a Gaussian: the law of the others given them, and the density of what was drawn."""

from collections.abc import Callable

import jax
import jax.numpy as jnp

from heliograph.factors.covariance_factors import decorrelate
from heliograph.factors.factored_gaussian import Gaussian
from heliograph.factors.pivots import square_root
from heliograph.factors.repeated_measurements import rounding_of_products
from heliograph.numerics.gaussian_density import LOG_TURN


def slopes_given_drawn(
    function: Callable[[jax.Array], jax.Array], x: Gaussian, drawn: int
) -> tuple[jax.Array, jax.Array]:
    """Return f(mean) (m,), and the slopes df/dxi (m, n) of f at the mean, for x = mean + L xi with a triangular L.

    The first `drawn` states are known and have no variance, so that the slopes in their xi are 0.
    """

    def function_of_others(others: jax.Array) -> jax.Array:
        """Return f of the states that are not drawn, with the drawn ones at their means."""
        return function(jnp.concatenate([x.mean[:drawn], others]))

    others = x.mean[drawn:]
    # The rows of L for the others are zero in the drawn states' columns, which have no variance.
    slopes = jax.jacfwd(function_of_others)(others) @ x.root[drawn:, drawn:]
    return function_of_others(others), jnp.pad(slopes, ((0, 0), (drawn, 0)))


def condition_on_draw(x: Gaussian, draw: jax.Array) -> Gaussian:
    """Return x given its leading states, drawn as mean + L sqrt(variance) draw; draw (drawn,) is standard normal.

    L is the unit triangular factor of the covariance of x.
    """
    drawn = len(draw)
    xi = square_root(x.variances[:drawn]) * draw
    return x._replace(mean=x.mean + x.root[:, :drawn] @ xi, variances=x.variances.at[:drawn].set(0.0))


def find_states_without_variance(x: Gaussian, d: jax.Array) -> jax.Array:
    """Return which of the leading states d (drawn,) have no variance given those before them, except rounding.

    `second_moment` bounds E[d^2], and the variance of rounding is a share of it.
    """
    drawn = len(d)
    second_moment = x.root[:drawn, :drawn] ** 2 @ x.variances[:drawn] + d**2
    return x.variances[:drawn] <= rounding_of_products(drawn, second_moment)


def condition_on_leading_states(x: Gaussian, d: jax.Array, certain: jax.Array) -> tuple[Gaussian, jax.Array]:
    """Return x given its leading states d (drawn,), and the log of their density.

    The Gaussian is x = mean + L xi with a unit lower triangular L (`root`) and uncorrelated xi: xi_i is the difference
    of state i from its mean given the states before it, of variance `variances`[i]. So xi = L^-1 (d - mean) of the
    leading states. A `certain` (drawn,) state has no variance and no density, and adds 0 to the log.
    """
    drawn = len(d)
    xi = decorrelate(x.root[:drawn, :drawn], (d - x.mean[:drawn])[:, None])[:, 0]
    variances = jnp.where(certain, 1.0, x.variances[:drawn])
    log_density = -(xi**2 / variances + jnp.log(variances) + LOG_TURN) / 2  # LOG_TURN = log 2 pi
    log_density = jnp.where(certain, 0.0, log_density)
    mean = (x.mean + x.root[:, :drawn] @ xi).at[:drawn].set(d)
    conditioned = x._replace(mean=mean, variances=x.variances.at[:drawn].set(0.0))
    return conditioned, jnp.sum(log_density)


def draw_index(log_weight: jax.Array, uniform: jax.Array) -> jax.Array:
    """Draw an index for each row of log weights (N, M), by one uniform number of [0, 1) each (N,).

    Index j has the probability exp(log_weight_j) / sum. It is drawn where the cumulated probabilities pass the number.
    """
    cumulated = jnp.cumsum(jax.nn.softmax(log_weight, axis=1), axis=1)
    return jnp.sum(cumulated[:, :-1] <= uniform[:, None], axis=1)
