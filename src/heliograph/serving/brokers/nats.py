"""Messages through NATS JetStream: a part of the stream is read in order, from what was acknowledged last."""

import asyncio
import contextlib
import uuid
from collections.abc import Awaitable, Callable, Sequence
from functools import partial
from typing import TypeVar

from nats.aio.client import Client
from nats.aio.msg import Msg
from nats.errors import Error, TimeoutError
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
from heliograph.serving.brokers.partition import WHOLE, Part, word
from heliograph.serving.brokers.retry import Retry, still_needed
from heliograph.serving.brokers.transport import Batch, TakenOverError
from heliograph.serving.brokers.url import Address
from heliograph.serving.output import Output

MOST = 1000  # messages of a batch
WAIT = 5.0  # seconds that one request for messages stays open
ANSWER = 30.0  # seconds that the server has for an answer
UNTOUCHED = 600.0  # seconds before the server would send again by itself: newer messages would then have gone before
RETENTION = 7 * 86400.0  # seconds that outputs stay on the server
AWAY = (Error, OSError, asyncio.TimeoutError)

T = TypeVar("T")


class Nats:
    """The messages of TOPIC.in.PLANT, as stream TOPIC keeps them; outputs go to TOPIC.out.KIND.PLANT and are kept too.

    A server that redelivers sends what is new first, and what is late might by then be too late. So nothing is ever
    redelivered: each reader, and each connection anew, makes a consumer that begins after the last acknowledged
    message, and removes the one before. One acknowledgement says that everything up to a message is kept.
    """

    def __init__(self, address: Address, part: Part = WHOLE):
        self.address, self.part = address, part
        self.topic = address.topic.replace("/", ".")
        self.stream = self.topic.replace(".", "-")
        self._client = Client()
        self._server: JetStreamContext | None = None
        self._reader: JetStreamContext.PullSubscription | None = None
        self._name, self._read, self._acknowledged = "", 0, 0
        self._retry, self._opening = Retry(str(address)), asyncio.Lock()

    async def receive(self) -> Batch | None:
        while True:
            still_needed()
            reader = await self._persist(self._reading)
            try:
                messages = await reader.fetch(MOST, WAIT)
            except TimeoutError:
                messages = []
            except AWAY as error:
                self._reader = None
                await self._retry.wait(error)
                continue
            if not messages:  # none came meanwhile, or the connection broke, which `_reading` sees
                continue
            count = messages[-1].metadata.sequence.consumer
            if count != self._read + len(messages):  # some were lost on the way here
                self._reader = None
                continue
            self._read = count
            return Batch([message.data for message in messages], partial(self._solve_steady, messages[-1]))

    async def _solve_steady(self, last: Msg) -> None:
        """Everything up to this message is kept; if the server does not hear of it they come again, as duplicates."""
        self._acknowledged = last.metadata.sequence.stream
        with contextlib.suppress(*AWAY):
            await last.ack_sync()

    async def publish(self, outputs: Sequence[Output]) -> None:
        for begin in range(0, len(outputs), MOST):
            await self._persist(partial(self._tell, outputs[begin : begin + MOST]))

    async def close(self) -> None:
        if self._client.is_connected:
            with contextlib.suppress(*AWAY):
                await asyncio.wait_for(self._client.close(), WAIT)

    async def _tell(self, outputs: Sequence[Output]) -> None:
        """Provisional estimates as they pass; what has a number stays, once, if it is told again soon."""
        server, stored = await self._open(), []
        for output in outputs:
            subject = f"{self.topic}.out.{output.kind}.{word(output.plant)}"
            if output.number is None:
                await self._client.publish(subject, output.body)
            else:
                name = {"Nats-Msg-Id": f"{subject}:{output.number}"}
                stored.append(await server.publish_async(subject, output.body, headers=name))
        await asyncio.wait_for(asyncio.gather(*stored), ANSWER)

    async def _persist(self, act: Callable[[], Awaitable[T]]) -> T:
        """Do it, however long the server is away."""
        while True:
            try:
                done = await act()
            except AWAY as error:
                await self._retry.wait(error)
            else:
                self._retry.worked()
                return done

    def _connected(self) -> bool:
        return self._client.is_connected

    async def _open(self) -> JetStreamContext:
        """The connection, made anew where it broke."""
        async with self._opening:
            if self._server is not None and self._client.is_connected:
                return self._server
            await self.close()
            self._client, self._server, self._reader = Client(), None, None
            await self._client.connect(
                f"nats://{self.address.host}:{self.address.port}",
                error_cb=_silent,
                user=self.address.user if self.address.password else None,
                password=self.address.password,
                token=None if self.address.password else self.address.user,
                tls=self.address.tls(),
                allow_reconnect=False,
                connect_timeout=5,
            )
            server = self._client.jetstream(timeout=ANSWER)
            subjects = [f"{self.topic}.out.{kind}.*" for kind in ("final", "refused")]
            await _stream(server, StreamConfig(f"{self.stream}-out", subjects=subjects, max_age=RETENTION))
            self._server = server
            return server

    async def _reading(self) -> JetStreamContext.PullSubscription:
        """A consumer of this part that begins after what was acknowledged; others of the part are removed."""
        if self._reader is not None and self._connected():
            return self._reader
        server = await self._open()
        newest = await self._made(server)
        mine = f"part-{self.part.number}-of-{self.part.of}-"
        others = [c for c in await server.consumers_info(self.stream) if c.name.startswith(mine)]
        if self._name and others and self._name not in [c.name for c in others]:
            raise TakenOverError(f"{self.address}, part {self.part.number}: expected one reader, another took over")
        floors = [c.ack_floor.stream_seq for c in others if c.ack_floor is not None]
        begun = self._acknowledged if others else 0  # a stream without its consumers is a new one
        self._acknowledged = min(max([begun, *floors]), newest)
        self._name, self._read = mine + uuid.uuid4().hex[:12], 0
        await server.add_consumer(self.stream, self._consumer())
        self._reader = await server.pull_subscribe_bind(self._name, self.stream)
        for other in others:
            await server.delete_consumer(self.stream, other.name)
        return self._reader

    def _consumer(self) -> ConsumerConfig:
        return ConsumerConfig(
            durable_name=self._name,
            deliver_policy=DeliverPolicy.BY_START_SEQUENCE,
            opt_start_seq=self._acknowledged + 1,
            ack_policy=AckPolicy.ALL,
            ack_wait=UNTOUCHED,
            max_ack_pending=4 * MOST,
            filter_subject=f"{self.topic}.in.{self.part.number}.*" if self.part.of > 1 else f"{self.topic}.in.*",
        )

    async def _made(self, server: JetStreamContext) -> int:
        """The stream of messages, if it is not there yet, and the number of the last one.

        The server itself writes a plant's part into the subject.
        """
        source, parts = f"{self.topic}.in.*", self.part.of
        target = f"{self.topic}.in.{{{{partition({parts},1)}}}}.{{{{wildcard(1)}}}}"
        transform = SubjectTransform(source, target) if parts > 1 else None
        expected = StreamConfig(self.stream, subjects=[source], storage=StorageType.FILE, subject_transform=transform)
        result = await _stream(server, expected)
        known = result.config.subject_transform
        if (known.dest if known else None) != (target if transform else None):
            raise fail(f"stream {self.stream} of {self.address}", f"one of {parts} parts", "one of another number")
        return result.state.last_seq


async def _stream(server: JetStreamContext, expected: StreamConfig) -> StreamInfo:
    """The stream of this name as it is, made if there is none."""
    try:
        return await server.stream_info(str(expected.name))
    except NotFoundError:
        return await server.add_stream(expected)


async def _silent(_: Exception) -> None:
    """What goes wrong is raised where it is waited for."""
