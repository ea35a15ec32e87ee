"""Powers of paths of one hop by a semidefinite programme, for traces and the worst direction: a check of `hg.design`.

With Y_k below the inverse error covariance of step k and V_k below that of its prediction, B B' = Q:
    min sum_k share_k tr X_k (or its largest eigenvalue)  subject to
    [X_k, F; F', Y_k] >= 0 with F F' = W,   Y_k <= V_k + sum_i j_ki c_i' c_i,
    [V_k, V_k A, V_k B; A' V_k, Y_k-1, 0; B' V_k, 0, I] >= 0,   j (a p + b) <= p,   and the budget, linear in p.
It is tight: matrices that satisfy this stay below the covariances' inverses. Q may be singular.
"""

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from heliograph.h_infinity.solver import run_solver, solvers
from heliograph.numerics.check import fail, instance, scalar
from heliograph.numerics.types import ArrayLike, Float
from heliograph.planning.budget import Budget, PowerLimits, Powers, as_budget, power_limits, unlimited
from heliograph.planning.error import Error
from heliograph.planning.paths.design import PathProblem, PowerTask, least_error, least_power, power_task
from heliograph.planning.paths.model import Paths

if TYPE_CHECKING:
    from cvxpy import Constraint

LINEAR = 1e-12  # a, of s kappa, below which j = p / b
RANK = 1e-14  # eigenvalue of W or Q, of the largest, that counts
LOUD = 1e3  # of a hop's noise: powers are measured in no larger units
FLAT = 1e-9  # of a variance: directions in which the error is smaller are not scaled up to it
OFF = 1e-3  # relative: by so much a solver's answer is off at most; the last digits are a root
Expression = Any  # of cvxpy, which has no types


class ProgrammeDesign(NamedTuple):
    """Powers (time, hop), their error, their total, and a bound of the error (or of the total, for a target error)."""

    powers: Powers
    error: float
    total: float
    bound: float


def semidefinite_design(
    paths: Paths,
    budget: Budget | ArrayLike | None = None,
    error: Error | None = None,
    target_error: ArrayLike | None = None,
) -> ProgrammeDesign:
    """Best powers of paths of one hop: of the least error within a budget, or the least total for a target error.

    The bound comes from the tangent of the convex error, at the weights that the programme's dual names.

    Raises:
        ValueError: paths of several hops, an error that no power reaches, a programme that the solver gives up.
        ModuleNotFoundError: cvxpy or clarabel is not installed (the extra `lmi`).
    """
    instance("paths", paths, Paths, "Paths (independent_paths, paths_of)")
    error = instance("error", Error() if error is None else error, Error, "an Error")
    steps, hops = paths.kappa.shape
    if hops != paths.rows.shape[1]:
        raise fail("paths of a semidefinite programme", "one hop each", f"{hops} hops of {paths.rows.shape[1]} paths")
    free, silent = np.ones(hops, dtype=bool), np.zeros((steps, hops))
    limits = unlimited(steps, hops)
    if budget is not None:
        limits = power_limits(as_budget(budget), paths.names, free, silent)
    states = tuple(f"x{i}" for i in range(paths.rows.shape[-1]))
    task = power_task(paths, error.criterion(states), limits, free, silent, 1, 0)
    programme = _Programme(task.problem, error.worst)
    if target_error is None:
        programme.solve(programme.error, programme.within(limits))
        p = limits.clip(programme.powers)
        value = task.problem.exact(p)
        bound = least_error(_weighted(task, programme.weights))[1].bound
        return ProgrammeDesign(p, value, float(p.sum(axis=1).mean()), min(bound, value))
    target = float(scalar("target error", target_error, 0.0))
    programme.solve(programme.mean_power, [*programme.within(limits), programme.error <= target / programme.unit])
    p = _scaled_to(task.problem, np.maximum(programme.powers, 0.0), target)
    total = float(p.sum(axis=1).mean())
    bound = least_power(_weighted(task, programme.weights), target)[1].bound
    return ProgrammeDesign(p, task.problem.exact(p), total, min(bound, total))


def _weighted(task: PowerTask, weights: Float[np.ndarray, "time n n"]) -> PowerTask:
    """Task with the linear error of these weights."""
    criterion = task.problem.criterion._replace(weight=weights, shares=np.ones(len(weights)), sharpness=None)
    return task._replace(problem=task.problem._replace(criterion=criterion))


def _scaled_to(problem: PathProblem, powers: Powers, target: float) -> Powers:
    """Powers times the factor near one at which the target is reached."""
    low, high = 1 - OFF, 1 + OFF
    if not problem.exact(low * powers) >= target >= problem.exact(high * powers):
        raise fail("least power", "an answer of the solver within a thousandth", f"error {problem.exact(powers):.6g}")
    for _ in range(50):
        middle = (low + high) / 2
        low, high = (low, middle) if problem.exact(middle * powers) <= target else (middle, high)
    return np.asarray(np.minimum(high * powers, problem.limits.peak))


class _Programme:
    """Variables and constraints, in units of the error, the powers and the information at even powers."""

    def __init__(self, problem: PathProblem, worst: bool):
        cp = solvers()
        self.problem, self.worst = problem, worst
        criterion = problem.criterion
        self.weights = criterion.shares[:, None, None] * criterion.weight
        self.given_weights = self.weights
        paths, n = problem.paths, problem.paths.rows.shape[-1]
        steps, senders = paths.kappa.shape
        self.root = self._root()
        back = np.linalg.inv(self.root)
        start = paths.plants.start
        self.unit = float(np.sum(self.weights * (self.root @ self.root.T)))
        self.x = cp.Variable((steps, senders), nonneg=True)  # powers, of `size`
        self.constraints: list[Constraint] = []
        self.tops: dict[int, Constraint] = {}  # by step: its largest eigenvalue is below what is made small
        inverse = [cp.Variable((n, n), symmetric=True) for _ in range(steps)]
        information = self._information()
        pieces: list[Expression] = []
        for k in range(steps):
            a = back @ paths.plants.transition[k] @ self.root
            noise = [_factor(back @ paths.plants.process[k] @ back.T)]
            if k == 0 and start is not None:
                noise.append(a @ _factor(back @ start @ back.T))
            b = np.concatenate(noise, axis=1)
            self._predict(inverse[k], inverse[k - 1] if k or start is None else None, a, b, information[k])
            if np.any(self.weights[k]):
                pieces.append(self._piece(inverse[k], k))
        self.error = sum(pieces)
        self.mean_power = cp.sum(cp.multiply(self.size, self.x)) / steps / float(np.max(self.size))

    def _root(self) -> Float[np.ndarray, "n n"]:
        """A factor of the error covariance at powers of the size of the budget: x = root xs, and xs is of order one."""
        paths = self.problem.paths
        free = np.minimum(self.problem.limits.peak, self.problem.limits.mean)
        total = self.problem.limits.total / free.shape[1]
        hop = np.where(paths.alpha > 0, paths.alpha, 1.0)
        self.size = np.minimum(np.minimum(free, total if np.isfinite(total) else hop), LOUD * hop)
        self.size = np.where(self.size > 0, self.size, hop)
        p = self.problem.covariances(self.size).mean(axis=0)
        unit = np.sqrt(np.diagonal(p))
        unit = np.where(unit > 0, unit, 1.0)
        return np.asarray(unit[:, None] * np.linalg.cholesky(p / np.outer(unit, unit) + FLAT * np.eye(len(p))))

    def _information(self) -> list[Expression]:
        """sum_i j_i c_i' c_i of each step, with j (a p + b) <= p: in u = a j and q = p a / b, 1 / (1 + q) <= 1 - u.

        A path that unlimited power frees of noise has a = 0 and j = p / b, one whose hop is free b = 0 and j = 1 / a.
        """
        cp = solvers()
        paths, n = self.problem.paths, len(self.root)
        full = paths.second * paths.kappa
        a, b = full - paths.signal, full * paths.alpha
        result = []
        for k in range(len(full)):
            c = paths.rows[k] @ self.root
            outer = np.einsum("in,im->inm", c, c).reshape(len(c), -1)
            straight, free = a[k] <= LINEAR * full[k], b[k] == 0
            bent = np.flatnonzero(~straight & ~free)
            total: Expression = np.zeros(n * n)
            if bent.size:
                u, rate = cp.Variable(bent.size), self.size[k, bent] * a[k, bent] / b[k, bent]
                self.constraints.append(cp.inv_pos(1 + cp.multiply(rate, self.x[k, bent])) <= 1 - u)
                total = total + (outer[bent] / a[k, bent, None]).T @ u
            for i in np.flatnonzero(straight & ~free):
                total = total + outer[i] * (self.size[k, i] / b[k, i]) * self.x[k, i]
            for i in np.flatnonzero(free):
                total = total + outer[i] / a[k, i]
            result.append(cp.reshape(total, (n, n), order="C"))
        return result

    def _predict(
        self, inverse: Expression, before: Expression, a: np.ndarray, b: np.ndarray, information: Expression
    ) -> None:
        """Y_k from Y_k-1, or from the start, which is then part of b."""
        cp = solvers()
        n, m = b.shape
        v = cp.Variable((n, n), symmetric=True)
        if before is None:
            block = cp.bmat([[v, v @ b], [(v @ b).T, np.eye(m)]])
        else:
            corner = [[before, np.zeros((n, m))], [np.zeros((m, n)), np.eye(m)]]
            over = cp.hstack([v @ a, v @ b])
            block = cp.bmat([[v, over], [over.T, cp.bmat(corner)]])
        self.constraints += [block >> 0, v + information - inverse >> 0]

    def _piece(self, inverse: Expression, k: int) -> Expression:
        """What step k adds to the error, in units of `unit`."""
        cp = solvers()
        f = self._weight_root(k)
        x = cp.Variable((len(f), len(f)), symmetric=True)
        self.constraints.append(cp.bmat([[x, f], [f.T, inverse]]) >> 0)
        if not self.worst:
            return cp.trace(x)
        top = cp.Variable()
        self.tops[k] = top * np.eye(len(f)) - x >> 0
        self.constraints.append(self.tops[k])
        return top

    def _weight_root(self, k: int) -> Float[np.ndarray, "r n"]:
        """W^1/2 of step k in these coordinates."""
        return _factor(self.root.T @ self.given_weights[k] @ self.root / self.unit).T

    def within(self, limits: PowerLimits) -> list[Expression]:
        """The budget, which is linear."""
        cp = solvers()
        p = cp.multiply(self.size, self.x)
        steps, constraints = len(self.size), []
        if np.isfinite(limits.total):
            constraints.append(cp.sum(p) / (limits.total * steps) <= 1 if limits.total else cp.sum(self.x) <= 0)
        for i, mean in enumerate(limits.mean):
            if np.isfinite(mean) and steps > 1:
                constraints.append(cp.sum(p[:, i]) <= mean * steps)
        peak = np.minimum(limits.peak, limits.mean) if steps == 1 else limits.peak
        rows, columns = np.nonzero(np.isfinite(peak))
        if rows.size:
            constraints.append(self.x[rows, columns] <= peak[rows, columns] / self.size[rows, columns])
        return constraints

    def solve(self, goal: Expression, within: list[Expression]) -> None:
        """Solve; powers and the weights that the dual names are then in `powers` and `weights`."""
        cp = solvers()
        task = cp.Problem(cp.Minimize(goal), self.constraints + within)
        status = run_solver(task, "clarabel")
        if not status.startswith("optimal") or self.x.value is None:
            raise fail("semidefinite programme", "a solution", status)
        self.powers = np.asarray(self.x.value) * self.size
        if self.worst:
            self.weights, back = np.zeros_like(self.given_weights), np.linalg.inv(self.root)
            for k, constraint in self.tops.items():
                f, dual = self._weight_root(k) @ back, np.asarray(constraint.dual_value)
                values, vectors = np.linalg.eigh((dual + dual.T) / 2)
                share = (vectors * np.maximum(values, 0.0)) @ vectors.T
                self.weights[k] = self.unit * f.T @ (share / np.trace(share)) @ f


def _factor(matrix: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n r"]:
    """F with F F' = matrix, of as many columns as its rank."""
    values, vectors = np.linalg.eigh(matrix)
    rank = values > RANK * max(values[-1], 0.0)
    return np.asarray(vectors[:, rank] * np.sqrt(values[rank]))
