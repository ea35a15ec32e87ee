"""Values of an OPC UA server, which reports by exception: subscribed with the deadband that the server itself has."""

import asyncio
import contextlib
import json
import logging
import time
from collections.abc import Sequence
from datetime import UTC, datetime
from math import isfinite
from typing import NamedTuple

from asyncua import Client, Node, ua
from asyncua.common.subscription import DataChangeNotif
from asyncua.ua.uaerrors import UaError

from heliograph.files.topic_statistics import TopicStatistics, note_payload
from heliograph.model.trigger import SendOnDelta
from heliograph.numerics.check import fail, items, show_value, text
from heliograph.serving.brokers.broker_address import Address, parse_address
from heliograph.serving.brokers.pipe import Pipe
from heliograph.serving.brokers.source_translator import Translator
from heliograph.serving.brokers.transport import Batch, Retry, acknowledge_nothing
from heliograph.serving.message import Payload
from heliograph.serving.output import Output

AWAY = (UaError, OSError, asyncio.TimeoutError)
WAIT = 5.0  # seconds between two looks whether the connection is there, and that an answer may take
FASTEST = 0.05  # seconds of a sampling interval that the server does not bound
MOST = 1000  # values of a batch
ABSOLUTE, OF_RANGE = 0, 3  # formats of an exception deviation: in the value's unit, in percent of its EURange


class Reporting(NamedTuple):
    """Rule by which a server reports a variable: where it left the deadband, looked at once in an interval.

    Args:
        deadband: change in the variable's unit that is not reported; 0 if the server states none.
        interval: seconds between two samples; 0 if the server states none.
    """

    deadband: float
    interval: float

    def trigger(self, heartbeat: int | None = None) -> SendOnDelta:
        """Return the trigger of a node, `hg.Node(..., trigger=...)`, that sends as the server does.

        The server sends a value when it has changed by the deadband. A step is a sampling interval of the server.

        Args:
            heartbeat: number of steps after which a value is sent in any case; None for never.

        Raises:
            ValueError: the server states no deadband.
        """
        if self.deadband <= 0:
            raise fail("deadband of the server", "a positive number", self.deadband)
        return SendOnDelta(self.deadband, heartbeat)


def read_reporting(url: str, variables: Sequence[str]) -> dict[str, Reporting]:
    """Read from an OPC UA server by which rule it reports variables: deadband and sampling interval.

    A server sends a variable only if it has moved by more than the deadband, so its silence tells something too. The
    interval is the attribute MinimumSamplingInterval; the deadband the property ExceptionDeviation of the variable or
    of its historical configuration, in its unit or in percent of the EURange.

    Args:
        url: address of the server, opc.tcp://host:port/path.
        variables: identifiers of the variables, as "ns=2;s=Boiler.Temperature".

    Raises:
        ValueError: no server there, an unknown variable; one line.
        ModuleNotFoundError: asyncua is not installed (extra "opcua").
    """
    where = parse_address(url)
    if where.kind != "opc.tcp":
        raise fail("url", "opc.tcp://host:port/path", where.kind)
    names = [text("variable", name) for name in items("variables", variables, "identifiers")]

    async def read_rules() -> dict[str, Reporting]:
        """Connect, and return the rule of each variable in `names`."""
        async with Client(url, timeout=WAIT) as client:
            return {name: await _read_rule(_find_node(client, name)) for name in names}

    try:
        return asyncio.run(read_rules())
    except AWAY as error:
        raise fail(f"OPC UA server {where}", "an answer", f"{type(error).__name__} {error}") from None


async def _read_rule(node: Node) -> Reporting:
    """Return the rule by which a variable is reported, 0 for what the server does not state."""
    interval = await _read_attribute(node, ua.AttributeIds.MinimumSamplingInterval)  # milliseconds; negative: unknown
    seconds = max(interval, 0.0) / 1e3
    # The deviation is a property of the variable, or of its historical configuration: the first that states one counts.
    stating = [node]
    with contextlib.suppress(UaError):
        stating += await node.get_referenced_nodes(ua.ObjectIds.HasHistoricalConfiguration)
    for owner in stating:
        deadband = await _read_deadband(owner, node)
        if deadband is not None:
            return Reporting(deadband, seconds)
    return Reporting(0.0, seconds)


async def _read_deadband(owner: Node, node: Node) -> float | None:
    """Return the deadband of the variable `node`, in its unit, as `owner` states it; None if it does not.

    It is the property ExceptionDeviation: absolute, or in percent of the variable's EURange.
    """
    deviation = await _read_property(owner, "ExceptionDeviation")
    if deviation is None:
        return None
    kind = await _read_property(owner, "ExceptionDeviationFormat")
    bounds = await _read_property(node, "EURange")  # the least and greatest value of normal operation
    if kind in (None, ABSOLUTE):
        return float(str(deviation))
    if int(str(kind)) == OF_RANGE and isinstance(bounds, ua.Range):
        return float(float(str(deviation)) / 100 * (bounds.High - bounds.Low))
    return None


class OpcUa:
    """Transport from an OPC UA server: each change of a variable is a message of the topic that is its identifier.

    A message is {"value": ..., "source_time": ..., "server_time": ...}; a value of bad quality is null. The server has
    no place for estimates, which go to standard output. Nothing is acknowledged: what changes while nobody is
    subscribed is lost, except for its last value.
    """

    def __init__(self, address: Address, translator: Translator, target: int = 1):
        """Prepare to read the server's variables that the sources name; the first call of `receive` connects.

        Args:
            address: the server.
            translator: reads the variables' changes as messages of the network.
            target: file descriptor of the outputs; 1 is standard output.
        """
        self.address, self._translator = address, translator
        self._output, self._retry = Pipe(target=target), Retry(str(address))
        self._changes: asyncio.Queue[Sequence[Payload]] = asyncio.Queue()  # messages of each change, not yet received
        self._client: Client | None = None
        self._first: set[str] = set()  # variables whose first value has not come yet
        self.reporting: dict[str, Reporting] = {}  # deadband and interval by variable

    async def receive(self) -> Batch | None:
        """Wait for changes of the nodes that are subscribed to, and return what came together."""
        while True:
            await self._connect()
            try:
                payloads = list(await asyncio.wait_for(self._changes.get(), WAIT))
            except TimeoutError:
                continue
            while len(payloads) < MOST and not self._changes.empty():
                payloads += self._changes.get_nowait()
            if payloads:
                return Batch(payloads, acknowledge_nothing)

    async def publish(self, outputs: Sequence[Output]) -> None:
        """Write outputs to the file descriptor, a line each."""
        await self._output.publish(outputs)

    async def close(self) -> None:
        """End the connection, if there is one."""
        if self._client is not None:
            with contextlib.suppress(*AWAY):
                await asyncio.wait_for(self._client.disconnect(), WAIT)

    def datachange_notification(self, node: Node, val: object, data: DataChangeNotif) -> None:
        """Put a change of a variable into the queue, as messages.

        The first value of a variable existed before, so it counts as a message that a broker had stored.

        `val`: the new value. `data`: its dates and quality.
        """
        topic, body = _translate_change(node, val, data)
        was_stored = topic in self._first
        self._first.discard(topic)
        self._changes.put_nowait(self._translator.read(topic, body, datetime.now(UTC), was_stored))

    async def _connect(self) -> None:
        """Connect and subscribe, again and again while the server is away."""
        while True:
            try:
                if self._client is not None:
                    await self._client.check_connection()
                    return
                await self._subscribe()
                self._retry.note_success()
                return
            except AWAY as error:
                if self._client is not None:
                    with contextlib.suppress(*AWAY):
                        await self._client.disconnect()
                self._client = None
                await self._retry.wait(error)

    async def _subscribe(self) -> None:
        """Connect, and subscribe to each variable that the sources name; the server sends its present value first."""
        client = _make_client(self.address)
        await client.connect()
        self._client = client
        for name in self._translator.sources.subscribed_topics:
            node = _find_node(client, name)
            self._first.add(node.nodeid.to_string())
            self.reporting[name] = await _monitor(client, node, self)


class Listener:
    """Listens to a server's variables and notes their changes in `topics`; `kinds` has each variable's type and rule.

    The first value of a variable was there before: it says nothing of rate and lateness.
    """

    def __init__(self, topics: dict[str, TopicStatistics]):
        """Hold the statistics of each topic, which it adds to; the types of the variables are not known yet."""
        self.topics, self.kinds = topics, dict[str, str]()

    async def listen(self, where: Address, seconds: float) -> None:
        """Subscribe for a while to all variables below Objects but those of the server itself.

        Raises:
            ValueError: no server there; one line.
        """
        try:
            async with _make_client(where) as client:
                for node in await _find_variables(client):
                    self.kinds[node.nodeid.to_string()] = (await node.read_data_type_as_variant_type()).name
                    rule = await _monitor(client, node, self)
                    if rule.deadband > 0:
                        self.kinds[node.nodeid.to_string()] += f", deadband {rule.deadband:g}, {rule.interval:g} s"
                await asyncio.sleep(seconds)
        except AWAY as error:
            raise fail(f"OPC UA server {where}", "an answer", f"{type(error).__name__} {error}".strip()) from None
        for name, topic in self.topics.items():
            topic.kind = self.kinds[name]

    def datachange_notification(self, node: Node, val: object, data: DataChangeNotif) -> None:
        """Note a change in its topic's statistics, but not the times of a variable's first value, which may be old."""
        topic, body = _translate_change(node, val, data)
        is_first = topic not in self.topics
        note_payload(self.topics, topic, body, time.time_ns())
        if is_first:  # forget the times that were just noted of it
            statistics = self.topics[topic]
            del statistics.logged[:], statistics.late[:]  # arrays


def _make_client(where: Address) -> Client:
    """Return a client of the server at an address, with its user and password if it has any."""
    # The client library warns whenever a server grants less than it asks for; this is not logged.
    logging.getLogger("asyncua").setLevel(logging.ERROR)
    client = Client(str(where), timeout=WAIT)
    if where.user is not None:
        client.set_user(where.user)
        client.set_password(where.password or "")
    return client


async def _monitor(client: Client, node: Node, handler: OpcUa | Listener) -> Reporting:
    """Subscribe to a variable with the deadband and the interval that the server states; return these."""
    rule = await _read_rule(node)
    interval = 1e3 * (rule.interval or FASTEST)
    subscription = await client.create_subscription(interval, handler)
    if rule.deadband > 0:
        await subscription.deadband_monitor(node, ua.Double(rule.deadband))
    else:
        await subscription.subscribe_data_change(node, sampling_interval=ua.Duration(interval))
    return rule


async def _find_variables(client: Client) -> list[Node]:
    """Return the variables below Objects that are of no namespace of OPC UA itself, MOST at most."""
    variables, seen, waiting = list[Node](), set[ua.NodeId](), [client.nodes.objects]
    while waiting and len(variables) < MOST:
        for child in await waiting.pop(0).get_children_descriptions():
            is_of_opc_ua = child.NodeId.NamespaceIndex == 0
            is_property = child.ReferenceTypeId.Identifier == ua.ObjectIds.HasProperty
            if is_of_opc_ua or is_property or child.NodeId in seen:
                continue
            seen.add(child.NodeId)
            waiting.append(client.get_node(child.NodeId))
            if child.NodeClass == ua.NodeClass.Variable:
                variables.append(waiting[-1])
    return variables


def _translate_change(node: Node, value: object, data: DataChangeNotif) -> tuple[str, bytes]:
    """Return a variable's change as a topic (the variable's identifier) and a message, JSON of its value and dates.

    A value of bad quality, NaN or infinity becomes null. A value that is no number becomes a text.
    """
    sample = data.monitored_item.Value
    has_good_quality = sample.StatusCode is None or sample.StatusCode.is_good()
    if not has_good_quality or (isinstance(value, float) and not isfinite(value)):  # JSON has no NaN, no infinity
        value = None
    elif not isinstance(value, bool | int | float):
        value = show_value(value)
    content = {
        "value": value,
        "source_time": _format_date(sample.SourceTimestamp),
        "server_time": _format_date(sample.ServerTimestamp),
    }
    return node.nodeid.to_string(), json.dumps(content).encode()


def _find_node(client: Client, name: str) -> Node:
    """Return the server's node with the identifier `name`; raise ValueError if `name` is no identifier."""
    try:
        return client.get_node(name)
    except (UaError, ValueError):
        raise fail("variable of an OPC UA server", "an identifier as ns=2;s=Boiler.Temperature", repr(name)) from None


async def _read_attribute(node: Node, attribute: ua.AttributeIds) -> float:
    """Return the number in an attribute of a node; 0 where it has none."""
    try:
        value = (await node.read_attribute(attribute)).Value
    except UaError:
        return 0.0
    return 0.0 if value is None or value.Value is None else float(value.Value)


async def _read_property(node: Node, name: str) -> object:
    """Return the value of a node's property with this name; None where it has none."""
    for member in await node.get_properties():
        if (await member.read_browse_name()).Name == name:
            return await member.read_value()
    return None


def _format_date(moment: datetime | None) -> str | None:
    """Return a date as ISO 8601 in UTC; the server's dates have no zone."""
    if moment is None:
        return None
    return (moment if moment.tzinfo is not None else moment.replace(tzinfo=UTC)).isoformat()
