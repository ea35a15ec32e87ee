"""Sending at every step, or seldom and with more power: what several hops make of the same mean power.

The information of a path of several hops grows faster than its power at first. Sent at t times the mean powers, a
share 1 / t of the time, a path carries j(t p) / t in the mean. 1 / j is a sum of powers of 1 / t with positive
coefficients, so
e = d log j / d log t falls; j(t p) / t is greatest where e = 1, and beyond j'' = j (e^2 - e + t e') / t^2 <= 0. So the
least concave function above j goes straight from 0 to that point: with its value in place of j the error is below that
of all ways to vary the powers together over time, since it is convex in the information of the steps.
"""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize_scalar

from heliograph.numerics.check import array, check_count, fail
from heliograph.numerics.readable import readable
from heliograph.numerics.types import ArrayLike, Float
from heliograph.planning.error import Error
from heliograph.planning.paths.model import Paths, path_information
from heliograph_studies.network_design.theory.choose import ROUNDING, sensor_set

LOUDEST = 1e6  # times the mean power, the most that a bound looks at
SLACK = 1e-9  # relative, of the maximum of a search: its neighbourhood is flat


@readable
class Bursts(NamedTuple):
    """Mean steady error when all send every n-th step with n times the power.

    errors: by n; error: the least of them, with `every` = n. bound: proven, no way to vary the powers together over
    time has a smaller error, at the same mean power.
    """

    errors: dict[int, float]
    every: int
    error: float
    bound: float

    @property
    def words(self) -> str:
        """What is gained, in a line."""
        steady = self.errors.get(1)
        gain = f", {100 * (1 - self.error / steady):.3g} % below sending at every step" if steady else ""
        return f"every {self.every} steps: {self.error:.6g}{gain}; nothing can be better than {self.bound:.6g}"


def burst_sending(
    paths: Paths,
    powers: ArrayLike,
    every: Iterable[int] = range(1, 11),
    peak: float = np.inf,
    error: Error | None = None,
    states: tuple[str, ...] | None = None,
) -> Bursts:
    """Errors of sending with n times the mean `powers` (hops,) at every n-th step, as far as no power exceeds `peak`.

    Raises:
        ValueError: nothing to compare, powers that are negative or above the peak, paths that are not steady.
    """
    case = sensor_set(paths, powers, error, states)
    p = array("powers", np.broadcast_to(np.asarray(powers, dtype=np.float64), paths.kappa[0].shape), (None,))
    loudest = float(np.min(np.divide(peak, p, out=np.full(p.shape, np.inf), where=p > 0)))
    steps = [
        n for n in sorted({check_count("steps between bursts", n) for n in every}) if n <= loudest * (1 + ROUNDING)
    ]
    if not steps:
        raise fail("steps between bursts", f"some of at most {loudest:.6g}, which the peak allows", "none")
    at_mean = path_information(paths, p[None]).information[0]
    unit = case._replace(information=case.information / np.where(at_mean > 0, at_mean, 1.0)[:, None, None])
    errors = {}
    for n in steps:
        shares = np.zeros((n, len(at_mean)))
        shares[0] = path_information(paths, n * p[None]).information[0]
        errors[n] = unit.error(shares)
    best = min(errors, key=lambda n: errors[n])
    most = np.array([_most(paths, p, i, min(loudest, LOUDEST)) for i in range(len(at_mean))])
    bound = unit.error(most[None]) * (1 - ROUNDING)
    return Bursts(errors, best, errors[best], min(bound, errors[best]))


def _most(paths: Paths, p: Float[np.ndarray, "hop"], i: int, loudest: float) -> float:
    """The largest j(t p) / t of a path over t >= 1."""

    def share(log: float) -> float:
        return float(path_information(paths, np.exp(log) * p[None]).information[0, i] * np.exp(-log))

    search = minimize_scalar(lambda log: -share(log), bounds=(0.0, float(np.log(loudest))), method="bounded")
    return max(share(0.0), share(float(search.x)) * (1 + SLACK))
