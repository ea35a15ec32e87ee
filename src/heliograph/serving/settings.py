"""Settings of a service, and those of the service of one node of a network."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from heliograph.files.sources.source_description import Source
from heliograph.live.event import INPUTS
from heliograph.live.fleet_options import Options
from heliograph.numerics.check import TINY, check_count, fail, scalar
from heliograph.serving.brokers.broker_address import Address
from heliograph.serving.brokers.transport import encode_name
from heliograph.serving.published_forecasts import Spans
from heliograph.serving.thresholds import Thresholds
from heliograph.simulation.mesh.node_filter import node_network
from heliograph.simulation.network import Network

if TYPE_CHECKING:
    from heliograph.serving.brokers.state_topics import StateTopics

NOTHING = "none"  # the store that keeps nothing
SHORTEST = 1.0  # seconds without messages after which their silence is used


@dataclass(frozen=True)
class ServiceSettings:
    """Settings of a service.

    Args:
        network: the network to run.
        options: limits of events and memory.
        store: path or URL of the database; None keeps no state.
        process: name of this process among several.
        snapshot: store whose plants a new store begins from, a file or a PostgreSQL URL.
        broker: the broker; None reads standard input.
        parts: number of parts of the plants that several processes share.
        page: port, or address and port, of the page.
        hosts: names by which others ask for the page, such as a proxy's.
        anew: names of plants that begin anew.
        sources: sources of messages that others make, by topic; None reads messages in our own form alone.
        others: nodes that other processes are, whose messages are left out.
        ignore_unknown: whether columns that the network does not know are left out, of a table on standard input.
        name: name of the network on the page.
        accept_changes: whether the plants of a store whose network has changed go on with what fits.
        every: seconds after which the estimate of a plant whose senders are silent is published again although it has
            hardly changed; None for never.
        states: where single states are published beside the outputs; None for nowhere.
        forecast: how far ahead forecasts are published beside provisional estimates; None for not at all.
        thresholds: levels of which forecasts have the probability that they are passed; none by default.

    Raises:
        ValueError: parts without a store and a broker, which all processes share; a snapshot without a store.
    """

    network: Network
    options: Options
    store: str | None = None
    process: str = ""
    snapshot: str | None = None
    broker: Address | None = None
    parts: int | None = None
    page: str | None = None
    hosts: tuple[str, ...] = ()
    anew: tuple[str, ...] = ()
    sources: object = None
    others: tuple[str, ...] = ()
    ignore_unknown: bool = False
    name: str = ""
    accept_changes: bool = False
    every: float | None = None
    forecast: Spans | None = None
    thresholds: Thresholds = ()
    states: "StateTopics | None" = None

    def __post_init__(self) -> None:
        """Raise ValueError, in one line, if options contradict each other, or need one that is not given."""
        if self.hosts and self.page is None:
            raise fail("--host", "a page for this host name (--page PORT)", "none")
        if self.every is not None:
            scalar("--every", self.every, TINY)
        if self.thresholds and self.forecast is None:
            raise fail("--threshold", "how far ahead (--forecast 5s,1min)", "no --forecast")
        if self.snapshot is not None:
            if self.store is None:
                raise fail("--from-snapshot", "a store to begin in (--store FILE)", "none")
            if "://" not in self.snapshot and not Path(self.snapshot).is_file():
                raise fail(f"snapshot {self.snapshot}", "a store's file", "nothing of that name")
        if self.anew and self.store is None:
            raise fail("--anew", "a store that has the plants (--store FILE)", "none")
        if self.parts is not None:
            check_count("--parts", self.parts)
            self._check_sharing()

    def _check_sharing(self) -> None:
        """Raise ValueError if a setting does not go with --parts, by which processes share the plants."""
        if self.states is not None:
            raise fail("--states", "one process, whose end says offline (no --parts)", "--parts")
        if self.store is None or self.broker is None:
            raise fail("--parts", "a store and a broker that all processes share", "not both")
        if self.sources is not None:
            raise fail("--parts", "messages in our own form, which name their part", "sources in the network's file")


def choose_store_location(network: str, given: str | None, parts: int | None, node: str | None = None) -> str | None:
    """Return the path or URL of the store: `given`, or else a file named after the network and its node.

    The answer None keeps no state. It is that of "none" (NOTHING), and of processes that share the plants in `parts`
    and name no store.
    """
    if given is not None or parts is not None:
        return None if given == NOTHING else given
    return f"{name_of_network(network)}{'' if node is None else f'-{encode_name(node)}'}.db"


def settings_of_node(settings: ServiceSettings, node: str) -> ServiceSettings:
    """Return the settings of a process that serves one node of a fusion between neighbours.

    In such a fusion each node runs the filter in a process of its own, and neighbours exchange estimates over a broker.
    The process reads and writes the topic that ends in the node's name, below the topic of the whole network. It keeps
    the node's own network (`node_network`) and sources; the length of a step in seconds (`step`) is the same for all.

    Args:
        settings: settings of the whole network: network, broker, topics of states, sources, options.
        node: name of the node.

    Raises:
        ValueError: no such node, no broker between the nodes, or plants divided into parts among processes (--parts).
    """
    if settings.broker is None or settings.parts is not None:
        raise fail("--node", "a broker between the nodes (--broker URL), and no --parts",
                   "none" if settings.broker is None else "--parts")  # fmt: skip
    states = settings.states
    if states is not None:
        states = states._replace(address=_address_below(states.address, node))
    sources, step = _select_sources(settings, node)
    return replace(
        settings,
        network=node_network(settings.network, node),
        options=settings.options._replace(step=step),
        broker=_address_below(settings.broker, node),
        states=states,
        sources=sources,
        others=tuple(name for name in settings.network.names if name != node),
        name=f"{settings.name} {node}",
    )


def _select_sources(settings: ServiceSettings, node: str) -> tuple[object, float | None]:
    """Return the sources of a node's own messages by topic (None if it has none), and the seconds of a step.

    A source says how a topic's messages are read. Sources that are not a mapping are returned unchecked. All nodes have
    the same step: that of any source, or else that of the settings.
    """
    sources, step = settings.sources, settings.options.step
    if not isinstance(sources, Mapping):
        return sources, step
    # A topic may have a single source instead of a list.
    by_topic = {topic: list(items) if isinstance(items, Sequence) else [items] for topic, items in sources.items()}
    step = next((source.step for items in by_topic.values() for source in items if isinstance(source, Source)), step)
    measures = node in settings.network.nodes and settings.network.nodes[node].received > 0
    of_node = {
        topic: [source for source in items if _is_for_node(source, node, measures)] for topic, items in by_topic.items()
    }
    return {topic: items for topic, items in of_node.items() if items} or None, step


def _is_for_node(source: object, node: str, measures: bool) -> bool:
    """Return whether a source is for a node: the source names the node, the inputs, or leaves the name to messages.

    In the last case `source.node` is no text, but says where the name stands in a message. It is then for the node if
    the node measures something (`measures`). Anything that is no Source is kept, and refused later.
    """
    if not isinstance(source, Source) or source.node in (node, INPUTS):
        return True
    is_named_by_message = not isinstance(source.node, str)
    return measures and is_named_by_message


def _address_below(address: Address, node: str) -> Address:
    """Return the address of a node's service, at the topic of its name below that of all."""
    return replace(address, topic=f"{address.topic}/{encode_name(node)}")


def name_of_network(network: str) -> str:
    """Return a name for a network's files: "my_network" for `my_network.py` and for the module `a.my_network`.

    `:name` at the end chooses one of several networks, and adds "-name". Any other colon is part of a path.
    """
    file, _, name = network.rpartition(":")
    if not file or not name.isidentifier():
        file, name = network, ""
    stem = Path(file).stem if file.endswith(".py") else file.rpartition(".")[2]
    return f"{stem}-{name}" if name else stem
