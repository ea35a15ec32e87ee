"""Filters of a network with all that depends on no data computed beforehand: covariances and gains of linear ones."""

from dataclasses import replace
from typing import cast

import equinox as eqx
import jax
import numpy as np

from heliograph.engine.choice import choose_code, compute_once, map_arrays
from heliograph.filters.base import AbstractFilter
from heliograph.numerics.float64 import quickly_compiled, to_numpy
from heliograph.numerics.types import Array, Float, PyTree
from heliograph.simulation.network_filters import AllFilters
from heliograph.simulation.runs.stacked_filters import StackedFilters, map_all
from heliograph.smoothing.forward_and_backward_pass import plan_with_smoother_steps


def precompute_filters(filters: AllFilters, u: Float[Array, "horizon inputs"]) -> AllFilters:
    """Return the filters with everything that depends on no data, such as gains, computed ahead for the inputs u.

    Gains do not depend on data only where no measurement is ever missing. Nodes that differ in numbers alone are a
    group, and `filters.complete` says of each group whether that is so. Central filters need it of all groups, since
    they receive the measurements of all nodes.
    """
    # The nodes' filters, of one structure in each stack; then the central filters, by name.
    stacks = [_precompute_stack(stack, u) if filters.complete[stack.group] else stack for stack in filters.stacks]
    central_filters = filters.central if all(filters.complete) else {}
    precomputed = {
        name: compute_once(_precompute_filter, _precompute_by_xla, (filter, u, filters.smooths))
        for name, filter in central_filters.items()
    }
    # A copy of all filters with these two fields replaced.
    changed = eqx.tree_at(lambda f: (f.stacks, f.central), filters, (tuple(stacks), filters.central | precomputed))
    return cast(AllFilters, to_numpy(changed))


def _precompute_stack(stacked: StackedFilters, u: Array) -> StackedFilters:
    """Return a stack of filters with everything that depends on no data computed ahead, for the inputs u.

    One program computes all filters: this library's native code, or XLA if native code refuses them.
    """
    count = stacked.count * stacked.nodes  # of filters in the stack
    arguments = stacked.filters, u, stacked.smooths
    with jax.enable_x64(True):
        # Native code runs once for each filter, as it does elsewhere for each run.
        choice = choose_code(_precompute_filter, arguments, differs_by_run=(True, False, False))
        if choice.code is None:
            return replace(stacked, filters=to_numpy(_precompute_all_by_xla(*arguments, count)))
    # A result that is the same for all filters was computed once, and is repeated for each filter.
    planned = map_arrays(lambda leaf: np.broadcast_to(leaf, (count, *leaf.shape[1:])), choice.results())
    return replace(stacked, filters=planned)


def _precompute_filter(filter: AbstractFilter, u: Array, smooths: bool) -> AbstractFilter:
    """Return a filter with its gains computed for inputs u, and with its smoother's gains if it `smooths`."""
    return plan_with_smoother_steps(filter, u) if smooths else filter.planned(u)


_precompute_by_xla = quickly_compiled(_precompute_filter)


@quickly_compiled
def _precompute_all_by_xla(filters: AbstractFilter, u: Array, smooths: bool, count: int) -> PyTree:
    """Return `count` stacked filters, each with its gains computed for inputs u."""
    return map_all(lambda filter: _precompute_filter(filter, u, smooths), count)(filters)


def can_precompute(filters: AllFilters) -> bool:
    """Return whether some filter has anything to precompute.

    Looked at are the stacked filters of the nodes, and those of all measurements. `AbstractFilter.planned` returns the
    filter itself; a class with gains that depend on no data overrides it, to return the filter with these gains
    computed.
    """
    all_filters = [*(stacked.filters for stacked in filters.stacks), *filters.central.values()]
    return any(type(filter).planned is not AbstractFilter.planned for filter in all_filters)
