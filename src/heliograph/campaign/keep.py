"""What a campaign keeps of each run."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from heliograph.model.estimate import Estimate
from heliograph.numerics.linalg import psd_solve
from heliograph.simulation.network import Network
from heliograph.simulation.record import AbstractReducer


class Errors(AbstractReducer):
    """Keep each run's errors, claimed variances and NEES per dimension; with `world` its truth and measurements too.

    Gives a dictionary: "estimates" by node and filter, each with error and variance (run, time, n) and
    nees_per_dimension = e' B^-1 e / n (run, time); "truth" (run, time, n); "measurements" by node.
    """

    world: bool = eqx.field(static=True, default=False)

    def initial(self, shapes: Any) -> Any:
        """Nothing is summed."""
        return ()

    def reduce(self, carry: Any, batch: Any, runs: jax.Array, valid: jax.Array) -> tuple[Any, Any]:
        """Collect the block's errors."""
        kept = {
            "estimates": jax.tree.map(
                lambda estimate: _errors(batch["truth"], estimate),
                batch["estimates"],
                is_leaf=lambda leaf: isinstance(leaf, Estimate),
            )
        }
        if self.world:
            kept |= {name: batch[name] for name in ("truth", "measurements")}
        return carry, kept

    def finish(self, carry: Any, collected: Any, network: Network) -> Any:
        """What was collected."""
        return collected


def _errors(truth: jax.Array, estimate: Estimate) -> dict[str, jax.Array]:
    error, bound = truth - estimate.mean, jnp.asarray(estimate.covariance)

    def squared_distance(b: jax.Array, e: jax.Array) -> jax.Array:
        return e @ psd_solve(b, e[:, None])[:, 0]

    return {
        "error": error,
        "variance": jnp.diagonal(bound, axis1=-2, axis2=-1),
        "nees_per_dimension": jax.vmap(jax.vmap(squared_distance))(bound, error) / error.shape[-1],
    }
