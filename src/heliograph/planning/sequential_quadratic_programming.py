"""One descent for all designs: sequential quadratic programmes from many starts, then Newton's method where they end.

At a vector x a design problem has an error e(x) and transmits the powers p(x). Sought is
    min e(x)         subject to  rows p(x) <= most  and  low <= x <= high,   or
    min mean power   subject to  the same and  e(x) <= target.
Where the powers themselves are free p(x) = x and the rows are linear; else p is any smooth function.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import Bounds, NonlinearConstraint, minimize

from heliograph.numerics.types import Bool, Float

Vector = Float[np.ndarray, "x"]

MOST_ITERATIONS = 400
FINE_TOLERANCE = 1e-14  # relative change at which a descent ends
COARSE_TOLERANCE = 1e-8  # that of many descents, of which only the best goes on
MOST_ROUNDS = 4  # of a descent begun again where it ended, its Hessian forgotten, and of Newton's method
FEASIBLE_EXCESS = 1e-7  # relative excess over a limit that counts as none
ACTIVE_ROOM = 1e-7  # relative: how near a limit is one that is reached
DIFFERENCE_WIDTH = 1e-5  # relative, of the differences of gradients that make a Hessian
ROUNDING = 1e-14  # relative
LEAST_SIZE = 1e-12  # unit of a value that is less, or 0, at the start


class ValueAndSlope(NamedTuple):
    """Value of a function of z at a point, and its gradient."""

    value: float
    slope: Vector


class Evaluation(NamedTuple):
    """Error and transmitted powers of a design at a point x, and their derivatives.

    Args:
        error: the error.
        error_slope: its gradient by x.
        powers: powers of all transmitters at all steps, step after step (entries,).
        power_slope: derivatives of the powers by x (entries, x).
    """

    error: float
    error_slope: Vector
    powers: Float[np.ndarray, "entries"]
    power_slope: Float[np.ndarray, "entries x"]


class PowerAndErrorLimits(NamedTuple):
    """Limits rows @ powers <= most, and error <= target if a target is given.

    Args:
        rows: a row for each limit, scaled so that the limit is 1, or 0 if nothing may be sent (limits, entries).
        most: the limits, 1 or 0 (limits,).
        target: target of the error; None if the error itself is minimised.
        steps: number of steps, by which the sum of all powers is divided to the mean power.
    """

    rows: Float[np.ndarray, "limits entries"]
    most: Float[np.ndarray, "limits"]
    target: float | None
    steps: int


class DescentProblem(NamedTuple):
    """A design problem as a descent needs it.

    Args:
        low: least values of x.
        high: largest values of x.
        unit: scale of each number in x.
        sharpnesses: smoothings of the error, one after another, the last the sharpest.
        evaluate: function of x and a smoothing that returns error, powers and derivatives; None where they grow without
            limit.
        restore: function that moves x back into the limits, as far as rounding took it out of them.
    """

    low: Vector
    high: Vector
    unit: Vector
    sharpnesses: Sequence[int | None]
    evaluate: Callable[[Vector, int | None], Evaluation | None]
    restore: Callable[[Vector], Vector]


class NewtonStep(NamedTuple):
    """Newton's step on a Lagrangian, value - multipliers' room.

    Args:
        step: change of z.
        multipliers: multipliers of the active limits, in their order.
        active: which limits are active: met with equality (limits,).
    """

    step: Vector
    multipliers: Vector
    active: Bool[np.ndarray, "limits"]


class ScaledProgramme:
    """A design problem with its limits, as a function of z = x / unit; values are divided by `size`, that of the start.

    The room of a limit is the part of it that is left: negative where it is exceeded.

    Args:
        problem: the design problem.
        limits: of powers, and of the error where there is a target.
        sharpness: the smoothing of the error.
        start: a point x, whose value sets the size.
    """

    def __init__(self, problem: DescentProblem, limits: PowerAndErrorLimits, sharpness: int | None, start: Vector):
        """Prepare a descent from a start x, in coordinates z = x / unit.

        The objective is divided by `self.size`, its value at the start, so that it is about 1.

        Args:
            problem: the design problem.
            limits: of powers, and of the error where there is a target.
            sharpness: the smoothing of the error, None of a trace.
            start: the start x.
        """
        self.problem, self.limits, self.sharpness = problem, limits, sharpness
        low, high = problem.low / problem.unit, problem.high / problem.unit
        self.bounds = Bounds(low, high)
        self._last: tuple[bytes, Evaluation | None] = (b"", None)  # the last point, as bytes, and its evaluation
        self.size = 1.0
        value = self.objective(start / problem.unit).value
        self.size = max(value, LEAST_SIZE) if np.isfinite(value) else 1.0

    def evaluate_at(self, z: Vector) -> Evaluation | None:
        """Return the evaluation at a point z = x / unit, or None if there is none; the last evaluation is cached.

        SciPy asks for the objective, the limits and their slopes at the same point one after another.
        """
        point, (last_point, evaluation) = z.tobytes(), self._last
        if point != last_point:
            evaluation = self.problem.evaluate(np.asarray(z * self.problem.unit), self.sharpness)
            self._last = point, evaluation
        return evaluation

    def objective(self, z: Vector) -> ValueAndSlope:
        """Return the objective at z = x / unit over `self.size`, infinite without an evaluation, and its gradient.

        The objective is the error, or the total mean power if there is a target error. Powers are summed over all
        steps, so their sum is divided by the number of steps.
        """
        evaluation = self.evaluate_at(z)
        if evaluation is None:
            return ValueAndSlope(np.inf, np.zeros_like(z))
        # By z = x / unit the gradient is that by x times the unit.
        unit = self.problem.unit
        if self.limits.target is None:
            return ValueAndSlope(evaluation.error / self.size, evaluation.error_slope * unit / self.size)
        scale = self.limits.steps * self.size
        total = float(evaluation.powers.sum())
        total_slope = evaluation.power_slope.sum(axis=0)
        return ValueAndSlope(total / scale, total_slope * unit / scale)

    def limit_room(self, z: Vector) -> Float[np.ndarray, "limits"]:
        """Return the unused part of each limit at z, with the target error last; it is negative if a limit is exceeded.

        Limits are scaled to 1 (or 0), so the parts are 1 - powers / limit, and 1 - error / target. All are -1 at a
        point without an evaluation, where the error grows without limit.
        """
        rows = self.limits.rows
        most = self.limits.most
        target = self.limits.target
        evaluation = self.evaluate_at(z)
        if evaluation is None:
            return np.full(len(most) + (target is not None), -1.0)
        room = most - rows @ evaluation.powers
        return room if target is None else np.append(room, 1 - evaluation.error / target)

    def limit_room_slope(self, z: Vector) -> Float[np.ndarray, "limits x"]:
        """Return the derivatives of `limit_room`, the unused part of each limit, by z (limits, x).

        They are 0 at a point without an evaluation, where the error grows without limit.
        """
        rows = self.limits.rows
        most = self.limits.most
        target = self.limits.target
        evaluation = self.evaluate_at(z)
        unit = self.problem.unit
        if evaluation is None:
            return np.zeros((len(most) + (target is not None), len(z)))
        slope = -(rows @ evaluation.power_slope) * unit  # by z = x / unit
        return slope if target is None else np.vstack([slope, -evaluation.error_slope * unit / target])

    def is_feasible(self, z: Vector) -> bool:
        """Return whether the error is finite at z and the limits are met, up to the relative FEASIBLE_EXCESS (1e-7)."""
        return self.evaluate_at(z) is not None and bool(np.all(self.limit_room(z) >= -FEASIBLE_EXCESS))

    def merit(self, z: Vector) -> float:
        """Return the objective at a point within the limits, and infinity beyond them, to compare points."""
        return self.objective(z).value if self.is_feasible(z) else np.inf

    def descend(self, z: Vector, tolerance: float) -> Vector:
        """Return the point where sequential quadratic programming ends, or the start if that is better.

        Args:
            z: the start, in units of each number.
            tolerance: relative change of the objective at which a descent ends.
        """
        constraints = []
        if len(self.limit_room(z)):
            constraints = [NonlinearConstraint(self.limit_room, 0.0, np.inf, self.limit_room_slope)]
        # The merit is the objective within the limits and infinite outside.
        merit_at_start = self.merit(z)
        end = self._minimize(self.objective, z, constraints, tolerance)
        # If neither the start nor the end is within the limits, go back into them first, and then descend again.
        if np.isinf(merit_at_start) and not self.is_feasible(end):
            within_limits = self._minimize(self._compute_squared_excess, end, [], tolerance)
            return self._minimize(self.objective, within_limits, constraints, tolerance)
        return end if self.merit(end) < merit_at_start else z

    def _compute_squared_excess(self, z: Vector) -> ValueAndSlope:
        """Return the sum of squared excesses over the limits, and its gradient: what a way back into them minimises."""
        broken = np.minimum(self.limit_room(z), 0.0)  # minus the excess over each limit, 0 where it is met
        return ValueAndSlope(float(broken @ broken), 2 * broken @ self.limit_room_slope(z))

    def _minimize(
        self,
        function: Callable[[Vector], ValueAndSlope],
        z: Vector,
        constraints: list[NonlinearConstraint],
        tolerance: float,
    ) -> Vector:
        """Return the end of SLSQP's minimisation of a function from z, within bounds and constraints.

        The end is moved back into limits that rounding broke (`restore`). If it is not finite, z is returned.

        Args:
            function: z -> value and gradient.
            z: the start.
            constraints: functions of z that have to be at least 0.
            tolerance: relative change of the value at which the minimisation ends.
        """
        optimum = minimize(function, z, jac=True, method="SLSQP", bounds=self.bounds, constraints=constraints,
                          options={"ftol": tolerance, "maxiter": MOST_ITERATIONS})  # fmt: skip
        end = np.clip(optimum.x, self.bounds.lb, self.bounds.ub)
        if not np.all(np.isfinite(end)):
            return z
        unit = self.problem.unit
        restored: Vector = self.problem.restore(end * unit) / unit
        return restored

    def polish_by_newton(self, z: Vector) -> Vector:
        """Return the point after Newton's steps on the Lagrangian of the limits that are active (met with equality).

        `z`: where a descent ended, within the limits; in units `problem.unit` of each number. Steps end when one is
        only rounding, leaves the limits, or raises the objective plus a penalty on the active limits. After each,
        `restore` moves the point back into limits that rounding broke.
        """
        for _ in range(MOST_ROUNDS):
            newton = self._solve_newton_step(z)
            if newton is None:
                break
            if np.all(np.abs(newton.step) <= ROUNDING):
                break
            unit = self.problem.unit
            end = self.problem.restore(np.clip(z + newton.step, self.bounds.lb, self.bounds.ub) * unit) / unit
            value, value_at_end = (self._compute_penalised_value(point, newton) for point in (z, end))
            if not (self.is_feasible(end) and value_at_end <= value * (1 + ROUNDING)):
                break
            z = end
        return z

    def _compute_penalised_value(self, z: Vector, newton: NewtonStep) -> float:
        """Return the objective at z plus the excess over the active limits, weighed by their multipliers.

        `newton`: says which limits are active, and has their multipliers.
        """
        excess = np.maximum(-self.limit_room(z), 0.0)
        return float(self.objective(z).value + np.maximum(newton.multipliers, 0.0) @ excess[newton.active])

    def _solve_newton_step(self, z: Vector) -> NewtonStep | None:
        """Return Newton's step d from z on the Lagrangian, with the multipliers m of the active limits.

        The value is minimised with room(z) >= 0 for each limit; a limit is active where its room is about 0. Over the
        variables at no bound d solves H d - A' m = -g and A d = -room, with the gradient g of the value, the slopes A
        of the active limits' room, and the Hessian H of the Lagrangian, value - m' room. None is returned where all
        variables are at bounds, or derivatives are not finite.
        """
        is_at_no_bound = (z > self.bounds.lb + ACTIVE_ROOM) & (z < self.bounds.ub - ACTIVE_ROOM)
        index = np.flatnonzero(is_at_no_bound)
        room = self.limit_room(z)
        active = room <= ACTIVE_ROOM
        if not len(index):
            return None
        # A and g, by each variable over its own size.
        scale = np.where(z[index] != 0, np.abs(z[index]), 1.0)
        slopes = self.limit_room_slope(z)[active][:, index] * scale
        gradient = self.objective(z).slope[index] * scale
        # First multipliers, with which A' m comes nearest to the gradient, for the Hessian of the Lagrangian. The step
        # is solved for together with new multipliers, which are returned.
        first_multipliers = np.linalg.lstsq(slopes.T, gradient, rcond=None)[0]
        hessian = self._differentiate_lagrangian(z, first_multipliers, active, index, scale)
        # The equations of Karush, Kuhn and Tucker on the active limits, with H made symmetric.
        system = np.block([[(hessian + hessian.T) / 2, -slopes.T], [slopes, np.zeros((len(slopes), len(slopes)))]])
        right = np.concatenate([-gradient, -room[active]])
        if not np.all(np.isfinite(system)):
            return None
        # Least squares, since limits that agree make the system singular; then d in the variables' own units.
        solution = np.linalg.lstsq(system, right, rcond=ROUNDING)[0]
        step = np.zeros_like(z)
        step[index] = scale * solution[: len(index)]
        return NewtonStep(step=step, multipliers=solution[len(index) :], active=active)

    def _differentiate_lagrangian(
        self, z: Vector, multipliers: Vector, active: Bool[np.ndarray, "limits"], index: np.ndarray, scale: Vector
    ) -> Float[np.ndarray, "k k"]:
        """Return the Hessian of the Lagrangian value - m' room at z, by differences of its gradients.

        The value is the objective, and room(z) the unused part of each limit, negative where a limit is exceeded. Entry
        (i, j) is d^2 / (dz_i dz_j) times scale_i scale_j, so that sizes of variables do not matter.

        Args:
            z: the point.
            multipliers: m, the multipliers of the active limits.
            active: flags of the limits that are active, which means reached at the solution.
            index: numbers of the k variables by which the Lagrangian is differentiated.
            scale: size of each of these variables (k,).
        """

        def lagrangian_gradient(point: Vector) -> Vector:
            """Return the gradient of value - m' room by the variables `index`, in units of `scale`.

            m are the `multipliers` of the `active` limits. It is that of the objective less m times the slopes of the
            active limits' room.
            """
            gradient = self.objective(point).slope
            slopes = self.limit_room_slope(point)[active]
            return np.asarray((gradient - multipliers @ slopes)[index] * scale)

        at_z = lagrangian_gradient(z)
        hessian = np.empty((len(index), len(index)))
        for column, variable in enumerate(index):
            shift = np.zeros_like(z)
            shift[variable] = DIFFERENCE_WIDTH * scale[column]
            hessian[:, column] = (lagrangian_gradient(z + shift) - at_z) / DIFFERENCE_WIDTH
        return hessian


def search_from_starts(problem: DescentProblem, limits: PowerAndErrorLimits, starts: Sequence[Vector]) -> Vector | None:
    """Return the best end x of descents from several starts, or None if none of them meets the limits.

    Coarse descents go from all starts. From the best end a fine one goes on, and Newton's method makes it exact.

    Args:
        problem: the design problem.
        limits: of powers, and of the error where there is a target.
        starts: points x, in the problem's own units.
    """
    points = [start / problem.unit for start in starts]
    sharpest = problem.sharpnesses[-1]
    # Coarse descents from everywhere, the largest eigenvalue sharper and sharper. From a single start the fine descent
    # below is the only one with the sharpest.
    for sharpness in problem.sharpnesses if len(points) > 1 else problem.sharpnesses[:-1]:
        programmes = [ScaledProgramme(problem, limits, sharpness, z * problem.unit) for z in points]
        points = [programme.descend(z, COARSE_TOLERANCE) for programme, z in zip(programmes, points, strict=True)]
    programme = ScaledProgramme(problem, limits, sharpest, points[0] * problem.unit)
    best = min(points, key=programme.merit)
    # A fine descent from the best, begun again as long as that helps.
    for _ in range(MOST_ROUNDS):
        before = programme.merit(best)
        best = programme.descend(best, FINE_TOLERANCE)
        if not np.isinf(before) and not programme.merit(best) < before * (1 - FINE_TOLERANCE):
            break
    return programme.polish_by_newton(best) * problem.unit if programme.is_feasible(best) else None
