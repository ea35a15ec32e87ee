"""Steady error where the receiver is told of modes: a coupled Riccati equation by policy iteration, and its adjoint.

With T[i, j] = P(next j | now i), pi its law, X_i = E[e e' 1{i}] and a gain K_j of each mode,
  X_j = (I - K_j H_j) Y_j (I - K_j H_j)' + pi_j K_j N_j K_j',  Y_j = sum_i T_ij A X_i A' + pi_j Q,
and the error is sum X_j. Given the gains this is linear; gains that are best given Y do not change the error to first
order. So with L_i = W + sum_l T_il F_l' L_l F_l, F_l = (I - K_l H_l) A, the gradient of <W, error> is that of
  sum_j <L_j, right side_j>  at fixed X, K, L.
One mode is the Riccati equation; modes that do not remember are losses that are told. The gains depend on the mode
alone: filters that also remember which modes were before do no worse, so with modes the error is an upper bound.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.numerics.check import fail
from heliograph.numerics.types import Float

PLAIN, POLICIES = 400, 40  # iterations: of the recursion until its gains stabilise, of gains after that
NEAR = 1e-4  # relative change of the recursion from which gains are improved
SETTLED = 1e-14


class Measured(NamedTuple):
    """A, Q, the chain T with its law pi, and by mode H and N of z = H x + n; powers of the transmitters, in order."""

    transition: Any  # (n, n), NumPy's or JAX's as what it is made of
    process: Any  # (n, n)
    chain: Any  # (M, M)
    law: Any  # (M,)
    output: Any  # (M, m, n)
    noise: Any  # (M, m, m)
    powers: Any  # (hops,)


class Settled(NamedTuple):
    """X, K and L of each mode."""

    parts: Float[np.ndarray, "M n n"]
    gains: Float[np.ndarray, "M n m"]
    ahead: Float[np.ndarray, "M n n"]


def settled(m: Measured, weight: Float[np.ndarray, "n n"]) -> Settled:
    """The fixed point and its adjoint.

    Raises:
        ValueError: an error that grows without limit.
    """
    n = len(m.transition)
    parts = m.law[:, None, None] * m.process
    for _ in range(PLAIN):
        gains, after = _best(m, parts)
        change = np.abs(after - parts).max()
        parts = after
        if not change > NEAR * np.abs(parts).max():
            break
    for _ in range(POLICIES):
        close = np.eye(n) - gains @ m.output
        loops = close @ m.transition
        whole = np.eye(len(m.law) * n * n) - _operator(m.chain, loops)
        source = close @ m.process @ close.swapaxes(1, 2) + gains @ m.noise @ gains.swapaxes(1, 2)
        solved = np.linalg.solve(whole, (m.law[:, None, None] * source).ravel()).reshape(parts.shape)
        change = np.abs(solved - parts).max()
        parts = (solved + solved.swapaxes(1, 2)) / 2
        if change <= SETTLED * np.abs(parts).max():
            break
        gains = _best(m, parts)[0]
    if not np.all(np.isfinite(parts)) or np.linalg.eigvalsh(parts).min() < -NEAR * np.abs(parts).max():
        raise fail(
            "steady error", "one that settles (what is heard tells too little of an unstable plant)", "one that grows"
        )
    ahead = np.linalg.solve(whole.T, np.tile(weight, (len(m.law), 1, 1)).ravel()).reshape(parts.shape)
    return Settled(parts, gains, (ahead + ahead.swapaxes(1, 2)) / 2)


def _best(m: Measured, parts: Float[np.ndarray, "M n n"]) -> tuple[np.ndarray, np.ndarray]:
    """Best gains and X after one step."""
    moved = m.transition @ parts @ m.transition.T
    before = np.einsum("ij,iab->jab", m.chain, moved) + m.law[:, None, None] * m.process
    cross = m.output @ before
    total = cross @ m.output.swapaxes(1, 2) + m.law[:, None, None] * m.noise
    gains = np.linalg.solve(total, cross).swapaxes(1, 2)
    after = before - gains @ cross
    return gains, (after + after.swapaxes(1, 2)) / 2


def _operator(chain: np.ndarray, loops: Float[np.ndarray, "M n n"]) -> Float[np.ndarray, "Mnn Mnn"]:
    """X -> (sum_i T_ij F_j X_i F_j')_j on all entries."""
    modes, n = len(chain), loops.shape[-1]
    double = np.einsum("jac,jbd->jabcd", loops, loops).reshape(modes, n * n, n * n)
    return np.asarray(np.einsum("ij,jab->jaib", chain, double).reshape(modes * n * n, modes * n * n))


def touched(m: Measured, at: Settled) -> jax.Array:
    """sum_j <L_j, right side_j>: what has the error's gradient where X, K and L are held."""
    parts, gains, ahead = (jnp.asarray(part) for part in at)
    close = jnp.eye(parts.shape[-1]) - gains @ m.output
    moved = m.transition @ parts @ m.transition.T
    before = jnp.einsum("ij,iab->jab", m.chain, moved) + m.law[:, None, None] * m.process
    noise = m.law[:, None, None] * (gains @ m.noise @ gains.swapaxes(1, 2))
    return jnp.sum(ahead * (close @ before @ close.swapaxes(1, 2) + noise))
