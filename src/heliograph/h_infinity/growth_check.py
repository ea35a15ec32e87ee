"""Whether a function obeys a growth constant: slopes over a stated region, and a search for a pair that breaks it."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.stats import qmc

from heliograph.numerics.check import array, fail, scalar
from heliograph.numerics.float64 import compiled
from heliograph.numerics.types import ArrayLike, Float

POINTS = 2**12  # of a low-discrepancy sequence, at which slopes are taken
CLIMBERS, TRIALS, ROUNDS = 16, 32, 60  # steepest points kept, random moves from each, and times this is repeated
SHRINK = 0.8  # of the moves' size from round to round: from half the region to 1e-6 of it
NEARBY = 1e-4  # distance of a close pair, relative to the region's width; closer ones lose digits
TOLERANCE = 1e-9  # relative excess over the constant that counts as rounding

Function = Callable[[jax.Array], jax.Array]  # (n,) -> (m,) or (), written with jax.numpy


class GrowthFinding(NamedTuple):
    """What was found about |f(x) - f(y)| <= constant |x - y| in the box from `low` to `high`.

    slope: the largest norm of a Jacobian found there, at `point`: at least this large is every true constant. pair and
    ratio: the two points found with the largest |f(x) - f(y)| / |x - y|. `refuted` if the ratio exceeds the constant. A
    finding that is not refuted is a search that failed, not a proof.
    """

    name: str
    constant: float
    low: Float[np.ndarray, "n"]
    high: Float[np.ndarray, "n"]
    slope: float
    point: Float[np.ndarray, "n"]
    pair: tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]
    ratio: float

    @property
    def refuted(self) -> bool:
        """Whether a pair breaks the constant."""
        return self.ratio > self.constant * (1 + TOLERANCE)

    @property
    def text(self) -> str:
        """One line."""
        where = f"in the box from {np.round(self.low, 4).tolist()} to {np.round(self.high, 4).tolist()}"
        if not self.refuted:
            return f"{self.name}: constant {self.constant:g} not refuted {where} (largest slope {self.slope:.6g})"
        x, y = (np.round(p, 6).tolist() for p in self.pair)
        return f"{self.name}: constant {self.constant:g} is false {where}: ratio {self.ratio:.6g} at {x} and {y}"


def check_growth(
    function: Function, constant: float, low: ArrayLike, high: ArrayLike, name: str = "f", seed: int = 0
) -> GrowthFinding:
    """Search the box from `low` to `high` (n,) for a function's largest slope, and for a pair that breaks `constant`.

    Norms of Jacobians by automatic differentiation at 4,096 points of a Sobol sequence, then random moves of shrinking
    size from the steepest. Pairs start close together along the steepest directions, and far apart, and move likewise.
    A box is convex, so in it the largest slope is the smallest true constant.

    Raises:
        ValueError: a negative constant, a box of the wrong shape or upside down.
    Source: H-infinity fusion over amplify-and-forward relays, condition (2).
    """
    bottom, top = _check_box(constant, low, high)
    tools, random = _Tools(function, float(np.linalg.norm(top - bottom))), np.random.default_rng(seed)
    starts = bottom + (top - bottom) * qmc.Sobol(len(bottom), seed=seed).random(POINTS)
    points = _climb(tools.slope, starts, bottom, top, random)
    move = tools.steepest(points) * NEARBY * tools.width / 2
    close = np.concatenate([np.clip(points - move, bottom, top), np.clip(points + move, bottom, top)], axis=1)
    far = bottom + (top - bottom) * random.random((POINTS, 2, len(bottom)))
    starts = np.concatenate([close, far.reshape(POINTS, -1)])
    pairs = _climb(tools.ratio, starts, np.tile(bottom, 2), np.tile(top, 2), random)
    return _finding(name, constant, bottom, top, tools, points, pairs)


def check_size(
    function: Function, constant: float, low: ArrayLike, high: ArrayLike, name: str = "f", seed: int = 0
) -> GrowthFinding:
    """Search the box for a point that breaks |f(x)| <= constant |x|, the weaker condition on f itself (pairs with 0).

    Raises:
        ValueError: a negative constant, a box of the wrong shape, upside down or without 0.
    Source: H-infinity fusion over amplify-and-forward relays, condition (2) with f(0) = 0.
    """
    bottom, top = _check_box(constant, low, high)
    if np.any(bottom > 0) or np.any(top < 0):
        raise fail("region", "a box around 0", f"{bottom.tolist()} and {top.tolist()}")
    tools, random = _Tools(function, float(np.linalg.norm(top - bottom))), np.random.default_rng(seed)
    starts = bottom + (top - bottom) * qmc.Sobol(len(bottom), seed=seed).random(POINTS)

    def from_zero(points: np.ndarray) -> np.ndarray:
        return tools.ratio(np.concatenate([points, np.zeros_like(points)], axis=1))

    points = _climb(from_zero, starts, bottom, top, random)
    return _finding(name, constant, bottom, top, tools, points, np.concatenate([points, np.zeros_like(points)], axis=1))


def _check_box(
    constant: float, low: ArrayLike, high: ArrayLike
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    scalar("growth constant", constant, 0.0)
    bottom = np.asarray(array("low corner of the region", low, (None,)))
    top = np.asarray(array("high corner of the region", high, bottom.shape))
    if np.any(top < bottom) or not np.any(top > bottom):
        raise fail("region", "a low corner below the high one", f"{bottom.tolist()} and {top.tolist()}")
    return bottom, top


class _Tools:
    """Slopes and ratios of a function at many points (count, n) or pairs (count, 2n), compiled once."""

    def __init__(self, function: Function, width: float):
        self.width = width
        self.jacobian = compiled(jax.vmap(jax.jacfwd(lambda x: jnp.atleast_1d(function(x)))))
        self.values = compiled(jax.vmap(lambda x: jnp.atleast_1d(function(x))))

    def slope(self, points: Float[np.ndarray, "count n"]) -> Float[np.ndarray, "count"]:
        """Norm of the Jacobian."""
        return np.asarray(np.linalg.norm(self.jacobian(points), 2, axis=(-2, -1)))

    def steepest(self, points: Float[np.ndarray, "count n"]) -> Float[np.ndarray, "count n"]:
        """Unit direction in which the function changes most."""
        return np.linalg.svd(self.jacobian(points))[2][:, 0]

    def ratio(self, pairs: Float[np.ndarray, "count both"]) -> Float[np.ndarray, "count"]:
        """|f(x) - f(y)| / |x - y|, and 0 for points too close to tell."""
        x, y = np.split(pairs, 2, axis=1)
        distance = np.linalg.norm(x - y, axis=1)
        apart = distance > NEARBY * self.width / 2
        return np.where(
            apart, np.linalg.norm(self.values(x) - self.values(y), axis=1) / np.where(apart, distance, 1), 0
        )


def _finding(
    name: str, constant: float, low: np.ndarray, high: np.ndarray, tools: _Tools, points: np.ndarray, pairs: np.ndarray
) -> GrowthFinding:
    slopes, ratios = tools.slope(points), tools.ratio(pairs)
    best, pair = int(np.argmax(slopes)), int(np.argmax(ratios))
    x, y = np.split(pairs[pair], 2)
    return GrowthFinding(
        name, float(constant), low, high, float(slopes[best]), points[best], (x, y), float(ratios[pair])
    )


def _climb(
    objective: Callable[[np.ndarray], np.ndarray],
    starts: Float[np.ndarray, "starts n"],
    low: Float[np.ndarray, "n"],
    high: Float[np.ndarray, "n"],
    random: np.random.Generator,
) -> Float[np.ndarray, "climbers n"]:
    """The best starts, each moved to the best of random moves around it, again and again, inside the box."""
    best = starts[np.argsort(-objective(starts), kind="stable")[:CLIMBERS]]
    size = (high - low) / 2
    for _ in range(ROUNDS):
        moved = best[:, None] + size * random.normal(size=(len(best), TRIALS, len(low)))
        moved[:, 0] = best
        moved = np.clip(moved, low, high)
        found = objective(moved.reshape(-1, len(low))).reshape(len(best), TRIALS)
        best = moved[np.arange(len(best)), found.argmax(axis=1)]
        size = SHRINK * size
    return best
