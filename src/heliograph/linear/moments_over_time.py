"""Moments of a state over time: finite ones, and whether they have come to stay."""

import numpy as np

from heliograph.numerics.check import fail
from heliograph.numerics.types import Float
from heliograph.random_affine.moments.monomials import exponents, position

EPS = float(np.finfo(np.float64).eps)

Moments = Float[np.ndarray, " monomials"]  # of (x, 1), all of one order


def check_moments(moments: Moments, k: int, order: int) -> None:
    """Raise ValueError where moments of the state after step k are no finite numbers."""
    if not np.all(np.isfinite(moments)):
        got = f"ones beyond doubles at step {k + 1}: use a shorter horizon, or units in which the state is smaller"
        raise fail(f"moments of the state up to order {order}", "finite ones at every step", got)


class SteadyMoments:
    """Test for steady moments of x up to `order` under x+ = A x + noise with one law for all time, to rounding.

    What a step changes shrinks with the spectral radius r of A, so that all later steps change no more than 1 / (1 - r)
    times as much. Moments are steady once that is below the rounding of their own scale, E[x_i^2]^(1/2) for each x_i.
    """

    def __init__(self, matrix: Float[np.ndarray, "n n"], order: int, varies: bool):
        rate = 1 - float(np.max(np.abs(np.linalg.eigvals(matrix)), initial=0.0))
        self._tolerance = -1.0 if varies or rate <= 0 else EPS * rate
        n, places = len(matrix), position(len(matrix) + 1, order)
        self._powers = np.array(exponents(n + 1, order))[:, :n]
        self._squares = [places[(*(2 * int(i == j) for j in range(n)), order - 2)] for i in range(n)]
        self._last: Moments | None = None

    def stays(self, moments: Moments) -> bool:
        """Return whether the moments are those of the call before, to rounding."""
        before, self._last = self._last, moments
        if before is None or self._tolerance < 0:
            return False
        scale = np.prod(np.sqrt(np.abs(moments[self._squares])) ** self._powers, axis=1)
        return bool(np.all(np.abs(moments - before) <= self._tolerance * scale))
