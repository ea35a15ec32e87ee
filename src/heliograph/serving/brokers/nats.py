"""Messages through NATS JetStream: a part of the stream is read in order, from what was acknowledged last."""

import asyncio
import contextlib
import uuid
from collections.abc import Awaitable, Callable, Sequence
from functools import partial
from typing import TypeVar

from nats.aio.client import Client
from nats.aio.msg import Msg
from nats.errors import Error, NoServersError, TimeoutError
from nats.js import JetStreamContext
from nats.js.api import (
    AckPolicy,
    ConsumerConfig,
    DeliverPolicy,
    StorageType,
    StreamConfig,
    StreamInfo,
    SubjectTransform,
)
from nats.js.errors import NotFoundError

from heliograph.numerics.check import fail
from heliograph.serving.brokers.broker_address import Address
from heliograph.serving.brokers.source_translator import Translator
from heliograph.serving.brokers.transport import (
    FIRST,
    LOG,
    WHOLE,
    Batch,
    Part,
    Retry,
    TakenOverError,
    raise_if_cancelled,
    topic_of,
)
from heliograph.serving.message import Payload
from heliograph.serving.output import Output

MOST = 1000  # messages of a batch
WAIT = 5.0  # seconds that one request for messages stays open
ANSWER = 30.0  # seconds that the server has for an answer
UNTOUCHED = 600.0  # seconds before the server would send again by itself: newer messages would then have gone before
RETENTION = 7 * 86400.0  # seconds that outputs stay on the server
AWAY = (Error, OSError, asyncio.TimeoutError)

T = TypeVar("T")


class Nats:
    """Transport over NATS JetStream: stream TOPIC stores TOPIC.in.PLANT; outputs go to TOPIC.out.KIND.PLANT.

    A server that redelivers sends new messages first, and the redelivered ones might by then be too late. So nothing is
    ever redelivered: each reader, and each new connection, makes a consumer that begins after the last acknowledged
    message, and removes the previous one. One acknowledgement covers everything up to its message. Outputs that have a
    number are stored too.
    """

    def __init__(self, address: Address, part: Part = WHOLE, translator: Translator | None = None):
        """Prepare to serve one part of the plants through the server at `address`; the first call connects."""
        self.address, self.part, self._translator = address, part, translator
        self.topic = address.topic.replace("/", ".")  # NATS separates the words of a subject by dots
        self.stream = self.topic.replace(".", "-")  # the server's name of our stored messages
        # The connection; what stores messages on the server; what reads them. None until there is a connection.
        self._client = Client()
        self._server: JetStreamContext | None = None
        self._reader: JetStreamContext.PullSubscription | None = None
        # The server's record of our reading, a consumer: its name, and how many of its messages were read.
        self._name, self._read = "", 0
        self._acknowledged = 0  # number in the stream of the last acknowledged message
        # Waits between attempts; the lock keeps reading and publishing from connecting both at once.
        self._retry, self._opening = Retry(str(address)), asyncio.Lock()

    async def receive(self) -> Batch | None:
        """Wait for messages and return them, connecting anew where needed; a gap in their count has them read again."""
        while True:
            raise_if_cancelled()
            reader = await self._repeat_while_away(self._open_reader)
            messages = await self._fetch(reader)
            # There are none if none came meanwhile, or if the connection broke: `_open_reader` then makes a new one.
            if not messages or self._has_gap(messages):
                continue
            payloads = [payload for message in messages for payload in self._read_payloads(message)]
            if payloads:
                return Batch(payloads, partial(self._acknowledge, messages[-1]))
            await self._acknowledge(messages[-1])  # topics that nobody reads

    async def _fetch(self, reader: JetStreamContext.PullSubscription) -> list[Msg]:
        """Return the next messages, [] where none came for a while; a broken connection gets a new consumer."""
        try:
            messages: list[Msg] = await reader.fetch(MOST, WAIT)
        except TimeoutError:
            return []
        except AWAY as error:
            self._reader = None
            await self._retry.wait(error)
            return []
        return messages

    def _has_gap(self, messages: Sequence[Msg]) -> bool:
        """Return whether messages were lost on the way; if not, count these as read.

        The consumer, which is the server's side of a reader, counts what it sends. After a gap the reader is dropped
        (None), and a new one reads everything again from the last acknowledged message.
        """
        count = messages[-1].metadata.sequence.consumer
        if count != self._read + len(messages):
            self._reader = None
            return True
        self._read = count
        return False

    def _read_payloads(self, message: Msg) -> Sequence[Payload]:
        """Return a message in heliograph's own form as it is; for other subjects, return what the sources read in it.

        Sources write a subject as a topic, with / in place of dots.
        """
        if self._translator is None or message.subject.startswith(f"{self.topic}.in."):
            return [message.data]
        return self._translator.read(message.subject.replace(".", "/"), message.data, message.metadata.timestamp)

    @property
    def _source_subjects(self) -> list[str]:
        """Return the subjects of the sources, with the wildcards of NATS."""
        topics = [] if self._translator is None else self._translator.sources.subscribed_topics
        return [topic.replace("/", ".").replace("+", "*").replace("#", ">") for topic in topics]

    async def _acknowledge(self, last: Msg) -> None:
        """Acknowledge everything up to this message; if the server misses it, the messages come again as duplicates."""
        self._acknowledged = last.metadata.sequence.stream
        with contextlib.suppress(*AWAY):
            await last.ack_sync()

    async def publish(self, outputs: Sequence[Output]) -> None:
        """Publish outputs, in order; return when the server has stored those that have a number."""
        for begin in range(0, len(outputs), MOST):
            await self._repeat_while_away(partial(self._publish_some, outputs[begin : begin + MOST]))

    async def close(self) -> None:
        """End the connection, if there is one."""
        if self._client.is_connected:
            with contextlib.suppress(*AWAY):
                await asyncio.wait_for(self._client.close(), WAIT)

    async def _publish_some(self, outputs: Sequence[Output]) -> None:
        """Publish outputs; those that have a number are stored by the server, each once, before this returns."""
        server, stored = await self._open(), []
        for output in outputs:
            subject = topic_of(self.address.topic, output).replace("/", ".")
            if output.number is None:
                await self._client.publish(subject, output.body)
            else:
                name = {"Nats-Msg-Id": f"{subject}:{output.number}"}
                stored.append(await server.publish_async(subject, output.body, headers=name))
        await asyncio.wait_for(asyncio.gather(*stored), ANSWER)

    async def _repeat_while_away(self, act: Callable[[], Awaitable[T]]) -> T:
        """Await an action, and repeat it for as long as the server is away."""
        while True:
            try:
                done = await act()
            except AWAY as error:
                await self._retry.wait(error)
            else:
                self._retry.note_success()
                return done

    def _is_connected(self) -> bool:
        """Return whether the connection is open; a call, since it may change while other tasks run."""
        return self._client.is_connected

    async def _open(self) -> JetStreamContext:
        """Return the connection, opened anew if it is broken; raise the server's error if it cannot be."""
        async with self._opening:
            if self._server is not None and self._client.is_connected:
                return self._server
            await self.close()
            self._client, self._server, self._reader = Client(), None, None
            await self._connect()
            LOG.info("%s: connected", self.address)
            # The stream of outputs that are published exactly once.
            server = self._client.jetstream(timeout=ANSWER)
            subjects = [f"{self.topic}.out.{kind}.*" for kind in ("final", "refused")]
            await _find_or_make_stream(server, StreamConfig(f"{self.stream}-out", subjects=subjects, max_age=RETENTION))
            self._server = server
            return server

    async def _connect(self) -> None:
        """Connect the client, without its own reconnection, after which messages would arrive out of order."""
        failures = list[Exception]()  # the client reports these by a callback and raises another error

        async def note_failure(error: Exception) -> None:
            """Keep an error of the connection that is being made."""
            failures.append(error)

        # A user without a password is a token.
        connecting = self._client.connect(
            f"nats://{self.address.host}:{self.address.port}",
            error_cb=note_failure,
            user=self.address.user if self.address.password else None,
            password=self.address.password,
            token=None if self.address.password else self.address.user,
            tls=self.address.tls(),
            allow_reconnect=False,
            connect_timeout=5,
            reconnect_time_wait=FIRST,  # type: ignore[arg-type]  # between attempts at a server that is away
        )
        # That no server answered says less than the failure itself, by which the caller knows that the server is away.
        try:
            await connecting
        except NoServersError as error:
            raise (failures[0] if failures and isinstance(failures[0], AWAY) else error) from None

    async def _open_reader(self) -> JetStreamContext.PullSubscription:
        """Return a consumer of this part that begins after the last acknowledged message; remove all others.

        Several processes share a stream of messages, each reads one numbered part. A consumer is the server's record of
        what a reader has read; each start of a reader makes a new one with a name of its own, so that a process whose
        consumer is gone knows that another took its part over.

        Raises:
            TakenOverError: another process reads this part by now.
        """
        # Keep the reader while the connection lasts.
        if self._reader is not None and self._is_connected():
            return self._reader
        server = await self._open()
        newest = await self._make_stream(server)
        # Another process has taken over this part if our consumer is gone and there is another.
        prefix = f"part-{self.part.number}-of-{self.part.of}-"
        consumers = [each for each in await server.consumers_info(self.stream) if each.name.startswith(prefix)]
        is_taken_over = self._name and consumers and self._name not in [each.name for each in consumers]
        if is_taken_over:
            raise TakenOverError(f"{self.address}, part {self.part.number}: expected one reader, another took over")
        # Begin after the last message that any reader acknowledged, ours or an earlier one; at the newest at most. A
        # stream without consumers was made anew, so our old position means nothing there.
        acknowledged_there = [each.ack_floor.stream_seq for each in consumers if each.ack_floor is not None]
        acknowledged_by_us = self._acknowledged if consumers else 0
        self._acknowledged = min(max([acknowledged_by_us, *acknowledged_there]), newest)
        # Make the new consumer before the old ones are removed, so that there is always one.
        self._name, self._read = prefix + uuid.uuid4().hex[:12], 0
        await server.add_consumer(self.stream, self._configure_consumer())
        self._reader = await server.pull_subscribe_bind(self._name, self.stream)
        for old in consumers:
            await server.delete_consumer(self.stream, old.name)
        return self._reader

    def _configure_consumer(self) -> ConsumerConfig:
        """Return the consumer's settings: it sends this part's messages in order, after the last acknowledged one.

        To acknowledge a message also acknowledges all before it. A process that serves all plants also reads the
        sources' subjects.
        """
        return ConsumerConfig(
            durable_name=self._name,
            deliver_policy=DeliverPolicy.BY_START_SEQUENCE,
            opt_start_seq=self._acknowledged + 1,
            ack_policy=AckPolicy.ALL,
            ack_wait=UNTOUCHED,
            max_ack_pending=4 * MOST,
            filter_subject=f"{self.topic}.in.{self.part.number}.*" if self.part.of > 1 else None,
            filter_subjects=None if self.part.of > 1 else [f"{self.topic}.in.*", *self._source_subjects],
        )

    async def _make_stream(self, server: JetStreamContext) -> int:
        """Make the stream of messages if there is none; return the number of its last message.

        The server itself writes a plant's part into the subject.

        Raises:
            ValueError: the stream exists with another number of parts.
        """
        source, parts = f"{self.topic}.in.*", self.part.of
        # In the server's notation: TOPIC.in.PLANT becomes TOPIC.in.PART.PLANT, with the part by a hash of the plant.
        target = f"{self.topic}.in.{{{{partition({parts},1)}}}}.{{{{wildcard(1)}}}}"
        transform = SubjectTransform(source, target) if parts > 1 else None
        subjects = [source, *self._source_subjects]
        expected = StreamConfig(self.stream, subjects=subjects, storage=StorageType.FILE, subject_transform=transform)
        info = await _find_or_make_stream(server, expected)
        found = info.config.subject_transform
        if (found.dest if found else None) != (target if transform else None):
            raise fail(f"stream {self.stream} of {self.address}", f"one of {parts} parts", "one of another number")
        return info.state.last_seq


async def _find_or_make_stream(server: JetStreamContext, expected: StreamConfig) -> StreamInfo:
    """Return the stream of this name, made if there is none, with all subjects that are expected."""
    try:
        info = await server.stream_info(str(expected.name))
        if set(expected.subjects or ()) <= set(info.config.subjects or ()):
            return info
        return await server.update_stream(info.config.evolve(subjects=expected.subjects))
    except NotFoundError:
        return await server.add_stream(expected)
