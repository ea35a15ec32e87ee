"""Draw paths of the state given all data: a filter ahead, and draws on the way back (FFBS)."""

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.factors.factored_gaussian import Gaussian
from heliograph.factors.pivots import square_root
from heliograph.filters.base import AbstractFilter
from heliograph.filters.rows.run_over_data import check_data
from heliograph.filters.smoother_step import SmootherStep
from heliograph.numerics.angles.angle import wrap_angles
from heliograph.numerics.check import check_count, check_seed, fail, instance
from heliograph.numerics.float64 import compile_in_float64
from heliograph.numerics.types import Array, ArrayLike, Float
from heliograph.smoothing.forward_and_backward_pass import filter_rows_with_smoother_steps, take_step, take_steps


def simulation_smoother(
    filter: AbstractFilter,
    z: Float[ArrayLike, "steps received"],
    u: Float[ArrayLike, "steps inputs"] | None = None,
    draws: int = 1000,
    seed: int = 0,
) -> Float[np.ndarray, "draws steps n"]:
    """Draw paths of the states given all rows, from the law whose moments are the smoothed means and covariances.

    The last state is drawn from its filtered law, each one before from its law given the state drawn after it:
    x_k = m + J (x_{k+1} - m-) + e. Here m is the filtered mean of x_k, m- the predicted mean of x_{k+1}, J the
    smoother's gain Cov(x_k, x_{k+1}) Cov(x_{k+1})^-1 given the data up to step k, and e a draw of zero mean. So each
    path as a whole is a draw, and answers how long a level was passed, or what the greatest value was. For a linear
    Gaussian model the draws are exact.

    Args:
        filter: a filter that can be smoothed; any that keeps a covariance.
        z: measurements (steps, received), or (steps,) of one number; NaN for what did not arrive.
        u: inputs (steps, inputs), the one that led to each row; by default a filter without inputs is assumed.
        draws: number of paths; 1000 by default.
        seed: seed of the random numbers; 0 by default.

    Returns:
        States (draws, steps, n), angles between -pi and pi.

    Raises:
        ValueError: data of another size than the filter's, no rows, a filter that cannot be smoothed.

    Source: Fruehwirth-Schnatter, Data augmentation and dynamic linear models (1994); Carter and Kohn (1994).
    """
    instance("filter", filter, AbstractFilter, "a filter, such as kalman_filter(...)")
    rows, inputs = check_data(filter, z, u)
    if not len(rows):
        raise fail("measurements", "at least one row", "none")
    key = jax.random.key(check_seed("seed", seed))
    keys = jax.random.split(key, check_count("draws", draws))
    return np.asarray(_draw_paths(filter, rows, inputs, keys))


@compile_in_float64
def _draw_paths(filter: AbstractFilter, z: Array, u: Array, keys: jax.Array) -> jax.Array:
    """Draw one path of the states for each key (draws, steps, n): one filter pass, then a pass back for each draw.

    Args:
        filter: the filter.
        z: measurements (steps, received), NaN where nothing arrived.
        u: inputs (steps, inputs).
        keys: a random key for each path (draws,).
    """
    first_step = np.asarray(0)
    _, steps = filter_rows_with_smoother_steps(filter, z, u, filter.init(), first_step)
    if steps.before is None:  # no single regression of a state on the next, as with several modes
        raise fail("paths", "a filter of one law of motion (rts_smoother takes several)", type(filter).__name__)
    paths: jax.Array = jax.vmap(lambda key: _draw_path_back(steps, key))(keys)
    return paths


def _draw_path_back(steps: SmootherStep, key: jax.Array) -> jax.Array:
    """Draw one path (steps, n) of the plant's states given all data, from the last step back.

    Paths show what the states may have been together, where a smoother gives each step's law alone. The last state is
    drawn from its filtered law, each earlier one from its law given the state drawn after it.

    Args:
        steps: of a filter, stacked along time: the regression of its state before a step on that after it (`before`),
            the filtered law after it (`after`), and which states are angles or attitudes (`manifold`).
        key: random key of the path.
    """

    def body(later: jax.Array, pair: tuple[SmootherStep, SmootherStep, jax.Array]) -> tuple[jax.Array, jax.Array]:
        """Draw the filter's state between two steps, given the drawn state `later` = x+ after both steps.

        The regression of x on x+ is x = m + J (x+ - m+) + noise, with the filtered mean m and the predicted mean m+.
        Return x, which the pass goes on with, and the plant's part of it.
        """
        previous, step, key = pair
        regression, manifold = step.before, step.manifold
        filtered_mean, predicted_mean = regression.left.mean, regression.ahead
        # An attitude x+ is replaced by the rotation vector that leads to it from m+, since the regression is linear.
        # Its result is a rotation vector from m, by which `settle` rotates m.
        mean = regression.mean_given(manifold.unsettle(predicted_mean, later))
        x = manifold.settle(filtered_mean, _draw_gaussian(regression.left._replace(mean=mean), key))
        return x, _take_plant_state(previous, x)

    # The last state, then back over pairs of successive steps, each with a key of its own.
    last = take_step(steps, -1)
    keys = jax.random.split(key, len(steps.mean))
    end = last.manifold.settle(last.after.mean, _draw_gaussian(last.after, keys[-1]))
    pairs = take_steps(steps, slice(None, -1)), take_steps(steps, slice(1, None)), keys[:-1]
    _, earlier = jax.lax.scan(body, end, pairs, reverse=True)
    return jnp.concatenate([earlier, _take_plant_state(last, end)[None]])


def _draw_gaussian(law: Gaussian, key: jax.Array) -> jax.Array:
    """Draw x = m + L diag(d)^1/2 e, with e standard normal, from a Gaussian of mean m and covariance L diag(d) L'."""
    normal = jax.random.normal(key, law.variances.shape, dtype=float)
    return jnp.asarray(law.mean + law.root @ (square_root(law.variances) * normal))


def _take_plant_state(step: SmootherStep, x: jax.Array) -> jax.Array:
    """Return the plant's state (n,), projection y + offset, for the filter's state y = `x`; angles within -pi and pi.

    Without a projection the filter's state is the plant's; `offset` is a mean that the filter subtracts.
    """
    x = x if step.projection is None else step.projection @ x
    return wrap_angles(x if step.offset is None else x + step.offset, step.angles)
