"""States published to MQTT beside what a service publishes: a retained topic each, with availability and discovery."""

import asyncio
import threading
from collections.abc import Sequence
from typing import NamedTuple

from paho.mqtt.client import Client, ConnectFlags
from paho.mqtt.reasoncodes import ReasonCode

from heliograph.numerics.check import fail, instance, name_list
from heliograph.serving.brokers.broker_address import Address
from heliograph.serving.brokers.mqtt import AT_LEAST_ONCE, Connection
from heliograph.serving.brokers.state_messages import (
    OFFLINE,
    ONLINE,
    availability_topic,
    make_discovery_messages,
    make_state_messages,
)
from heliograph.serving.brokers.transport import Batch, Transport
from heliograph.serving.output import Output


class StateTopics(NamedTuple):
    """Where states are published.

    Attributes:
        address: broker of MQTT, and the topic below which the states are.
        discovery: topic under which Home Assistant looks for devices; "" tells it nothing.
    """

    address: Address
    discovery: str = ""


class StatePublishing:
    """A transport that publishes each plant's newest states to MQTT too; the rest it leaves to another transport.

    Each state of each filter has a topic, TOPIC/state/PLANT/NODE/FILTER/STATE, whose last message the broker keeps:
    flat JSON of `value`, `deviation` (null where none is claimed), `dead` (1 where the sender of the node is dead, else
    0) and `time` (seconds since 1970 of dates). On TOPIC/availability stands online or offline, also as last will.

    Args:
        inner: the transport of messages and outputs.
        topics: where the states go.
        states: names of the states.

    Raises:
        ValueError: no topics, a broker of another kind, names that are no texts.
    """

    def __init__(self, inner: Transport, topics: StateTopics, states: Sequence[str]):
        """Hold the inner transport, and connect to the broker to which the states of these names are published."""
        address = instance("topics", topics, StateTopics, "StateTopics").address
        if instance("topics, address", address, Address, "an Address").kind != "mqtt":
            raise fail("topics, address", "mqtt:// or mqtts://host:port/topic", str(address))
        states = name_list("states", states)
        self._inner, self._writer = inner, _StateWriter(topics, states)

    async def receive(self) -> Batch | None:
        """Wait for messages as the other transport does."""
        return await self._inner.receive()

    async def publish(self, outputs: Sequence[Output]) -> None:
        """Send outputs, then the newest states, which are not waited for: they are sent again with each connection."""
        await self._inner.publish(outputs)
        newest = {output.plant: output.body for output in outputs if output.kind == "provisional"}
        for plant, body in newest.items():
            self._writer.publish(plant, body)

    async def close(self) -> None:
        """Say offline, and release both connections."""
        await asyncio.gather(self._inner.close(), asyncio.to_thread(self._writer.close))


class _StateWriter(Connection):
    """Connection that publishes states; its last will is that the service is offline.

    The client drops what it is given while it has no broker, so the newest states are published again with each
    connection, by the client's thread.
    """

    def __init__(self, topics: StateTopics, states: Sequence[str]):
        """Connect to the broker, to publish the states of these names; the last will says "offline"."""
        super().__init__(topics.address, "")
        self._topics, self._states = topics, states
        self._announced = set[str]()  # topics of sensors that Home Assistant was told of
        self._newest = dict[str | None, bytes]()  # each plant's newest estimate, to publish it again
        self._one_at_a_time = threading.Lock()  # the client's thread and the service's use these two
        self._available = availability_topic(topics.address.topic)
        # The last will: what the broker says for this client when its connection breaks.
        self.client.will_set(self._available, OFFLINE, AT_LEAST_ONCE, retain=True)
        self.start()

    def publish(self, plant: str | None, body: bytes) -> None:
        """Publish the states of a plant's estimate now, and again whenever the connection is new."""
        with self._one_at_a_time:
            self._newest[plant] = body
            if self.client.is_connected():
                self._publish(body)

    def _publish(self, body: bytes) -> None:
        """Publish an estimate's states; with `discovery`, first tell Home Assistant of sensors that are new to it."""
        topic = self._topics.address.topic
        if self._topics.discovery:
            for message in make_discovery_messages(topic, self._states, body, self._topics.discovery):
                if message.topic not in self._announced:
                    self._announced.add(message.topic)
                    self.client.publish(message.topic, message.body, AT_LEAST_ONCE, retain=True)
        for message in make_state_messages(topic, self._states, body):
            self.client.publish(message.topic, message.body, 0, retain=True)

    def connected(self, client: Client, data: object, flags: ConnectFlags, code: ReasonCode, more: object) -> None:
        """Publish "online" and everything else again, since the broker may have forgotten it."""
        super().connected(client, data, flags, code, more)
        client.publish(self._available, ONLINE, AT_LEAST_ONCE, retain=True)
        with self._one_at_a_time:
            self._announced.clear()
            for body in self._newest.values():
                self._publish(body)

    def close(self) -> None:
        """Publish "offline" and end the connection; the last will says so only if a connection breaks."""
        if self.client.is_connected():
            self.client.publish(self._available, OFFLINE, AT_LEAST_ONCE, retain=True).wait_for_publish(2.0)
        super().close()
