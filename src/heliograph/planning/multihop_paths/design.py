"""Designs of the powers of independent paths: water filling, descents, and bounds that hold for all allocations."""

import numpy as np

from heliograph.numerics.check import fail
from heliograph.planning.design_problem import Certificate, DesignProblem, PowerDesign
from heliograph.planning.multihop_paths.model import compute_path_information
from heliograph.planning.multihop_paths.path_problem import PathProblem, PowerTask
from heliograph.planning.multihop_paths.power_split_over_hops import SplitPaths
from heliograph.planning.multihop_paths.water_filling import water_filling
from heliograph.planning.power_budget import MET_EXCESS, Powers

PLENTY = 1e13  # times alpha: more changes nothing but rounding
REACH_MARGIN = 1e-9  # relative: a target so near to what unlimited power leaves is not reached
FACTORS = 1e-12, 1e12  # by which a start is raised until it reaches a target
BISECTIONS = 60


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
    value = problem.compute_exact_error(powers)
    bound = problem.lower_bound(powers)
    tangent_value = problem.make_support(powers).value
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
    if total > limits.total * (1 + MET_EXCESS):
        _, certificate = find_least_error_powers(task)
        least = certificate.value
        raise fail("target error", f"at least {least:.6g}, the least found within the budget", f"{target:.6g}")
    # The least total with which the error's tangent at these powers reaches the target. A convex error needs no less.
    bound = unlimited.problem.bound_least_total(powers, target)
    stationarity = 1 - bound / total if total > 0 else 0.0
    # An error that is not convex is bounded by the convex problem with concave envelopes of each path's information.
    if not task.convex:
        relaxed = unlimited.relax_to_whole_paths()
        of_paths = task.sum_by_path(powers)
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

    Each start is raised until it reaches the target.

    Args:
        problem: the error as a function of the free powers.
        starts: powers at which searches begin, (time, free) each.
        target: the target error.
    """
    no_power = np.zeros_like(starts[0])
    if problem.criterion.smooth(problem.covariances(no_power)).value <= target:
        return no_power
    raised_starts = [_raise_powers(problem, start, target) for start in starts]
    reaching_starts = [start for start in raised_starts if start is not None]
    if not reaching_starts:
        return None
    scale = max(float(reaching_starts[0].mean(axis=0).sum()), np.finfo(float).tiny)
    return problem._replace(scale=scale).solve_from_starts(reaching_starts, target)


def _raise_powers(problem: PathProblem, start: Powers, target: float) -> Powers | None:
    """Return the start times the least factor with which the error reaches the target, or None if none does.

    The powers are cut to their limits. The factor is found by bisection of its logarithm between the two FACTORS, 1e-12
    and 1e12, as the error falls with the powers.

    Args:
        problem: the error as a function of the free powers, with their limits.
        start: powers that are raised or lowered (time, free).
        target: the target error.
    """

    def reaches(factor: float) -> bool:
        """Return whether the start's powers times this factor, cut to the limits, lead to the target error or less.

        `problem` has the error as a function of the powers, and their limits.
        """
        powers = problem.limits.clip_powers(start * factor)
        return problem.criterion.smooth(problem.covariances(powers)).value <= target

    low, high = FACTORS
    if not reaches(high):
        return None
    for _ in range(BISECTIONS):
        middle = np.sqrt(low * high)  # halves the interval of logarithms
        low, high = (low, middle) if reaches(middle) else (middle, high)
    return problem.limits.clip_powers(start * high)


def _check_reachable(task: PowerTask, target: float) -> None:
    """Raise ValueError unless the target exceeds, by the share REACH_MARGIN, the error that all allowed power leaves.

    Args:
        task: the error, the free hops and the limits of their powers.
        target: the target error.
    """
    limits = task.problem.limits
    alpha = task.problem.paths.alpha[:, task.free]
    has_limits = np.any(np.isfinite(limits.peak)) or np.any(np.isfinite(limits.mean))
    # Each may send up to its peak, up to its mean power of all steps in one, and at most a lot of power (PLENTY).
    plenty = PLENTY * np.maximum(alpha, 1.0)
    whole_mean = limits.mean * len(limits.peak)
    largest_powers = np.minimum(np.minimum(limits.peak, plenty), whole_mean)
    least_error = task.problem.compute_exact_error(largest_powers)
    if target <= least_error * (1 + REACH_MARGIN):
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
    gradient = all_free.sensitivity(of_all_hops).gradient
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
