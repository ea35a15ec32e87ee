"""A Gaussian whose mean is a rounded number plus its rounding error, so that single precision keeps its digits."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.factors.factored_gaussian import Gaussian, from_covariance
from heliograph.numerics.compensated_arithmetic import split_sum
from heliograph.numerics.types import Array, Float


class SplitMeanGaussian(NamedTuple):
    """Mean high + low, where high is the mean rounded to the precision in use, and covariance L diag(d) L'.

    `low` is the rounding error of `high`. Far from the origin, the mean of a precise estimate needs both.

    Shapes: high and low (n,), lower (n (n - 1) / 2,) of L, variances d (n,).
    """

    high: Float[jax.Array, " n"]
    low: Float[jax.Array, " n"]
    lower: Float[jax.Array, " entries"]
    variances: Float[jax.Array, " n"]

    @property
    def about_center(self) -> Gaussian:
        """The Gaussian of x - high, the small part of x: its mean is `low`, its covariance that of x."""
        return Gaussian(self.low, self.lower, self.variances)


def center_gaussian(center: jax.Array, x: Gaussian) -> SplitMeanGaussian:
    """Return the law of center + x, with the mean center + E x split into its rounded value and the rounding error."""
    mean = split_sum(center, x.mean)
    return SplitMeanGaussian(mean.high, jnp.asarray(mean.low), x.lower, x.variances)


def center_known(x: Gaussian) -> SplitMeanGaussian:
    """Return the law with its known mean split in two parts: the mean in single precision, and the rest.

    So single precision can compute with a mean of double precision. The covariance does not change.
    """
    mean = np.asarray(x.mean, np.float64)
    high = mean.astype(np.float32).astype(np.float64)
    return SplitMeanGaussian(jnp.asarray(high), jnp.asarray(mean - high), x.lower, x.variances)


def centred_from_covariance(mean: Array, covariance: Array) -> SplitMeanGaussian:
    """Return the law of this mean (n,) and covariance (n, n); the precision in use holds the mean, so low is 0."""
    x = from_covariance(mean, covariance)
    return SplitMeanGaussian(jnp.asarray(mean), jnp.zeros_like(x.mean), x.lower, x.variances)
