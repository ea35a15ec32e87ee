"""Diagram of a network in lines or as a table: plant, nodes from sensor to filters, fusions, what is shared."""

from collections.abc import Sequence
from html import escape
from typing import NamedTuple

from heliograph.disk.quoting import visible
from heliograph.filters.base import AbstractFilter
from heliograph.model.over_time import first
from heliograph.model.relays import RelayNetwork
from heliograph.numerics.module import LINES, cut
from heliograph.random_affine.base import memories
from heliograph.simulation.description.links import ARROW, link_in_words
from heliograph.simulation.node import HasNodes, Node
from heliograph.simulation.shared_fading import memory_places

NAMED = 3  # of many nodes that are alike, how many are named


class Part(NamedTuple):
    """One line of a diagram: what it is of, and what it is."""

    name: str
    words: str


def diagram(network: HasNodes) -> list[Part]:
    """Return the parts of a network in the order in which data flow."""
    plant = first(network.plant)
    inputs = f"; inputs {', '.join(network.inputs)}" if network.inputs else ""
    parts = [Part("plant", f"{type(plant).__name__} of {', '.join(network.states)}{inputs}")]
    # Nodes that are alike share a line.
    alike: dict[str, list[str]] = {}
    for name in network.names:
        alike.setdefault(_node(network, name), []).append(name)
    parts += [Part(listed(names), words) for words, names in alike.items()]
    # Fused estimates, then what several nodes share.
    claims = network.claims().get("fused", {})
    for name, fusion in network.fused.items():
        if isinstance(fusion, AbstractFilter):
            words = f"{type(fusion).__name__} of all measurements"
        else:
            words = f"{type(fusion.rule).__name__} of {fusion.filter!r} of {listed(network.nodes_with(fusion.filter))}"
        parts.append(Part(f"fused {name}", f"{words} ({claims[name]})"))
    parts += [Part("shared", words) for words in shared(network)]
    return [Part(visible(line.name), visible(line.words)) for line in parts]


def _node(network: HasNodes, name: str) -> str:
    """Return what a node receives, through which hops, and its filters with their claims."""
    node, claims = network.nodes[name], network.claims()[name]
    filters = ", ".join(f"{label} ({claim})" for label, claim in claims.items()) or "no filter of its own"
    if isinstance(node, Node):
        return ARROW.join([", ".join(node.outputs), link_in_words(node.channel), filters])
    if network.common is not None:
        rows = network.rows()[name] + 1
        return ARROW.join([f"numbers {rows[0]} to {rows[-1]} of the common channel", filters])
    return ARROW.join([f"{node.received} numbers from {_senders(network.relays, name)}", filters])


def _senders(relays: RelayNetwork | None, name: str) -> str:
    slots = () if relays is None else relays.slots
    return listed(list(dict.fromkeys(sender for slot in slots for sender in slot.get(name, {}))))


def shared(network: HasNodes) -> list[str]:
    """Return what several nodes share, in words: a common channel, or the memory of their links."""
    if network.common is not None:
        return [f"sensor and channel of all nodes: {link_in_words(network.common.channel)}"]
    channels = {name: node.channel for name, node in network.nodes.items() if isinstance(node, Node)}
    places = memory_places(channels)
    # Nodes of each memory.
    nodes: dict[int, list[str]] = {}
    names: dict[int, str] = {}
    for name, channel in channels.items():
        for row, memory in zip(places[name].tolist(), memories(channel).values(), strict=True):
            nodes.setdefault(row, []).append(name)
            names[row] = type(memory).__name__ if memory.name is None else repr(memory.name)
    return [f"fading {names[row]}: {listed(of)}" for row, of in nodes.items() if len(of) > 1]


def listed(names: Sequence[str]) -> str:
    """Return names on a line; of many, the first few and their number."""
    if len(names) <= 2 * NAMED:
        return ", ".join(names)
    return f"{', '.join(names[:NAMED])} … ({len(names)})"


def text_of(network: HasNodes) -> str:
    """Return the whole diagram as lines of text."""
    return "\n".join(_lines(network))


def short_text_of(network: HasNodes) -> str:
    """Return the diagram in as many and as long lines as any object is shown in; … stands for what is left out."""
    lines = _lines(network)
    left = len(lines) - LINES
    lines = [*lines[: LINES - 1], f"… {left + 1} more lines (heliograph check shows all)"] if left > 0 else lines
    return "\n".join(cut(line) for line in lines)


def _lines(network: HasNodes) -> list[str]:
    parts = diagram(network)
    width = max(len(line.name) for line in parts)
    return [_title(network), *(f"{line.name:{width}}  {line.words}" for line in parts)]


def _title(network: HasNodes) -> str:
    return f"Network of {len(network.nodes)} node{'s' * (len(network.nodes) > 1)}"


def table_of(network: HasNodes) -> str:
    """Return the diagram as an HTML table, for notebooks."""
    rows = (
        f'<tr><th style="text-align:left">{escape(line.name)}</th>'
        f'<td style="text-align:left">{escape(line.words)}</td></tr>'
        for line in diagram(network)
    )
    return f"<table><caption>{_title(network)}</caption>{''.join(rows)}</table>"
