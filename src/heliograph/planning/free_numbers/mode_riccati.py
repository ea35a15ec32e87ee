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

PLAIN, POLICIES = 400, 40  # iterations: of the recursion until its gains stabilise, of gains after that
NEAR = 1e-4  # relative change of the recursion from which gains are improved
CONVERGED = 1e-14

Parts = Float[np.ndarray, "time M n n"]

Numbers = Any  # NumPy's or JAX's, as what they are made of


class ModeSystem(NamedTuple):
    """System of the best linear filter at each step, by mode where the receiver observes modes.

    x+ = A x + w, Cov w = Q; T the chain into the step and pi its law; z = H x + n, Cov n = N by mode; the powers sent.
    start: the covariance before the first step; None where the steps repeat for ever.
    """

    transition: Numbers  # (time, n, n)
    process: Numbers  # (time, n, n)
    chain: Numbers  # (time, M, M)
    law: Numbers  # (time, M)
    output: Numbers  # (time, M, m, n)
    noise: Numbers  # (time, M, m, m)
    powers: Numbers  # (time, hops)
    start: Numbers  # (n, n)


class ModeSolution(NamedTuple):
    """Covariances X (parts, which sum to P over the modes), gains K and adjoint L of each step and mode."""

    parts: Parts
    gains: Float[np.ndarray, "time M n m"]
    adjoint: Parts


def solve_riccati(m: ModeSystem, criterion: Criterion) -> ModeSolution:
    """Return the covariances X under the best gains K, these gains, and the adjoint L of X, by step and mode.

    If `m.start` is None, the periodic steady state is solved for. Otherwise the recursion runs from this covariance.
    Rounding may make a covariance negative by the share NEAR of the largest entry.

    Raises:
        ValueError: an error that grows without limit.
    """
    expected = "one that converges (what is received informs too little of an unstable plant)"
    growth = fail("steady error", expected, "growth")
    try:
        with np.errstate(over="ignore", invalid="ignore"):
            X, gains = _solve_periodic(m) if m.start is None else _run_riccati(m, m.start[None])
    except np.linalg.LinAlgError:  # raised for NaN, and for a growth of exactly 1
        raise growth from None
    if not np.all(np.isfinite(X)) or np.linalg.eigvalsh(X).min() < -NEAR * np.abs(X).max():
        raise growth
    covariances_of_all_modes = X.sum(axis=1)
    _, weights = criterion.smooth(covariances_of_all_modes)
    return ModeSolution(X, gains, _close_loop(m, gains).adjoint(weights, m.start is None))


def _solve_periodic(m: ModeSystem) -> tuple[Parts, np.ndarray]:
    """Return X (steps, modes, n, n) and the best gains K (steps, modes, n, m) for steps that repeat for ever.

    X_k,i = E[e e' 1{mode i}] is the covariance of the error e after step k in mode i, times the mode's probability.
    """
    # Iterate the Riccati recursion until its gains stabilise the error; X begins as pi Q, the plant's noise alone.
    last = m.law[-1, :, None, None] * m.process[-1]
    for _ in range(PLAIN):
        parts, gains = _run_riccati(m, last)
        change = np.abs(parts[-1] - last).max()
        last = parts[-1]
        if not change > NEAR * np.abs(last).max():
            break
    # Policy iteration: X of these gains by a linear equation around the period, then the best gains for X.
    for _ in range(POLICIES):
        previous, parts = parts, _close_loop(m, gains).steady()
        if np.abs(parts - previous).max() <= CONVERGED * np.abs(parts).max():
            break
        # The gains of step k follow from X after the step before it (the period's last for k = 0).
        gains = np.array([_update_riccati(m, k, parts[k - 1])[0] for k in range(len(parts))])
    return parts, gains


def _run_riccati(m: ModeSystem, X: Float[np.ndarray, "_ n n"]) -> tuple[Parts, np.ndarray]:
    """Return X after each step (steps, modes, n, n) and the best gains, by the coupled Riccati recursion.

    X of a mode is its covariance times its probability. The argument X is that before the first step, for each mode, or
    one for all modes together if their chain has no memory.
    """
    covariances, gains = [], []
    for k in range(len(m.law)):
        gain, X = _update_riccati(m, k, X)
        covariances.append(X)
        gains.append(gain)
    return np.array(covariances), np.array(gains)


def _update_riccati(m: ModeSystem, k: int, X: Float[np.ndarray, "_ n n"]) -> tuple[np.ndarray, np.ndarray]:
    """Return the best gains K (modes, n, m) of step k and X (modes, n, n) after it, from X before it.

    X of a mode is its covariance times the mode's probability (`m.law`), so the noises are weighted by it too.
    """
    law = m.law[k][:, None, None]
    predicted_X = JumpSystem(m.chain[k], m.transition[k], law * m.process[k]).step(X)
    # A mode that never occurs has X = 0. Give it any regular noise, so that its gain is zero.
    noise = np.where(law > 0, law * m.noise[k], np.eye(m.noise.shape[-1]))
    corrected_X = observe_root(roots_of(predicted_X), m.output[k], roots_of(noise))
    return corrected_X.gain, corrected_X.covariance


def _close_loop(m: ModeSystem, gains: Numbers) -> JumpSystem:
    """Return the recursion of X under given gains K, X_j = sum_i T_ij F_j X_i F_j' + S_j, with T the chain of modes.

    X_j = E[e e' 1{mode j}] is the covariance of the error e times the probability of mode j. F = (I - K H) A and
    S = pi [(I - K H) Q (I - K H)' + K N K'], with pi (`m.law`) the probability of each mode, H (`m.output`), and Q and
    N the covariances of process and measurement noise. All are by step; K, H, N, F and S also by mode.
    """
    K, law = gains, m.law[:, :, None, None]  # K (steps, modes, n, m); law: pi (steps, modes, 1, 1)
    I_KH = np.eye(K.shape[2]) - K @ m.output  # I - K H
    # `[:, None]`: A and Q of a step are the same in all modes.
    noise_in_error = I_KH @ m.process[:, None] @ I_KH.swapaxes(-1, -2) + K @ m.noise @ K.swapaxes(-1, -2)
    return JumpSystem(m.chain, I_KH @ m.transition[:, None], law * noise_in_error)


def lagrangian(m: ModeSystem, solution: ModeSolution) -> jax.Array:
    """Return sum_k,j trace(L_k,j R_k,j), whose gradient by the system m at fixed X, K and L is that of the error.

    X_k,j is the error covariance after step k in mode j, times the mode's probability. R_k,j is the right side of its
    recursion X_k,j = R_k,j(X_k-1) under the gains K. L is the adjoint: the derivative of the error by each X.
    """
    X, gains, adjoint = (jnp.asarray(values) for values in solution)
    X_before = jnp.roll(X, 1, axis=0)  # in a period, the last step leads to the first
    if m.start is not None:
        # Over a horizon the first step's mode does not depend on an earlier one: all rows of its chain are equal. So
        # the covariance before it may be put into any mode, here mode 0.
        X_before = jnp.zeros_like(X).at[0, 0].set(m.start).at[1:].set(X[:-1])
    right_side = _close_loop(m, gains).step(X_before)
    return jnp.sum(adjoint * right_side)
