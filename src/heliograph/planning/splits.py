"""One path of several hops: how its power is best split among them, in closed form.

What is received over its mean gain has the noise s K F - t, F = prod_h (1 + alpha_h / p_h): whatever the plant, the
sensor and the fading, F is to be small. It is convex in the powers, and at the best split of a sum
p_h (1 + p_h / alpha_h) = 1 / l for all hops, so that p_h = (sqrt(alpha_h^2 + 4 alpha_h / l) - alpha_h) / 2.
"""

import numpy as np
from scipy.optimize import brentq

from heliograph.numerics.check import array, fail, scalar
from heliograph.numerics.types import ArrayLike, Float
from heliograph.planning.independent import at_least

FAR = 1e60  # beyond it squares of noise over power leave the range of doubles


def split_power(alpha: ArrayLike, total: ArrayLike) -> Float[np.ndarray, "H"]:
    """The powers p_h >= 0 of this sum that make prod_h (1 + alpha_h / p_h) least; alpha (H,) is noise in sent power.

    Two hops share in the ratio sqrt(alpha_1 (P + alpha_2)) to sqrt(alpha_2 (P + alpha_1)). A hop without noise gets
    nothing.

    Raises:
        ValueError: a negative noise or total, no hops, a total beyond all measure of the noise.
    """
    a, sum_ = _alphas(alpha), float(scalar("total power", total, 0.0))
    if sum_ == 0 or not np.any(a):
        return np.zeros(len(a))
    within = a[a > 0]
    if sum_ > FAR * within.min() or sum_ < within.max() / FAR:
        raise fail("total power", f"one within a factor of {FAR:g} of each hop's noise", f"{sum_:g}")
    if len(a) == 2:
        share = np.sqrt(a * (sum_ + a[::-1]))
        return np.asarray(sum_ * share / share.sum())
    # the sum lies between those of sqrt(alpha / l) and of alpha / (2 sqrt(alpha)) less: a bracket for log l
    middle = 2 * float(np.log(np.sqrt(a).sum() / sum_))

    def excess(log: float) -> float:
        return float(_powers(a, np.exp(-log)).sum() - sum_)

    low, high = middle - 1.0, middle + 1.0
    while excess(low) < 0:
        low -= 2.0
    while excess(high) > 0:
        high += 2.0
    p = _powers(a, np.exp(-float(brentq(excess, low, high, xtol=1e-15, rtol=1e-15))))
    return np.asarray(p * (sum_ / p.sum()))


def path_noise(alpha: ArrayLike, total: ArrayLike) -> float:
    """F = prod_h (1 + alpha_h / p_h) at the best split of a total power; infinite where that is zero.

    Two hops, u and v being their alphas over the power: (sqrt((1 + u) (1 + v)) + sqrt(u v))^2.

    Raises:
        ValueError: a negative noise or total, no hops, a total beyond all measure of the noise.
    """
    a, p = _alphas(alpha), split_power(alpha, total)
    if np.any((p == 0) & (a > 0)):
        return float("inf")
    return float(np.prod(1 + np.divide(a, p, out=np.zeros_like(a), where=a > 0)))


def power_for_noise(alpha: ArrayLike, wanted: ArrayLike) -> Float[np.ndarray, "H"]:
    """The powers of the least sum with which prod_h (1 + alpha_h / p_h) is at most what is wanted.

    Raises:
        ValueError: a wanted factor of 1 or less, which no power reaches; a negative noise, no hops.
    """
    a, factor = _alphas(alpha), float(scalar("wanted noise", wanted))
    if not np.any(a):
        return np.zeros(len(a))
    if factor <= 1:
        raise fail("wanted noise", "a factor above 1, which unlimited power leaves", f"{factor:.6g}")

    def excess(log: float) -> float:
        p = _powers(a, np.exp(-log))
        return float(np.log1p(np.divide(a, p, out=np.zeros_like(a), where=a > 0)).sum() - np.log(factor))

    low = high = -float(np.log(np.max(a)))
    while excess(low) > 0:
        low -= 2.0
    while excess(high) < 0:
        high += 2.0
    return _powers(a, np.exp(-float(brentq(excess, low, high, xtol=1e-15, rtol=1e-15))))


def _powers(alpha: Float[np.ndarray, "H"], price: float) -> Float[np.ndarray, "H"]:
    """(sqrt(alpha^2 + 4 alpha / l) - alpha) / 2 without cancellation; `price` is 1 / l."""
    return np.asarray(2 * alpha * price / np.maximum(np.sqrt(alpha**2 + 4 * alpha * price) + alpha, 1e-300))


def _alphas(alpha: ArrayLike) -> Float[np.ndarray, "H"]:
    a = at_least(0.0, "alpha of hops", array("alpha of hops", alpha, (None,)))
    if not len(a):
        raise fail("alpha of hops", "at least one", "none")
    return a
