"""The best powers of paths of one hop as a semidefinite programme, for traces and for the worst direction.

With Y_k below the inverse error covariance of step k and V_k below that of its prediction, B B' = Q:
  min sum_k share_k tr X_k (or its largest eigenvalue)  subject to
  [X_k, F; F', Y_k] >= 0 with F F' = W,   Y_k <= V_k + sum_i j_ki c_i' c_i,
  [V_k, V_k A, V_k B; A' V_k, Y_k-1, 0; B' V_k, 0, I] >= 0,   j (a p + b) <= p,   and the budget, linear in p.
It is tight: matrices that satisfy this stay below the covariances' inverses. Q may be singular.
"""

from typing import TYPE_CHECKING, Any

import numpy as np

from heliograph.h_infinity.solver import run_solver, solvers
from heliograph.numerics.check import fail, instance, scalar
from heliograph.numerics.types import ArrayLike, Float
from heliograph.planning.adjoint import covariances
from heliograph.planning.allocation import Allocation, LeastPower
from heliograph.planning.budget import Allowed, Budget
from heliograph.planning.criterion import Error
from heliograph.planning.fixed_point import cheapest, fill, swapped, unlimited, unreachable
from heliograph.planning.one_hop import OneHop, inside, one_hop
from heliograph.planning.paths import Paths, Powers, heard, informations

if TYPE_CHECKING:
    from cvxpy import Constraint

LINEAR = 1e-12  # a, of s kappa, below which j = p / b
KEPT = 1e-14  # eigenvalue of W or Q, of the largest, that counts
LOUD = 1e3  # of a hop's noise: powers are measured in no larger units
FLAT = 1e-9  # of a variance: directions in which the error is smaller are not scaled up to it
Expression = Any  # of cvxpy, which has no types


def semidefinite_powers(
    paths: Paths, budget: Budget | ArrayLike, error: Error | None = None, states: tuple[str, ...] | None = None
) -> Allocation:
    """The best powers of paths of one hop by a semidefinite programme; it takes the worst direction as well as traces.

    The bound comes from the tangent of the convex error, at the weights that the programme's dual names.

    Raises:
        ValueError: paths of several hops, a budget without limit, a programme that the solver gives up.
        ModuleNotFoundError: cvxpy or clarabel is not installed (the extra `lmi`).
    """
    worst = _is_worst(error)
    problem = one_hop(paths, budget, error, states)
    programme = _Programme(problem, worst)
    programme.solve(programme.error, programme.within(problem.allowed))
    p = inside(programme.powers, problem.allowed)
    bound = fill(problem._replace(weights=programme.weights))[2].bound
    value = worst_of(problem, p) if worst else problem.at(p).value
    return Allocation(p, value, min(bound, value), "semidefinite programme")


def semidefinite_least_power(
    paths: Paths,
    wanted: ArrayLike,
    budget: Budget | None = None,
    error: Error | None = None,
    states: tuple[str, ...] | None = None,
) -> LeastPower:
    """The smallest total power, in the mean over time, that reaches a wanted error, by a semidefinite programme.

    Raises:
        ValueError: an error that no power reaches, a programme that the solver gives up.
        ModuleNotFoundError: cvxpy or clarabel is not installed (the extra `lmi`).
    """
    worst, wanted = _is_worst(error), float(scalar("wanted error", wanted, 0.0))
    problem = swapped(paths, budget, error, states)

    def value(p: Powers) -> float:
        return worst_of(problem, p) if worst else problem.at(p).value

    limit = value(unlimited(problem)[0])
    if limit >= wanted:
        raise unreachable(limit, wanted)
    programme = _Programme(problem, worst)
    within = [*programme.within(problem.allowed), programme.error <= wanted / programme.unit]
    programme.solve(programme.mean_power, within)
    p = np.maximum(programme.powers, 0.0)
    low, high = 1 - 1e-3, 1 + 1e-3  # by so much a solver's answer is off at most: the last digits are a root
    if not value(low * p) >= wanted >= value(high * p):
        raise fail("least power", "an answer of the solver within a thousandth", f"error {value(p):.6g}")
    for _ in range(50):
        middle = (low + high) / 2
        low, high = (low, middle) if value(middle * p) <= wanted else (middle, high)
    p = np.minimum(high * p, problem.allowed.peak)
    bound = cheapest(problem._replace(weights=programme.weights), wanted).bound
    total = float(p.sum(axis=1).mean())
    return LeastPower(p, value(p), total, min(bound, total))


def worst_of(problem: OneHop, powers: Powers) -> float:
    """Largest eigenvalue of W^1/2 P W^1/2, in the mean over the steps that count."""
    p = covariances(problem.paths.plants, informations(problem.paths, heard(problem.paths, powers).information))
    return sum(float(np.max(np.linalg.eigvals(w @ one).real)) for w, one in zip(problem.weights, p, strict=True))


class _Programme:
    """Variables and constraints, in units of the error, the powers and the information at even powers."""

    def __init__(self, problem: OneHop, worst: bool):
        cp = solvers()
        self.problem, self.worst = problem, worst
        paths, n = problem.paths, problem.paths.rows.shape[-1]
        steps, senders = paths.kappa.shape
        self.root = self._root()
        back = np.linalg.inv(self.root)
        start = paths.plants.start
        self.unit = float(np.sum(problem.weights * (self.root @ self.root.T)))
        self.x = cp.Variable((steps, senders), nonneg=True)  # powers, of `size`
        self.constraints: list[Constraint] = []
        self.tops: dict[int, Constraint] = {}  # by step: its largest eigenvalue is below what is made small
        told = [cp.Variable((n, n), symmetric=True) for _ in range(steps)]
        informed = self._information()
        pieces: list[Expression] = []
        for k in range(steps):
            a = back @ paths.plants.transition[k] @ self.root
            noise = [_factor(back @ paths.plants.process[k] @ back.T)]
            if k == 0 and start is not None:
                noise.append(a @ _factor(back @ start @ back.T))
            b = np.concatenate(noise, axis=1)
            self._predict(told[k], told[k - 1] if k or start is None else None, a, b, informed[k], k)
            if np.any(problem.weights[k]):
                pieces.append(self._piece(told[k], k))
        self.error = sum(pieces)
        self.mean_power = cp.sum(cp.multiply(self.size, self.x)) / steps / float(np.max(self.size))

    def _root(self) -> Float[np.ndarray, "n n"]:
        """A factor of the error covariance at powers of the size of the budget: x = root xs, and xs is of order one."""
        paths = self.problem.paths
        free = np.minimum(self.problem.allowed.peak, self.problem.allowed.each)
        total = self.problem.allowed.total / free.shape[1]
        hop = np.where(paths.alpha > 0, paths.alpha, 1.0)
        self.size = np.minimum(np.minimum(free, total if np.isfinite(total) else hop), LOUD * hop)
        self.size = np.where(self.size > 0, self.size, hop)
        p = covariances(paths.plants, informations(paths, heard(paths, self.size).information)).mean(axis=0)
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
            told: Expression = np.zeros(n * n)
            if bent.size:
                u, rate = cp.Variable(bent.size), self.size[k, bent] * a[k, bent] / b[k, bent]
                self.constraints.append(cp.inv_pos(1 + cp.multiply(rate, self.x[k, bent])) <= 1 - u)
                told = told + (outer[bent] / a[k, bent, None]).T @ u
            for i in np.flatnonzero(straight & ~free):
                told = told + outer[i] * (self.size[k, i] / b[k, i]) * self.x[k, i]
            for i in np.flatnonzero(free):
                told = told + outer[i] / a[k, i]
            result.append(cp.reshape(told, (n, n), order="C"))
        return result

    def _predict(
        self, told: Expression, before: Expression, a: np.ndarray, b: np.ndarray, informed: Expression, k: int
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
        self.constraints += [block >> 0, v + informed - told >> 0]

    def _piece(self, told: Expression, k: int) -> Expression:
        """What step k adds to the error, in units of `unit`."""
        cp = solvers()
        f = self._seen(k)
        x = cp.Variable((len(f), len(f)), symmetric=True)
        self.constraints.append(cp.bmat([[x, f], [f.T, told]]) >> 0)
        if not self.worst:
            return cp.trace(x)
        top = cp.Variable()
        self.tops[k] = top * np.eye(len(f)) - x >> 0
        self.constraints.append(self.tops[k])
        return top

    def _seen(self, k: int) -> Float[np.ndarray, "r n"]:
        """W^1/2 of step k in these coordinates."""
        return _factor(self.root.T @ self.problem.weights[k] @ self.root / self.unit).T

    def within(self, allowed: Allowed) -> list[Expression]:
        """The budget, which is linear."""
        cp = solvers()
        p = cp.multiply(self.size, self.x)
        steps, found = len(self.size), []
        if np.isfinite(allowed.total):
            found.append(cp.sum(p) / (allowed.total * steps) <= 1 if allowed.total else cp.sum(self.x) <= 0)
        for i, each in enumerate(allowed.each):
            if np.isfinite(each) and steps > 1:
                found.append(cp.sum(p[:, i]) <= each * steps)
        peak = np.minimum(allowed.peak, allowed.each) if steps == 1 else allowed.peak
        rows, columns = np.nonzero(np.isfinite(peak))
        if rows.size:
            found.append(self.x[rows, columns] <= peak[rows, columns] / self.size[rows, columns])
        return found

    def solve(self, goal: Expression, within: list[Expression]) -> None:
        """Solve, and keep powers and the weights that the dual names."""
        cp = solvers()
        task = cp.Problem(cp.Minimize(goal), self.constraints + within)
        status = run_solver(task, "clarabel")
        if not status.startswith("optimal") or self.x.value is None:
            raise fail("semidefinite programme", "a solution", status)
        self.powers = np.asarray(self.x.value) * self.size
        self.weights = self.problem.weights
        if self.worst:
            self.weights, back = np.zeros_like(self.problem.weights), np.linalg.inv(self.root)
            for k, constraint in self.tops.items():
                f, dual = self._seen(k) @ back, np.asarray(constraint.dual_value)
                values, vectors = np.linalg.eigh((dual + dual.T) / 2)
                share = (vectors * np.maximum(values, 0.0)) @ vectors.T
                self.weights[k] = self.unit * f.T @ (share / np.trace(share)) @ f


def _factor(matrix: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n r"]:
    """F with F F' = matrix, of as many columns as its rank."""
    values, vectors = np.linalg.eigh(matrix)
    kept = values > KEPT * max(values[-1], 0.0)
    return np.asarray(vectors[:, kept] * np.sqrt(values[kept]))


def _is_worst(error: Error | None) -> bool:
    return error is not None and instance("error", error, Error, "an Error").worst
