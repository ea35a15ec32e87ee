"""Designs of the powers of independent paths: water filling, descents, and bounds that hold for all allocations."""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from heliograph.numerics.check import fail
from heliograph.numerics.types import Bool, Float, Int
from heliograph.planning.budget import MET, PowerLimits, Powers
from heliograph.planning.error_objective import Criterion
from heliograph.planning.paths.model import (
    PathInformation,
    Paths,
    error_covariances,
    path_information,
    path_sensitivities,
)
from heliograph.planning.paths.relaxation import SplitPaths, compute_envelope, split_paths
from heliograph.planning.paths.water_filling import water_filling
from heliograph.planning.problem import Certificate, DesignProblem, PowerDesign
from heliograph.planning.quadratic_programme import (
    DescentProblem,
    Evaluation,
    PowerAndErrorLimits,
    Vector,
    search_from_starts,
)

UNLIMITED = 1e13  # times alpha: more changes nothing but rounding
REACHED = 1e-9  # relative: a target so near to what unlimited power leaves is not reached
FACTORS = 1e-12, 1e12  # by which a start is raised until it reaches a target
BISECTIONS = 60

Mask = Bool[np.ndarray, "time free"]


class PathProblem(NamedTuple):
    """Error of paths as a function of free powers (time, free), as a descent needs it.

    path: of each free column. information: j of each path and dj/dp of each column, from the free powers. scale: of
    the powers.
    """

    paths: Paths
    criterion: Criterion
    path: Int[np.ndarray, "free"]
    information: Callable[[Powers], PathInformation]
    limits: PowerLimits
    scale: float

    def covariances(self, powers: Powers) -> Float[np.ndarray, "time n n"]:
        """Return the error covariance P after each step."""
        return error_covariances(self.paths, self.information(powers).information)

    def exact(self, powers: Powers) -> float:
        """Return the error at these powers, without smoothing of an eigenvalue."""
        return self.criterion.exact(self.covariances(powers))

    def sensitivity(self, powers: Powers) -> tuple[float, Powers, Powers]:
        """Return error, -d error / d j of the path of each free hop, and d error / d p; by one adjoint recursion."""
        information, slope = self.information(powers)
        p = error_covariances(self.paths, information)
        value, weights = self.criterion.smooth(p)
        by_information = path_sensitivities(self.paths, information, p, weights)[:, self.path]
        return value, by_information, -by_information * slope

    def evaluate(self, x: Vector, sharpness: int | None) -> Evaluation:
        """Return the error, powers and their derivatives."""
        powers = np.maximum(x, 0.0).reshape(self.limits.peak.shape)
        sharp = self._replace(criterion=self.criterion._replace(sharpness=sharpness))
        value, _, gradient = sharp.sensitivity(powers)
        return Evaluation(value, gradient.ravel(), powers.ravel(), np.eye(x.size))

    def linear(self, powers: Powers) -> tuple["PathProblem", float, Powers]:
        """Return the problem with the linear error that touches this one from below at p, its value and gradient."""
        problem = self._replace(criterion=self.criterion.supporting(self.covariances(powers)))
        value, _, gradient = problem.sensitivity(powers)
        return problem, value, gradient

    def lower_bound(self, powers: Powers) -> float:
        """Return Frank and Wolfe's bound f(p) + min over allowed q of grad f(p).(q - p), which no convex f is below."""
        _, value, gradient = self.linear(powers)
        return float(value + np.sum(gradient * (self.limits.best(-gradient) - powers)))

    def least_total(self, powers: Powers, target: float) -> float:
        """Return the least total power at which the linear model at p reaches the target: a convex f needs no less."""
        _, value, gradient = self.linear(powers)
        low, high = 0.0, float(powers.mean(axis=0).sum()) * (1 + 1e-9)
        for _ in range(100):
            middle = (low + high) / 2
            best = self.limits._replace(total=middle).best(-gradient)
            reached = value + np.sum(gradient * (best - powers))
            low, high = (low, middle) if reached <= target else (middle, high)
        return low

    def solve(self, starts: list[Powers], target: float | None = None) -> Powers | None:
        """Return the best powers from these starts, for the least error or for the least total that reaches a target.

        None where no start reaches the target.
        """
        rows, most = self.limits.rows()
        peak = self.limits.peak
        problem = DescentProblem(
            low=np.zeros(peak.size),
            high=peak.ravel(),
            unit=np.full(peak.size, self.scale),
            sharpnesses=[criterion.sharpness for criterion in self.criterion.sharper()],
            evaluate=self.evaluate,
            restore=lambda x: self.limits.clip(x.reshape(peak.shape)).ravel(),
        )
        best = search_from_starts(
            problem, PowerAndErrorLimits(rows, most, target, len(peak)), [start.ravel() for start in starts]
        )
        return None if best is None else np.maximum(best, 0.0).reshape(peak.shape)


class PowerTask(NamedTuple):
    """A problem in the free powers (time, free), which hops are free, what the others send, and starts of a search."""

    problem: PathProblem
    free: Bool[np.ndarray, "hop"]
    fixed: Float[np.ndarray, "time hop"]
    starts: list[Powers]

    @property
    def convex(self) -> bool:
        """True if no path has two free hops; then j is concave in its power, and the error convex."""
        return is_convex(self.problem.path)

    def whole(self) -> SplitPaths:
        """Return the paths by the power that their free hops send together."""
        return split_paths(self.problem.paths, self.free, self.fixed)

    def relax(self) -> PathProblem:
        """Return the convex problem in the power of whole paths, whose least error is a lower bound of this one's.

        A path may send what its hops may together, and split it at its best; its information is replaced by the concave
        envelope, which is nowhere below.
        """
        problem, limits = self.problem, self.problem.limits
        steps, count = problem.paths.second.shape
        # Limits of a path: the sums of its hops'.
        peak, mean = np.zeros((steps, count)), np.zeros(count)
        np.add.at(peak.T, problem.path, limits.peak.T)
        np.add.at(mean, problem.path, limits.mean)
        cap = np.minimum(np.minimum(peak, mean * steps), limits.total * steps)
        envelope = compute_envelope(self.whole(), cap)
        return problem._replace(
            path=np.arange(count),
            information=lambda powers: PathInformation(*envelope.information(powers)),
            limits=limits._replace(peak=peak, mean=mean),
        )

    def of_paths(self, powers: Powers) -> Float[np.ndarray, "time path"]:
        """Return the power that the free hops of each path send together."""
        total = np.zeros(self.problem.paths.second.shape)
        np.add.at(total.T, self.problem.path, powers.T)
        return total


def is_convex(path: Int[np.ndarray, "free"]) -> bool:
    """Decide whether no two free hops are on the same path."""
    return len(set(path.tolist())) == len(path)


def make_power_task(
    paths: Paths,
    criterion: Criterion,
    limits: PowerLimits,
    free: Bool[np.ndarray, "hop"],
    fixed: Float[np.ndarray, "time hop"],
    starts: int,
    seed: int,
) -> PowerTask:
    """Return the problem in the free powers, with starts that are even over some choices of the paths that send.

    criterion: the error; limits: of the free powers; free: which hops are; fixed: what all send at present; starts: how
    many; seed: of those that are drawn.
    """

    def information(powers: Powers) -> PathInformation:
        """Return the information of all paths and its slope by the free powers, the others being fixed."""
        every = fixed.copy()
        every[:, free] = powers
        of_paths = path_information(paths, every)
        return PathInformation(of_paths.information, of_paths.slope[:, free])

    # Where no total is given: that of the other limits, or so much that a hop's noise hardly counts.
    total = limits.total
    if not np.isfinite(total):
        largest = np.minimum(limits.peak.mean(axis=0), limits.mean)
        plenty = 10 * max(paths.alpha.max(), np.finfo(float).tiny)
        total = float(np.where(np.isfinite(largest), largest, plenty).sum())
    masks = choose_supports(paths.path[free], len(fixed), starts, seed)
    even = [limits._replace(total=total).even(mask) for mask in masks]
    sizes = [limits.total, *limits.peak[np.isfinite(limits.peak)], float(even[0].max(initial=0.0))]
    scale = max((size for size in sizes if np.isfinite(size)), default=1.0) or 1.0
    problem = PathProblem(
        paths=paths,
        criterion=criterion,
        path=paths.path[free],
        information=information,
        limits=limits,
        scale=scale,
    )
    return PowerTask(problem=problem, free=free, fixed=fixed, starts=even)


def choose_supports(path: Int[np.ndarray, "free"], steps: int, starts: int, seed: int) -> list[Mask]:
    """Return masks (steps, free) of the hops that send: all, then every choice of paths, or `starts` in all, drawn.

    A convex problem has one minimum, and one start.
    """
    whole = np.ones((steps, len(path)), dtype=bool)
    if is_convex(path):
        return [whole]
    distinct, column = np.unique(path, return_inverse=True)
    entries = steps * len(distinct)
    if entries < 63 and 2**entries - 1 <= starts:
        # Every choice but all and none, as the bits of a number.
        choices: Iterator[np.ndarray] = (
            np.array([(number >> i) & 1 for i in range(entries)], dtype=bool) for number in range(2**entries - 2, 0, -1)
        )
    else:
        # Each path sends with a probability that is drawn too, so that few and many are tried.
        draws = np.random.default_rng(seed)
        choices = (draws.uniform(size=entries) < draws.uniform(0.1, 0.9) for _ in range(starts - 1))
    return [whole, *(on.reshape(steps, len(distinct))[:, column] for on in choices if np.any(on))]


def least_error_powers(task: PowerTask) -> tuple[Powers, Certificate]:
    """Return the powers of the least error within the limits of a `task`, and the certificate."""
    problem, starts = task.problem, task.starts
    # Water filling solves a convex problem of the trace but for rounding; the descent goes on from there.
    if task.convex and problem.criterion.sharpness is None and np.all(np.isfinite(starts[0])):
        whole = SplitPaths(*(values[:, problem.path] for values in task.whole()))
        starts = [water_filling(problem.limits, problem.sensitivity, whole, starts[0])]
    powers = problem.solve(starts)
    assert powers is not None  # the starts are within the limits
    # The bound of a convex error, or of the concave envelopes above each path's information.
    value, bound = problem.exact(powers), problem.lower_bound(powers)
    stationarity = max(problem.linear(powers)[1] - bound, 0.0) / value
    if not task.convex:
        relaxed = task.relax()
        lower = relaxed.solve([task.of_paths(powers)])
        bound = relaxed.lower_bound(task.of_paths(powers) if lower is None else lower)
    return powers, Certificate(
        convex=task.convex,
        value=value,
        bound=min(bound, value),
        stationarity=stationarity,
        starts=len(starts),
        unit="error",
    )


def least_power(task: PowerTask, target: float) -> tuple[Powers, Certificate]:
    """Return the powers of the least total that reaches the target error, and the certificate."""
    _check_reachable(task, target)
    # Without a limit of the total, which is checked afterwards.
    limits = task.problem.limits
    free_total = task._replace(problem=task.problem._replace(limits=limits._replace(total=np.inf)))
    powers = _find_least_powers(free_total.problem, task.starts, target)
    if powers is None:
        raise fail("target error", "one that some start reaches (give more starts)", f"{target:.6g}")
    total = float(powers.mean(axis=0).sum())
    if total > limits.total * (1 + MET):
        least = least_error_powers(task)[1].value
        raise fail("target error", f"at least {least:.6g}, the least found within the budget", f"{target:.6g}")
    # The bound: of the linear model where the problem is convex, else of that of the envelopes.
    problem, near = free_total.problem, powers
    stationarity = 1 - problem.least_total(near, target) / total if total > 0 else 0.0
    if not task.convex:
        problem, near = free_total.relax(), task.of_paths(powers)
        lower = _find_least_powers(problem, [near], target)
        near = near if lower is None else lower
    bound = min(problem.least_total(near, target), total)
    fixed = float(task.fixed[:, ~task.free].mean(axis=0).sum())
    return powers, Certificate(
        convex=task.convex,
        value=total + fixed,
        bound=bound + fixed,
        stationarity=max(stationarity, 0.0),
        starts=len(task.starts),
        unit="power",
    )


def _find_least_powers(problem: PathProblem, starts: list[Powers], target: float) -> Powers | None:
    """Return the least powers that reach a target, from starts each raised until it does; None where none can."""
    no_power = np.zeros_like(starts[0])
    if problem.criterion.smooth(problem.covariances(no_power))[0] <= target:
        return no_power
    raised = [start for start in (_raise_powers(problem, start, target) for start in starts) if start is not None]
    if not raised:
        return None
    scale = max(float(raised[0].mean(axis=0).sum()), np.finfo(float).tiny)
    return problem._replace(scale=scale).solve(raised, target)


def _raise_powers(problem: PathProblem, start: Powers, target: float) -> Powers | None:
    """Return the start times the least factor that reaches the target, as far as peaks and means allow; None if none.

    By bisection of the factor's logarithm.
    """

    def reaches(factor: float) -> bool:
        return problem.criterion.smooth(problem.covariances(problem.limits.clip(start * factor)))[0] <= target

    low, high = FACTORS
    if not reaches(high):
        return None
    for _ in range(BISECTIONS):
        middle = np.sqrt(low * high)
        low, high = (low, middle) if reaches(middle) else (middle, high)
    return problem.limits.clip(start * high)


def _check_reachable(task: PowerTask, target: float) -> None:
    """Raise ValueError where the target is not above the error that remains however much is sent."""
    limits = task.problem.limits
    bounded = np.any(np.isfinite(limits.peak)) or np.any(np.isfinite(limits.mean))
    most = np.minimum(limits.peak, UNLIMITED * np.maximum(task.problem.paths.alpha[:, task.free], 1.0))
    most = np.minimum(most, limits.mean * len(most))  # of the mean: all in one step
    left = task.problem.exact(most)
    if target <= left * (1 + REACHED):
        what = "power at its limits" if bounded else "unlimited power"
        raise fail("target error", f"more than {left:.6g}: {what} leaves {left:.6g}", f"{target:.6g}")


def design_paths(problem: DesignProblem, task: PowerTask, target: float | None, present: float) -> PowerDesign:
    """Return the design of a task: the least error, or the least power for a target."""
    powers, certificate = least_error_powers(task) if target is None else least_power(task, target)
    paths = task.problem.paths
    every = task.fixed.copy()
    every[:, task.free] = powers
    # Derivatives by the powers of all hops, of those that are not free too.
    whole = task.problem._replace(path=paths.path, information=lambda p: path_information(paths, p))
    gradient = whole.sensitivity(every)[2]
    return PowerDesign(
        problem=problem,
        powers=dict(zip(paths.names, every.T, strict=True)),
        error=task.problem.exact(powers),
        certificate=certificate,
        present=present,
        covariance=task.problem.covariances(powers),
        sensitivity=dict(zip(paths.names, gradient.sum(axis=0).tolist(), strict=True)),
        price=float(np.max(-gradient[:, task.free] * len(gradient), initial=0.0)),
        numbers={},
        realised=None,
    )
