"""Filters of one kind in parallel: stacked along axes of filters and nodes, and vmapped."""

from collections.abc import Callable, Collection
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

from heliograph.filters.base import AbstractFilter, step_with_judgement
from heliograph.filters.innovation import Weighed
from heliograph.filters.plausibility import Judgement, Reason
from heliograph.filters.smoother_step import SmootherStep
from heliograph.model.estimate import Estimate, Innovation
from heliograph.model.over_time import stack
from heliograph.model.sensor import without_output_names
from heliograph.numerics.module import Module
from heliograph.numerics.types import PyTree
from heliograph.simulation.network import Network


class StepOutput(NamedTuple):
    """Output of a filter's step.

    Args:
        estimate: after the step.
        steps: what a smoother needs of the step; None unless asked for.
        judgement: whether the data were plausible; None unless asked for.
        weighed: the innovation by component, of a filter that judges its data and weighs components; None of others.
    """

    estimate: Estimate
    steps: SmootherStep | None = None
    judgement: Judgement | None = None
    weighed: Weighed | None = None


def filter_step(
    filter: AbstractFilter,
    state: PyTree,
    z: jax.Array,
    u: jax.Array,
    k: jax.Array,
    smooths: bool,
    judges: bool = False,
    skip: jax.Array | None = None,
) -> tuple[PyTree, StepOutput]:
    """Step a filter: return its next state, and its output.

    Args:
        filter: the filter.
        state: state of the filter before the step.
        z: measurement (received,), NaN where a component is missing.
        u: inputs of the plant over the step.
        k: number of the step.
        smooths: put out a smoother step too: what the backward pass of a smoother needs of this step.
        judges: put out a judgement too: whether the data were plausible under the prediction.
        skip: code of the reason not to use z, 0 if there is none. With a reason, z counts as not arrived; if the reason
            is that the prediction is not finite, the state before it stays. None: use z.

    Returns:
        The next state, and the estimate with what was asked for; `weighed` is the innovation by component, for a filter
        that gives unlikely components a smaller weight.
    """
    # Data that are not used count as not arrived.
    z = z if skip is None else jnp.where(skip > 0, jnp.nan, z)
    judgement, weighed = None, None
    # With a smoother step, which returns no judgement: this comes from a second step from the same state.
    if smooths:
        if judges:
            *_, judgement, innovation = step_with_judgement(filter, state, z, u, k)
            weighed = get_weighed_components(innovation)
        after, steps = filter.step_with_smoother(state, z, u, k)
        return after, StepOutput(filter.after_step(after, k), steps, judgement, weighed)
    # With a judgement, or alone.
    if judges:
        after, estimate, judgement, innovation = step_with_judgement(filter, state, z, u, k)
        weighed = get_weighed_components(innovation)
    else:
        after, estimate = filter.step(state, z, u, k)
    # A prediction that is no number leaves the state as it was.
    if skip is not None:
        stays, before = skip == Reason.PREDICTION, (state, filter.estimate(state))
        after, estimate = jax.tree.map(lambda old, new: jnp.where(stays, old, new), before, (after, estimate))
    return after, StepOutput(estimate, judgement=judgement, weighed=weighed)


def get_weighed_components(innovation: Innovation) -> Weighed | None:
    """Return value, variance and weight of each component of an innovation, or None if the filter does not weigh.

    A filter that weighs leaves out a part of what is unlikely. A weight is from 0 (left out) to 1.
    """
    if innovation.weight is None:
        return None
    variance = jnp.diagonal(innovation.covariance)
    return Weighed(jnp.asarray(innovation.value), variance, jnp.asarray(innovation.weight))


class StackedFilters(Module):
    """Filters that differ in numbers alone, stacked along one axis: filter after filter, and for each node after node.

    Args:
        filters: the stack (filter and node, ...).
        group: number of the group of nodes that they belong to.
        count: of filters at each node.
        nodes: their number.
        smooths: each step puts out a smoother step.
        judges: each step puts out a judgement of its data.
    """

    filters: AbstractFilter
    group: int = eqx.field(static=True)
    count: int = eqx.field(static=True)
    nodes: int = eqx.field(static=True)
    smooths: bool = eqx.field(static=True, default=False)
    judges: bool = eqx.field(static=True, default=False)

    def init(self) -> PyTree:
        """Return states before the first step, (filter and node, ...)."""
        return map_all(initial_state, self.count * self.nodes)(self.filters)

    def step(
        self, states: PyTree, z: jax.Array, u: jax.Array, k: jax.Array, skip: jax.Array | None = None
    ) -> tuple[PyTree, StepOutput]:
        """Step each filter: return the next states (filter and node, ...), and outputs (filter, node, ...).

        A stack holds filters of one structure at the nodes of a group, `self.count` filters at each of `self.nodes`
        nodes; all are stepped by one map.

        Args:
            states: states before the step (filter times node, ...).
            z: measurements (node, received) of the group.
            u: inputs of the plant over the step.
            k: number of the step.
            skip: codes of reasons not to use the measurements (filter, node), 0 to use them; None: use all.
        """

        def step_one(
            filter: AbstractFilter, state: PyTree, z: jax.Array, skip: jax.Array | None
        ) -> tuple[PyTree, StepOutput]:
            """Return one filter's state after step k with inputs u at one node, and the outputs of the step.

            `skip`: the number of the reason not to use z, or 0 to use it. `self.smooths`, `self.judges`: whether
            outputs for smoothing, and judgements, are wanted.
            """
            return filter_step(filter, state, z, u, k, self.smooths, self.judges, skip)

        # Join the axes of filters and nodes; each filter of a node gets the node's z.
        reasons = None if skip is None else skip.reshape(-1)
        step_all = map_all(step_one, self.count * self.nodes)
        after, outputs = step_all(self.filters, states, jnp.tile(z, (self.count, 1)), reasons)
        # Outputs get separate axes (filter, node) again.
        return after, jax.tree.map(lambda leaf: leaf.reshape(self.count, len(z), *leaf.shape[1:]), outputs)

    def compute_by_node(
        self,
        function: Callable[..., object],
        states: PyTree,
        filter_number: int,
        z: jax.Array,
        u: jax.Array,
        k: jax.Array,
    ) -> PyTree:
        """Return function(filter, state, z, u, k) of one filter at each node, with a leading axis of nodes.

        `filter_number`: the number of the filter at its node.

        `states`: states of all filters before step k. `z`: measurements (node, received).
        """
        filters, states = self.take_filter(filter_number, states)
        return map_all(lambda node, state, z: function(node, state, z, u, k), self.nodes)(filters, states, z)

    def take_filter(self, filter_number: int, states: PyTree) -> tuple[AbstractFilter, PyTree]:
        """Return filter number `filter_number` of each node and its state, both with a leading axis of nodes.

        The stack has `self.count` filters at each of `self.nodes` nodes, along one axis: the first filter of all nodes,
        then the second, and so on. `states`: states of all of them, in the same order.
        """
        begin = filter_number * self.nodes  # the stack has the first filter of all nodes, then the second, and so on
        rows = slice(begin, begin + self.nodes)

        def take_rows(leaf: PyTree) -> PyTree:
            """Return the rows of an array, anything else as it is."""
            return leaf[rows] if eqx.is_array(leaf) else leaf

        filter, state = jax.tree.map(take_rows, (self.filters, states))
        return filter, state


def initial_state(filter: AbstractFilter) -> PyTree:
    """Return the state of a filter before the first step, on the device."""
    return jax.tree.map(jnp.asarray, filter.init())


def map_all(function: Callable[..., PyTree], size: int) -> Callable[..., PyTree]:
    """Return a function of stacks of `size` rows that applies `function` to each row.

    `size` is given, since a stack may hold no array. A single row is not vectorised, which halves the time to trace.
    """
    if size == 1:
        return partial(_apply_to_one, function)
    apply: Callable[..., PyTree] = eqx.filter_vmap(function, in_axes=eqx.if_array(0), axis_size=size)
    return apply


def _apply_to_one(function: Callable[..., PyTree], *stacked: PyTree) -> PyTree:
    """Return a function's result for a stack of one, as a stack of one, without the cost of `vmap`.

    A stack is a tree whose arrays have a leading axis, here of length 1.
    """

    def drop_axis(leaf: PyTree) -> PyTree:
        """Return the only row of an array."""
        return jax.lax.squeeze(leaf, (0,)) if eqx.is_array(leaf) else leaf

    def add_axis(leaf: PyTree) -> PyTree:
        """Return an array as the only row of another."""
        return jax.lax.expand_dims(leaf, (0,)) if eqx.is_array(leaf) else leaf

    return jax.tree.map(add_axis, function(*jax.tree.map(drop_axis, stacked)))


def stack_filters(network: Network, smoothed_stacks: Collection[int], judges: bool) -> tuple[StackedFilters, ...]:
    """Return the filters of a network's nodes as stacks: filters that differ in numbers alone along one axis.

    Filters of one structure differ in numbers alone, so that one `vmap` steps them all. A group holds the nodes of one
    structure. A stack holds filters of one structure at all nodes of one group; along its axis are the first filter of
    all nodes, then the second one, and so on.

    Args:
        network: the network.
        smoothed_stacks: numbers of the stacks whose estimates are to be smoothed.
        judges: whether filters judge if their measurements are plausible.
    """
    stacks = []
    for number, index in enumerate(network.stacks):
        nodes = network.groups[index.group]
        filters = [without_output_names(network.nodes[node].filters[f]) for f in index.filters for node in nodes]
        stacks.append(
            StackedFilters(
                filters=stack(filters),
                group=index.group,
                count=len(index.filters),
                nodes=len(nodes),
                smooths=number in smoothed_stacks,
                judges=judges,
            )
        )
    return tuple(stacks)
