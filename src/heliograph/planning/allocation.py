"""What a convex design returns: powers, their error, and the bound below which no powers within the budget come."""

from typing import NamedTuple

import numpy as np

from heliograph.numerics.readable import readable
from heliograph.numerics.types import Float


@readable
class Allocation(NamedTuple):
    """Powers with a certificate.

    powers: by step and transmitter. error: what they attain. bound: proven, no powers within the budget have a smaller
    error. method: how the powers were found; the certificate does not rest on it.
    """

    powers: Float[np.ndarray, "time hop"]
    error: float
    bound: float
    method: str

    @property
    def gap(self) -> float:
        """By how much another allocation could be better at most."""
        return max(self.error - self.bound, 0.0)

    @property
    def words(self) -> str:
        """How good the powers are, in a line."""
        return no_error_below(self.bound, self.gap)


@readable
class LeastPower(NamedTuple):
    """Powers that reach a wanted error, with a certificate.

    total: their sum over transmitters, in the mean over time. bound: proven, no smaller sum reaches the error.
    """

    powers: Float[np.ndarray, "time hop"]
    error: float
    total: float
    bound: float

    @property
    def gap(self) -> float:
        """By how much another allocation could be cheaper at most."""
        return max(self.total - self.bound, 0.0)

    @property
    def words(self) -> str:
        """How good the powers are, in a line."""
        return f"optimal within {self.gap:.1e}: the problem is convex, and no power below {self.bound:.8g} reaches it"


def no_error_below(bound: float, gap: float) -> str:
    """What the bound of a convex problem says, in a line."""
    return f"optimal within {gap:.1e}: the problem is convex, and no error is below {bound:.8g}"
