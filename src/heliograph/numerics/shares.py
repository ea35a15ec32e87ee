"""Shares that were counted, with Wilson's interval."""

from typing import NamedTuple

import numpy as np
import scipy

from heliograph.numerics.module import readable


@readable
class Share(NamedTuple):
    """Probability with its 95 % interval.

    Args:
        estimate: the estimate.
        low: lower end of the interval.
        high: upper end.
    """

    estimate: float
    low: float
    high: float


def wilson(hits: float, of: float) -> Share:
    """Share k / n with Wilson's interval, |k - n p| <= 1.96 sqrt(n p (1 - p)) for its ends p; (NaN, 0, 1) of nothing.

    Source: Wilson, Probable inference (1927).
    """
    if not of:
        return Share(float("nan"), 0.0, 1.0)
    z = float(scipy.special.ndtri(0.975))
    p = hits / of
    middle = (p + z**2 / (2 * of)) / (1 + z**2 / of)
    half = z / (1 + z**2 / of) * np.sqrt(p * (1 - p) / of + z**2 / (4 * of**2))
    return Share(p, 0.0 if not hits else float(middle - half), 1.0 if hits == of else float(middle + half))
