"""Messages through MQTT: each is acknowledged after the commit; the broker keeps a session while nobody reads."""

import asyncio
import sys
import threading
from collections import deque
from collections.abc import Sequence
from datetime import UTC, datetime
from typing import NamedTuple

from paho.mqtt.client import Client, ConnectFlags, DisconnectFlags, MQTTMessage, MQTTv311
from paho.mqtt.enums import CallbackAPIVersion
from paho.mqtt.reasoncodes import ReasonCode

from heliograph.serving.brokers.broker_address import Address
from heliograph.serving.brokers.source_translator import Translator
from heliograph.serving.brokers.transport import FIRST, LOG, LONGEST, WHOLE, Batch, Part, explain_failure, topic_of
from heliograph.serving.message import Payload
from heliograph.serving.output import Output

MOST = 1000  # messages of a batch
HELD = 4 * MOST  # messages that wait here; the broker waits with what comes then
AT_LEAST_ONCE = 1


class Mqtt:
    """Transport over MQTT: messages under TOPIC/in, or TOPIC/in/PART if shared; outputs to TOPIC/out/KIND/PLANT.

    The topics of the sources are read too.

    The session belongs to the part, not to the process: whoever reads a part next takes over its session, and with it
    the messages that were not acknowledged. The broker closes the connection of the previous reader. We speak version
    3.1.1, which every broker supports. Reading and writing have a connection each, since reading may have to wait while
    something is written.
    """

    def __init__(self, address: Address, part: Part = WHOLE, translator: Translator | None = None):
        """Connect to the broker at `address` in order to read a part of the plants' messages and to write outputs.

        Args:
            address: the broker's address, with the topic.
            part: which of the equal parts of the plants is read; all plants by default.
            translator: translates messages of the sources' topics to heliograph's own form; None by default.
        """
        self.address = address
        self._reader, self._writer = _Reader(address, part, translator), _Writer(address)

    async def receive(self) -> Batch | None:
        """Wait for messages, and return those that are there; they are acknowledged after the commit."""
        return await self._reader.receive()

    async def publish(self, outputs: Sequence[Output]) -> None:
        """Publish outputs, in order; return when the broker has confirmed those that have a number."""
        for begin in range(0, len(outputs), MOST):
            await asyncio.to_thread(self._writer.publish, outputs[begin : begin + MOST])

    async def close(self) -> None:
        """End both connections."""
        await asyncio.gather(asyncio.to_thread(self._reader.close), asyncio.to_thread(self._writer.close))


class Connection:
    """A connection that is opened anew whenever it ends, after a wait that doubles; callbacks run in its thread."""

    def __init__(self, address: Address, identity: str):
        """Prepare a client of the broker at an address; `start` connects it.

        `identity`: name of the session that the broker keeps while nobody reads, whose messages are acknowledged one by
        one; "" for no session.
        """
        self.address, self.open = address, True  # open: until `close`
        self.changed = threading.Condition()  # for threads that wait for the broker, or for room for messages
        session = bool(identity)
        client = Client(
            CallbackAPIVersion.VERSION2, identity, clean_session=not session, protocol=MQTTv311, manual_ack=session
        )
        client.on_connect, client.on_disconnect = self.connected, self.disconnected
        client.on_connect_fail = self.failed
        client.max_inflight_messages_set(MOST)
        client.reconnect_delay_set(FIRST, LONGEST)  # type: ignore[arg-type]  # parts of a second too
        if address.user is not None:
            client.username_pw_set(address.user, address.password)
        if context := address.tls():
            client.tls_set_context(context)
        self.client = client

    def start(self) -> None:
        """Begin to connect; return at once."""
        self.client.connect_async(self.address.host, self.address.port)
        self.client.loop_start()

    def connected(self, client: Client, data: object, flags: ConnectFlags, code: ReasonCode, more: object) -> None:
        """Log it where the broker refuses the connection."""
        if code.is_failure:
            LOG.warning("%s: refused, %s; trying again", self.address, code)

    def disconnected(
        self, client: Client, data: object, flags: DisconnectFlags, code: ReasonCode, more: object
    ) -> None:
        """Log that the connection ended, unless it was closed here; the client connects again by itself."""
        if self.open:
            LOG.warning("%s: the connection ended, %s; trying again", self.address, code)

    def failed(self, client: Client, data: object) -> None:
        """Log why there is no connection: nobody answers at the address, or the certificate is not trusted."""
        if self.open:
            # The client calls this method while it handles the exception.
            LOG.warning("%s: %s; trying again", self.address, explain_failure(sys.exc_info()[1]))

    def close(self) -> None:
        """End the connection, and its thread."""
        with self.changed:  # wakes threads that wait for the broker or for room
            self.open = False
            self.changed.notify_all()
        self.client.disconnect()
        self.client.loop_stop()


class HeldMessage(NamedTuple):
    """A message that waits to be received: the number of the connection by which it came, itself, and its arrival."""

    connection: int
    message: MQTTMessage
    arrival: datetime


class _Reader(Connection):
    """Connection that receives messages and holds them until `receive` takes them."""

    def __init__(self, address: Address, part: Part, translator: Translator | None):
        """Connect, in order to read one part of the plants' messages, and the topics of the translator's sources."""
        super().__init__(address, f"{address.topic.replace('/', '-')}-part-{part.number}-of-{part.of}")
        # Topics to read: below the service's own, those of the part (# is the wildcard for all); those of the sources.
        self._prefix, self._translator = f"{address.topic}/in/", translator
        self._topics_below = f"{part.number}/#" if part.of > 1 else "#"
        # Messages that wait for `receive`. The client's thread adds them, and sets the event in the service's loop.
        self._held: deque[HeldMessage] = deque()
        self._loop, self._some_held = asyncio.get_running_loop(), asyncio.Event()
        self._connection = 0  # counts connections and their ends: a message is acknowledged in its own only
        self.client.on_message = self._hold_message
        self.start()

    async def receive(self) -> Batch:
        """Wait for messages, and return those that the service reads; acknowledging the batch acknowledges them all."""
        batch, payloads = list[HeldMessage](), list[Payload]()
        # Wait until there are messages that the service reads. A batch may have none: `_some_held` may be set although
        # the batch before took all, and messages of topics that no source reads are acknowledged at once.
        while not payloads:
            self._acknowledge(batch)  # the last batch, without anything to read; empty at first
            await self._some_held.wait()
            batch = self._take_held()
            payloads = [payload for held in batch for payload in self._read_payloads(held.message, held.arrival)]

        async def acknowledge() -> None:
            """Acknowledge all messages of the batch."""
            self._acknowledge(batch)

        return Batch(payloads, acknowledge)

    def _take_held(self) -> list[HeldMessage]:
        """Return at most MOST of the messages that are held, the oldest first.

        The client's thread waits while too many messages are held. It may then add others.
        """
        with self.changed:
            batch = [self._held.popleft() for _ in range(min(MOST, len(self._held)))]
            if not self._held:
                self._some_held.clear()
            self.changed.notify_all()
        return batch

    def _read_payloads(self, message: MQTTMessage, arrival: datetime) -> Sequence[Payload]:
        """Return a message below `_prefix` as it is; for any other topic, return what the sources read in it."""
        if self._translator is None or message.topic.startswith(self._prefix):
            return [bytes(message.payload)]
        return self._translator.read(message.topic, bytes(message.payload), arrival, message.retain)

    def _acknowledge(self, batch: Sequence[HeldMessage]) -> None:
        """Acknowledge the messages of the present connection; those of an earlier connection come again.

        The broker numbers messages in each connection: the number of an earlier one may by now be another message's.
        """
        for held in batch:
            if held.connection == self._connection:
                self.client.ack(held.message.mid, held.message.qos)

    def _hold_message(self, client: Client, data: object, message: MQTTMessage) -> None:
        """Hold a message with its connection and time; while HELD are held, block the client's thread from reading."""
        with self.changed:
            self.changed.wait_for(lambda: len(self._held) < HELD or not self.open)
            self._held.append(HeldMessage(self._connection, message, datetime.now(UTC)))
            if self.open:
                self._loop.call_soon_threadsafe(self._some_held.set)

    def connected(self, client: Client, data: object, flags: ConnectFlags, code: ReasonCode, more: object) -> None:
        """Subscribe to our topics and to those of the sources, after each connection anew."""
        super().connected(client, data, flags, code, more)
        self._connection += 1  # messages of an earlier one are not acknowledged in this one
        if not code.is_failure:
            own_topic = f"{self._prefix}{self._topics_below}"
            topics_of_sources = [] if self._translator is None else self._translator.sources.subscribed_topics
            LOG.info("%s: connected", self.address)
            client.subscribe([(topic, AT_LEAST_ONCE) for topic in (own_topic, *topics_of_sources)])

    def disconnected(
        self, client: Client, data: object, flags: DisconnectFlags, code: ReasonCode, more: object
    ) -> None:
        """Count the end of the connection: messages that came in it can no longer be acknowledged."""
        super().disconnected(client, data, flags, code, more)
        self._connection += 1


class _Writer(Connection):
    """Connection that publishes outputs."""

    def __init__(self, address: Address):
        """Connect to the broker in a session without a name, and note from now on what the broker confirms."""
        super().__init__(address, "")
        self._delivered: set[int] = set()  # numbers of messages that the broker has confirmed
        self.client.on_publish = self._note_received
        self.start()

    def publish(self, outputs: Sequence[Output]) -> None:
        """Publish outputs, and return when the broker has confirmed all numbered ones; others may be lost."""
        to_confirm = set()
        for output in outputs:
            # With quality of service 0, a message is sent once and not confirmed.
            quality = 0 if output.kind == "provisional" else AT_LEAST_ONCE
            message = self.client.publish(topic_of(self.address.topic, output), output.body, quality)
            if output.number is not None:
                to_confirm.add(message.mid)
        with self.changed:
            self.changed.wait_for(lambda: to_confirm <= self._delivered or not self.open)
            self._delivered.clear()

    def _note_received(self, client: Client, data: object, number: int, code: ReasonCode, more: object) -> None:
        """Note that the broker has the message with this number, for `publish`, which waits for it."""
        with self.changed:
            self._delivered.add(number)
            self.changed.notify_all()
