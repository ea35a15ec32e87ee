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

from functools import reduce
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.numerics.check import fail
from heliograph.numerics.types import Float
from heliograph.planning.error import Criterion

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
    """X, K and L of each step and mode."""

    parts: Parts
    gains: Float[np.ndarray, "time M n m"]
    adjoint: Parts


def solve_riccati(m: ModeSystem, criterion: Criterion) -> ModeSolution:
    """Covariances with the best gains, and their adjoint under the criterion.

    Raises:
        ValueError: an error that grows without limit, measurements without any noise.
    """
    try:
        with np.errstate(over="ignore", invalid="ignore"):
            parts, gains = _periodic(m) if m.start is None else _step_through(m, _initial(m))
    except np.linalg.LinAlgError:
        raise fail("network of a design", "measurements with noise", "a singular innovation covariance") from None
    if not np.all(np.isfinite(parts)) or np.linalg.eigvalsh(parts).min() < -NEAR * np.abs(parts).max():
        expected = "one that converges (what is received informs too little of an unstable plant)"
        raise fail("steady error", expected, "growth")
    weights = criterion.smooth(parts.sum(axis=1))[1]
    return ModeSolution(parts, gains, _adjoint(m, _closed_loops(m, gains), weights))


def _periodic(m: ModeSystem) -> tuple[Parts, np.ndarray]:
    """X and best gains for steps that repeat for ever."""
    n, modes = m.process.shape[-1], m.law.shape[1]
    # The recursion, until its gains stabilise.
    last = m.law[-1, :, None, None] * m.process[-1]
    for _ in range(PLAIN):
        parts, gains = _step_through(m, last)
        change = np.abs(parts[-1] - last).max()
        last = parts[-1]
        if not change > NEAR * np.abs(last).max():
            break
    # Policy iteration: X of these gains by a linear equation around the period, then the best gains for X.
    for _ in range(POLICIES):
        before, loops = parts, _closed_loops(m, gains)
        close = np.eye(n) - gains @ m.output
        added = close @ m.process[:, None] @ close.swapaxes(2, 3) + gains @ m.noise @ gains.swapaxes(2, 3)
        source = m.law[:, :, None, None] * added
        operators = [_operator(chain, loop) for chain, loop in zip(m.chain, loops, strict=True)]
        constant = reduce(lambda total, step: step[0] @ total + step[1].ravel(),
                          zip(operators, source, strict=True), np.zeros(modes * n * n))  # fmt: skip
        product = reduce(lambda product, operator: operator @ product, operators)
        x, through = np.linalg.solve(np.eye(modes * n * n) - product, constant), []
        for operator, term in zip(operators, source, strict=True):
            x = operator @ x + term.ravel()
            through.append(x.reshape(modes, n, n))
        parts = (np.array(through) + np.swapaxes(through, -1, -2)) / 2
        if np.abs(parts - before).max() <= CONVERGED * np.abs(parts).max():
            break
        gains = np.array([_update(m, k, parts[k - 1])[0] for k in range(len(parts))])
    return parts, gains


def _initial(m: ModeSystem) -> Float[np.ndarray, "M n n"]:
    """X before the first step, over which the chain has no memory."""
    modes = m.law.shape[1]
    parts: np.ndarray = m.start[None] * (np.ones((modes, 1, 1)) / modes)
    return parts


def _step_through(m: ModeSystem, parts: Float[np.ndarray, "M n n"]) -> tuple[Parts, np.ndarray]:
    """X and the best gains of each step, from X before the first."""
    steps = []
    for k in range(len(m.law)):
        gain, parts = _update(m, k, parts)
        steps.append((parts, gain))
    return np.array([x for x, _ in steps]), np.array([gain for _, gain in steps])


def _update(m: ModeSystem, k: int, parts: Float[np.ndarray, "M n n"]) -> tuple[np.ndarray, np.ndarray]:
    """Best gains of a step, and X after it."""
    moved, law = m.transition[k] @ parts @ m.transition[k].T, m.law[k][:, None, None]
    prior = np.einsum("ij,iab->jab", m.chain[k], moved) + law * m.process[k]
    cross = m.output[k] @ prior
    # A mode that never occurs has the gain zero.
    noise = np.where(law > 0, law * m.noise[k], np.eye(m.noise.shape[-1]))
    gains = np.linalg.solve(cross @ m.output[k].swapaxes(1, 2) + noise, cross).swapaxes(1, 2)
    after = prior - gains @ cross
    return gains, (after + after.swapaxes(1, 2)) / 2


def _closed_loops(m: ModeSystem, gains: np.ndarray) -> Parts:
    """F = (I - K H) A."""
    return np.asarray((np.eye(gains.shape[2]) - gains @ m.output) @ m.transition[:, None])


def _operator(chain: np.ndarray, loops: Float[np.ndarray, "M n n"]) -> Float[np.ndarray, "Mnn Mnn"]:
    """X -> (sum_i T_ij F_j X_i F_j')_j on all entries."""
    modes, n = len(chain), loops.shape[-1]
    squares = np.einsum("jac,jbd->jabcd", loops, loops).reshape(modes, n * n, n * n)
    return np.asarray(np.einsum("ij,jab->jaib", chain, squares).reshape(modes * n * n, modes * n * n))


def _adjoint(m: ModeSystem, loops: Parts, weights: Float[np.ndarray, "time n n"]) -> Parts:
    """L of each step: backwards from zero behind the last, or from its fixed point around a period."""
    steps, modes, n = len(loops), *loops.shape[1:3]
    back = [_operator(chain, loop).T for chain, loop in zip(m.chain, loops, strict=True)]
    terms = [np.tile(weight, (modes, 1, 1)).ravel() for weight in weights]

    def backwards(after: np.ndarray) -> list[np.ndarray]:
        """Sums that later steps add to L of the last, ..., the first step, and to that of the last before."""
        sums = [after]
        for k in range(steps - 1, -1, -1):
            sums.append(back[k] @ (terms[k] + sums[-1]))
        return sums

    # Around a period L before the first step is that behind the last.
    after = np.zeros(modes * n * n)
    if m.start is None:
        around = reduce(lambda product, factor: product @ factor, back)
        after = np.linalg.solve(np.eye(len(after)) - around, backwards(after)[-1])
    later = backwards(after)[:-1][::-1]
    adjoint = np.array([w + more for w, more in zip(terms, later, strict=True)]).reshape(steps, modes, n, n)
    return np.asarray(adjoint + adjoint.swapaxes(2, 3)) / 2


def lagrangian(m: ModeSystem, solution: ModeSolution) -> jax.Array:
    """sum_k,j <L, right side>, which has the error's gradient where X, K and L are fixed."""
    parts, gains, ahead = (jnp.asarray(values) for values in solution)
    earlier = jnp.roll(parts, 1, axis=0) if m.start is None else jnp.concatenate([_initial(m)[None], parts[:-1]])
    close = jnp.eye(parts.shape[-1]) - gains @ m.output
    moved = m.transition[:, None] @ earlier @ m.transition[:, None].swapaxes(2, 3)
    law = m.law[:, :, None, None]
    prior = jnp.einsum("kij,kiab->kjab", m.chain, moved) + law * m.process[:, None]
    return jnp.sum(ahead * (close @ prior @ close.swapaxes(2, 3) + law * (gains @ m.noise @ gains.swapaxes(2, 3))))
