"""The second moment of a stable plant in the long run, in any units of its states."""

import numpy as np

from heliograph.numerics.check import fail
from heliograph.numerics.types import Float

DOUBLINGS = 60
EPS = float(np.finfo(np.float64).eps)


def steady_moment(transition: Float[np.ndarray, "n n"], process: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    """E[x x'] in the long run.

    Raises:
        ValueError: a plant that is not stable.
    """
    radius = float(np.max(np.abs(np.linalg.eigvals(transition))))
    if radius >= 1:
        expected = "a stable plant, since what its sensors send grows without limit (a horizon bounds it)"
        raise fail("steady powers", expected, f"an eigenvalue of size {radius:.6g}")
    total, power = process, transition
    for _ in range(DOUBLINGS):  # sum_k A^k Q A'^k, twice as many terms each time: in any units of the states
        more = power @ total @ power.T
        total, power = total + more, power @ power
        if np.all(np.abs(more) <= EPS * np.abs(total)):
            break
    return np.asarray((total + total.T) / 2)
