"""An estimate: mean, covariance, and what the covariance claims to be."""

from typing import Literal

import equinox as eqx
import jax
import numpy as np

Claim = Literal["exact", "upper", "nominal", "none"]
STRENGTH: dict[Claim, int] = {"none": -1, "nominal": 0, "upper": 1, "exact": 2}


class Estimate(eqx.Module):
    """An estimate and the covariance claimed for its error.

    claim: "exact" if `covariance` is E[(x - mean)(x - mean)'], "upper" if it dominates it, "nominal" if it is only what
    the filter's approximations say, "none" if no covariance is claimed: then `covariance` is NaN.

    Shapes: mean (..., n), covariance (..., n, n).
    """

    mean: jax.Array | np.ndarray
    covariance: jax.Array | np.ndarray
    claim: Claim = eqx.field(static=True)


def weakest(claims: list[Claim]) -> Claim:
    """The strongest claim that all of `claims` support."""
    return min(claims, key=STRENGTH.__getitem__)
