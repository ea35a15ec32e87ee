"""H-infinity filter design: gains with a guaranteed level, step after step or over the whole horizon at once.

The level gamma bounds, for the filter xhat+ = A xhat + f(xhat) + K (received - E[G] (C xhat + h(xhat))),
sum_s E|M (x - xhat)|^2 < gamma^2 (sum_s |v|^2 + |rho|^2 + xi_0' W xi_0) with xi_0 = (x_0, x_0 - xhat_0), for all
disturbances that are not zero. It is a guarantee as long as the growth constants are true (`check_growth`).
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from heliograph.h_infinity.error_system import LARGEST, GrowthSystem, symmetric_weight
from heliograph.h_infinity.scaled_coordinates import scale_steps
from heliograph.h_infinity.solver import (
    MARGIN,
    HorizonProblem,
    Objective,
    Solver,
    StepProblem,
    check_choice,
    run_solver,
)
from heliograph.h_infinity.step_inequality import (
    StepMatrices,
    Unknowns,
    UnknownsLayout,
    complete_multipliers,
    compute_next_energy,
    list_step_matrices,
)
from heliograph.numerics.check import TINY, array, fail, flag, instance, scalar
from heliograph.numerics.module import readable
from heliograph.numerics.types import ArrayLike, Float

SEARCH_ACCURACY = 1e-4  # relative, of a level found by bisection
SEARCH_LIMIT = 1e6  # times the first guess; a smallest level beyond is reported as none
SCREEN = 1e-9  # strictness left in a solution, relative to the level squared, below which a step counts as failed


@readable
class HInfinityDesign(NamedTuple):
    """Gains K with weights P_0 ... and multipliers that prove `level`.

    Where no gains exist for the choices made, arrays are NaN from `failed_step` on.

    Args:
        level: gamma, the proven bound on the ratio of norms; NaN where a search over the level failed.
        gains: K (steps, n, m).
        weights: P_0 ... P_steps (steps + 1, 2n, 2n), of the stacked (x, e).
        multipliers: (steps, 2) for (f, f~) and (h, h~), or (steps, 4) for f, f~, h, h~; zero for a function that is
            zero.
        feasible: true if the gains prove the level over the whole horizon.
        status: the solver's status, or what went wrong.
        failed_step: first step without a gain; None if all have one.
        smallest_level: smallest level that works with the same choices; None if it was not searched for, or none works.
    """

    level: float
    gains: Float[np.ndarray, "steps n m"]
    weights: Float[np.ndarray, "steps+1 n+n n+n"]
    multipliers: Float[np.ndarray, "steps count"]
    feasible: bool
    status: str
    failed_step: int | None = None
    smallest_level: float | None = None


def recursive_design(
    system: GrowthSystem,
    level: float | None = None,
    initial: "Float[ArrayLike, 'n+n n+n'] | None" = None,
    objective: Objective = "trace",
    solver: Solver = "clarabel",
    separate: bool = False,
    search: bool = True,
) -> HInfinityDesign:
    """Design gains by one linear matrix inequality after another, at a given level or at the smallest that succeeds.

    Each inequality leaves P_s+1 = L^-1 free, and the choice decides whether later steps can be solved. The smallest
    level is larger than that of `horizon_design`: a recursion cannot look ahead.

    Args:
        system: the system, from `growth_system`.
        level: gamma, a positive ratio of norms; the smallest at which the recursion succeeds, to 1e-4 relative by
            bisection, unless given.
        initial: P_0 (2n, 2n); the largest allowed, level^2 W, by default.
        objective: which P_s+1 to take: "trace" the smallest tr L (this and the next in coordinates of order one where
            no growth makes lengths comparable), "largest_eigenvalue" that of L and among those the smallest tr L,
            "log_determinant" the largest log det P, "none" the first that the solver meets, often a dead end (default
            "trace").
        solver: "clarabel" (interior point) or "scs" (first order) (default "clarabel").
        separate: one multiplier for each of f, f~, h, h~ in place of two, which is less conservative (default False).
        search: look for the smallest level if the given one fails (default True).

    Raises:
        ValueError: a level that is not positive, an unknown objective or solver, an initial weight of the wrong shape,
            no level given and none that works.
        ModuleNotFoundError: cvxpy or the solver is not installed.
    Source: H-infinity fusion over amplify-and-forward relays, Theorem 2 (inequality (32), after a congruence).
    """
    instance("system", system, GrowthSystem, "a GrowthSystem, as growth_system makes it")
    target = None if level is None else float(scalar("level", level, low=TINY, high=LARGEST))
    check_choice("objective", objective, Objective)
    check_choice("solver", solver, Solver)
    start = None if initial is None else _check_initial_weight(initial, system.states)
    recursion = _RecursiveDesigner(system, objective, solver, flag("separate", separate))
    search = flag("search", search)
    # At the given level, if there is one and it works; else the smallest level, by bisection.
    design = None if target is None else recursion.run(target, start)
    if design is not None and (design.feasible or not search):
        return design
    tried: dict[float, HInfinityDesign] = {}

    def is_feasible(trial: float) -> bool:
        """Return whether the recursion succeeds at a level, `trial`; its design is kept in `tried`."""
        tried[trial] = recursion.run(trial, start)
        return tried[trial].feasible

    smallest = _bisect_level(is_feasible, recursion.coordinates.unit if target is None else target)
    if design is not None:  # the given level fails: it is said which one would not
        return design._replace(smallest_level=smallest)
    if smallest is None:
        raise fail("smallest level", f"one below {SEARCH_LIMIT:g} times the norm of M", "none that works")
    return tried[smallest]


def horizon_design(
    system: GrowthSystem,
    separate: bool = False,
    gains: "Float[ArrayLike, 'steps n m'] | None" = None,
    initial: "Float[ArrayLike, 'n+n n+n'] | None" = None,
    solver: Solver = "clarabel",
) -> HInfinityDesign:
    """Find the smallest level over the whole horizon, and gains that attain it: all steps as one convex problem.

    With P and Y = P2 K as unknowns in place of L and K every step is linear, and so is the level squared.

    Args:
        system: the system, from `growth_system`.
        separate: one multiplier for each of f, f~, h, h~ in place of two; never worse (default False).
        gains: K (steps, n, m), to find the smallest level that can be proven for these; free by default.
        initial: P_0 (2n, 2n); by default the largest allowed, level^2 W, which is never worse than another.
        solver: "clarabel" or "scs" (default "clarabel").

    Raises:
        ValueError: an unknown solver, gains or an initial weight of the wrong shape.
        ModuleNotFoundError: cvxpy or the solver is not installed.
    Source: H-infinity fusion over amplify-and-forward relays, Theorems 1 and 2, solved jointly (not in the paper).
    """
    instance("system", system, GrowthSystem, "a GrowthSystem")
    check_choice("solver", solver, Solver)
    n, m = system.states, system.received
    given_gains = None if gains is None else np.asarray(array("gains", gains, (system.steps, n, m)))
    # Coordinates of order one, and the unknowns of every step: a correction of its nominal gain among them, which is
    # zero where gains are given.
    steps, coordinates = scale_steps(system, list_step_matrices(system, flag("separate", separate)), given_gains)
    given_correction = None if given_gains is None else np.zeros((n, m))
    layouts = [UnknownsLayout(n, m, len(s.growth), given_correction) for s in steps]
    start = None if initial is None else coordinates.scale_initial_weight(_check_initial_weight(initial, n))
    allowed = coordinates.unit**2 * coordinates.scale_initial_weight(system.initial_weight)
    # One convex problem in all weights, gains, multipliers and the level squared.
    problem = HorizonProblem(steps, layouts, allowed, start)
    status = run_solver(problem.problem, solver)
    values = problem.unknowns.value
    if not status.startswith("optimal") or values is None:
        text = f"no level could be proven over the horizon ({status})"
        return _make_unsolved_design(system, separate, float("nan"), text)
    # The solver's answer must satisfy every step's inequality itself.
    level_part, *step_parts = [np.asarray(values[entries]) for entries in problem.slices]
    solved = [layout.unpack(part) for layout, part in zip(layouts, step_parts, strict=True)]
    level_squared = level_part.item()
    first_weight = (1 - MARGIN) * level_squared * allowed if start is None else start
    weights = [first_weight, *map(_weigh_state_and_error, solved)]
    failed = _find_first_failing(steps, solved, weights, level_squared)
    if failed is not None:
        text = f"the solver's answer fails at step {failed} ({status})"
        return _make_unsolved_design(system, separate, float("nan"), text)._replace(failed_step=failed)
    # Back to the user's units.
    found = [coordinates.unscale_gain(steps[k].nominal + _gain_correction(u), k) for k, u in enumerate(solved)]
    multipliers = np.array([coordinates.unscale_multipliers(u, k) for k, u in enumerate(solved)])
    return HInfinityDesign(
        level=float(np.sqrt(level_squared)) * coordinates.unit,
        gains=np.array(found) if given_gains is None else given_gains,
        weights=np.array([coordinates.unscale_weight(weight, k) for k, weight in enumerate(weights)]),
        multipliers=complete_multipliers(system, multipliers, separate),
        feasible=True,
        status=status,
    )


def _find_first_failing(
    steps: Sequence[StepMatrices], solved: Sequence[Unknowns], weights: Sequence[np.ndarray], square: float
) -> int | None:
    """Return the number of the first step whose inequality a solution does not satisfy; None if all hold.

    At a step, E[(x+, e+)'P+ (x+, e+)] + |M e|^2 - gamma^2 |(v, rho)|^2 < (x, e)'P (x, e), whatever the disturbances v
    and rho are, in scaled coordinates. It must hold by SCREEN gamma^2.

    Args:
        steps: matrices of all steps.
        solved: each step's unknowns: P+, gain and multipliers.
        weights: P before each step.
        square: the level squared, gamma^2.
    """
    for k, (step, unknowns) in enumerate(zip(steps, solved, strict=True)):
        # The part without unknowns. (x, e) are the first entries of eta, the vector of all that the step depends on.
        fixed = step.target - square * step.energy
        size = len(weights[k])
        fixed[:size, :size] -= weights[k]
        if not _inequality_holds(step, unknowns, fixed, strictness=SCREEN * square):
            return k
    return None


class _RecursiveDesigner:
    """Recursive design over the horizon: one problem a step, compiled again only where the system's data change."""

    def __init__(self, system: GrowthSystem, objective: Objective, solver: Solver, separate: bool):
        """Store the system with its steps in scaled coordinates, and a list of the problems compiled so far.

        Args:
            system: plant, sensor and channel; functions f and h in them are known by growth constants alone, each with
                a multiplier in the step's inequality.
            objective: which of the feasible weights after a step is taken.
            solver: "clarabel" or "scs".
            separate: one multiplier for each growth condition; else those of f share one, and those of h.
        """
        self.system, self.objective, self.solver, self.separate = system, objective, solver, separate
        self.steps, self.coordinates = scale_steps(system, list_step_matrices(system, separate))
        self.layout = UnknownsLayout(system.states, system.received, len(self.steps[0].growth))
        # Each compiled problem with what it was compiled for: matrices, sizes of x and e, a first weight that couples.
        self.compiled: list[tuple[StepMatrices, tuple[float, float], np.ndarray | None, StepProblem]] = []

    def run(self, level: float, initial: Float[np.ndarray, "w w"] | None) -> HInfinityDesign:
        """Return the design at one level, feasible or not.

        The level gamma bounds the error M e, e = x - xhat, by the disturbances (v, rho), in sums of squares. P_k is a
        weight of (x, e) before step k. Each step looks for a gain and a P_k+1 for which the quadratic form
        eta'Phi eta = E[(x, e)+' P_k+1 (x, e)+] + |M e|^2 - gamma^2 |(v, rho)|^2 - (x, e)' P_k (x, e), plus terms for
        the growth of the nonlinear functions, is negative: then the sum over all steps gives the bound. All is computed
        in scaled coordinates and divided by gamma^2, and stored in the user's units.

        Args:
            level: gamma.
            initial: P_0 in the user's units; nearly level^2 W, the largest allowed, if None. W weighs the first (x, e).
        """
        system, n, coordinates = self.system, self.system.states, self.coordinates
        design = _make_unsolved_design(system, self.separate, level, "")  # its arrays are filled below
        level_squared = (level / coordinates.unit) ** 2  # in scaled coordinates
        weight = self._choose_initial_weight(initial, level_squared)  # P_k / gamma^2
        if weight is None:
            return design._replace(status="the initial condition 0 < P_0 < level^2 W fails", failed_step=0)
        design.weights[0] = level_squared * coordinates.unscale_weight(weight, 0)
        for k, step in enumerate(self.steps):
            # The part of Phi that is known: M'M / gamma^2 of e, -I of (v, rho), and -P_k of (x, e), which come first.
            fixed = step.target / level_squared - step.energy
            fixed[: 2 * n, : 2 * n] -= weight
            # The solver's answer must satisfy the inequality itself.
            status, unknowns = self._find_problem(k, weight if k == 0 else None).solve(fixed)
            if unknowns is None or not _inequality_holds(step, unknowns, fixed, SCREEN):
                text = f"no gain found at step {k} of {system.steps} ({status})"
                return design._replace(status=text, failed_step=k)
            # P_k+1 for the next step; gain, weight and multipliers in the user's units. The gain is the nominal one of
            # the scaled step plus the correction that was found.
            weight = _weigh_state_and_error(unknowns)
            design.gains[k] = coordinates.unscale_gain(step.nominal + _gain_correction(unknowns), k)
            design.weights[k + 1] = level_squared * coordinates.unscale_weight(weight, k + 1)
            multipliers = level_squared * coordinates.unscale_multipliers(unknowns, k)
            design.multipliers[k] = complete_multipliers(system, multipliers, self.separate)
        return design._replace(feasible=True, status="optimal")

    def _choose_initial_weight(
        self, initial: Float[np.ndarray, "w w"] | None, level_squared: float
    ) -> Float[np.ndarray, "w w"] | None:
        """Return P_0 / gamma^2 of the first (x, e) in scaled coordinates; None unless 0 < P_0 < gamma^2 W.

        `initial` is P_0 in the user's units; where it is None, P_0 is nearly gamma^2 W, the largest allowed.
        `level_squared` is gamma^2 in scaled coordinates.
        """
        coordinates = self.coordinates
        if level_squared < LARGEST**-2:  # its inverse would be no number
            return None
        largest = coordinates.unit**2 * coordinates.scale_initial_weight(self.system.initial_weight)  # W
        if initial is None:
            weight = (1 - MARGIN) * largest
        else:
            weight = coordinates.scale_initial_weight(initial) / level_squared
        if np.linalg.eigvalsh(largest - weight)[0] <= 0 or np.linalg.eigvalsh(weight)[0] <= 0:
            return None
        return weight

    def _find_problem(self, k: int, start: Float[np.ndarray, "w w"] | None) -> StepProblem:
        """Return the problem of step k, the one compiled before where its matrices and sizes are the same.

        `start` is the weight P of (x, e) before the step. If it couples x and e, the step gets a problem of its own.
        `sizes` are the scales of x and e before the next step.
        """
        step, sizes = self.steps[k], self.coordinates.relative_scales(k + 1)
        coupling = _coupled_initial_weight(start, self.system.states)
        for old_step, old_sizes, old_coupling, problem in self.compiled:
            is_same_step = all(map(np.array_equal, old_step, step)) and old_sizes == sizes
            if is_same_step and coupling is None and old_coupling is None:
                return problem
        problem = StepProblem(step, self.layout, self.objective, self.solver, sizes, coupling)
        self.compiled.append((step, sizes, coupling, problem))
        return problem


def _coupled_initial_weight(start: Float[np.ndarray, "w w"] | None, n: int) -> Float[np.ndarray, "w w"] | None:
    """Return the initial weight if it couples x and e, as those of later steps do not; else None."""
    return None if start is None or not np.any(start[:n, n:]) else start


def _check_initial_weight(initial: ArrayLike, n: int) -> Float[np.ndarray, "w w"]:
    """Return the initial weight P_0 (2n, 2n), symmetric; raise ValueError for another shape."""
    return symmetric_weight("initial weight P_0", array("initial weight P_0", initial, (2 * n, 2 * n)))


def _inequality_holds(
    step: StepMatrices, unknowns: Unknowns, fixed: Float[np.ndarray, "q q"], strictness: float
) -> bool:
    """Decide whether one step is feasible: P1, P2 > 0, and all eigenvalues of Phi below -strictness.

    eta'Phi eta = E[x+'P1 x+ + e+'P2 e+] + growth forms + `fixed`, where eta is the vector of all that the step depends
    on, and x+ and e+ are the next state and error. `fixed` is the part without unknowns: |M e|^2 - gamma^2 |(v, rho)|^2
    less the weight of (x, e) before the step.
    """
    # The solver's unknowns are Y and Z >= K'P2 K with K = P2^-1 Y. Phi is judged with Z = K'P2 K itself.
    gain = _gain_correction(unknowns)
    exact = unknowns._replace(product=unknowns.error @ gain, gain_square=gain.T @ unknowns.error @ gain)
    are_positive = min(np.linalg.eigvalsh(unknowns.state)[0], np.linalg.eigvalsh(unknowns.error)[0]) > 0
    phi = compute_next_energy(step, exact) + fixed
    return bool(are_positive and np.linalg.eigvalsh(phi)[-1] < -strictness)


def _gain_correction(unknowns: Unknowns) -> Float[np.ndarray, "n m"]:
    """Return K - K0 = P2^-1 Y, by which the gain of a step differs from its nominal one K0.

    P2 is the weight of the next error, and Y = P2 (K - K0) the solver's unknown in place of the gain.
    """
    return np.asarray(np.linalg.solve(unknowns.error, unknowns.product))


def _weigh_state_and_error(unknowns: Unknowns) -> Float[np.ndarray, "w w"]:
    """Return diag(P1, P2), the weight of (x, e) after a step, from the weights P1 of x and P2 of e that were found."""
    zero = np.zeros_like(unknowns.state)
    return np.block([[unknowns.state, zero], [zero, unknowns.error]])


def _make_unsolved_design(system: GrowthSystem, separate: bool, level: float, status: str) -> HInfinityDesign:
    """Return a design at a level that is not feasible, or not yet: all its arrays are NaN, and it has a status.

    With `separate` each of the four functions f, f~, h, h~ has a multiplier. Else (f, f~) share one, and (h, h~) too.
    """
    n, steps = system.states, system.steps
    return HInfinityDesign(
        level=level,
        gains=np.full((steps, n, system.received), np.nan),
        weights=np.full((steps + 1, 2 * n, 2 * n), np.nan),
        multipliers=np.full((steps, 4 if separate else 2), np.nan),
        feasible=False,
        status=status,
    )


def _bisect_level(works: Callable[[float], bool], guess: float) -> float | None:
    """Return the smallest level that works, to SEARCH_ACCURACY; None if none does up to SEARCH_LIMIT times the guess.

    By doubling or halving the guess until one level works and half of it does not, then bisection of the logarithm.
    """
    high = guess
    while not works(high):
        high *= 2.0
        if high > SEARCH_LIMIT * guess:
            return None
    low = high / 2.0
    while works(low):
        high, low = low, low / 2.0
        if low < guess / SEARCH_LIMIT:
            return high
    while high / low > 1 + SEARCH_ACCURACY:
        middle = float(np.sqrt(high * low))
        low, high = (low, middle) if works(middle) else (middle, high)
    return high
