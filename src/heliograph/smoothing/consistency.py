"""Consistency of a filter, judged by its NIS: smoothing an inconsistent filter makes its claims worse."""

import warnings
from itertools import pairwise

import jax.numpy as jnp
import numpy as np

from heliograph.filters.smoother_step.base import AbstractSmootherStep
from heliograph.numerics.float64 import in_float64
from heliograph.numerics.types import Array, Float

BLOCKS = 10  # parts of a run, whose scatter gives the standard error of the NIS
DEVIATIONS = 3.5  # standard errors of the mean NIS: fewer may be chance
EXCESS = 1.05  # times the expected NIS: less does little harm


@in_float64
def nis_sums(steps: AbstractSmootherStep) -> Float[Array, "5"]:
    """Sums over blocks of one run, s the sum of e' S^-1 e and h the number of components: s, h, s^2, s h, h^2."""
    if steps.nis is None or steps.received is None:
        return jnp.zeros(5)
    time = len(steps.mean)
    count = min(BLOCKS, time)
    edges = [-(-time * i // count) for i in range(count + 1)]
    s, h = (jnp.stack([jnp.sum(part[a:b]) for a, b in pairwise(edges)]) for part in (steps.nis, steps.received))
    return jnp.stack([jnp.sum(part) for part in (s, h, s * s, s * h, h * h)])


def nis_test(sums: Float[np.ndarray, "5"]) -> tuple[float, float]:
    """Mean NIS per component, 1 for a consistent filter, and its standard error from the scatter of the blocks."""
    s, h, ss, sh, hh = (float(part) for part in sums)
    if not h:
        return 1.0, 0.0
    ratio = s / h
    return ratio, float(np.sqrt(max(ss - 2 * ratio * sh + ratio**2 * hh, 0.0))) / h


def warn_of(name: str, sums: Float[np.ndarray, "5"]) -> None:
    """Warn if a filter's NIS is significantly larger than its model predicts."""
    ratio, error = nis_test(sums)
    if ratio > EXCESS and ratio - 1 > DEVIATIONS * error:
        warnings.warn(
            f"{name}: squared innovations are {ratio:.3g} +- {error:.1g} times what the filter believes; of a filter "
            "that is not consistent later data make the claims worse, and perhaps the estimates",
            stacklevel=3,
        )
