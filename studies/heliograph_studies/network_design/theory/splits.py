"""Noise of a relay chain at the best split of its power, and the power that a noise takes, in closed form.

What is received over the chain's mean gain has the noise s K F - t, F = prod_h (1 + alpha_h / p_h): whatever the plant,
the sensor and the fading, F is to be small. `hg.planning.split_power` gives the split.
"""

import numpy as np
from scipy.optimize import brentq

from heliograph.numerics.check import fail, scalar
from heliograph.numerics.types import ArrayLike, Float
from heliograph.planning.paths.relaxation import hop_noises, split_power


def path_noise(alpha: ArrayLike, total: ArrayLike) -> float:
    """Noise factor F = prod_h (1 + alpha_h / p_h) at the best split of a total power; infinite where that is zero.

    Two hops, u and v being their alphas over the power: (sqrt((1 + u) (1 + v)) + sqrt(u v))^2.

    Raises:
        ValueError: a negative noise or total, no hops.
    """
    a, p = hop_noises(alpha), split_power(alpha, total)
    if np.any((p == 0) & (a > 0)):
        return float("inf")
    return float(np.prod(1 + np.divide(a, p, out=np.zeros_like(a), where=a > 0)))


def power_for_noise(alpha: ArrayLike, target: ArrayLike) -> Float[np.ndarray, "H"]:
    """Powers of the least sum with which prod_h (1 + alpha_h / p_h) is at most a target.

    Raises:
        ValueError: a target of 1 or less, which no power reaches; a negative noise, no hops.
    """
    a, factor = hop_noises(alpha), float(scalar("target noise", target))
    if not np.any(a):
        return np.zeros(len(a))
    if factor <= 1:
        raise fail("target noise", "a factor above 1, which unlimited power leaves", f"{factor:.6g}")

    def excess(log: float) -> float:
        p = _powers(a, np.exp(-log))
        return float(np.log1p(np.divide(a, p, out=np.zeros_like(a), where=a > 0)).sum() - np.log(factor))

    # A bracket for the logarithm of the multiplier, then its root.
    low = high = -float(np.log(np.max(a)))
    while excess(low) > 0:
        low -= 2.0
    while excess(high) < 0:
        high += 2.0
    return _powers(a, np.exp(-float(brentq(excess, low, high, xtol=1e-15, rtol=1e-15))))


def _powers(alpha: Float[np.ndarray, "H"], price: float) -> Float[np.ndarray, "H"]:
    """(sqrt(alpha^2 + 4 alpha / l) - alpha) / 2 without cancellation; `price` is 1 / l."""
    return np.asarray(2 * alpha * price / np.maximum(np.sqrt(alpha**2 + 4 * alpha * price) + alpha, 1e-300))
