"""Innovation of a fused estimate: what arrives at the nodes, less what the predicted fused estimate expects of it."""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.factors.gaussian import Gaussian, from_covariance
from heliograph.filters.gaussian.adaptive import AdaptiveBelief
from heliograph.filters.linear.belief import LinearBelief
from heliograph.filters.plausibility import innovation_distance
from heliograph.filters.smoother_step import gaussian_of, with_gaussian
from heliograph.fusion.network_fusion import Fusion
from heliograph.model.estimate import Estimate
from heliograph.model.over_time import at
from heliograph.numerics.float64 import in_float64
from heliograph.numerics.module import Module
from heliograph.numerics.types import PyTree
from heliograph.simulation.centres.fusions import find_source_filters
from heliograph.simulation.network import FUSED, Network
from heliograph.simulation.runs.side_by_side import StackedFilters

UNROLLED = 16  # nodes of a kind whose corrections are written out: more are a loop
WHOLE = Gaussian, LinearBelief, AdaptiveBelief  # states whose mean and covariance are all that is known of x


class FusedDistance(NamedTuple):
    """Squared innovation e' S^-1 e of a fused estimate, NaN where nothing arrived, and how many numbers arrived."""

    distance: jax.Array
    arrived: jax.Array


class FusedInnovation(Module):
    """Test of a fused estimate xf of covariance Pf by the measurements of the nodes whose estimates it fuses.

    From the last step's xf and Pf, e = z - H xf- with z the measurements of all nodes has the covariance
    S = H Pf- H' + R, since what was fused depends on none of their noises. Node after node: the prediction is corrected
    by the first node's filter, the result by the second's, and so on; with e_i the innovation of each and S_i its
    covariance, e' S^-1 e = sum_i e_i' S_i^-1 e_i. So each node's filter says what its sensor and channel do. If Pf is
    exact and all is Gaussian, e' S^-1 e is chi-squared; if Pf is an upper bound, so is S, and the mean is at most the
    number of values.

    Args:
        start: the plant's initial law, before the first fusion.
        sources: kind and filter of the estimates that are fused.
    """

    start: Gaussian
    sources: tuple[tuple[int, int], ...] = eqx.field(static=True)

    def step(
        self, before: Gaussian, alike: Sequence[StackedFilters], states: Sequence[PyTree], z: Sequence[jax.Array],
        u: jax.Array, k: jax.Array, skip: Sequence[jax.Array | None],
    ) -> FusedDistance:  # fmt: skip
        """Test the prediction from the fused estimate `before`, with the filters' states before step k.

        `skip`: reasons not to use a node's measurement, by kind.
        """
        # x = N(xf-, Pf-), d = 0; then for each node i: x, e_i, S_i by its correction, d += e_i' S_i^-1 e_i.
        carry: tuple[Gaussian, jax.Array, jax.Array] | None = None
        for kind, f in self.sources:
            # Arrays of each node's filter, its state and what it receives; a stack has the nodes of filter 0 first.
            stacked, reasons = alike[kind], skip[kind]
            rows = slice(f * stacked.nodes, (f + 1) * stacked.nodes)
            filters, beliefs = jax.tree.map(
                lambda a, rows=rows: a[rows] if eqx.is_array(a) else a, (stacked.filters, states[kind])
            )
            received = z[stacked.group]
            if reasons is not None:
                received = jnp.where(reasons[f][:, None] > 0, jnp.nan, received)
            numbers, static = eqx.partition(filters, eqx.is_array)
            # Prediction from the fused estimate, by the first node's model of the plant.
            if carry is None:
                head, state = jax.tree.map(lambda a: a[0], (numbers, beliefs))
                start = eqx.combine(head, static).predict(with_gaussian(state, before), u, k)
                carry = gaussian_of(start), jnp.zeros(()), jnp.zeros(())

            def correct(carry: PyTree, row: PyTree, static: PyTree = static) -> tuple[PyTree, None]:
                """Correct x by one node's filter, and add its squared innovation."""
                x, distance, arrived = carry
                numbers, prior, z_i = row
                after, innovation = eqx.combine(numbers, static).correct(with_gaussian(prior, x), z_i, k)
                more, count = innovation_distance(innovation)
                return (gaussian_of(after), distance + more, arrived + count), None

            # What else a filter's state holds, predicted; then correction by node after node.
            predict = eqx.filter_vmap(lambda node, state: node.predict(state, u, k), in_axes=(eqx.if_array(0), 0))
            by_node = numbers, predict(filters, beliefs), received
            carry, _ = jax.lax.scan(correct, carry, by_node, unroll=min(stacked.nodes, UNROLLED))
        assert carry is not None  # there is at least one node
        _, distance, arrived = carry
        return FusedDistance(jnp.where(arrived > 0, distance, jnp.nan), arrived)


def following_prior(estimate: Estimate) -> Gaussian:
    """Return the Gaussian of a fused estimate, from which the next step is predicted."""
    return from_covariance(jnp.asarray(estimate.mean), jnp.asarray(estimate.covariance))


def make_fused_innovations(network: Network, alike: Sequence[StackedFilters]) -> dict[str, FusedInnovation]:
    """Return the tests of the network's fusions of estimates, by name, where there is one.

    There is none where a filter's state is more than a mean and a covariance of the plant's states (a mixture, or past
    signals behind a link of random delay), or where a fusion claims no covariance. Nor where nodes share a channel,
    fading or relays: their measurements' noises then depend on each other.
    """
    tests: dict[str, FusedInnovation] = {}
    if network.common is not None or network.relays is not None or network.shared:
        return tests
    places, plant = network.places, at(network.plant, 0)
    claims = network.claims()
    for name, fusion in network.fused.items():
        if isinstance(fusion, Fusion) and claims[FUSED][name] != "none":
            sources, _ = find_source_filters(network, places, network.nodes_with(fusion.filter), fusion.filter)
            beliefs = [eqx.filter_eval_shape(alike[kind].init) for kind, _ in sources]
            if all(isinstance(b, WHOLE) and gaussian_of(b).mean.shape[-1] == len(network.states) for b in beliefs):
                start = in_float64(from_covariance)(
                    np.asarray(plant.initial_mean), np.asarray(plant.initial_covariance)
                )
                # NumPy arrays, so that the test is a constant and takes no device.
                tests[name] = FusedInnovation(jax.tree.map(np.asarray, start), sources)
    return tests
