"""What a campaign keeps of each run."""

import equinox as eqx
import jax
import jax.numpy as jnp

from heliograph.model.estimate import Estimate
from heliograph.numerics.linalg import psd_solve
from heliograph.numerics.types import PyTree
from heliograph.simulation.network import Network
from heliograph.simulation.record import AbstractReducer


class Errors(AbstractReducer):
    """Keep each run's errors, claimed variances and NEES per dimension; with `world` its truth and measurements too.

    Gives a dictionary: "estimates" by node and filter, each with error and variance (run, time, n) and
    nees_per_dimension = e' P^-1 e / n (run, time); "truth" (run, time, n); "measurements" by node.
    """

    world: bool = eqx.field(static=True, default=False)

    def initial(self, shapes: PyTree) -> PyTree:
        """Nothing is summed."""
        return ()

    def reduce(self, carry: PyTree, batch: PyTree, runs: jax.Array, valid: jax.Array) -> tuple[PyTree, PyTree]:
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

    def finish(self, carry: PyTree, collected: PyTree, network: Network) -> PyTree:
        """What was collected."""
        return collected


def _errors(truth: jax.Array, estimate: Estimate) -> dict[str, jax.Array]:
    error, covariance = truth - estimate.mean, jnp.asarray(estimate.covariance)

    def squared_distance(p: jax.Array, e: jax.Array) -> jax.Array:
        return e @ psd_solve(p, e[:, None])[:, 0]

    return {
        "error": error,
        "variance": jnp.diagonal(covariance, axis1=-2, axis2=-1),
        "nees_per_dimension": jax.vmap(jax.vmap(squared_distance))(covariance, error) / error.shape[-1],
    }
