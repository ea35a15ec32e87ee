"""Errors where the receiver is told of modes: coupled Riccati recursions, by policy iteration if steady, and adjoints.

With T_k[i, j] = P(j at step k | i before), pi_k the law, X_k,i = E[e e' 1{i}] and a gain K_k,j of each step and mode,
  X_k,j = (I - K H) Y (I - K H)' + pi_k,j K N K',  Y_k,j = sum_i T_k,ij A X_k-1,i A' + pi_k,j Q,
and P_k = sum_j X_k,j. Given the gains this is linear; gains that are best given Y do not change the error to first
order. So with W_k the error's derivative by P_k and L_k,i = W_k + sum_l T_k+1,il F' L_k+1,l F, F = (I - K_k+1,l H) A,
the error's gradient is that of
  sum_k,j <L_k,j, right side_k,j>  at fixed X, K, L.
One mode is the Riccati equation; modes that do not remember are losses that are told. The gains depend on the mode
alone: filters that also remember which modes were before do no worse, so with modes the error is an upper bound.
"""

from functools import reduce
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.numerics.check import fail
from heliograph.numerics.types import Float
from heliograph.planning.weighing import Weighing

PLAIN, POLICIES = 400, 40  # iterations: of the recursion until its gains stabilise, of gains after that
NEAR = 1e-4  # relative change of the recursion from which gains are improved
SETTLED = 1e-14

Parts = Float[np.ndarray, "time M n n"]

Numbers = Any  # NumPy's or JAX's, as what they are made of


class Measured(NamedTuple):
    """Of each step A, Q, the chain T into it, the law pi, by mode H and N of z = H x + n, and the transmitters' powers.

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


class Settled(NamedTuple):
    """X, K and L of each step and mode."""

    parts: Parts
    gains: Float[np.ndarray, "time M n m"]
    ahead: Parts


def settled(m: Measured, weighing: Weighing) -> Settled:
    """The covariances with the best gains, and their adjoint.

    Raises:
        ValueError: an error that grows without limit, readings without any noise.
    """
    try:
        with np.errstate(over="ignore", invalid="ignore"):
            parts, gains, loops = _around(m) if m.start is None else _along(m)
    except np.linalg.LinAlgError:
        raise fail("network of a design", "readings with noise", "an innovation covariance that is singular") from None
    if not np.all(np.isfinite(parts)) or np.linalg.eigvalsh(parts).min() < -NEAR * np.abs(parts).max():
        expected = "one that settles (what is heard tells too little of an unstable plant)"
        raise fail("steady error", expected, "one that grows")
    weights = weighing.smooth(parts.sum(axis=1))[1]
    return Settled(parts, gains, _ahead(m, loops, weights))


def _along(m: Measured) -> tuple[Parts, np.ndarray, np.ndarray]:
    """From the start on: X, best gains and F of each step."""
    parts, gains = _cycle(m, _begin(m))
    return parts, gains, _loops(m, gains)


def _around(m: Measured) -> tuple[Parts, np.ndarray, np.ndarray]:
    """The same for steps that repeat for ever."""
    n, modes = m.process.shape[-1], m.law.shape[1]
    last = m.law[-1, :, None, None] * m.process[-1]
    for _ in range(PLAIN):
        parts, gains = _cycle(m, last)
        change = np.abs(parts[-1] - last).max()
        last = parts[-1]
        if not change > NEAR * np.abs(last).max():
            break
    for _ in range(POLICIES):
        loops, before = _loops(m, gains), parts
        source = _source(m, gains)
        operators = [_operator(chain, loop) for chain, loop in zip(m.chain, loops, strict=True)]
        given = reduce(lambda so_far, item: item[0] @ so_far + item[1].ravel(),
                       zip(operators, source, strict=True), np.zeros(modes * n * n))  # fmt: skip
        whole = np.eye(modes * n * n) - reduce(lambda so_far, one: one @ so_far, operators)
        x, found = np.linalg.solve(whole, given), []
        for operator, own in zip(operators, source, strict=True):
            x = operator @ x + own.ravel()
            found.append(x.reshape(modes, n, n))
        parts = (np.array(found) + np.swapaxes(found, -1, -2)) / 2
        if np.abs(parts - before).max() <= SETTLED * np.abs(parts).max():
            break
        gains = np.array([_best(m, k, parts[k - 1])[0] for k in range(len(parts))])
    return parts, gains, loops


def _begin(m: Measured) -> Float[np.ndarray, "M n n"]:
    """X before the first step, over which the chain forgets."""
    modes = m.law.shape[1]
    begin: np.ndarray = m.start[None] * (np.ones((modes, 1, 1)) / modes)
    return begin


def _cycle(m: Measured, parts: Float[np.ndarray, "M n n"]) -> tuple[Parts, np.ndarray]:
    """X and the best gains of each step, from X before the first."""
    found, gains = [], []
    for k in range(len(m.law)):
        gain, parts = _best(m, k, parts)
        found.append(parts)
        gains.append(gain)
    return np.array(found), np.array(gains)


def _best(m: Measured, k: int, parts: Float[np.ndarray, "M n n"]) -> tuple[np.ndarray, np.ndarray]:
    """Best gains of a step and X after it."""
    moved, law = m.transition[k] @ parts @ m.transition[k].T, m.law[k][:, None, None]
    before = np.einsum("ij,iab->jab", m.chain[k], moved) + law * m.process[k]
    cross = m.output[k] @ before
    total = cross @ m.output[k].swapaxes(1, 2) + np.where(law > 0, law * m.noise[k], np.eye(m.noise.shape[-1]))
    gains = np.linalg.solve(total, cross).swapaxes(1, 2)
    after = before - gains @ cross
    return gains, (after + after.swapaxes(1, 2)) / 2


def _loops(m: Measured, gains: np.ndarray) -> Parts:
    """F = (I - K H) A."""
    return np.asarray((np.eye(gains.shape[2]) - gains @ m.output) @ m.transition[:, None])


def _source(m: Measured, gains: np.ndarray) -> Parts:
    """What each step adds to X: of the plant's noise and of what is heard."""
    close = np.eye(gains.shape[2]) - gains @ m.output
    added = close @ m.process[:, None] @ close.swapaxes(2, 3) + gains @ m.noise @ gains.swapaxes(2, 3)
    return np.asarray(m.law[:, :, None, None] * added)


def _operator(chain: np.ndarray, loops: Float[np.ndarray, "M n n"]) -> Float[np.ndarray, "Mnn Mnn"]:
    """X -> (sum_i T_ij F_j X_i F_j')_j on all entries."""
    modes, n = len(chain), loops.shape[-1]
    double = np.einsum("jac,jbd->jabcd", loops, loops).reshape(modes, n * n, n * n)
    return np.asarray(np.einsum("ij,jab->jaib", chain, double).reshape(modes * n * n, modes * n * n))


def _ahead(m: Measured, loops: Parts, weights: Float[np.ndarray, "time n n"]) -> Parts:
    """L of each step: backwards from zero behind the last, or from what it is around a period."""
    steps, modes, n = len(loops), *loops.shape[1:3]
    back = [_operator(chain, loop).T for chain, loop in zip(m.chain, loops, strict=True)]
    own = [np.tile(one, (modes, 1, 1)).ravel() for one in weights]

    def cycle(after: np.ndarray) -> list[np.ndarray]:
        found = [after]  # what the first step of the next cycle asks of the last one
        for k in range(steps - 1, -1, -1):
            found.append(back[k] @ (own[k] + found[-1]))
        return found

    after = np.zeros(modes * n * n)
    if m.start is None:
        around = reduce(lambda so_far, one: so_far @ one, back)
        after = np.linalg.solve(np.eye(len(after)) - around, cycle(after)[-1])
    ahead = np.array([w + f for w, f in zip(own, cycle(after)[:-1][::-1], strict=True)]).reshape(steps, modes, n, n)
    return np.asarray(ahead + ahead.swapaxes(2, 3)) / 2


def touched(m: Measured, at: Settled) -> jax.Array:
    """sum_k,j <L, right side>: what has the error's gradient where X, K and L are held."""
    parts, gains, ahead = (jnp.asarray(part) for part in at)
    earlier = jnp.roll(parts, 1, axis=0) if m.start is None else jnp.concatenate([_begin(m)[None], parts[:-1]])
    close = jnp.eye(parts.shape[-1]) - gains @ m.output
    moved = m.transition[:, None] @ earlier @ m.transition[:, None].swapaxes(2, 3)
    law = m.law[:, :, None, None]
    before = jnp.einsum("kij,kiab->kjab", m.chain, moved) + law * m.process[:, None]
    return jnp.sum(ahead * (close @ before @ close.swapaxes(2, 3) + law * (gains @ m.noise @ gains.swapaxes(2, 3))))
