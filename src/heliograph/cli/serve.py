"""`heliograph serve`: the filters of a network kept running, from messages to estimates."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

if TYPE_CHECKING:
    from heliograph.serving.brokers.state_topics import StateTopics
    from heliograph.serving.settings import ServiceSettings


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class ServeOptions:
    """Options of the command, as they are typed."""

    window: Annotated[float, Parameter(help="How late a message may be, in seconds or steps.")] = 10.0
    ahead: Annotated[float, Parameter(help="How much later than its arrival a message's time may be.")] = 0.1
    leap: Annotated[float, Parameter(help="How much later than all before it without a second that confirms it.")] = (
        10_000.0
    )
    every: Annotated[
        float | None,
        Parameter(help="Seconds after which a silent plant is published again; only what has changed, unless given."),
    ] = None
    store: Annotated[
        str | None,
        Parameter(
            help="File or PostgreSQL URL that keeps the state: NETWORK.db here, unless given; none keeps nothing."
        ),
    ] = None
    process: Annotated[str, Parameter(help="Name of this process among several that share a store.")] = ""
    from_snapshot: Annotated[
        str | None, Parameter(help="File or PostgreSQL URL of a store whose plants this one begins with.")
    ] = None
    anew: Annotated[
        list[str] | None,
        Parameter(help="Name of a plant whose state is forgotten at the start; may be given again.", negative=""),
    ] = None
    accept_changes: Annotated[
        bool, Parameter(help="Go on from a store whose network has changed, with all that fits.", negative="")
    ] = False
    broker: Annotated[str | None, Parameter(help="mqtt:// or nats://host:port/topic, or opc.tcp://host:port.")] = None
    parts: Annotated[int | None, Parameter(help="Parts of the plants that processes share among them.")] = None
    node: Annotated[
        str | None,
        Parameter(help="Node of a fusion between neighbours that this process is; its messages go by the broker."),
    ] = None
    page: Annotated[str | None, Parameter(help="Port of a page to watch it on, or address:port.")] = None
    host: Annotated[
        list[str] | None,
        Parameter(help="Name by which others ask for the page, as of a proxy; may be given again.", negative=""),
    ] = None
    forecast: Annotated[
        str, Parameter(help="How far ahead forecasts are published beside estimates: 5s,1min, or steps.")
    ] = ""
    threshold: Annotated[
        list[str] | None,
        Parameter(help="Of --forecast: a level whose passing has its probability, as level>30; again.", negative=""),
    ] = None
    states: Annotated[
        str | None, Parameter(help="mqtt://host:port/topic: a retained topic for each state, of the newest estimates.")
    ] = None
    discovery: Annotated[
        str, Parameter(help="Of --states: topic under which Home Assistant looks for devices, as homeassistant.")
    ] = ""
    ignore_unknown: Annotated[
        bool, Parameter(help="Of a table: leave out columns that the network does not know.", negative="")
    ] = False
    schema: Annotated[bool, Parameter(help="Print the JSON schema of messages and outputs.", negative="")] = False

    def settings(self, reference: str) -> "ServiceSettings":
        """Load the network, and return the settings of its service, from the options of the command line.

        `self` has the options: addresses (broker, store, states) as texts, the plants to begin anew, and for several
        processes that share a store this one's name and the number of parts. Each is parsed here, so that a wrong one
        is an error before the service begins. With `node`, this process is one node of a fusion between neighbours.

        Args:
            reference: the Python file of the network, as FILE or FILE:NAME.
        """
        from heliograph.files.network_file import load_module
        from heliograph.live.fleet_options import Options
        from heliograph.numerics.times.dates import horizons_in
        from heliograph.serving.brokers.broker_address import parse_address
        from heliograph.serving.settings import (
            ServiceSettings,
            choose_store_location,
            name_of_network,
            settings_of_node,
        )
        from heliograph.serving.thresholds import parse_threshold

        # Addresses are checked before the network is loaded.
        broker = None if self.broker is None else parse_address(self.broker)
        store = choose_store_location(reference, self.store, self.parts, self.node)
        network, module = load_module(reference)
        settings = ServiceSettings(
            network=network,
            options=Options(window=self.window, ahead=self.ahead, leap=self.leap),
            store=store,
            process=self.process,
            snapshot=self.from_snapshot,
            broker=broker,
            parts=self.parts,
            page=self.page,
            hosts=tuple(self.host or ()),
            anew=tuple(self.anew or ()),
            sources=module.get("sources"),
            ignore_unknown=self.ignore_unknown,
            name=name_of_network(reference),
            accept_changes=self.accept_changes,
            every=self.every,
            forecast=horizons_in(self.forecast) if self.forecast else None,
            thresholds=tuple(map(parse_threshold, self.threshold or ())),
            states=self._make_state_topics(),
        )
        return settings if self.node is None else settings_of_node(settings, self.node)

    def _make_state_topics(self) -> "StateTopics | None":
        """Return the topics under which single states are published, by --states and --discovery; None without.

        `self.states`: the broker's URL with the first part of the topics; `self.discovery`: the topic under which home
        automation looks for devices.

        Raises:
            ValueError: an address that is none of MQTT; discovery without one, or a topic that is none.
        """
        from heliograph.numerics.check import fail
        from heliograph.serving.brokers.broker_address import parse_address
        from heliograph.serving.brokers.state_topics import StateTopics

        if self.states is None:
            if self.discovery:
                raise fail("--discovery", "a broker for the states (--states mqtt://host/topic)", "none")
            return None
        address = parse_address(self.states)
        if address.kind != "mqtt":
            raise fail("--states", "mqtt:// or mqtts://host:port/topic", str(address))
        if any(sign in self.discovery for sign in "+# ") or self.discovery != self.discovery.strip("/"):
            raise fail("--discovery", "words between slashes, as homeassistant", repr(self.discovery))
        return StateTopics(address, self.discovery)


def serve(network: str | None = None, /, *, options: ServeOptions | None = None) -> None:
    """Keep the filters of your own network running: messages as JSON lines in, estimates as JSON lines out.

    Where the network's file names `sources`, messages of their topics are read too: of the broker, or of lines with a
    topic and a payload, as mosquitto_sub -F %j prints them. What `run` reads of text may come through a pipe, too:
    tables of CSV (rows of time, events, rows that sources map), JSON, logs, packed or not.

    Parameters
    ----------
    network:
        A Python file or module that holds a heliograph.Network: my_network.py, or my_network.py:name where it
        holds several.
    """
    import asyncio
    import json

    from heliograph.numerics.check import fail
    from heliograph.serving.message import schema as message_schema
    from heliograph.serving.output import schema as output_schema
    from heliograph.serving.service_assembly import run_service

    requested = ServeOptions() if options is None else options
    # The schema needs no network.
    if requested.schema:
        print(json.dumps({"message": message_schema(), "output": output_schema()}, indent=1))
        return
    if network is None:
        raise fail("serve", "a network, such as my_network.py", "none")
    asyncio.run(run_service(requested.settings(network)))
