"""H-infinity design by a Riccati recursion, without a solver, behind a channel whose gains are known."""

from typing import NamedTuple

import numpy as np

from heliograph.h_infinity.design import HInfinityDesign
from heliograph.h_infinity.error_system import GrowthSystem
from heliograph.h_infinity.step_inequality import StepMatrices, list_step_matrices
from heliograph.numerics.check import TINY, array, fail, instance, scalar
from heliograph.numerics.types import ArrayLike, Float

SPARE = 0.05  # of the state's own weight at each step, so that its inequality is strict
GREATEST = 1e100  # level of a closed form, whose square times squares of matrices doubles hold
SLACK = 1e-6  # relative strictness that a closed form gives away, so that its certificate has a margin


def known_channel_design(
    system: GrowthSystem, level: float, multipliers: "Float[ArrayLike, 'steps 2'] | None" = None
) -> HInfinityDesign:
    """Design gains at a given level for a channel whose gains are certain: a Riccati recursion.

    The filter's error e follows e+ = E eta - K U eta, with eta = (e, f~, h~, v, rho), the innovation U eta and the gain
    K. Here f~ = f(x) - f(xhat), |f~| <= a |e|, and h~ likewise with b, are the unknown functions of plant and sensor; v
    and rho are disturbances. P2 is the weight of the error before the step, P2+ after it, and M e what the level
    bounds. With multipliers lambda of the bounds on f~ and h~, let Q = P2 - M'M - (lambda_f~ a^2 + lambda_h~ b^2) I and
    S = diag(Q, lambda_f~, lambda_h~, level^2)^-1. The best gain is K* = E S U' (U S U')^-1. It makes
    P2+^-1 = E S E' - K* U S E' the smallest over all gains.

    Args:
        system: the system, from `growth_system`, whose channel has no random gain.
        level: gamma, a positive ratio of norms.
        multipliers: those of f~ and h~ (steps, 2), positive where the function is not zero. By default they are zeros,
            as a linear system needs them; the design is then the H-infinity filter of textbooks.

    Raises:
        ValueError: a channel with random gains, multipliers of the wrong shape, a level not in (0, 1e100].
    Source: H-infinity fusion over amplify-and-forward relays, Theorem 1 with all arrival probabilities 1.
    """
    instance("system", system, GrowthSystem, "a GrowthSystem, as growth_system makes it")
    level = float(scalar("level", level, low=TINY, high=GREATEST))
    if any(len(link.spreads()) for link in system.channel):
        raise fail("channel of a closed-form design", "gains that are certain", "random gains; use recursive_design")
    shape = (system.steps, 2)
    values = np.zeros(shape) if multipliers is None else array("multipliers", multipliers, shape)
    for growth, column, name in ((system.growth, 0, "f~"), (system.output_growth, 1, "h~")):
        if not growth.absent and np.any(values[:, column] <= 0):
            raise fail(f"multipliers of {name}", "positive ones, since it is not zero", values[:, column].min())
    return _run_riccati(system, level, values)


def _run_riccati(system: GrowthSystem, level: float, multipliers: Float[np.ndarray, "steps 2"]) -> HInfinityDesign:
    """Return a design by the Riccati recursion at one level; it ends, infeasible, at a step for which no gain exists.

    The filter bounds the energy of the error e by level^2 = gamma^2 times that of the disturbances. A storage function
    (x, e)' P_k (x, e) proves it, with P_k = diag(p I, P2), a number p for the state x and a matrix P2 for e. A Riccati
    step gives the best gain and the next P2. The design ends, infeasible, at a step for which no gain exists.

    Args:
        system: the system x+ = A x + f(x) + B v with its measurements, its initial weight W, and growth bounds of f and
            h.
        level: gamma, the bound to be reached.
        multipliers: multipliers of the growth bounds of the differences f~ and h~ (steps, 2), in the user's units.
    """
    n, m, steps = system.states, system.received, system.steps
    # A little below the level, so that the certificate has a margin.
    inner_level = level * (1 - SLACK)
    # P_0: P2 as large as level^2 W allows, and p so small that the weight of x costs next to nothing of the level,
    # whatever B v adds to x.
    error_weight = level**2 * float(np.linalg.eigvalsh(system.initial_weight)[0]) * (1 - SLACK)
    input_size = float(np.max(np.linalg.norm(system.disturbance, 2, axis=(1, 2))))
    state_weight = SLACK * min(error_weight, level**2 / (1 + (1 + 1 / SPARE) * input_size**2))
    design = HInfinityDesign(
        level=level,
        gains=np.full((steps, n, m), np.nan),
        weights=np.full((steps + 1, 2 * n, 2 * n), np.nan),
        multipliers=np.full((steps, 4), np.nan),
        feasible=False,
        status="",
    )
    design.weights[0] = np.diag(np.repeat([state_weight, error_weight], n))
    # Step by step: K and P2 in closed form, p small enough that it does no harm.
    for k, step in enumerate(list_step_matrices(system, separate=True)):
        error_weight_before = design.weights[k, n:, n:]  # P2 of step k
        found = _compute_best_gain(system, step, error_weight_before, inner_level, multipliers[k])
        if found is None:
            text = f"no gain exists at step {k} of {steps} with these multipliers"
            return design._replace(status=text, failed_step=k)
        design.gains[k], next_error_weight = found
        state_weight, multiplier_f, multiplier_h = _compute_state_weight(system, k, state_weight)
        no_coupling = np.zeros((n, n))
        design.weights[k + 1] = np.block([[state_weight * np.eye(n), no_coupling], [no_coupling, next_error_weight]])
        design.multipliers[k] = [multiplier_f, multipliers[k, 0], multiplier_h, multipliers[k, 1]]
    return design._replace(feasible=True, status="optimal")


def _compute_best_gain(
    system: GrowthSystem,
    step: StepMatrices,
    weight: Float[np.ndarray, "n n"],
    level: float,
    multipliers: Float[np.ndarray, "2"],
) -> tuple[Float[np.ndarray, "n m"], Float[np.ndarray, "n n"]] | None:
    """Return the best gain K* of a step and the largest weight P2+ of e after it, or None where there is no gain.

    eta = (x, e, f, f~, h, h~, v, rho) is all that a step depends on; the part (e, f~, h~, v, rho) moves the error:
    e+ = E eta before the correction, and U eta is what is received less its prediction. S^-1 is the quadratic form that
    the H-infinity bound with this level allows for eta. The correction e+ = (E - K U) eta has least size for
    K* = E S U' (U S U')^-1, and then P2+ = (E S E' - K* U S E')^-1.

    Args:
        system: the system x+ = A x + f(x) + B v with growth bounds of f and h.
        step: its matrices at this step: `error` E, `received` U, `target` M'M, `energy` of (v, rho).
        weight: P2, the weight of e before the step.
        level: gamma, the bound on the error's energy per energy of the disturbances.
        multipliers: multipliers lambda of the growth bounds of f~ and h~.
    """
    errors = slice(system.states, 2 * system.states)
    grows = [not growth.absent for growth in (system.growth, system.output_growth)]
    # S^-1: P2 - M'M - (lambda_f~ a^2 + lambda_h~ b^2) I of e, the multipliers of f~ and h~, level^2 of v and rho. The
    # growth forms of differences, f~ and h~, are every second one.
    inverse_s = level**2 * step.energy - step.target - np.diag(multipliers[grows] @ step.growth[1::2])
    inverse_s[errors, errors] += weight
    if np.linalg.eigvalsh(inverse_s[errors, errors])[0] <= 0:
        return None
    # Take only parts of eta that the form has, and solve for K*; least squares, as U S U' may be singular.
    used = np.flatnonzero(np.diag(inverse_s))
    S = np.linalg.inv(inverse_s[np.ix_(used, used)])
    E, U = step.error[:, used], step.received[:, used]
    USE = U @ S @ E.T
    K_transposed, *_ = np.linalg.lstsq(U @ S @ U.T, USE, rcond=None)  # U S U' K' = U S E'
    gain = K_transposed.T
    # P2+, a little smaller (SLACK) for a margin of rounding, and symmetric.
    next_weight = np.linalg.inv(E @ S @ E.T - gain @ USE)
    return gain, (1 - SLACK) * (next_weight + next_weight.T) / 2


class _NextStateWeight(NamedTuple):
    """Weight p+ of the next state, P1+ = p+ I, and multipliers of the growth bounds of f and h."""

    weight: float
    multiplier_f: float
    multiplier_h: float


def _compute_state_weight(system: GrowthSystem, k: int, state: float) -> _NextStateWeight:
    """Return the weight p+ of the next state, P1+ = p+ I, and the multipliers lambda_f and lambda_h of f and h.

    No measurement changes x+ = A x + f + B v. f and h are known by |f| <= a |x| and |h| <= b |x|, so that its part of
    the step's inequality is, for every x, f, h and v, and up to a share of |v|^2,

      p+ |A x + f + B v|^2 + lambda_f (a^2 |x|^2 - |f|^2) + lambda_h (b^2 |x|^2 - |h|^2) < p |x|^2.

    |A x + f + B v|^2 <= (1 + d) |A x + f|^2 + (1 + 1/d) |B|^2 |v|^2 with d = SPARE, and |A x + f| is at most
    (|A| + a) |x|. A p+ of (1 + d)^-3 p / (|A| + a)^2 or less leaves a part of p for the multipliers. `state` is p.
    """
    norm_of_a = np.linalg.norm(system.transition[k], 2)
    a, b = system.growth.state[k], system.output_growth.state[k]
    next_weight = state / ((1 + SPARE) ** 3 * max(float(norm_of_a + a) ** 2, 1.0))
    # |A x + f|^2 <= (1 + |A|/a) |f|^2 + (1 + a/|A|) |A x|^2: lambda_f outweighs the first term. If a = 0, f is zero.
    multiplier_f = next_weight * 10 / SPARE
    if a > 0:
        multiplier_f = next_weight * (1 + SPARE) ** 2 * float(1 + norm_of_a / a)
    multiplier_h = state * SPARE / (4 * (1 + float(b) ** 2))  # lambda_h b^2 is at most d / 4 of p
    return _NextStateWeight(next_weight, multiplier_f, multiplier_h)
