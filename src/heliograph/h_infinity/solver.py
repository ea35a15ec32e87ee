"""Semidefinite programmes of H-infinity design, written for cvxpy, which no other file imports."""

import math
import warnings
from collections.abc import Callable
from types import ModuleType
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, get_args

import numpy as np
from scipy.sparse import csr_array
from typing_extensions import TypeAliasType

from heliograph.h_infinity.step_inequality import (
    LinearForms,
    StepMatrices,
    Unknowns,
    UnknownsLayout,
    find_independent_parts,
    make_linear_forms,
)
from heliograph.numerics.check import fail, show_value
from heliograph.numerics.process.optional_packages import how_to_install
from heliograph.numerics.types import Float

if TYPE_CHECKING:
    from cvxpy import Constraint, Expression, Maximize, Minimize, Parameter, Problem

MARGIN = 1e-7  # strictness of every inequality, relative to the level squared; solvers leave some 1e-9
Objective = TypeAliasType("Objective", Literal["trace", "largest_eigenvalue", "log_determinant", "none"])
Solver = TypeAliasType("Solver", Literal["clarabel", "scs"])
TIES = 1e-6, 1e-5, 1e-4  # relative, of a largest eigenvalue that counts as the smallest one: the first that is solved
SCS_ACCURACY = 1e-9  # its own default, 1e-4, is coarser than MARGIN
SCS_ITERATIONS = 100_000


def import_cvxpy() -> ModuleType:
    """Import cvxpy and return the module; raise ModuleNotFoundError that says how to install it."""
    try:
        import cvxpy
    except ModuleNotFoundError as error:
        text = f"{error.name}: expected to be installed, got no such package: {how_to_install('lmi')}"
        raise ModuleNotFoundError(text, name=error.name) from None
    return cvxpy


def check_choice(name: str, value: str, choices: Any) -> None:
    """Raise ValueError unless `value` is among the choices of an alias of a Literal.

    `choices`: a type alias, such as `type Solver = Literal["clarabel", "scs"]`.
    """
    allowed = get_args(choices.__value__)
    if not isinstance(value, str) or value not in allowed:
        raise fail(name, f"one of {', '.join(allowed)}", show_value(value))


def run_solver(problem: "Problem", solver: Solver) -> str:
    """Solve a problem and return its status; a solver that gives up or is not sure of its answer is a status too.

    SCS_ACCURACY, SCS_ITERATIONS: accuracy (finer than its own) and most iterations of the solver SCS.
    """
    cp = import_cvxpy()
    solve: Callable[..., object] = problem.solve  # it has no types
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Solution may be inaccurate")
        try:
            if solver == "scs":
                accuracy = {"eps_abs": SCS_ACCURACY, "eps_rel": SCS_ACCURACY, "max_iters": SCS_ITERATIONS}
                solve(solver=cp.SCS, **accuracy)
            else:
                solve(solver=cp.CLARABEL)
        except cp.SolverError:
            return "solver_error"
    return str(problem.status)


class StepProblem:
    """Inequality of one step, compiled once: find P+, gain and multipliers for a given P, at level 1.

    Everything is divided by the level squared before it comes here, so that the level does not matter to the solver.
    A later step needs P+ as large as can be. Trace and determinant leave nothing smaller than another feasible P+; the
    largest eigenvalue alone leaves all the others open, and what a solver makes of them may end far above.

    Args:
        step: the step's matrices in scaled coordinates.
        layout: where the unknowns stand in their vector.
        objective: which feasible P+ = L^-1 to take: "trace" the smallest tr L, "largest_eigenvalue" that of L and among
            those the smallest tr L, "log_determinant" the largest log det P+, "none" any.
        solver: "clarabel" or "scs".
        sizes: sizes of x and e where S1 and S2 are numbers, so that the first two objectives are of L in the system's
            units.
        start: a weight before the step that is not diag(P1, P2).
    """

    def __init__(
        self,
        step: StepMatrices,
        layout: UnknownsLayout,
        objective: Objective,
        solver: Solver,
        sizes: tuple[float, float] = (1.0, 1.0),
        start: Float[np.ndarray, "w w"] | None = None,
    ):
        """Compile the problem of one step: Phi < 0 with the known part of Phi as a parameter.

        Phi is a quadratic form in the state x, the filter's error e, and the disturbances of the step: the step keeps
        the H-infinity level where it is negative definite. It is linear in the unknowns: a linear matrix inequality.

        Args:
            step: matrices of the step's state, error and measurement over all variables, in scaled coordinates.
            layout: which entries of the vector of unknowns are the weights P1 (of x) and P2 (of e), and the gain's.
            objective: which of the possible weights after the step is taken.
            solver: "clarabel" or "scs".
            sizes: of x and e, in whose units the objective measures.
            start: the weight (2 n, 2 n) before the first step, which may couple x and e; None at all others.
        """
        cp = import_cvxpy()
        self.layout, self.solver = layout, solver
        self.unknowns = cp.Variable(layout.size)
        self.fixed = cp.Parameter(step.energy.shape, symmetric=True)
        forms, n = make_linear_forms(step, layout), layout.states
        constraints = self._list_constraints(cp, step, forms, start)
        # One or two objectives on the weight's diagonal blocks, of x and of e, optimised one after another. `reached`
        # is the best value of the first, which the second keeps; `more` are the constraints that express an objective.
        weight = cp.reshape(forms.weight @ self.unknowns, (2 * n, 2 * n), order="C")
        self.reached = cp.Parameter()
        goals = _list_objectives(cp, objective, [weight[:n, :n], weight[n:, n:]], sizes, self.reached)
        self.problems = [cp.Problem(goal, constraints + more) for goal, more in goals]

    def _list_constraints(
        self, cp: ModuleType, step: StepMatrices, forms: LinearForms, start: Float[np.ndarray, "w w"] | None
    ) -> "list[Constraint]":
        """Return the constraints of a step: Phi < 0, multipliers >= 0, and matrices that must be positive definite.

        eta'Phi eta < 0 is the step's inequality, for every eta, the vector (of length q) of all that the step depends
        on. Phi is linear in the unknowns (`forms.next`) plus a known part (`self.fixed`). Matrices such as
        [[Z, Y'], [Y, P2]], with Y = P2 K and Z >= K'P2 K, must be positive (`forms.positive`). A matrix must be
        definite by MARGIN. `start`: the weight before the step if it couples state and error.
        """
        q, layout = len(step.energy), self.layout
        phi = cp.reshape(forms.next @ self.unknowns, (q, q), order="C") + self.fixed
        # The multipliers are the last unknowns.
        constraints = [self.unknowns[layout.size - layout.multipliers :] >= 0]
        # Phi is block-diagonal after a permutation: a smaller constraint for each block, by its indices of eta.
        for block in find_independent_parts(step, forms, start):
            constraints.append(phi[block][:, block] << -MARGIN * np.eye(len(block)))
        for form in forms.positive:
            size = math.isqrt(len(form))
            constraints.append(cp.reshape(form @ self.unknowns, (size, size), order="C") >> MARGIN * np.eye(size))
        return constraints

    def solve(self, fixed: Float[np.ndarray, "q q"]) -> tuple[str, Unknowns | None]:
        """Solve the problems of all objectives, one after another; return the solver's status, and a solution if any.

        `fixed` is the part of the step's inequality without unknowns: |M e|^2 - |(v, rho)|^2 less the weight P before
        the step, as a form of eta, the vector of all that the step depends on, in units of the level squared.
        """
        self.fixed.value = fixed
        first, *others = self.problems
        status = run_solver(first, self.solver)
        if not status.startswith("optimal") or self.unknowns.value is None:
            return status, None
        # A later objective may give up a share of the first one's best value, its tie. The smallest share of TIES for
        # which the solver finds an optimum is taken.
        values, best = np.asarray(self.unknowns.value), float(first.value)
        for problem in others:
            for tie in TIES:
                self.reached.value = (1 - tie) * best
                if run_solver(problem, self.solver) == "optimal":
                    values = np.asarray(self.unknowns.value)
                    break
        return status, self.layout.unpack(values)


def _list_objectives(
    cp: ModuleType,
    objective: Objective,
    weights: list["Expression"],
    sizes: tuple[float, float],
    reached: "Parameter",
) -> list[tuple["Minimize | Maximize", list["Constraint"]]]:
    """Return the objectives on L = P+^-1, to be solved one after another, each with the constraints that express it.

    A later step of the H-infinity design needs weights P+ as large as possible, hence L as small as possible.

    Args:
        cp: the module cvxpy.
        objective: "none", "log_determinant", "trace", or else the largest eigenvalue.
        weights: variables P1 of x and P2 of e, P+ = diag(P1, P2).
        sizes: sizes of x and e, the units in which L is measured.
        reached: value of the first objective that the second must keep.
    """
    if objective == "none":
        return [(cp.Minimize(0), [])]
    if objective == "log_determinant":
        return [(cp.Maximize(sum(cp.log_det(w) for w in weights)), [])]
    # The least tr L, with L >= P+^-1 by a Schur complement: [[L, I], [I, P+]] >= 0.
    eye = np.eye(weights[0].shape[0])
    inverses = [cp.Variable(w.shape, symmetric=True) for w in weights]
    above_inverse = [cp.bmat([[inverse, eye], [eye, w]]) >> 0 for inverse, w in zip(inverses, weights, strict=True)]
    least_trace = cp.Minimize(sum(s**2 * cp.trace(inverse) for inverse, s in zip(inverses, sizes, strict=True)))
    if objective == "trace":
        return [(least_trace, above_inverse)]
    # The least largest eigenvalue of L, that is the largest smallest one of P+; then the least trace that keeps it.
    smallest = cp.Variable()
    above_smallest = [w >> smallest * s**2 * eye for w, s in zip(weights, sizes, strict=True)]
    return [
        (cp.Maximize(smallest), above_smallest),
        (least_trace, [*above_inverse, *above_smallest, smallest >= reached]),
    ]


class AffineMatrix(NamedTuple):
    """Matrix (w, w) that is affine in the unknowns: constant + sum_i maps_i @ (unknowns of slice i).

    Args:
        maps: by the number i of a slice of the vector of all unknowns, the linear map from these to the matrix, which
            is written row by row (w w, length of the slice).
        constant: the part without unknowns (w, w).
    """

    maps: dict[int, np.ndarray]
    constant: Float[np.ndarray, "w w"]


class HorizonProblem:
    """Convex problem of all steps at once: P_1 ... P_T+1, gains, multipliers and the level squared are unknown.

    P_0 is the largest allowed, level^2 W up to MARGIN, unless `initial` gives it: a larger one is never worse. One
    vector holds all unknowns, so that each inequality is one sparse matrix: cvxpy then has next to nothing to do.

    Args:
        steps: matrices of every step.
        layouts: where the unknowns of every step stand in their part of the vector.
        weight: W (2n, 2n), the weight of the initial state in the level.
        initial: P_0 (2n, 2n) if it is given.
    """

    def __init__(
        self,
        steps: list[StepMatrices],
        layouts: list[UnknownsLayout],
        weight: Float[np.ndarray, "w w"],
        initial: Float[np.ndarray, "w w"] | None = None,
    ):
        """Compile the problem of all steps, with their unknowns and the level squared, which is minimised.

        An H-infinity filter bounds the error's energy by level^2 times the energy of all disturbances. Each step
        demands a linear matrix inequality between the weight P before it and the weight after it (the matrix of a
        quadratic function of the error); the least level for which all hold is sought (a semidefinite programme).

        Args:
            steps: each step's matrices in scaled coordinates.
            layouts: where each unknown of a step stands in the part of the vector that belongs to the step.
            weight: W, where P_0 <= level^2 W.
            initial: P_0; if None the largest allowed, nearly level^2 W.
        """
        cp = import_cvxpy()
        # One vector: the level squared, then each step's unknowns.
        sizes = [1, *(layout.size for layout in layouts)]
        self.slices = [slice(end - size, end) for size, end in zip(sizes, np.cumsum(sizes), strict=True)]
        self.unknowns = cp.Variable(sum(sizes))
        self.constraints: list[Constraint] = []
        # The weight P before the first step: nearly level^2 W, which is linear in the level squared (slice 0); or P_0,
        # a constant with level^2 W - P_0 >= 0, but for a margin.
        largest_initial = {0: (1 - MARGIN) * weight.ravel()[:, None]}
        if initial is None:
            weight_before = AffineMatrix(maps=largest_initial, constant=np.zeros_like(weight))
        else:
            self._require_semidefinite(AffineMatrix(maps=largest_initial, constant=-initial))
            weight_before = AffineMatrix(maps={}, constant=initial)
        start: np.ndarray | None = weight if initial is None else initial  # it may couple x and e, as no later P does
        forms: LinearForms | None = None
        # Every step's inequality, from the weight before it to its own.
        for k, (step, layout) in enumerate(zip(steps, layouts, strict=True)):
            # The forms of the step before serve a step with the same matrices. With given gains they differ by step.
            is_like_last = forms is not None and layout.gain is None and all(map(np.array_equal, step, steps[k - 1]))
            if forms is None or not is_like_last:
                forms = make_linear_forms(step, layout)
            self._add_step(k, step, forms, weight_before, start)
            # The multipliers are the last unknowns of a step.
            multipliers = self.unknowns[self.slices[k + 1]][layout.size - layout.multipliers :]
            self.constraints.append(multipliers >= 0)
            # The weight before the next step is an unknown of this one.
            weight_before, start = AffineMatrix(maps={k + 1: forms.weight}, constant=np.zeros_like(weight)), None
        level_squared = self.unknowns[0]
        self.problem = cp.Problem(cp.Minimize(level_squared), self.constraints)

    def _add_step(
        self,
        k: int,
        step: StepMatrices,
        forms: LinearForms,
        weight_before: AffineMatrix,
        start: Float[np.ndarray, "w w"] | None,
    ) -> None:
        """Add the inequality -Phi >= MARGIN level^2 of step k, and that its positive matrices are positive.

        The problem is a semidefinite program: find weights P and gains of all steps for the least level^2. A quadratic
        form Phi must be negative at each step, so that the storage (x, e)' P (x, e) does not grow by more than the
        disturbances (v, rho) supply. eta'Phi eta =
        E[x+'P1 x+ + e+'P2 e+] + |M e|^2 - level^2 |(v, rho)|^2 + growth forms - (x, e)'P (x, e), for the vector eta of
        all that the step depends on, of length q.

        Args:
            k: number of the step. In the vector of unknowns level^2 is slice 0, and the unknowns of this step are
                slice k + 1.
            step: its matrices in scaled coordinates: `target` M'M, `energy` of (v, rho).
            forms: matrices of the step as linear maps of its unknowns, each matrix written row by row.
            weight_before: P, the weight before the step, by the unknowns.
            start: an initial weight that may couple x and e, at the first step; else None.
        """
        q, width = len(step.energy), len(weight_before.constant)
        # The part of -Phi without unknowns: P's constant part - M'M.
        constant = -step.target
        constant[:width, :width] += weight_before.constant
        # Phi is block-diagonal after a permutation, and small blocks are solved faster. `block`: indices in eta of one
        # block; `entries`: of its entries in the matrix (q, q) written row by row.
        for block in find_independent_parts(step, forms, start):
            entries = (block[:, None] * q + block).ravel()
            # -Phi as a linear map of the unknowns of each slice: of the level squared, this step's, and those of P.
            maps = {0: (step.energy - MARGIN * np.eye(q)).ravel()[entries][:, None], k + 1: -forms.next[entries]}
            for i, form in weight_before.maps.items():
                padded = np.zeros((q, q, form.shape[1]))
                padded[:width, :width] = form.reshape(width, width, -1)
                maps[i] = maps.get(i, 0.0) + padded.reshape(q * q, -1)[entries]
            self._require_semidefinite(AffineMatrix(maps, constant[np.ix_(block, block)]))
        # Matrices of the unknowns that must be positive, by MARGIN level^2.
        for form in forms.positive:
            size = math.isqrt(len(form))
            maps = {0: -MARGIN * np.eye(size).ravel()[:, None], k + 1: form}
            self._require_semidefinite(AffineMatrix(maps, np.zeros((size, size))))

    def _require_semidefinite(self, affine: AffineMatrix) -> None:
        """Add the constraint that a matrix, affine in the unknowns, is positive semidefinite.

        `self.slices` says where the unknowns of each slice lie in the vector of all.
        """
        constant = affine.constant
        # One sparse matrix maps the vector of all unknowns to the matrix, row by row: entries side by side, each with
        # its row, and its column moved to where the slice begins.
        values, rows, columns = [], [], []
        for i, matrix_of_map in affine.maps.items():
            map_rows, map_columns = np.nonzero(matrix_of_map)
            values.append(matrix_of_map[map_rows, map_columns])
            rows.append(map_rows)
            columns.append(map_columns + self.slices[i].start)
        entries = np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))
        form = csr_array(entries, shape=(constant.size, self.unknowns.size))
        matrix = import_cvxpy().reshape(form @ self.unknowns, constant.shape, order="C") + constant
        self.constraints.append(matrix >> 0)
