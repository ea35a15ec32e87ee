"""Diagram of a network in lines or as a table: plant, nodes from sensor to filters, channels in words, fusions."""

from collections.abc import Mapping
from html import escape
from typing import NamedTuple

from heliograph.disk.quoted_text import join_names, visible
from heliograph.filters.base import AbstractFilter
from heliograph.model.channel import Channel
from heliograph.model.over_time import OverTime, first
from heliograph.model.relays import RelayNetwork
from heliograph.numerics.module import LINES, cut
from heliograph.numerics.numpy_or_jax import describe_rounded, is_traced
from heliograph.random_affine.composite import ARROW, DIRECT
from heliograph.random_affine.memories_of_channels import memories
from heliograph.simulation.covariance_claims import yield_mistaken_beliefs
from heliograph.simulation.description.rounded_to_single import find_rounded_parts
from heliograph.simulation.node import FUSED, HasNodes, Node
from heliograph.simulation.transmission.channel_draws import number_memory_seeds


class DiagramLine(NamedTuple):
    """One line of a diagram: what it is of, and what it is."""

    name: str
    words: str


def list_diagram_lines(network: HasNodes) -> list[DiagramLine]:
    """Return a line for each part of a network, in the order in which data flow: from the plant to fused estimates.

    Nodes that are described in the same words share a line. Estimates come with their claims, what their covariances
    are said to be: exact, an upper bound or nominal.
    """
    plant = first(network.plant)
    inputs = f"; inputs {', '.join(network.inputs)}" if network.inputs else ""
    parts = [DiagramLine("plant", f"{type(plant).__name__} of {', '.join(network.states)}{inputs}")]
    claims = claims_in_words(network)
    # Nodes that are alike share a line.
    names_by_words: dict[str, list[str]] = {}
    for name in network.names:
        names_by_words.setdefault(_describe_node(network, name, claims[name]), []).append(name)
    parts += [DiagramLine(join_names(names), words) for words, names in names_by_words.items()]
    # Fused estimates.
    for name, fusion in network.fused.items():
        if isinstance(fusion, AbstractFilter):
            words = f"{type(fusion).__name__} of all measurements"
        else:
            nodes = join_names(network.nodes_with(fusion.filter))
            words = f"{type(fusion.rule).__name__} of {fusion.filter!r} of {nodes}"
        parts.append(DiagramLine(f"fused {name}", f"{words} ({claims[FUSED][name]})"))
    # What several nodes share, and numbers that lost digits.
    parts += [DiagramLine("shared", words) for words in list_shared_in_words(network)]
    parts += [DiagramLine("digits", words) for words in list_rounded_numbers(network)]
    return [DiagramLine(visible(line.name), visible(line.words)) for line in parts]


def claims_in_words(network: HasNodes) -> dict[str, dict[str, str]]:
    """Return the claim of each estimate by node and filter, and which of its models differ from the node's own.

    A claim says what a covariance is: exact, an upper bound, nominal, or none. An entry is such as "nominal, believes
    another channel".
    """
    words: dict[str, dict[str, str]] = {node: dict(by_name) for node, by_name in network.claims().items()}
    for belief in yield_mistaken_beliefs(network):
        words[belief.node][belief.filter] += f", believes {belief.another}"
    return words


def _describe_node(network: HasNodes, name: str, claims: Mapping[str, str]) -> str:
    """Return in words what a node receives, over which hops, and its filters with their claims.

    A node receives its own sensor's signal, rows of a channel that all nodes share (`network.common`), or what relays
    send. `claims`: by name of the filter.
    """
    node = network.nodes[name]
    filters = ", ".join(f"{label} ({claim})" for label, claim in claims.items()) or "no filter of its own"
    if isinstance(node, Node):  # it has a sensor and a channel of its own
        return ARROW.join([", ".join(node.outputs), link_in_words(node.channel), filters])
    if network.common is not None:
        rows = network.rows[name]
        return ARROW.join([f"numbers {rows.start + 1} to {rows.stop} of the common channel", filters])
    return ARROW.join([f"{node.received} numbers from {_list_senders(network.relays, name)}", filters])


def _list_senders(relays: RelayNetwork | None, name: str) -> str:
    """Return in words who sends to a node in any slot, a turn of the relays' schedule: {listener: {sender: hop}}."""
    senders: list[str] = []
    for slot in () if relays is None else relays.slots:
        senders += slot.get(name, {})
    return join_names(list(dict.fromkeys(senders)))  # each once


def list_shared_in_words(network: HasNodes) -> list[str]:
    """Return what several nodes share, in words: a common channel, or the memory of their links.

    Links share fading if their channels have the same memory, a state that is random over time: it is drawn once for
    all of them.
    """
    if network.common is not None:
        return [f"sensor and channel of all nodes: {link_in_words(network.common.channel)}"]
    channels = {name: node.channel for name, node in network.nodes.items() if isinstance(node, Node)}
    numbers_of = number_memory_seeds(channels)
    # Nodes that have each memory, and the memory's name, by number. Equal memories have equal numbers.
    nodes: dict[int, list[str]] = {}
    names: dict[int, str] = {}
    for name, channel in channels.items():
        for number, memory in zip(numbers_of[name].tolist(), memories(channel).values(), strict=True):
            nodes.setdefault(number, []).append(name)
            names[number] = type(memory).__name__ if memory.name is None else repr(memory.name)
    return [f"fading {names[number]}: {join_names(sharing)}" for number, sharing in nodes.items() if len(sharing) > 1]


def list_rounded_numbers(network: HasNodes) -> list[str]:
    """Return lines on numbers of the models that were rounded to single precision, and the parts that hold them."""
    return [
        f"rounded to single precision before they came in: {describe_rounded(rounded)} ({join_names(names)})"
        for rounded, names in find_rounded_parts(network).items()
    ]


def write_diagram(network: HasNodes) -> str:
    """Return the whole diagram as lines of text."""
    return "\n".join(_format_lines(network))


def write_short_diagram(network: HasNodes) -> str:
    """Return the diagram cut to LINES lines, each cut to the usual length; … stands for what is left out.

    It is what `repr` of a network shows.
    """
    lines = _format_lines(network)
    if len(lines) > LINES:
        hidden = len(lines) - (LINES - 1)
        lines = [*lines[: LINES - 1], f"… {hidden} more lines (heliograph check shows all)"]
    return "\n".join(cut(line) for line in lines)


def _format_lines(network: HasNodes) -> list[str]:
    """Return the diagram's title, and a line for each part of the network: its name, padded to a column, and words."""
    parts = list_diagram_lines(network)
    width = max(len(part.name) for part in parts)
    lines = [f"{part.name:{width}}  {part.words}" for part in parts]
    return [_make_title(network), *lines]


def _make_title(network: HasNodes) -> str:
    """Return a title such as "Network of 3 nodes"."""
    return f"Network of {len(network.nodes)} node{'s' * (len(network.nodes) > 1)}"


def write_html_table(network: HasNodes) -> str:
    """Return the diagram as an HTML table, for notebooks."""
    rows = (
        f'<tr><th style="text-align:left">{escape(line.name)}</th>'
        f'<td style="text-align:left">{escape(line.words)}</td></tr>'
        for line in list_diagram_lines(network)
    )
    return f"<table><caption>{_make_title(network)}</caption>{''.join(rows)}</table>"


def link_in_words(channel: Channel) -> str:
    """Return a channel in words, such as "Rician hop → hop of gain 1.1, 10% lost"; DIRECT if it delivers z = y.

    A channel that JAX traces has no known numbers, so only its class is named.
    """
    if isinstance(channel, OverTime):
        return f"varying over time, at first {link_in_words(first(channel))}"
    if is_traced(channel):
        return type(channel).__name__
    return channel.in_words() or DIRECT
