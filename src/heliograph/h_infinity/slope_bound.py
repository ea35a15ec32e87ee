"""A proven bound of a function's slope over a box: intervals of its Jacobian, over ever smaller parts of the box."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.h_infinity.interval import Interval, UnknownError, evaluate
from heliograph.numerics.types import Float

BOXES = 256  # looked at together
LIMIT = 16_384  # boxes in all: what is not proven by then is left unproven
NORM_ROUNDING = 1e-13  # relative, of the spectral norm of a small matrix


class SlopeBound(NamedTuple):
    """Largest norm that a Jacobian in the box can have, infinite if nothing is proven, and the reason if so."""

    value: float
    reason: str


def slope_bound(
    function: Callable[[jax.Array], jax.Array], low: Float[np.ndarray, " n"], high: Float[np.ndarray, " n"], goal: float
) -> SlopeBound:
    """Compute a proven bound of |f(x) - f(y)| / |x - y| over a box, below `goal` if LIMIT boxes suffice.

    |J| <= |C| + |R| (spectral norms) for every J in the interval C +- R of a part's Jacobians; a function that is
    continuous, and differentiable but for kinks, has no larger ratio than the largest of these. Continuous is one made
    of continuous operations, with every decision the same throughout the box.
    """
    try:
        with jax.enable_x64(True):
            example = jnp.zeros((BOXES, len(low)))
            plain = jax.vmap(lambda x: jnp.atleast_1d(function(x)))
            whole = Interval(np.tile(low, (BOXES, 1)), np.tile(high, (BOXES, 1)))
            evaluate(jax.make_jaxpr(plain)(example), [whole], continuous=True)
            slopes = jax.make_jaxpr(jax.vmap(jax.jacfwd(lambda x: jnp.atleast_1d(function(x)))))(example)
            return SlopeBound(_sharpened(slopes, low, high, goal), "")
    except UnknownError as reason:
        return SlopeBound(np.inf, f"cannot follow {reason}")


def _sharpened(
    slopes: jax.extend.core.ClosedJaxpr, low: Float[np.ndarray, " n"], high: Float[np.ndarray, " n"], goal: float
) -> float:
    bottoms, tops, done, seen = low[None], high[None], 0.0, 0
    while len(bottoms):
        bounds = np.concatenate(
            [_bounds(slopes, bottoms[i : i + BOXES], tops[i : i + BOXES]) for i in range(0, len(bottoms), BOXES)]
        )
        seen += len(bottoms)
        open_ = bounds > goal
        done = max(done, float(np.max(bounds[~open_], initial=0.0)))
        if seen + 2 * np.count_nonzero(open_) > LIMIT:
            return max(done, float(np.max(bounds)))
        bottoms, tops = _halved(bottoms[open_], tops[open_], high - low)
    return done


def _bounds(slopes: jax.extend.core.ClosedJaxpr, low: np.ndarray, high: np.ndarray) -> Float[np.ndarray, " boxes"]:
    short = BOXES - len(low)
    ends = [np.concatenate([end, np.repeat(end[-1:], short, axis=0)]) for end in (low, high)]
    (result,) = evaluate(slopes, [Interval(*ends)], continuous=False)
    finite = np.isfinite(result.low) & np.isfinite(result.high)
    a, b = np.where(finite, result.low, 0.0), np.where(finite, result.high, 0.0)
    centre = a / 2 + b / 2
    radius = np.nextafter(np.maximum(b - centre, centre - a), np.inf)
    norms = sum(np.linalg.norm(part, 2, axis=(-2, -1)) for part in (centre, radius)) * (1 + NORM_ROUNDING)
    return np.where(finite.all(axis=(1, 2)), norms, np.inf)[: len(low)]


def _halved(low: np.ndarray, high: np.ndarray, width: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Every box in two, across its widest side, in shares of the whole box's."""
    sides = np.argmax((high - low) / np.where(width > 0, width, 1.0), axis=1)
    rows = np.arange(len(low))
    middle = (low[rows, sides] + high[rows, sides]) / 2
    left, right = high.copy(), low.copy()
    left[rows, sides] = right[rows, sides] = middle
    return np.concatenate([low, right]), np.concatenate([left, high])
