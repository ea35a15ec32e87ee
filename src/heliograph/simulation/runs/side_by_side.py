"""Filters of one kind in parallel: stacked along axes of filters and nodes, and vmapped."""

from collections.abc import Callable
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
from heliograph.numerics.module import Module
from heliograph.numerics.types import PyTree


class StepOutput(NamedTuple):
    """Output of a filter's step: its estimate, and its smoother step and judgement if asked for.

    weighed: of a filter that judges and weighs.
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
    """Step a filter, and return its output.

    `skip`: the reason not to use z, if any: then nothing of it arrived, and where the prediction itself is no number
    the state before it stays.
    """
    # What is not used did not arrive.
    z = z if skip is None else jnp.where(skip > 0, jnp.nan, z)
    # With a smoother step, and a judgement of the same step.
    judgement, weighed = None, None
    if smooths:
        if judges:
            *_, judgement, innovation = step_with_judgement(filter, state, z, u, k)
            weighed = get_weighed(innovation)
        after, steps = filter.step_with_smoother(state, z, u, k)
        return after, StepOutput(filter.after_step(after, k), steps, judgement, weighed)
    # With a judgement, or alone.
    if judges:
        after, estimate, judgement, innovation = step_with_judgement(filter, state, z, u, k)
        weighed = get_weighed(innovation)
    else:
        after, estimate = filter.step(state, z, u, k)
    # A prediction that is no number leaves the state as it was.
    if skip is not None:
        stays, known = skip == Reason.PREDICTION, (state, filter.estimate(state))
        after, estimate = jax.tree.map(lambda old, new: jnp.where(stays, old, new), known, (after, estimate))
    return after, StepOutput(estimate, judgement=judgement, weighed=weighed)


def get_weighed(innovation: Innovation) -> Weighed | None:
    """Return the innovation by component, of a filter that weighs; None of all others."""
    if innovation.weight is None:
        return None
    return Weighed(jnp.asarray(innovation.value), jnp.diagonal(innovation.covariance), jnp.asarray(innovation.weight))


class StackedFilters(Module):
    """Filters that differ in numbers alone, stacked along one axis, node after node for each of them.

    `group`: of nodes that they belong to; `count` of filters at each of `nodes` nodes. `smooths`: each step returns its
    smoother step.
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
        """Step each filter with the nodes' measurements (node, received); outputs (filter, node, ...).

        `skip` (filter, node): reasons not to use them.
        """

        def single(
            filter: AbstractFilter, state: PyTree, z: jax.Array, skip: jax.Array | None
        ) -> tuple[PyTree, StepOutput]:
            return filter_step(filter, state, z, u, k, self.smooths, self.judges, skip)

        reasons = None if skip is None else skip.reshape(-1)
        both = map_all(single, self.count * self.nodes)
        after, known = both(self.filters, states, jnp.tile(z, (self.count, 1)), reasons)
        return after, jax.tree.map(lambda leaf: leaf.reshape(self.count, len(z), *leaf.shape[1:]), known)

    def matrices(
        self, read: Callable[..., object], states: PyTree, f: int, z: jax.Array, u: jax.Array, k: jax.Array
    ) -> PyTree:
        """Apply `read` to this step of filter f at each node, from the states before it; (node, ...)."""
        mine = slice(f * self.nodes, (f + 1) * self.nodes)
        filters, states = jax.tree.map(lambda leaf: leaf[mine] if eqx.is_array(leaf) else leaf, (self.filters, states))
        return map_all(lambda node, state, z: read(node, state, z, u, k), self.nodes)(filters, states, z)


def initial_state(filter: AbstractFilter) -> PyTree:
    """Return the state of a filter before the first step, on the device."""
    return jax.tree.map(jnp.asarray, filter.init())


def map_all(function: Callable[..., PyTree], size: int) -> Callable[..., PyTree]:
    """Vectorise a function of one of what is stacked; some hold no array from which the number could be read.

    A single one is not vectorised: its function takes half as long to trace as the same over one axis more.
    """
    if size == 1:
        return partial(_apply_to_one, function)
    over: Callable[..., PyTree] = eqx.filter_vmap(function, in_axes=eqx.if_array(0), axis_size=size)
    return over


def _apply_to_one(function: Callable[..., PyTree], *stacked: PyTree) -> PyTree:
    """Apply a function of one run to arrays that hold one run only, without the cost of `vmap`."""

    def only(leaf: PyTree) -> PyTree:
        return jax.lax.squeeze(leaf, (0,)) if eqx.is_array(leaf) else leaf

    def alone(leaf: PyTree) -> PyTree:
        return jax.lax.expand_dims(leaf, (0,)) if eqx.is_array(leaf) else leaf

    return jax.tree.map(alone, function(*jax.tree.map(only, stacked)))
