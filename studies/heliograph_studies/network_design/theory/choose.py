"""Choice of k of M sensors to receive: every choice compared, or a good one of a search, with a bound for all choices.

With z_i = 1 for those that are chosen the error is a convex function of sum_i z_i j_i c_i' c_i. Let z be any numbers
from 0 to 1 with sum k: the least error over these is below that of every choice. Convex too is the mean error of a
period in the z of its steps, and it does not mind a rotation of them: so the same number, with a sum of k at each step,
is below the error of every schedule of every period.
"""

from collections.abc import Callable, Iterable
from itertools import combinations
from math import comb
from typing import NamedTuple

import numpy as np
from scipy.optimize import Bounds, LinearConstraint, minimize

from heliograph.numerics.check import check_count, fail, instance, shown
from heliograph.numerics.readable import readable
from heliograph.numerics.types import ArrayLike, Float
from heliograph.planning.error import Error
from heliograph.planning.paths.information_filter import Plants, adjoint, covariances
from heliograph.planning.paths.model import Paths, path_information

COMPARED = 5000  # choices that are all compared; above, a search
ROUNDING = 1e-12  # relative, by which a bound stays below what is computed


@readable
class Choice(NamedTuple):
    """Those that are chosen, by number.

    bound: proven, no choice of as many has a smaller error. exact: every choice was compared.
    """

    chosen: tuple[int, ...]
    error: float
    bound: float
    exact: bool

    @property
    def words(self) -> str:
        """How good the choice is, in a line."""
        if self.exact:
            return f"the best of all choices: every one was compared; a bound without that would be {self.bound:.6g}"
        return f"the best of a few starts and their swaps; nothing can be better than {self.bound:.6g}"


class SensorSet(NamedTuple):
    """A steady plant, the information c_i' c_i j_i of each sensor when it is received, and the weight of the error."""

    plants: Plants
    information: Float[np.ndarray, "M n n"]
    weight: Float[np.ndarray, "n n"]

    def error(self, shares: Float[np.ndarray, "time M"]) -> float:
        """Mean error of steps that repeat for ever, each with these shares of the sensors' information."""
        p = covariances(self._over(len(shares)), np.tensordot(shares, self.information, axes=1))
        return float(np.einsum("ij,kji->k", self.weight, p).mean())

    def slope(self, shares: Float[np.ndarray, "M"]) -> tuple[float, Float[np.ndarray, "M"]]:
        """Error of shares that stay, and its gradient."""
        total = np.tensordot(shares, self.information, axes=1)[None]
        p = covariances(self.plants, total)
        ahead = adjoint(self.plants, total, p, self.weight[None])
        inner = p[0] @ ahead[0] @ p[0]
        return float(np.sum(self.weight * p[0])), -np.einsum("ij,mji->m", inner, self.information)

    def on(self, steps: Iterable[Iterable[int]]) -> Float[np.ndarray, "time M"]:
        """Ones for the sensors that are received at each step."""
        listed = [list(step) for step in steps]
        result = np.zeros((len(listed), len(self.information)))
        for k, step in enumerate(listed):
            result[k, step] = 1.0
        return result

    def _over(self, steps: int) -> Plants:
        a, q = self.plants.transition[0], self.plants.process[0]
        return Plants(np.tile(a, (steps, 1, 1)), np.tile(q, (steps, 1, 1)), None)


def sensor_set(paths: Paths, powers: ArrayLike, error: Error | None, states: tuple[str, ...] | None) -> SensorSet:
    """Steady paths whose hops send with these powers (hops,), or one number, when they are on.

    Raises:
        ValueError: paths over several steps, the worst direction.
    """
    instance("paths", paths, Paths, "Paths (independent_paths, paths_of)")
    error = Error() if error is None else instance("error", error, Error, "an Error")
    steps, hops = paths.kappa.shape
    if steps != 1 or paths.plants.start is not None or error.steps != 1 or error.horizon is not None:
        raise fail("paths to choose from", "steady ones", f"{steps} steps")
    if error.worst:
        raise fail("error of a choice", "a trace", "the worst direction")
    try:
        p = np.broadcast_to(np.asarray(powers, dtype=np.float64), (1, hops))
    except (TypeError, ValueError):
        raise fail("powers", f"one number or one for each of {hops} hops", shown(powers)) from None
    if not np.all(np.isfinite(p) & (p >= 0)):
        raise fail("powers", "finite numbers of at least zero", shown(powers))
    n = paths.rows.shape[-1]
    rows, information = paths.rows[0], path_information(paths, p).information[0]
    matrix = error.matrix(tuple(f"x{i}" for i in range(n)) if states is None else states)
    return SensorSet(paths.plants, np.einsum("m,mi,mj->mij", information, rows, rows), matrix)


def choose_sensors(
    paths: Paths,
    count: int,
    powers: ArrayLike,
    error: Error | None = None,
    states: tuple[str, ...] | None = None,
    compared: int = COMPARED,
) -> Choice:
    """The `count` sensors whose steady error is least, each sending with its hops' `powers` or not at all.

    All choices are compared if they are no more than `compared`; else the greedy choice and that of the largest
    shares are bettered by swaps until none helps. For the trace greedy choice has no guaranteed factor: see the bound.

    Raises:
        ValueError: more sensors than there are, paths that are not steady.
    """
    case = sensor_set(paths, powers, error, states)
    number = len(case.information)
    if check_count("sensors to choose", count) > number:
        raise fail("sensors to choose", f"at most the {number} there are", count)

    def of(chosen: tuple[int, ...]) -> float:
        return case.error(case.on([chosen]))

    shares, bound = shared(case, count)
    exact = comb(number, count) <= check_count("choices compared", compared, 0)
    if exact:
        best = min(combinations(range(number), count), key=of)
    else:
        rounded = tuple(int(i) for i in np.argsort(-shares, kind="stable")[:count])
        best = min((swapped(of, number, start) for start in (greedy(of, number, count), rounded)), key=of)
    least = of(best)
    return Choice(best, least, min(bound, least), exact)


def greedy(of: Callable[[tuple[int, ...]], float], number: int, count: int) -> tuple[int, ...]:
    """One after another, the best with those before it."""
    chosen: tuple[int, ...] = ()
    while len(chosen) < count:
        chosen = min(((*chosen, i) for i in range(number) if i not in chosen), key=of)
    return chosen


def swapped(of: Callable[[tuple[int, ...]], float], number: int, chosen: tuple[int, ...]) -> tuple[int, ...]:
    """The best swap again and again, until none helps."""
    value = of(chosen)
    while True:
        swaps = [
            (*(i for i in chosen if i != out), new) for out in chosen for new in range(number) if new not in chosen
        ]
        if not swaps or of(best := min(swaps, key=of)) >= value:
            return tuple(sorted(chosen))
        chosen, value = best, of(best)


def shared(case: SensorSet, count: int) -> tuple[Float[np.ndarray, "M"], float]:
    """The best shares from 0 to 1 with sum `count`, and their error less what its tangent leaves open."""
    number = len(case.information)
    start: np.ndarray = np.full(number, count / number)
    search = minimize(
        case.slope,
        start,
        jac=True,
        method="SLSQP",
        bounds=Bounds(np.zeros(number), np.ones(number)),
        constraints=[LinearConstraint(np.ones((1, number)), [count], [count])],
        options={"ftol": 1e-15, "maxiter": 300},
    )
    tangents = []
    for shares in (start, np.clip(search.x, 0.0, 1.0)):
        value, gradient = case.slope(shares)
        tangents.append(value + float(np.sort(gradient)[:count].sum() - gradient @ shares) - ROUNDING * value)
    return np.clip(search.x, 0.0, 1.0), max(tangents)
