"""Error covariances of the best linear filter in information form, and their gradient by one adjoint recursion.

With the predicted covariance X_k = A P_{k-1} A' + Q and the information J_k of what is received at step k,
P_k^-1 = X_k^-1 + J_k. For a cost sum_k <W_k, P_k> the adjoint L_k = W_k + Phi_{k+1}' L_{k+1} Phi_{k+1} with
Phi_k = (I - P_k J_k) A_k gives
    d cost = - sum_k <P_k L_k P_k, dJ_k>:
one backward recursion, or one Lyapunov equation, for any number of parameters.
"""

from functools import reduce
from typing import NamedTuple

import numpy as np

from heliograph.numerics.check import fail
from heliograph.numerics.types import Float

DOUBLINGS = 60
CONVERGED = 1e-16  # relative change of the fixed point by a doubling: rounding

Matrices = Float[np.ndarray, "time n n"]


class Plants(NamedTuple):
    """A and Q of each step; `start` is the error covariance before the first, None where the steps repeat for ever."""

    transition: Matrices
    process: Matrices
    start: Float[np.ndarray, "n n"] | None


class RiccatiMap(NamedTuple):
    """Map X -> A X (I + G X)^-1 A' + H of predicted covariances over one step of the filter, or over several."""

    a: Float[np.ndarray, "n n"]
    g: Float[np.ndarray, "n n"]
    h: Float[np.ndarray, "n n"]


def compose(first: RiccatiMap, second: RiccatiMap) -> RiccatiMap:
    """Composition of two such maps, the first applied first: again such a map."""
    inner = np.linalg.inv(np.eye(len(first.h)) + first.h @ second.g)
    through = inner @ first.a
    g = first.g + first.a.T @ second.g @ through
    h = second.h + second.a @ inner @ first.h @ second.a.T
    return RiccatiMap(second.a @ through, (g + g.T) / 2, (h + h.T) / 2)


def fixed_point(step: RiccatiMap) -> Float[np.ndarray, "n n"]:
    """Limit of X = A X (I + G X)^-1 A' + H from X = 0, by doubling: 2^k steps after k of them.

    Raises:
        ValueError: covariances that grow without limit.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(DOUBLINGS):
            twice = compose(step, step)
            if not np.all(np.isfinite(twice.h)):
                break
            if np.abs(twice.h - step.h).max() <= CONVERGED * np.abs(twice.h).max():
                return twice.h
            step = twice
    raise fail("steady error", "one that converges (the plant is unstable in a state that nobody receives)", "growth")


def updated(predicted: Float[np.ndarray, "n n"], information: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    """Posterior covariance (X^-1 + J)^-1 = X (I + J X)^-1, where X may be singular."""
    after = np.linalg.solve(np.eye(len(predicted)) + predicted @ information, predicted)
    return np.asarray((after + after.T) / 2)


def covariances(plants: Plants, information: Matrices) -> Matrices:
    """Posterior covariance P_k of each step under the information received at each step.

    Raises:
        ValueError: steps that repeat for ever, under which the error grows without limit.
    """
    a, q = plants.transition, plants.process
    # Predicted covariance of the first step: fixed point over the period, or from the start.
    if plants.start is None:
        steps = [RiccatiMap(a[k], information[k - 1], q[k]) for k in (*range(1, len(a)), 0)]
        predicted = fixed_point(reduce(compose, steps))
    else:
        predicted = a[0] @ plants.start @ a[0].T + q[0]
    # The recursion through the steps.
    result: list[np.ndarray] = []
    for k, received in enumerate(information):
        if k:
            predicted = a[k] @ result[-1] @ a[k].T + q[k]
        result.append(updated(predicted, received))
    return np.array(result)


def adjoint(plants: Plants, information: Matrices, p: Matrices, weights: Matrices) -> Matrices:
    """Adjoint L_k, the gradient of the cost with respect to P_k through all later steps."""
    phi = (np.eye(p.shape[-1]) - p @ information) @ plants.transition
    result = np.array(weights)
    if plants.start is None:
        result[-1] = _around_period(phi, weights)
    for k in range(len(p) - 2, -1, -1):
        result[k] += phi[k + 1].T @ result[k + 1] @ phi[k + 1]
    return result


def _around_period(phi: Matrices, weights: Matrices) -> Float[np.ndarray, "n n"]:
    """L = S + R' L R at a period's last step, R = Phi_last ... Phi_0: the Lyapunov equation, by doubling."""
    total, product = weights[-1], np.eye(phi.shape[-1])
    for k, factor in enumerate(phi):
        product = factor @ product
        if k + 1 < len(phi):
            total = total + product.T @ weights[k] @ product
    for _ in range(DOUBLINGS):
        more = product.T @ total @ product
        total = total + more
        if np.abs(more).max() <= CONVERGED * np.abs(total).max():
            break
        product = product @ product
    return np.asarray(total)
