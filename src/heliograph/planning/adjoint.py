"""Error covariances of the best linear filter, steady, over a period or a horizon, and their gradient by one adjoint.

With X_k = A P_{k-1} A' + Q the predicted error and J_k the information of what is heard, P_k^-1 = X_k^-1 + J_k.
For a cost sum_k <W_k, P_k> the adjoint L_k = W_k + Phi_{k+1}' L_{k+1} Phi_{k+1}, Phi_k = (I - P_k J_k) A_k, gives
  d cost = - sum_k <P_k L_k P_k, dJ_k>:
one backward recursion, or one Lyapunov equation, for however many parameters.
"""

from functools import reduce
from typing import NamedTuple

import numpy as np

from heliograph.numerics.check import fail
from heliograph.numerics.types import Float

DOUBLINGS = 60
SETTLED = 1e-16  # relative change of the fixed point by a doubling: rounding

Matrices = Float[np.ndarray, "time n n"]


class Plants(NamedTuple):
    """A and Q of each step; `start` is the error covariance before the first, None where the steps repeat for ever."""

    transition: Matrices
    process: Matrices
    start: Float[np.ndarray, "n n"] | None


class Fraction(NamedTuple):
    """The map X -> A X (I + G X)^-1 A' + H of covariances, as a step of the filter or several make it."""

    a: Float[np.ndarray, "n n"]
    g: Float[np.ndarray, "n n"]
    h: Float[np.ndarray, "n n"]


def then(first: Fraction, second: Fraction) -> Fraction:
    """One map after another: again such a map."""
    inner = np.linalg.inv(np.eye(len(first.h)) + first.h @ second.g)
    through = inner @ first.a
    g = first.g + first.a.T @ second.g @ through
    h = second.h + second.a @ inner @ first.h @ second.a.T
    return Fraction(second.a @ through, (g + g.T) / 2, (h + h.T) / 2)


def fixed(one: Fraction) -> Float[np.ndarray, "n n"]:
    """X = A X (I + G X)^-1 A' + H, the limit from X = 0, by doubling: 2^k steps after k of them.

    Raises:
        ValueError: covariances that grow without limit.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(DOUBLINGS):
            two = then(one, one)
            if not np.all(np.isfinite(two.h)):
                break
            if np.abs(two.h - one.h).max() <= SETTLED * np.abs(two.h).max():
                return two.h
            one = two
    raise fail("steady error", "one that settles (the plant is unstable in what nobody hears)", "one that grows")


def corrected(predicted: Float[np.ndarray, "n n"], information: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    """(X^-1 + J)^-1 = X (I + J X)^-1, where X may be singular."""
    after = np.linalg.solve(np.eye(len(predicted)) + predicted @ information, predicted)
    return np.asarray((after + after.T) / 2)


def covariances(plants: Plants, information: Matrices) -> Matrices:
    """P_k after what is heard at each step.

    Raises:
        ValueError: steps that repeat for ever, under which the error grows without limit.
    """
    a, q = plants.transition, plants.process
    if plants.start is None:
        steps = [Fraction(a[k], information[k - 1], q[k]) for k in (*range(1, len(a)), 0)]
        predicted = fixed(reduce(then, steps))
    else:
        predicted = a[0] @ plants.start @ a[0].T + q[0]
    found: list[np.ndarray] = []
    for k, heard in enumerate(information):
        if k:
            predicted = a[k] @ found[-1] @ a[k].T + q[k]
        found.append(corrected(predicted, heard))
    return np.array(found)


def adjoint(plants: Plants, information: Matrices, p: Matrices, weights: Matrices) -> Matrices:
    """L_k, the gradient of the cost with respect to P_k through all later steps."""
    phi = (np.eye(p.shape[-1]) - p @ information) @ plants.transition
    found = np.array(weights)
    if plants.start is None:
        found[-1] = _once_more(phi, weights)
    for k in range(len(p) - 2, -1, -1):
        found[k] += phi[k + 1].T @ found[k + 1] @ phi[k + 1]
    return found


def _once_more(phi: Matrices, weights: Matrices) -> Float[np.ndarray, "n n"]:
    """L = S + R' L R at a period's last step, R = Phi_last ... Phi_0: the Lyapunov equation, by doubling."""
    total, around = weights[-1], np.eye(phi.shape[-1])
    for k, one in enumerate(phi):
        around = one @ around
        if k + 1 < len(phi):
            total = total + around.T @ weights[k] @ around
    for _ in range(DOUBLINGS):
        more = around.T @ total @ around
        total = total + more
        if np.abs(more).max() <= SETTLED * np.abs(total).max():
            break
        around = around @ around
    return np.asarray(total)
