"""Whether a filter's covariance stays bounded: the published condition with its margin, and what holds instead."""

from dataclasses import dataclass
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from scipy.linalg import solve_discrete_lyapunov

from heliograph.model.plant import AbstractPlant, LinearPlant
from heliograph.numerics.check import array, fail, scalar
from heliograph.numerics.float64 import to_numpy
from heliograph.numerics.types import ArrayLike


@dataclass(frozen=True)
class GrowthCondition:
    """Theorem 3's condition for one plant over the states that it visits.

    The theorem wants theta = (1 + b) ((1 + eps) a v + (1 + 1/eps) n_x n v m + chi) <= v for some v, eps > 0, where
    a >= sigma_max(J)^2 at every state, J = df/dx, and all other terms are positive. So it can be met only if
    factor = (1 + b) a < 1, the limit eps -> 0.

    factor: (1 + b) max sigma_max(J)^2. gains (state,): sigma_max(J)^2 at each state. worst_state: where it is largest.
    """

    factor: float
    gains: np.ndarray
    worst_state: np.ndarray

    @property
    def satisfiable(self) -> bool:
        """Whether the condition can be met at all."""
        return self.factor < 1

    @property
    def excess(self) -> float:
        """By how much it fails: factor - 1; negative where it can be met."""
        return self.factor - 1


@dataclass(frozen=True)
class Ceiling:
    """A largest eigenvalue of a filter's covariance, and what it rests on.

    kind: "provable" holds for every step and any data; "empirical" is the largest that occurred, and proves nothing
    about other runs or later steps. step: where it occurred; None for a limit.
    """

    value: float
    kind: Literal["provable", "empirical"]
    reason: str
    step: int | None = None


def growth_condition(
    plant: AbstractPlant, states: ArrayLike, first_scalar: float = 0.0, inputs: ArrayLike | None = None
) -> GrowthCondition:
    """Evaluate the published condition of uniform boundedness at visited states.

    The condition uses the plant and beta_1 alone (`first_scalar`): its proof drops whatever measurements achieve, so
    neither sensor nor channel can help to meet it.

    Shapes: states (count, n), inputs (count, inputs).

    Raises:
        ValueError: states or inputs of the wrong shape, a negative scalar.
    Source: cubature fusion under amplify-and-forward relays, Theorem 3.
    """
    visited = array("states", states, (None, len(plant.states)))
    count = len(visited)
    if count == 0:
        raise fail("states", "at least one state", "none")
    given = np.zeros((count, 0)) if inputs is None else inputs
    u = array("inputs", given, (count, len(plant.inputs)))
    beta = scalar("first scalar of the bound", first_scalar, 0.0)
    with jax.enable_x64(True):
        jacobians = to_numpy(jax.vmap(jax.jacfwd(plant.transition))(jnp.asarray(visited), jnp.asarray(u)))
    gains = np.linalg.norm(jacobians, 2, axis=(-2, -1)) ** 2
    worst = int(np.argmax(gains))
    return GrowthCondition(float((1 + beta) * gains[worst]), gains, visited[worst])


def provable_ceiling(plant: LinearPlant, initial_covariance: ArrayLike, first_scalar: float = 0.0) -> Ceiling:
    """A ceiling that a linear plant's filter never exceeds, whatever it measures.

    The update subtracts a positive matrix from (1 + b) P^-, so the claimed covariance stays below
    S+ = (1 + b) (A S A' + R), S_0 = its start; this converges where (1 + b) rho(A)^2 < 1, rho the spectral radius.
    The ceiling is the largest eigenvalue on the way there. It holds for fixed scalars, the first of them b.

    Shapes: initial_covariance (n, n), the filter's own.

    Raises:
        ValueError: a plant whose (1 + b) rho(A)^2 is not below 1, a negative scalar, a covariance of the wrong shape.
    Source: the step (42) of Theorem 3 without the norms that follow it.
    """
    a, n = np.asarray(plant.matrix), len(plant.states)
    beta = float(scalar("first scalar of the bound", first_scalar, 0.0))
    start = array("initial covariance", initial_covariance, (n, n))
    growth = float((1 + beta) * np.max(np.abs(np.linalg.eigvals(a))) ** 2)
    if growth >= 1:
        raise fail("plant", "(1 + beta) times the squared spectral radius below 1", f"{growth:.6g}")
    with jax.enable_x64(True):
        noise = to_numpy(plant.noise_covariance(jnp.zeros(len(plant.inputs))))
    limit = solve_discrete_lyapunov(np.sqrt(1 + beta) * a, (1 + beta) * noise)
    return Ceiling(
        _largest_on_the_way(a, noise, beta, start, limit),
        "provable",
        f"(1 + beta) rho^2 = {growth:.4g} < 1: (1 + beta) (A S A' + R) converges and dominates the filter's covariance",
    )


def _largest_on_the_way(a: np.ndarray, noise: np.ndarray, beta: float, start: np.ndarray, limit: np.ndarray) -> float:
    """Largest eigenvalue of S_k over all k: iterate until what is left of the start is below rounding."""
    s, largest, end = start, float(np.linalg.norm(start, 2)), float(np.linalg.norm(limit, 2))
    while np.linalg.norm(s - limit, 2) > 1e-12 * end:
        s = (1 + beta) * (a @ s @ a.T + noise)
        largest = max(largest, float(np.linalg.norm(s, 2)))
    return max(largest, end)


def empirical_ceiling(covariances: ArrayLike, what: str = "covariance") -> Ceiling:
    """The largest eigenvalue that occurred in a sequence of covariances, claimed or actual, (time, n, n).

    Raises:
        ValueError: an array of the wrong shape, or numbers that are not finite.
    Source: none; it takes the place of Theorem 3 where that does not apply, and proves nothing.
    """
    values = np.linalg.eigvalsh(array(what, covariances, (None, None, None)))[:, -1]
    step = int(np.argmax(values))
    return Ceiling(float(values[step]), "empirical", f"largest {what} over {len(values)} steps of the runs", step)
