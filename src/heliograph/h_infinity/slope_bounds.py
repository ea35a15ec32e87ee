"""Proven bound of a function's slope over a box, by interval arithmetic on its Jacobian."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.h_infinity.interval_arithmetic import Interval, NoIntervalError, bound_program
from heliograph.numerics.types import Float

BOXES = 256  # looked at together
LIMIT = 16_384  # boxes in all: what is not proven by then is left unproven
NORM_ROUNDING = 1e-13  # relative, of the spectral norm of a small matrix


class SlopeBound(NamedTuple):
    """Largest norm that a Jacobian in the box can have, infinite if nothing is proven, and the reason if so."""

    value: float
    reason: str


def prove_slope_bound(
    function: Callable[[jax.Array], jax.Array], low: Float[np.ndarray, " n"], high: Float[np.ndarray, " n"], goal: float
) -> SlopeBound:
    """Return a proven bound of |f(x) - f(y)| / |x - y| over a box, below `goal` if LIMIT boxes suffice.

    |J| <= |C| + |R| (spectral norms) for every J in the interval C +- R of a part's Jacobians; a function that is
    continuous, and differentiable but for kinks, has no larger ratio than the largest of these. Continuous is one made
    of continuous operations, with every decision the same throughout the box.
    """
    try:
        with jax.enable_x64(True):
            example = jnp.zeros((BOXES, len(low)))
            # The function itself over the whole box: refused unless it is continuous. Programs take BOXES boxes at
            # once, so the box is repeated.
            values = jax.vmap(lambda x: jnp.atleast_1d(function(x)))
            whole_box = Interval(np.tile(low, (BOXES, 1)), np.tile(high, (BOXES, 1)))
            bound_program(jax.make_jaxpr(values)(example), [whole_box], continuous=True)
            slopes = jax.make_jaxpr(jax.vmap(jax.jacfwd(lambda x: jnp.atleast_1d(function(x)))))(example)
            return SlopeBound(_sharpen_bound(slopes, low, high, goal), "")
    except NoIntervalError as reason:
        return SlopeBound(np.inf, f"cannot follow {reason}")


def _sharpen_bound(
    slopes: jax.extend.core.ClosedJaxpr, low: Float[np.ndarray, " n"], high: Float[np.ndarray, " n"], goal: float
) -> float:
    """Return a bound of all slopes in a box, as sharp as the `goal` if that takes at most LIMIT boxes.

    Boxes whose bound is above the goal are halved, since bounds by interval arithmetic are sharper over smaller boxes.

    Args:
        slopes: program of the Jacobian at BOXES points.
        low: lower corner of the box (n,).
        high: upper corner (n,).
        goal: the slope that is not to be exceeded.
    """
    bottoms, tops = low[None], high[None]
    largest_within = 0.0  # bound of the boxes that are within the goal
    boxes_seen = 0
    while len(bottoms):
        bounds = np.concatenate(
            [_bound_slopes(slopes, bottoms[i : i + BOXES], tops[i : i + BOXES]) for i in range(0, len(bottoms), BOXES)]
        )
        boxes_seen += len(bottoms)
        undecided = bounds > goal
        largest_within = max(largest_within, float(np.max(bounds[~undecided], initial=0.0)))
        if boxes_seen + 2 * np.count_nonzero(undecided) > LIMIT:
            return max(largest_within, float(np.max(bounds)))
        bottoms, tops = _halve_boxes(bottoms[undecided], tops[undecided], high - low)
    return largest_within


def _bound_slopes(
    slopes: jax.extend.core.ClosedJaxpr, low: np.ndarray, high: np.ndarray
) -> Float[np.ndarray, " boxes"]:
    """Return a bound of the Jacobian's norm over each box, infinite where the interval arithmetic says nothing.

    Interval arithmetic gives ends of each entry of J, so J = C +- R with the middle C and half the width R. Then
    |J| <= |C| + |R| in the spectral norm.

    Args:
        slopes: program of the Jacobian J at BOXES points.
        low: lower corners of the boxes (boxes, n).
        high: upper corners.
    """
    # The program is for BOXES boxes: fewer are padded.
    padding = BOXES - len(low)
    ends = [np.concatenate([end, np.repeat(end[-1:], padding, axis=0)]) for end in (low, high)]
    (jacobian,) = bound_program(slopes, [Interval(*ends)], continuous=False)
    is_finite = np.isfinite(jacobian.low) & np.isfinite(jacobian.high)
    lowest, highest = np.where(is_finite, jacobian.low, 0.0), np.where(is_finite, jacobian.high, 0.0)
    C = lowest / 2 + highest / 2
    R = np.nextafter(np.maximum(highest - C, C - lowest), np.inf)
    norms = sum(np.linalg.norm(matrix, 2, axis=(-2, -1)) for matrix in (C, R))  # |C| + |R|
    return np.where(is_finite.all(axis=(1, 2)), norms * (1 + NORM_ROUNDING), np.inf)[: len(low)]


def _halve_boxes(low: np.ndarray, high: np.ndarray, width: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the lower and the upper corners of twice as many boxes: each is halved across its widest side.

    Args:
        low: lower corners of the boxes (boxes, n).
        high: upper corners.
        width: lengths of the sides of the whole region (n,), relative to which a side is wide.
    """
    sides = np.argmax((high - low) / np.where(width > 0, width, 1.0), axis=1)
    rows = np.arange(len(low))
    middle = (low[rows, sides] + high[rows, sides]) / 2
    high_of_left, low_of_right = high.copy(), low.copy()
    high_of_left[rows, sides] = low_of_right[rows, sides] = middle
    return np.concatenate([low, low_of_right]), np.concatenate([high_of_left, high])
