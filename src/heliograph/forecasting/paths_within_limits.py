"""How drawn paths keep the limits of states: where they begin, and at each step."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.special import ndtr, ndtri

from heliograph.filters.truncation import PlacedLimits
from heliograph.numerics.module import Module


class StateLimits(Module):
    """Limits within which states of a path keep, such as a level that is not negative.

    `limits` has a tuple for each limited state: its index, lowest and highest value.
    """

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


def _draw_normal_within(
    low: np.ndarray, high: np.ndarray, generator: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Draw standard normal numbers given that they lie within limits; return them and the probability of that (draws,).

    They are values of the inverse distribution function, drawn uniformly between its values at the limits.

    Args:
        low: lower limits, in deviations from the mean (draws,); minus infinity where there is none.
        high: upper limits, likewise.
        generator: of the random numbers.
    """
    probability_below_low, probability_below_high = ndtr(low), ndtr(high)
    probability_within = probability_below_high - probability_below_low
    return ndtri(probability_below_low + generator.random(len(low)) * probability_within), probability_within


def draw_limited_components(
    part: np.ndarray, means: np.ndarray, covariances: np.ndarray, limits: PlacedLimits, generator: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Draw the limited states of a Gaussian mixture within their limits; return the law of all states given these.

    A limited state is one such as a level that is not negative. These states are drawn one after the other, each from
    its normal law given those before, cut to its limits. If several are limited, this sequence alone favours some
    draws: each draw gets as weight the product of its probabilities of being within the limits, and the draws of each
    Gaussian are drawn anew by weight.

    Returns:
        For each draw the mean of all states given the drawn ones (draws, n), in which the drawn ones are themselves;
        and for each Gaussian the covariance given them (K, n, n), which does not depend on their values.

    Args:
        part: part[d] is the index of the Gaussian from which draw d comes (draws,).
        means: means of the Gaussians (K, n).
        covariances: covariances of the Gaussians (K, n, n).
        limits: index, lowest and highest value of each limited component.
        generator: of the random numbers.

    Source: the simulator of Geweke, Hajivassiliou and Keane; Genz and Bretz, Computation of multivariate normal and t
        probabilities (2009), 4.2.
    """
    # Mean (draws, n) and covariance P (K, n, n) given the components drawn so far.
    mean, P = means[part], covariances
    weight = np.ones(len(part))
    for i, low, high in limits:
        # Draw the component within its limits. One without variance stays.
        variance = P[:, i, i]
        is_random = variance > 0
        divisor = np.where(is_random, variance, 1.0)
        deviation = np.sqrt(divisor)[part]
        low_end, high_end = ((end - mean[:, i]) / deviation for end in (low, high))
        normal, probability_within = _draw_normal_within(low_end, high_end, generator)
        moved = np.where(is_random[part], deviation * normal, 0.0)
        drawn = np.clip(mean[:, i] + moved, low, high)
        weight *= np.where(is_random[part], probability_within, 1.0)
        # Condition all components on this one: mean + slope (drawn - mean_i), P - P_i P_i' / P_ii, with P_i its column
        # of P and slope = P_i / P_ii.
        slopes = np.where(is_random[:, None], P[:, :, i] / divisor[:, None], 0.0)
        mean = mean + slopes[part] * (drawn - mean[:, i])[:, None]
        mean[:, i] = drawn
        P = P - slopes[:, :, None] * P[:, None, i]
    # Resample the draws of each Gaussian by weight.
    if len(limits) > 1 and np.ptp(weight) > 0:
        for number in np.unique(part):
            own = np.flatnonzero(part == number)  # the draws of this Gaussian
            share = weight[own] / weight[own].sum() if weight[own].any() else None
            mean[own] = mean[generator.choice(own, size=len(own), p=share)]
    return mean, P
