"""How often the words of a network are overloaded before any data, and what that may do to a claim."""

from typing_extensions import TypeAliasType

from heliograph.filters.words.linear_word_filter import LinearWordsFilter
from heliograph.filters.words.overload import Overload
from heliograph.simulation.network import Network

Overloads = TypeAliasType("Overloads", dict[str, dict[str, Overload]])  # by node and filter


def find_overloads(network: object) -> Overloads:
    """Return how often words are overloaded by values beyond their range, by node and filter that takes words.

    Args:
        network: a network. The result is empty for any other model.
    """
    if not isinstance(network, Network):
        return {}
    overloads: Overloads = {}
    for name, node in network.nodes.items():
        by_filter = {
            label: filter.overload for label, filter in node.filters.items() if isinstance(filter, LinearWordsFilter)
        }
        if by_filter:
            overloads[name] = by_filter
    return overloads
