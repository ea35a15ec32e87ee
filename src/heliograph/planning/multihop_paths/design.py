"""Designs of the powers of independent paths: water filling, descents, and bounds that hold for all allocations."""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from heliograph.numerics.check import fail
from heliograph.numerics.types import Bool, Float, Int
from heliograph.planning.design_problem import Certificate, DesignProblem, PowerDesign
from heliograph.planning.error_objective import Criterion
from heliograph.planning.multihop_paths.model import (
    PathInformation,
    Paths,
    compute_error_covariances,
    compute_path_information,
    compute_path_sensitivities,
)
from heliograph.planning.multihop_paths.power_split_over_hops import SplitPaths, compute_envelope, split_paths
from heliograph.planning.multihop_paths.water_filling import water_filling
from heliograph.planning.power_budget import MET, PowerLimits, Powers
from heliograph.planning.sequential_quadratic_programming import (
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

    path: number of the path of each free column. information: free powers -> j of each path and dj/dp of each column, j
    being the information that a path carries at a step. limits: of the free powers. scale: size of the powers.
    """

    paths: Paths
    criterion: Criterion
    path: Int[np.ndarray, "free"]
    information: Callable[[Powers], PathInformation]
    limits: PowerLimits
    scale: float

    def covariances(self, powers: Powers) -> Float[np.ndarray, "time n n"]:
        """Return the error covariance P after each step."""
        return compute_error_covariances(self.paths, self.information(powers).information)

    def compute_exact_error(self, powers: Powers) -> float:
        """Return the error at these powers, without smoothing of an eigenvalue."""
        return self.criterion.compute_exact_error(self.covariances(powers))

    def sensitivity(self, powers: Powers) -> tuple[float, Powers, Powers]:
        """Return the error, -d error / d j of each free hop's path, and d error / d p, both (time, free), at powers p.

        j is the information of a path, and `self.path` the path of each free hop. One adjoint recursion gives both.
        """
        information, slope = self.information(powers)
        p = compute_error_covariances(self.paths, information)
        value, weights = self.criterion.smooth(p)
        by_information = compute_path_sensitivities(self.paths, information, p, weights)[:, self.path]
        return value, by_information, -by_information * slope

    def evaluate(self, x: Vector, sharpness: int | None) -> Evaluation:
        """Return the error, the powers and their derivatives at x (all powers in a row), with this smoothing."""
        powers = np.maximum(x, 0.0).reshape(self.limits.peak.shape)
        smoothed = self._replace(criterion=self.criterion._replace(sharpness=sharpness))
        value, _, gradient = smoothed.sensitivity(powers)
        return Evaluation(value, gradient.ravel(), powers.ravel(), np.eye(x.size))

    def make_support(self, powers: Powers) -> tuple["PathProblem", float, Powers]:
        """Return a problem whose error is at most this one's, and equal at `powers`; then its value and gradient there.

        Its error is linear in the covariance P: the tangent of this criterion at the P of these powers (time, free).
        """
        problem = self._replace(criterion=self.criterion.make_tangent(self.covariances(powers)))
        value, _, gradient = problem.sensitivity(powers)
        return problem, value, gradient

    def lower_bound(self, powers: Powers) -> float:
        """Return Frank and Wolfe's lower bound f(p) + min over allowed q of grad f(p).(q - p) of a convex error f."""
        _, value, gradient = self.make_support(powers)
        return float(value + np.sum(gradient * (self.limits.find_best_powers(-gradient) - powers)))

    def bound_least_total(self, powers: Powers, target: float) -> float:
        """Return the least total power at which the tangent at p reaches the target, found by bisection.

        A convex error is nowhere below its tangent, so it needs at least this power.
        """
        _, value, gradient = self.make_support(powers)
        low, high = 0.0, float(powers.mean(axis=0).sum()) * (1 + 1e-9)
        for _ in range(100):
            middle = (low + high) / 2
            best = self.limits._replace(total=middle).find_best_powers(-gradient)
            reached = value + np.sum(gradient * (best - powers))
            low, high = (low, middle) if reached <= target else (middle, high)
        return low

    def solve_from_starts(self, starts: list[Powers], target: float | None = None) -> Powers | None:
        """Return the best powers (time, free) of descents from these starts, or None where none reaches the target.

        They are those of the least error, or with a target of the least total power that reaches it.
        """
        rows, most = self.limits.make_limit_rows()
        peak = self.limits.peak
        problem = DescentProblem(
            low=np.zeros(peak.size),
            high=peak.ravel(),
            unit=np.full(peak.size, self.scale),
            sharpnesses=[criterion.sharpness for criterion in self.criterion.list_from_smoothest()],
            evaluate=self.evaluate,
            restore=lambda x: self.limits.clip_powers(x.reshape(peak.shape)).ravel(),
        )
        best = search_from_starts(
            problem, PowerAndErrorLimits(rows, most, target, len(peak)), [start.ravel() for start in starts]
        )
        return None if best is None else np.maximum(best, 0.0).reshape(peak.shape)


class PowerTask(NamedTuple):
    """A problem in the free powers (time, free), which hops are free, what the others send, and starts of a search.

    fixed: powers that all hops send at present, of which those of the free ones do not matter.
    """

    problem: PathProblem
    free: Bool[np.ndarray, "hop"]
    fixed: Float[np.ndarray, "time hop"]
    starts: list[Powers]

    @property
    def convex(self) -> bool:
        """True if no path has two free hops; then j is concave in its power, and the error convex."""
        return is_convex(self.problem.path)

    def whole_paths(self) -> SplitPaths:
        """Return the paths as functions of the power that their free hops send together."""
        return split_paths(self.problem.paths, self.free, self.fixed)

    def relax_to_whole_paths(self) -> PathProblem:
        """Return the convex problem in the power of whole paths, whose least error is a lower bound of this one's.

        The power of a path is the sum over its hops, split best, within the sum of their limits. The information of a
        path is replaced by its concave envelope over that power, which is nowhere lower.
        """
        problem, limits = self.problem, self.problem.limits
        steps, count = problem.paths.second.shape  # (time, paths)
        peak, mean = np.zeros((steps, count)), np.zeros(count)  # limits of a path: the sums of its hops' limits
        np.add.at(peak.T, problem.path, limits.peak.T)
        np.add.at(mean, problem.path, limits.mean)
        cap = np.minimum(np.minimum(peak, mean * steps), limits.total * steps)
        envelope = compute_envelope(self.whole_paths(), cap)
        return problem._replace(
            path=np.arange(count),
            information=lambda powers: PathInformation(*envelope.information(powers)),
            limits=limits._replace(peak=peak, mean=mean),
        )

    def sum_by_path(self, powers: Powers) -> Float[np.ndarray, "time path"]:
        """Return the sum of the free hops' powers for each path (time, path), from their powers (time, free)."""
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

    Args:
        paths: the paths of all hops.
        criterion: the error.
        limits: of the free powers.
        free: which hops are free.
        fixed: what all hops send at present.
        starts: number of starts, if there are as many choices.
        seed: of the choices that are drawn.
    """

    def information(powers: Powers) -> PathInformation:
        """Return the information of all paths, and its slope by the free powers, with the other powers fixed.

        `fixed`: powers of all hops (time, hop), those of the hops `free` replaced by `powers` (time, free).
        """
        of_all_hops = fixed.copy()
        of_all_hops[:, free] = powers
        of_paths = compute_path_information(paths, of_all_hops)
        return PathInformation(of_paths.information, of_paths.slope[:, free])

    # Each start shares the total evenly over the hops of one mask.
    total = limits.total if np.isfinite(limits.total) else _choose_total(limits, paths)
    masks = choose_supports(paths.path[free], len(fixed), starts, seed)
    even_powers = [limits._replace(total=total).find_even_powers(mask) for mask in masks]
    # The scale of the powers: the largest limit, or power of the first start, that is finite; 1 if that is 0.
    sizes = [limits.total, *limits.peak[np.isfinite(limits.peak)], float(even_powers[0].max(initial=0.0))]
    scale = max((size for size in sizes if np.isfinite(size)), default=1.0) or 1.0
    problem = PathProblem(
        paths=paths,
        criterion=criterion,
        path=paths.path[free],
        information=information,
        limits=limits,
        scale=scale,
    )
    return PowerTask(problem=problem, free=free, fixed=fixed, starts=even_powers)


def _choose_total(limits: PowerLimits, paths: Paths) -> float:
    """Return the total power of starts if no total is given: the sum over transmitters of what each may send.

    Its limits are of peak and mean. Without any it is ten times the largest alpha, where half of what arrives is noise.
    """
    largest_means = np.minimum(limits.peak.mean(axis=0), limits.mean)  # of each transmitter
    without_limit = 10 * max(paths.alpha.max(), np.finfo(float).tiny)
    return float(np.where(np.isfinite(largest_means), largest_means, without_limit).sum())


def choose_supports(path: Int[np.ndarray, "free"], steps: int, starts: int, seed: int) -> list[Mask]:
    """Return a mask (steps, free) for each start of a search: which free hops send power at which step.

    In the first all hops send. In each other one some whole paths send at each step: every choice if there are at most
    `starts`, else random ones. A convex problem needs the first only. `path`: number of the path of each free hop.
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


def find_least_error_powers(task: PowerTask) -> tuple[Powers, Certificate]:
    """Return the powers (time, free) of the least error within the limits of a task, and the certificate.

    `task`: the error, its limits, the free hops, and starts. The certificate has a lower bound of the least error.
    """
    problem, starts = task.problem, task.starts
    # Water filling nearly solves a convex problem of a trace (one without a sharpness); the descent goes on from there.
    if task.convex and problem.criterion.sharpness is None and np.all(np.isfinite(starts[0])):
        path_of_hop = SplitPaths(*(values[:, problem.path] for values in task.whole_paths()))
        starts = [water_filling(problem.limits, problem.sensitivity, path_of_hop, starts[0])]
    powers = problem.solve_from_starts(starts)
    assert powers is not None  # the starts are within the limits
    # The least value of the error's tangent at these powers within the limits. A convex error is nowhere below it.
    value, bound = problem.compute_exact_error(powers), problem.lower_bound(powers)
    _, tangent_value, _ = problem.make_support(powers)
    stationarity = max(tangent_value - bound, 0.0) / value if value > 0 else 0.0  # 0: nothing is left to gain
    # An error that is not convex is bounded by the convex problem with concave envelopes of each path's information.
    if not task.convex:
        relaxed = task.relax_to_whole_paths()
        relaxed_powers = relaxed.solve_from_starts([task.sum_by_path(powers)])
        bound = relaxed.lower_bound(task.sum_by_path(powers) if relaxed_powers is None else relaxed_powers)
    return powers, Certificate(
        convex=task.convex,
        value=value,
        bound=min(bound, value),
        stationarity=stationarity,
        starts=len(starts),
        unit="error",
    )


def find_least_total_powers(task: PowerTask, target: float) -> tuple[Powers, Certificate]:
    """Return the powers (time, free) of the least total that reaches the target error, and the certificate.

    The certificate has a bound of the power that any allocation needs. `task`: paths, limits, free hops, starts.
    """
    _check_reachable(task, target)  # the target is possible at all within each transmitter's own limit
    # Searched without the limit of the total power, which is what becomes small; it is checked afterwards.
    limits = task.problem.limits
    unlimited = task._replace(problem=task.problem._replace(limits=limits._replace(total=np.inf)))
    powers = _find_least_powers(unlimited.problem, task.starts, target)
    if powers is None:
        raise fail("target error", "one that some start reaches (give more starts)", f"{target:.6g}")
    total = float(powers.mean(axis=0).sum())
    if total > limits.total * (1 + MET):
        least = find_least_error_powers(task)[1].value
        raise fail("target error", f"at least {least:.6g}, the least found within the budget", f"{target:.6g}")
    # The least total with which the error's tangent at these powers reaches the target. A convex error needs no less.
    bound = unlimited.problem.bound_least_total(powers, target)
    stationarity = 1 - bound / total if total > 0 else 0.0
    # An error that is not convex is bounded by the convex problem with concave envelopes of each path's information.
    if not task.convex:
        relaxed, of_paths = unlimited.relax_to_whole_paths(), task.sum_by_path(powers)
        relaxed_powers = _find_least_powers(relaxed, [of_paths], target)
        bound = relaxed.bound_least_total(of_paths if relaxed_powers is None else relaxed_powers, target)
    fixed = float(task.fixed[:, ~task.free].mean(axis=0).sum())
    return powers, Certificate(
        convex=task.convex,
        value=total + fixed,
        bound=min(bound, total) + fixed,
        stationarity=max(stationarity, 0.0),
        starts=len(task.starts),
        unit="power",
    )


def _find_least_powers(problem: PathProblem, starts: list[Powers], target: float) -> Powers | None:
    """Return the powers of least total that reach a target, by descents from the starts, or None if none can.

    Each start is raised until it reaches the target. `scale`: the size of powers, which sets the steps of the search.
    """
    no_power = np.zeros_like(starts[0])
    if problem.criterion.smooth(problem.covariances(no_power))[0] <= target:
        return no_power
    raised_starts = [_raise_powers(problem, start, target) for start in starts]
    reaching_starts = [start for start in raised_starts if start is not None]
    if not reaching_starts:
        return None
    scale = max(float(reaching_starts[0].mean(axis=0).sum()), np.finfo(float).tiny)
    return problem._replace(scale=scale).solve_from_starts(reaching_starts, target)


def _raise_powers(problem: PathProblem, start: Powers, target: float) -> Powers | None:
    """Return the start times the least factor that reaches the target within peaks and means, or None if none does."""

    def reaches(factor: float) -> bool:
        """Return whether the start's powers times this factor, cut to the limits, lead to the target error or less."""
        powers = problem.limits.clip_powers(start * factor)
        return problem.criterion.smooth(problem.covariances(powers))[0] <= target

    low, high = FACTORS  # the factor's logarithm is bisected between these
    if not reaches(high):
        return None
    for _ in range(BISECTIONS):
        middle = np.sqrt(low * high)
        low, high = (low, middle) if reaches(middle) else (middle, high)
    return problem.limits.clip_powers(start * high)


def _check_reachable(task: PowerTask, target: float) -> None:
    """Raise ValueError unless the target exceeds, by the share REACHED, the error that all allowed power leaves."""
    limits, alpha = task.problem.limits, task.problem.paths.alpha[:, task.free]
    has_limits = np.any(np.isfinite(limits.peak)) or np.any(np.isfinite(limits.mean))
    # Each may send up to its peak, up to its mean power of all steps in one, and at most a lot of power (UNLIMITED).
    plenty, whole_mean = UNLIMITED * np.maximum(alpha, 1.0), limits.mean * len(limits.peak)
    largest_powers = np.minimum(np.minimum(limits.peak, plenty), whole_mean)
    least_error = task.problem.compute_exact_error(largest_powers)
    if target <= least_error * (1 + REACHED):
        what = "power at its limits" if has_limits else "unlimited power"
        raise fail("target error", f"more than {least_error:.6g}: {what} leaves {least_error:.6g}", f"{target:.6g}")


def design_paths(problem: DesignProblem, task: PowerTask, target: float | None, present: float) -> PowerDesign:
    """Return the design of a task: the least error within its limits, or the least power that reaches a target.

    Args:
        problem: the user's design problem, kept in the result.
        task: paths of hops, which hops' powers are free, the powers of the others, and starts of the search.
        target: the target error; None for the least error.
        present: error of the network as it is.
    """
    powers, certificate = find_least_error_powers(task) if target is None else find_least_total_powers(task, target)
    paths = task.problem.paths
    of_all_hops = task.fixed.copy()
    of_all_hops[:, task.free] = powers
    # Derivatives (time, hop) by the powers of all hops, of those that are not free too.
    all_free = task.problem._replace(path=paths.path, information=lambda p: compute_path_information(paths, p))
    _, _, gradient = all_free.sensitivity(of_all_hops)
    return PowerDesign(
        problem=problem,
        powers=dict(zip(paths.names, of_all_hops.T, strict=True)),
        error=task.problem.compute_exact_error(powers),
        certificate=certificate,
        present=present,
        covariance=task.problem.covariances(powers),
        sensitivity=dict(zip(paths.names, gradient.sum(axis=0).tolist(), strict=True)),
        price=task.problem.limits.find_price(powers, -gradient[:, task.free], is_least_power=target is not None),
        numbers={},
        realised=None,
    )
