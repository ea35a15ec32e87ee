"""How drawn paths keep the limits of states: where they begin, and at each step."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.special import ndtr, ndtri

from heliograph.filters.truncation import PlacedLimits
from heliograph.numerics.module import Module


class StateLimits(Module):
    """Limits within which states of a path keep: index, lowest and highest value of each limited one."""

    limits: PlacedLimits = eqx.field(static=True)

    def hold(self, x: jax.Array) -> jax.Array:
        """Return a state (n,) with its limited components clipped to their limits."""
        for i, low, high in self.limits:
            x = x.at[i].set(jnp.clip(x[i], low, high))
        return x

    def mirror(self, x: jax.Array) -> jax.Array:
        """Return a state (n,) with limited components beyond a limit mirrored at it.

        At a limit, symmetric noise then has the law that it has given that it does not lead beyond the limit.
        """
        for i, low, high in self.limits:
            value = x[i]
            mirrored = jnp.where(value < low, 2 * low - value, jnp.where(value > high, 2 * high - value, value))
            x = x.at[i].set(mirrored)
        return x


def draw_limited_components(
    part: np.ndarray, means: np.ndarray, covariances: np.ndarray, limits: PlacedLimits, generator: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Return means (draws, n) and covariances (K, n, n) of Gaussians given their limited components, which are drawn.

    Some states have limits (such as a level that is not negative), so that draws of a Gaussian mixture must respect
    them. The limited components are drawn one after the other, each from its normal law given those before, cut to its
    limits. If several are limited, this sequence alone favours some draws: each draw gets as weight the product of the
    probabilities of being within the limits, and draws are drawn anew by weight.

    Args:
        part: index of the Gaussian of each draw (draws,).
        means: means of the Gaussians (K, n).
        covariances: covariances of the Gaussians (K, n, n).
        limits: index, lowest and highest value of each limited component.
        generator: of the random numbers.

    Source: the simulator of Geweke, Hajivassiliou and Keane; Genz and Bretz, Computation of multivariate normal and t
        probabilities (2009), 4.2.
    """
    # `center` (draws, n) and `left` (K, n, n): mean and covariance given the components drawn so far.
    center, left, weight = means[part], covariances, np.ones(len(part))
    for i, low, high in limits:
        # Draw the component by the inverse of its distribution function, between that function's values at the limits.
        # A component without variance stays.
        variance = left[:, i, i]
        is_random = variance > 0
        divisor = np.where(is_random, variance, 1.0)
        deviation = np.sqrt(divisor)[part]
        least, most = (ndtr((end - center[:, i]) / deviation) for end in (low, high))
        units = ndtri(least + generator.random(len(part)) * (most - least))
        moved = np.where(is_random[part], deviation * units, 0.0)
        drawn = np.clip(center[:, i] + moved, low, high)
        # The probability of being within the limits.
        weight *= np.where(is_random[part], most - least, 1.0)
        # Condition the others: center + slope (drawn - mean), P - P_j P_j' / P_jj, with P_j the column of this
        # component.
        slopes = np.where(is_random[:, None], left[:, :, i] / divisor[:, None], 0.0)
        center = center + slopes[part] * (drawn - center[:, i])[:, None]
        center[:, i] = drawn
        left = left - slopes[:, :, None] * left[:, None, i]
    # Resample the draws of each Gaussian by weight.
    if len(limits) > 1 and np.ptp(weight) > 0:
        for number in np.unique(part):
            own = np.flatnonzero(part == number)
            share = weight[own] / weight[own].sum() if weight[own].any() else None
            center[own] = center[generator.choice(own, size=len(own), p=share)]
    return center, left
