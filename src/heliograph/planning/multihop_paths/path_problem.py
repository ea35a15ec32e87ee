"""The error of independent paths as a function of the powers of their free hops, its bounds, and starts of searches."""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from heliograph.numerics.types import Bool, Float, Int
from heliograph.planning.error_objective import Criterion
from heliograph.planning.multihop_paths.model import (
    PathInformation,
    Paths,
    compute_error_covariances,
    compute_path_information,
    compute_path_sensitivities,
)
from heliograph.planning.multihop_paths.power_split_over_hops import SplitPaths, compute_envelope, split_paths
from heliograph.planning.power_budget import PowerLimits, Powers
from heliograph.planning.sequential_quadratic_programming import (
    DescentProblem,
    Evaluation,
    PowerAndErrorLimits,
    Vector,
    search_from_starts,
)

Mask = Bool[np.ndarray, "time free"]


class ErrorSlopes(NamedTuple):
    """Error of paths at some powers, and its derivatives, both (time, free).

    Args:
        error: the error, smoothed if it is an eigenvalue.
        weights: -d error / d j, with j the information of the path of each free hop: what more information is worth.
        gradient: d error / d p, by the power of each free hop.
    """

    error: float
    weights: Powers
    gradient: Powers


class ErrorTangent(NamedTuple):
    """A criterion's linear lower bound as a problem of its own, and its value and gradient where both errors are equal.

    Args:
        problem: the problem with the linear criterion.
        value: its error at the powers of the tangent.
        gradient: its derivative by the free powers there (time, free).
    """

    problem: "PathProblem"
    value: float
    gradient: Powers


class PathProblem(NamedTuple):
    """Error of paths as a function of free powers (time, free), as a descent needs it.

    Args:
        paths: the paths, each a chain of hops from one sensor to the receiver.
        criterion: the number made of the error covariances that is to be small.
        path: number of the path of each free hop (free,).
        information: function of the free powers that returns j of each path, the information that it carries at a
            step, and dj/dp of each free hop.
        limits: of the free powers.
        scale: size of the powers.
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

    def sensitivity(self, powers: Powers) -> ErrorSlopes:
        """Return the error at powers p (time, free), -d error / d j of each free hop's path, and d error / d p.

        j is the information of a path, and d error / d p = (d error / d j) (dj/dp). One adjoint recursion gives the
        derivatives by all j.
        """
        information, slope = self.information(powers)  # j (time, path), and dj/dp (time, free)
        p = compute_error_covariances(self.paths, information)
        smoothed = self.criterion.smooth(p)
        weights_of_paths = compute_path_sensitivities(self.paths, information, p, smoothed.slopes)
        weights = weights_of_paths[:, self.path]
        return ErrorSlopes(error=smoothed.value, weights=weights, gradient=-weights * slope)

    def evaluate(self, x: Vector, sharpness: int | None) -> Evaluation:
        """Return the error, the powers and their derivatives at x, the free powers step after step.

        `sharpness`: smoothing of the error if it is an eigenvalue; None of a trace.
        """
        powers = np.maximum(x, 0.0).reshape(self.limits.peak.shape)
        smoothed = self._replace(criterion=self.criterion._replace(sharpness=sharpness))
        at_powers = smoothed.sensitivity(powers)
        return Evaluation(at_powers.error, at_powers.gradient.ravel(), powers.ravel(), np.eye(x.size))

    def make_support(self, powers: Powers) -> ErrorTangent:
        """Return a problem whose error is at most this one's, and equal at `powers` (time, free).

        Its criterion is linear in the covariance P: the tangent of this criterion at the P of these powers.
        """
        problem = self._replace(criterion=self.criterion.make_tangent(self.covariances(powers)))
        at_powers = problem.sensitivity(powers)
        return ErrorTangent(problem, at_powers.error, at_powers.gradient)

    def lower_bound(self, powers: Powers) -> float:
        """Return Frank and Wolfe's lower bound f(p) + min over allowed q of grad f(p).(q - p) of a convex error f."""
        tangent = self.make_support(powers)
        least_on_tangent = self.limits.find_best_powers(-tangent.gradient)
        return float(tangent.value + np.sum(tangent.gradient * (least_on_tangent - powers)))

    def bound_least_total(self, powers: Powers, target: float) -> float:
        """Return the least total power at which the error's tangent at `powers` reaches the target, by bisection.

        A convex error is nowhere below its tangent, so it needs at least this power.
        """
        _, value, gradient = self.make_support(powers)
        low = 0.0
        high = float(powers.mean(axis=0).sum()) * (1 + 1e-9)
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
    """A problem in the free powers, and what its search needs.

    Args:
        problem: the error as a function of the free powers (time, free).
        free: which hops are free (hop,).
        fixed: powers that all hops send at present (time, hop), of which those of the free ones do not matter.
        starts: free powers at which searches begin, (time, free) each.
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
        peak = np.zeros((steps, count))
        mean = np.zeros(count)  # limits of a path: the sums of its hops' limits
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

    Args:
        limits: limits of the free powers.
        paths: the paths, for the noise of their hops (`alpha`, in units of sent power).
    """
    largest_means = np.minimum(limits.peak.mean(axis=0), limits.mean)  # of each transmitter
    without_limit = 10 * max(paths.alpha.max(), np.finfo(float).tiny)
    return float(np.where(np.isfinite(largest_means), largest_means, without_limit).sum())


def choose_supports(path: Int[np.ndarray, "free"], steps: int, starts: int, seed: int) -> list[Mask]:
    """Return a mask (steps, free) for each start of a search: which free hops send power at which step.

    In the first all hops send. In each other one some whole paths send at each step: every choice if there are at most
    `starts`, else random ones. A convex problem needs the first only.

    Args:
        path: number of the path of each free hop (free,).
        steps: number of steps.
        starts: largest number of masks.
        seed: of the choices that are drawn.
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
