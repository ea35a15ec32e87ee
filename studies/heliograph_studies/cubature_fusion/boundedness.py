"""Theorem 3's condition for a filter's covariance to stay bounded, with its margin over visited states."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

import heliograph as hg
from heliograph.numerics.check import array, scalar
from heliograph.numerics.float64 import to_numpy


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


def growth_condition(plant: hg.Plant | hg.LinearPlant, states: ArrayLike, first_scalar: float) -> GrowthCondition:
    """Evaluate the condition at visited states (count, n) of a plant without inputs.

    It uses the plant and beta_1 alone (`first_scalar`): its proof drops whatever measurements achieve, so neither
    sensor nor channel can help to meet it.

    Raises:
        ValueError: states of the wrong shape, a negative scalar.
    Source: cubature fusion under amplify-and-forward relays, Theorem 3.
    """
    visited = array("states", states, (None, len(plant.states)))
    beta = scalar("first scalar of the bound", first_scalar, 0.0)
    with jax.enable_x64(True):
        jacobians = to_numpy(jax.vmap(jax.jacfwd(lambda x: plant.transition(x, jnp.zeros(0))))(jnp.asarray(visited)))
    gains = np.linalg.norm(jacobians, 2, axis=(-2, -1)) ** 2
    worst = int(np.argmax(gains))
    return GrowthCondition(float((1 + beta) * gains[worst]), gains, visited[worst])
