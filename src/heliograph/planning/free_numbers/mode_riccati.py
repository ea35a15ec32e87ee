"""Error covariances where the receiver observes modes: coupled Riccati recursions, policy iteration, and adjoints.

With T_k[i, j] = P(j at step k | i before), pi_k the law, X_k,i = E[e e' 1{i}] and a gain K_k,j of each step and mode,
    X_k,j = (I - K H) Y (I - K H)' + pi_k,j K N K',  Y_k,j = sum_i T_k,ij A X_k-1,i A' + pi_k,j Q,
and P_k = sum_j X_k,j. For fixed gains this is linear; gains that are best for Y do not change the error to first
order. So with W_k the error's derivative by P_k and L_k,i = W_k + sum_l T_k+1,il F' L_k+1,l F, F = (I - K_k+1,l H) A,
the error's gradient is that of
    sum_k,j <L_k,j, right side_k,j>  at fixed X, K, L.
One mode is the Riccati equation; modes without memory are losses that the receiver observes. The gains depend on the
mode alone: filters that also remember earlier modes do no worse, so with modes the error is an upper bound.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.factors.square_root_update import observe_root, roots_of
from heliograph.linear.jump_system import JumpSystem
from heliograph.numerics.check import fail
from heliograph.numerics.types import Float
from heliograph.planning.error_objective import Criterion

MOST_RECURSIONS = 400  # periods of the Riccati recursion, until its gains stabilise the error
MOST_POLICIES = 40  # improvements of the gains after that
NEARLY_STEADY = 1e-4  # relative change over a period at which the recursion has come near the steady state
CONVERGED = 1e-14  # relative change of the steady state at which gains are the best but for rounding

Parts = Float[np.ndarray, "time M n n"]

Numbers = Any  # NumPy's or JAX's, as what they are made of


class ModeSystem(NamedTuple):
    """System of the best linear filter at each step, by mode where the receiver observes modes.

    x+ = A x + w, Cov w = Q, is received as z = H x + n, Cov n = N, with H and N by mode.

    Args:
        transition: A of each step (time, n, n).
        process: Q (time, n, n).
        chain: T, [k, i, j] = P(mode j at step k | mode i at the step before) (time, M, M).
        law: pi, the probability of each mode at each step (time, M).
        output: H (time, M, m, n).
        noise: N (time, M, m, m).
        powers: what the transmitters send, for the limits of a design (time, hops).
        start: error covariance before the first step (n, n); None where the steps repeat for ever.
    """

    transition: Numbers
    process: Numbers
    chain: Numbers
    law: Numbers
    output: Numbers
    noise: Numbers
    powers: Numbers
    start: Numbers


class ModeSolution(NamedTuple):
    """Solution of the filter's error in each step and mode.

    Args:
        parts: X = E[e e' 1{mode}] of the error e after a step, which sum to its covariance P over the modes
            (time, M, n, n).
        gains: K, the best gains of the filter (time, M, n, m).
        adjoint: L, the derivative of the criterion by X, through all later steps (time, M, n, n).
    """

    parts: Parts
    gains: Float[np.ndarray, "time M n m"]
    adjoint: Parts


def solve_riccati(system: ModeSystem, criterion: Criterion) -> ModeSolution:
    """Return the error's covariances X under the filter's best gains K, these gains, and the adjoint L of X.

    If `system.start` is None, the periodic steady state is solved for. Otherwise the recursion runs from this
    covariance. Rounding may make a covariance negative by the share NEARLY_STEADY of the largest entry.

    Args:
        system: the system of the filter at each step, by mode.
        criterion: the number that a design makes small, of which L is the derivative.

    Raises:
        ValueError: an error that grows without limit.
    """
    expected = "one that converges (what is received informs too little of an unstable plant)"
    growth = fail("steady error", expected, "growth")
    try:
        with np.errstate(over="ignore", invalid="ignore"):
            X, gains = _solve_periodic(system) if system.start is None else _run_riccati(system, system.start[None])
    except np.linalg.LinAlgError:  # raised for NaN, and for a growth of exactly 1
        raise growth from None
    if not np.all(np.isfinite(X)) or np.linalg.eigvalsh(X).min() < -NEARLY_STEADY * np.abs(X).max():
        raise growth
    covariances_of_all_modes = X.sum(axis=1)
    _, weights = criterion.smooth(covariances_of_all_modes)
    return ModeSolution(X, gains, _close_loop(system, gains).adjoint(weights, system.start is None))


def _solve_periodic(system: ModeSystem) -> tuple[Parts, np.ndarray]:
    """Return X (steps, modes, n, n) and the best gains K (steps, modes, n, m) for steps that repeat for ever.

    X_k,i = E[e e' 1{mode i}] is the covariance of the filter's error e after step k in mode i, times the mode's
    probability. The coupled Riccati recursion alone converges slowly. So it runs, period after period, until X changes
    by no more than NEARLY_STEADY of its size. Policy iteration goes on from there, which needs few rounds: it solves
    the linear equation of X under fixed gains, and takes the best gains for that X. `system`: the system of the filter
    at each step of the period, by mode.
    """
    # The recursion; X begins as pi Q, the plant's noise alone.
    last = system.law[-1, :, None, None] * system.process[-1]
    for _ in range(MOST_RECURSIONS):
        parts, gains = _run_riccati(system, last)
        change = np.abs(parts[-1] - last).max()
        last = parts[-1]
        if not change > NEARLY_STEADY * np.abs(last).max():
            break
    # Policy iteration.
    for _ in range(MOST_POLICIES):
        previous = parts
        parts = _close_loop(system, gains).steady()  # X under these gains
        if np.abs(parts - previous).max() <= CONVERGED * np.abs(parts).max():
            break
        # The gains of step k follow from X after the step before it (the period's last for k = 0).
        updates = [_update_riccati(system, k, parts[k - 1]) for k in range(len(parts))]
        gains = np.array([best_gains for best_gains, _ in updates])
    return parts, gains


def _run_riccati(system: ModeSystem, X: Float[np.ndarray, "_ n n"]) -> tuple[Parts, np.ndarray]:
    """Return X after each step (steps, modes, n, n) and the best gains, by the coupled Riccati recursion.

    X of a mode is its covariance times its probability. The argument X is that before the first step, for each mode, or
    one for all modes together if their chain has no memory.

    Args:
        system: the system of the filter at each step, by mode.
        X: X before the first step (modes, n, n), or summed over the modes (1, n, n).
    """
    covariances, gains = [], []
    for k in range(len(system.law)):
        gain, X = _update_riccati(system, k, X)
        covariances.append(X)
        gains.append(gain)
    return np.array(covariances), np.array(gains)


def _update_riccati(system: ModeSystem, k: int, X: Float[np.ndarray, "_ n n"]) -> tuple[np.ndarray, np.ndarray]:
    """Return the best gains K (modes, n, m) of step k and X (modes, n, n) after it, from X before it.

    X of a mode is its covariance times the mode's probability (`system.law`), so the noises are weighted by it too.

    Args:
        system: the system of the filter at each step, by mode.
        k: the step.
        X: X before the step (modes, n, n), or summed over the modes (1, n, n).
    """
    law = system.law[k][:, None, None]
    predicted_X = JumpSystem(system.chain[k], system.transition[k], law * system.process[k]).step(X)
    # A mode that never occurs has X = 0. Give it any regular noise, so that its gain is zero.
    noise = np.where(law > 0, law * system.noise[k], np.eye(system.noise.shape[-1]))
    corrected_X = observe_root(roots_of(predicted_X), system.output[k], roots_of(noise))
    return corrected_X.gain, corrected_X.covariance


def _close_loop(system: ModeSystem, gains: Numbers) -> JumpSystem:
    """Return the recursion of X under given gains K, X_j = sum_i T_ij F_j X_i F_j' + S_j, with T the chain of modes.

    X_j = E[e e' 1{mode j}] is the covariance of the error e times the probability of mode j. F = (I - K H) A and
    S = pi [(I - K H) Q (I - K H)' + K N K'], with pi (`system.law`) the probability of each mode, H (`system.output`),
    and Q and N the covariances of process and measurement noise. All are by step; K, H, N, F and S also by mode.

    Args:
        system: the system of the filter at each step, by mode.
        gains: K (steps, modes, n, m).
    """
    K = gains
    law = system.law[:, :, None, None]  # K (steps, modes, n, m); law: pi (steps, modes, 1, 1)
    I_KH = np.eye(K.shape[2]) - K @ system.output  # I - K H
    # `[:, None]`: A and Q of a step are the same in all modes.
    noise_in_error = I_KH @ system.process[:, None] @ I_KH.swapaxes(-1, -2) + K @ system.noise @ K.swapaxes(-1, -2)
    return JumpSystem(system.chain, I_KH @ system.transition[:, None], law * noise_in_error)


def lagrangian(system: ModeSystem, solution: ModeSolution) -> jax.Array:
    """Return sum_k,j trace(L_k,j R_k,j), whose gradient by the system at fixed X, K and L is that of the error.

    X_k,j is the error covariance after step k in mode j, times the mode's probability. R_k,j is the right side of its
    recursion X_k,j = R_k,j(X_k-1) under the gains K. L is the adjoint: the derivative of the error by each X.

    Args:
        system: the system of the filter at each step, by mode; JAX differentiates by its arrays.
        solution: X, K and L, which are held fixed.
    """
    X, gains, adjoint = (jnp.asarray(values) for values in solution)
    X_before = jnp.roll(X, 1, axis=0)  # in a period, the last step leads to the first
    if system.start is not None:
        # Over a horizon the first step's mode does not depend on an earlier one: all rows of its chain are equal. So
        # the covariance before it may be put into any mode, here mode 0.
        X_before = jnp.zeros_like(X).at[0, 0].set(system.start).at[1:].set(X[:-1])
    right_side = _close_loop(system, gains).step(X_before)
    return jnp.sum(adjoint * right_side)
