"""Central filter of several nodes: one prediction, then their measurements one after another."""

from collections.abc import Sequence
from dataclasses import replace
from operator import itemgetter

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.factors.factored_gaussian import Gaussian
from heliograph.filters.base import (
    AbstractSizedFilter,
    FilterAngles,
    Step,
    corrects,
    estimates,
    make_sizes,
    predicts,
)
from heliograph.filters.gaussian.gaussian import GaussianFilter
from heliograph.filters.gaussian.gaussian_prediction import smoother_step_by_transform
from heliograph.filters.smoother_step import SmootherStep, StepTrace
from heliograph.model.assumed.agreement import join_assumed
from heliograph.model.assumed.assumed_model import with_assumed
from heliograph.model.estimate import Claim, Estimate, Innovation, weakest
from heliograph.model.over_time import have_same_structure, stack
from heliograph.numerics.check import fail, instance, items
from heliograph.numerics.float64 import in_float64
from heliograph.numerics.types import ArrayLike, PyTree


class SequentialFilter(AbstractSizedFilter):
    """Predict with the first node's filter, then correct with each node's in turn; z is the nodes' measurements joined.

    The posterior of one node is the prior of the next. Behind uncertain gains the first correction is not a conditional
    mean, so a next one that assumes E[e yhat'] = 0 (`ZeroMean`) is no bound: the claim is "nominal" unless every part
    is exact. The innovations are those of node after node, each given the nodes before it: the covariance has a block
    for each, and the log-likelihood is their sum, which is that of all.
    """

    filters: tuple[GaussianFilter, ...]

    def angles_used(self) -> FilterAngles:
        """Return the angles of the plant, and those of all nodes' measurements, one after another."""
        # Index of each node's first number in z, which joins the nodes' measurements.
        starts = np.cumsum([0, *(filter.received for filter in self.filters)]).tolist()[:-1]
        angles_by_node = [filter.angles_used() for filter in self.filters]
        received = [start + i for start, angles in zip(starts, angles_by_node, strict=True) for i in angles.received]
        return FilterAngles(angles_by_node[0].states, tuple(received))

    @in_float64
    def init(self) -> Gaussian:
        """Return the Gaussian of x before any data: the first node's, as all nodes observe one plant."""
        return self.filters[0].init()

    @predicts
    def predict(self, state: Gaussian, u: ArrayLike = (), k: Step = 0) -> Gaussian:
        """Predict x over one step with the first node's filter; all nodes observe the same plant."""
        return self.filters[0].predict(state, u, k)

    @corrects
    def correct(self, state: Gaussian, z: ArrayLike, k: Step = 0) -> tuple[Gaussian, Innovation]:
        """Correct with each node's measurement in turn: the posterior of one node is the prior of the next.

        z holds the measurements of all nodes, one after another. The innovations are joined likewise.
        """
        z = jnp.asarray(z)
        if all(have_same_structure(filter, self.filters[0]) for filter in self.filters):
            return self._correct_in_one_loop(state, z, k)
        # Filters of different structure cannot be stacked, so each corrects by itself.
        # ends: index behind each node's last number.
        ends, innovations = np.cumsum([filter.received for filter in self.filters]), []
        for filter, received in zip(self.filters, jnp.split(z, ends[:-1]), strict=True):
            state, innovation = filter.correct(state, received, k)
            innovations.append(innovation)
        return state, _join_innovations(innovations)

    def _correct_in_one_loop(self, state: Gaussian, z: jax.Array, k: Step) -> tuple[Gaussian, Innovation]:
        """Correct with the measurement of node after node, as `correct` does, by one loop over the nodes.

        The filters of all nodes have the same structure here and differ only in their arrays, so that the loop's body
        is compiled once. `z` joins measurements of equal length.
        """
        # `arrays`: what differs from node to node, stacked; `rest`: what all filters share.
        arrays, rest = eqx.partition(stack(self.filters), eqx.is_array)

        def correct(belief: Gaussian, node: tuple[PyTree, jax.Array]) -> tuple[Gaussian, Innovation]:
            """Correct with one node's measurement, by its filter's arrays and `rest`, which all filters share."""
            arrays_of_node, measurement = node
            filter_of_node: GaussianFilter = eqx.combine(arrays_of_node, rest)
            return filter_of_node.correct(belief, measurement, k)

        nodes = len(self.filters)
        state, innovations = jax.lax.scan(correct, state, (arrays, z.reshape(nodes, -1)))
        return state, _join_innovations([jax.tree.map(itemgetter(i), innovations) for i in range(nodes)])

    @estimates
    def estimate(self, state: Gaussian) -> Estimate:
        """Return the mean and covariance of x, with this filter's claim instead of that of the first node's filter."""
        posterior = self.filters[0].estimate(state)
        return Estimate(posterior.mean, posterior.covariance, self.claim)

    def smoother_step(self, step: StepTrace) -> SmootherStep:
        """Return what a backward pass needs of a step: the prediction is the first node's, `step.after` all nodes'."""
        return replace(smoother_step_by_transform(self.filters[0], step, self.filters[0]), claim=self.claim)


def _join_innovations(innovations: Sequence[Innovation]) -> Innovation:
    """Return one innovation of all nodes' measurements, from each node's innovation given the nodes before it.

    The log likelihoods add up. The covariance between nodes is 0, since each innovation is given the nodes before it.
    """
    covariance = jax.scipy.linalg.block_diag(*(innovation.covariance for innovation in innovations))
    total = jnp.sum(jnp.stack([jnp.asarray(innovation.log_likelihood) for innovation in innovations]))
    return Innovation(jnp.concatenate([innovation.value for innovation in innovations]), covariance, total)


def sequential_filter(filters: Sequence[GaussianFilter]) -> SequentialFilter:
    """Return the central filter made of single nodes' `filters`, in the order of the network's nodes.

    The central filter has all nodes' measurements. At each step it predicts once, then the filter of each node corrects
    the estimate by that node's measurement, one after another.

    Claim: "exact" if the covariances of all nodes' filters are, else "nominal".

    Args:
        filters: one Gaussian filter (cubature, extended, ...) for each node, of one plant.

    Raises:
        ValueError: no filters, or filters of different state dimensions.

    Source: cubature fusion under amplify-and-forward relays, Section I (centralised fusion, the reference).
    """
    nodes = tuple(items("sequential filter", filters, "filters"))
    for filter in nodes:
        instance("sequential filter", filter, GaussianFilter, "filters of single nodes (cubature, extended, ...)")
    # All must estimate the same plant: as many states and inputs, and the same states are angles.
    sizes = [(len(filter.states), len(filter.inputs)) for filter in nodes]
    if len(set(sizes)) != 1:
        raise fail("sequential filter", "filters of as many states and inputs each", sizes)
    angles = {filter.angles_used().states for filter in nodes}
    if len(angles) != 1:
        raise fail("sequential filter", "filters of one plant, whose angles are the same states", sorted(angles))
    # A covariance that bounds the error after one node's correction need not do so after the next one's. So any claim
    # weaker than "exact" becomes "nominal".
    claim: Claim = "exact" if weakest([filter.claim for filter in nodes]) == "exact" else "nominal"
    central = SequentialFilter(filters=nodes, **make_sizes(claim, nodes[0], sum(filter.received for filter in nodes)))
    # The models (plant, sensor, channel) under which the claim holds need those of every node.
    assumed_models = [filter.assumed for filter in nodes if filter.assumed is not None]
    return with_assumed(central, join_assumed(assumed_models) if len(assumed_models) == len(nodes) else None)
