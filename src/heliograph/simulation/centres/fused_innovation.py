"""Innovation of a fused estimate: what arrives at the nodes, less what the predicted fused estimate expects of it."""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.factors.factored_gaussian import Gaussian, from_covariance
from heliograph.filters.base import AbstractFilter
from heliograph.filters.gaussian.adaptive import AdaptiveBelief
from heliograph.filters.linear.linear_filter_state import LinearBelief
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
from heliograph.simulation.runs.stacked_filters import StackedFilters

UNROLLED = 16  # nodes of a stack whose corrections are written out: more are a loop
WHOLE = Gaussian, LinearBelief, AdaptiveBelief  # states whose mean and covariance are all that is known of x


class FusedSquaredInnovation(NamedTuple):
    """Squared innovation e' S^-1 e of a fused estimate, NaN where nothing arrived, and how many numbers arrived."""

    distance: jax.Array
    arrived: jax.Array


class _CorrectedEstimate(NamedTuple):
    """The fused estimate x, predicted and corrected by some nodes.

    distance: sum of their e_i' S_i^-1 e_i. arrived: how many numbers they received.
    """

    x: Gaussian
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
        sources: (stack, number within the stack) of the filters whose estimates are fused.
    """

    start: Gaussian
    sources: tuple[tuple[int, int], ...] = eqx.field(static=True)

    def step(
        self, before: Gaussian, stacks: Sequence[StackedFilters], states: Sequence[PyTree], z: Sequence[jax.Array],
        u: jax.Array, k: jax.Array, skip: Sequence[jax.Array | None],
    ) -> FusedSquaredInnovation:  # fmt: skip
        """Return e' S^-1 e of the fused estimate `before`, predicted over step k, by the measurements of that step.

        e are the innovations of all nodes' measurements and S is their covariance under the fused estimate: the sum
        tests whether the fused estimate's claimed covariance holds. It is summed node by node, each correcting the
        estimate for the next. Filters that differ in numbers alone are stacked in
        arrays; `self.sources` lists (stack, number of the filter in it) for each group of nodes that is fused.

        Args:
            before: the fused estimate after step k - 1.
            stacks: the nodes' filters, those of one structure stacked.
            states: the states of these filters before step k, by stack.
            z: measurements (node, received) by group of nodes, NaN where one is missing.
            u: inputs of the plant over the step.
            k: number of the step.
            skip: by stack, codes of the reason not to use a node's measurement (filter, node), 0 where it is used; None
                where all are.
        """
        corrected: _CorrectedEstimate | None = None
        for stack, f in self.sources:
            stacked, reasons = stacks[stack], skip[stack]
            filters, beliefs = stacked.take_filter(f, states[stack])
            received = z[stacked.group]
            # A measurement that is not used becomes NaN, which counts as missing.
            if reasons is not None:
                received = jnp.where(reasons[f][:, None] > 0, jnp.nan, received)
            # x = N(xf-, Pf-): predicted from the fused estimate, by the first node's model of the plant.
            if corrected is None:
                x = _predict_by_first(filters, beliefs, before, u, k)
                corrected = _CorrectedEstimate(x, jnp.zeros(()), jnp.zeros(()))
            corrected = _correct_in_turn(corrected, filters, beliefs, received, u, k)
        assert corrected is not None  # there is at least one node
        # Where nothing arrived there is nothing to test: NaN.
        return FusedSquaredInnovation(jnp.where(corrected.arrived > 0, corrected.distance, jnp.nan), corrected.arrived)


def _predict_by_first(
    filters: AbstractFilter, states: PyTree, estimate: Gaussian, u: jax.Array, k: jax.Array
) -> Gaussian:
    """Return `estimate` predicted over step k by the first of some stacked filters.

    All filters have the same plant, so any of them predicts the same.

    `states`: the filters' states, stacked too. The estimate replaces the one in the first state.
    """
    arrays, static = eqx.partition(filters, eqx.is_array)
    first_arrays, state = jax.tree.map(lambda leaf: leaf[0], (arrays, states))
    first_filter: AbstractFilter = eqx.combine(first_arrays, static)
    prior: Gaussian = gaussian_of(first_filter.predict(with_gaussian(state, estimate), u, k))
    return prior


def _correct_in_turn(
    corrected: _CorrectedEstimate,
    filters: AbstractFilter,
    states: PyTree,
    received: jax.Array,
    u: jax.Array,
    k: jax.Array,
) -> _CorrectedEstimate:
    """Return the fused estimate x, corrected by these nodes' measurements too, with their innovations in the sums.

    The nodes' filters correct x one after another. The sum of squares e' S^-1 e tests the fused estimate: if its
    covariance is right, it is the number of values that arrived, on average.

    Args:
        corrected: x, the sum of squares and the number of values, over the nodes before.
        filters: one filter of each node, stacked.
        states: states of the filters before the step; what they hold beside x, each filter predicts itself.
        received: measurements (node, received).
        u: inputs of the plant over the step.
        k: number of the step.
    """
    # The scan goes over the filters' arrays; what is not an array is the same in all of them.
    numbers, static = eqx.partition(filters, eqx.is_array)

    def correct(before: _CorrectedEstimate, row: tuple[PyTree, PyTree, jax.Array]) -> tuple[_CorrectedEstimate, None]:
        """Return the fused estimate x corrected by one node's filter, with its squared innovation e' S^-1 e added.

        `row`: the arrays of the node's filter, its predicted state, and the node's measurement. `static` is the rest of
        the filter.
        """
        filter_arrays, prior, z = row
        filter = eqx.combine(filter_arrays, static)
        after, innovation = filter.correct(with_gaussian(prior, before.x), z, k)
        distance, arrived = innovation_distance(innovation)
        return _CorrectedEstimate(gaussian_of(after), before.distance + distance, before.arrived + arrived), None

    predict = eqx.filter_vmap(lambda node, state: node.predict(state, u, k), in_axes=(eqx.if_array(0), 0))
    by_node = numbers, predict(filters, states), received
    corrected, _ = jax.lax.scan(correct, corrected, by_node, unroll=min(len(received), UNROLLED))
    return corrected


def following_prior(estimate: Estimate) -> Gaussian:
    """Return the Gaussian of a fused estimate, from which the next step is predicted."""
    return from_covariance(jnp.asarray(estimate.mean), jnp.asarray(estimate.covariance))


def make_fused_innovations(network: Network, stacks: Sequence[StackedFilters]) -> dict[str, FusedInnovation]:
    """Return the test of each fusion of estimates in the network, by name; `stacks`: its filters, stacked.

    There is none where a filter's state is more than a mean and a covariance of the plant's states (a mixture, or past
    signals behind a link of random delay), or where a fusion claims no covariance. Nor where nodes share a channel,
    fading or relays: their measurements' noises then depend on each other.
    """
    tests: dict[str, FusedInnovation] = {}
    if network.common is not None or network.relays is not None or network.shared:
        return tests
    indices_by_filter, plant = network.estimate_indices, at(network.plant, k=0)
    claims = network.claims()
    for name, fusion in network.fused.items():
        if isinstance(fusion, Fusion) and claims[FUSED][name] != "none":
            sources, _ = find_source_filters(
                network, indices_by_filter, network.nodes_with(fusion.filter), fusion.filter
            )
            if all(_is_gaussian_of_states(stacks[stack], len(network.states)) for stack, _ in sources):
                start = in_float64(from_covariance)(
                    np.asarray(plant.initial_mean), np.asarray(plant.initial_covariance)
                )
                # NumPy arrays, so that the test is a constant and takes no device.
                tests[name] = FusedInnovation(jax.tree.map(np.asarray, start), sources)
    return tests


def _is_gaussian_of_states(stacked: StackedFilters, n: int) -> bool:
    """Return whether the filters' states are a mean and a covariance of the plant's n states, and no more."""
    state = eqx.filter_eval_shape(stacked.init)  # its shapes alone
    return isinstance(state, WHOLE) and gaussian_of(state).mean.shape[-1] == n
