"""Which filters and fusions of a network take longer than others, and why: those by XLA, and those row by row."""

from collections.abc import Iterator

import jax
import numpy as np

from heliograph.disk.quoted_text import join_names
from heliograph.engine.choice import explain_refusal
from heliograph.filters.base import AbstractFilter
from heliograph.model.sensor import without_output_names
from heliograph.numerics.types import PyTree
from heliograph.simulation.mesh.building import DENSE, build_mesh
from heliograph.simulation.network import Network

SHOWN = 3  # of many that are refused for one reason


def explain_xla_fallbacks(network: Network) -> list[str]:
    """Return a line for each reason for which XLA computes filters in place of this library's native code.

    A line names the filters or fusions first, and then the reason.
    """
    names_by_reason: dict[str, list[str]] = {}
    for name, reason in (*_find_refused_filters(network), *_find_refused_meshes(network)):
        names_by_reason.setdefault(reason, []).append(name)
    return [f"{_join_first_names(refused)}: {reason}" for reason, refused in names_by_reason.items()]


def describe_sequential_filters(network: Network) -> str:
    """Return in words which filters go row by row however long a recording is, "" if none does.

    They are those that are not linear in their data: linear ones can be run in chunks of rows side by side.
    """
    sequential = [who for who, filter in _list_filters(network) if not filter.is_linear]
    return _join_first_names(sequential) if sequential else ""


def _list_filters(network: Network) -> Iterator[tuple[str, AbstractFilter]]:
    """Yield (description in words, filter) for each filter of the network."""
    for node in network.names:
        for label, filter in network.nodes[node].filters.items():
            yield f"filter {label!r} of node {node!r}", filter
    for label, fusion in network.fused.items():
        if isinstance(fusion, AbstractFilter):  # a filter of all nodes' measurements
            yield f"filter {label!r}", fusion


def _find_refused_filters(network: Network) -> Iterator[tuple[str, str]]:
    """Yield (name, reason) for each filter whose step native code refuses, so that XLA computes it.

    Native code is the library's own compiler of straight-line code, faster than XLA; it does not know every operation.
    The step is traced with zeros, which have the shapes of any data.
    """
    for name, filter_with_names in _list_filters(network):
        filter = without_output_names(filter_with_names)  # so that filters of one structure are compiled once
        z, u = np.zeros(filter.received), np.zeros(len(filter.inputs))
        if reason := explain_refusal(_step_filter, filter, filter.init(), z, u, np.asarray(0)):
            yield name, reason


def _step_filter(filter: AbstractFilter, *arguments: jax.Array) -> PyTree:
    """Return what one step of a filter returns for (state, z, u, k), as it would be compiled."""
    state, z, u, k = arguments
    return filter.step(state, z, u, k)


def _find_refused_meshes(network: Network) -> Iterator[tuple[str, str]]:
    """Yield (name, reason) for each fusion between neighbours whose step is too long to write out as native code.

    XLA computes it then, which takes longer to begin.
    """
    for name, fusion in network.meshes.items():
        nodes = len(network.mesh_nodes(name))
        # A rule that needs the joint covariance of all errors cannot be built for more than DENSE nodes.
        can_be_built = nodes <= DENSE or not fusion.rule.needs_joint
        if can_be_built and build_mesh(network, name).has_long_step:
            yield f"fusion {name!r}", f"between {nodes} neighbours, too many to be written out"


def _join_first_names(names: list[str]) -> str:
    """Return names in words, the first SHOWN of many and how many more there are."""
    more = len(names) - SHOWN
    return f"{', '.join(names[:SHOWN])} and {more} more" if more > 0 else join_names(names)
