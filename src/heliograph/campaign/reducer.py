"""Reducer that keeps the errors of each run of a campaign."""

from operator import itemgetter

import equinox as eqx
import jax
import jax.numpy as jnp

from heliograph.model.estimate import Estimate
from heliograph.numerics.small_matrix import squared_distance
from heliograph.numerics.types import PyTree
from heliograph.simulation.network import Network
from heliograph.simulation.results.by_name import by_name, measurements_of
from heliograph.simulation.results.reducer import AbstractReducer, OfStep


class Errors(AbstractReducer[dict[str, PyTree]]):
    """Reducer to each run's errors, claimed variances and NEES per dimension; with `world` also truth and measurements.

    The result is a dictionary: "estimates" by node and filter, each with error and variance (run, time, n) and
    nees_per_dimension = e' P^-1 e / n (run, time); "truth" (run, time, n); "measurements" by node.
    """

    world: bool = eqx.field(static=True, default=False)

    def initial(self, shapes: PyTree) -> PyTree:
        """Return an empty carry: nothing is summed."""
        return ()

    def reduce(self, carry: PyTree, batch: PyTree, runs: jax.Array, valid: jax.Array) -> tuple[PyTree, PyTree]:
        """Collect the errors of a block."""
        recorded = {
            part: jax.tree.map(
                lambda estimate: _errors(batch["truth"], estimate),
                batch[part],
                is_leaf=lambda leaf: isinstance(leaf, Estimate),
            )
            for part in ("estimates", "fused")
        }
        if self.world:
            recorded |= {name: batch[name] for name in ("truth", "measurements")}
        return carry, recorded

    def of_step(self, step: PyTree) -> OfStep:
        """Collect the errors of a block of one run and one step."""
        block = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None, None], step)
        _, recorded = self.reduce((), block, jnp.zeros(1), jnp.ones(1, dtype=bool))
        return OfStep(collected=jax.tree.map(lambda leaf: leaf[0, 0], recorded))

    def finish(self, carry: PyTree, collected: PyTree, network: Network) -> dict[str, PyTree]:
        """Arrange the collected errors by node and filter."""
        results = {
            part: by_name(network, collected, itemgetter(part), axis)
            for part, axis in (("error", -3), ("variance", -3), ("nees_per_dimension", -2))
        }
        estimates = {
            node: {name: {part: values[node][name] for part, values in results.items()} for name in names}
            for node, names in network.claims().items()
        }
        if not self.world:
            return {"estimates": estimates}
        measurements = measurements_of(network, collected["measurements"])
        return {"estimates": estimates, "truth": collected["truth"], "measurements": measurements}


def _errors(truth: jax.Array, estimate: Estimate) -> dict[str, jax.Array]:
    mean, covariance = jnp.asarray(estimate.mean), jnp.asarray(estimate.covariance)
    error = truth.reshape(*truth.shape[:2], *[1] * (mean.ndim - 3), -1) - mean
    variance = jnp.broadcast_to(jnp.diagonal(covariance, axis1=-2, axis2=-1), error.shape)
    matrix, e = jnp.moveaxis(covariance, (-2, -1), (0, 1)), jnp.moveaxis(error, -1, 0)
    nees = squared_distance(matrix.transpose(0, 1, *range(3, matrix.ndim), 2), e.transpose(0, *range(2, e.ndim), 1))
    return {"error": error, "variance": variance, "nees_per_dimension": jnp.moveaxis(nees, -1, 0) / error.shape[-1]}
