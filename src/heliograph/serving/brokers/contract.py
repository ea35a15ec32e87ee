"""What a transport must do, shown on a broker: those of the package, and yours."""

import asyncio
from collections.abc import AsyncIterator, Awaitable, Iterable, Sequence
from contextlib import asynccontextmanager
from itertools import count
from typing import Protocol, TypeVar

from heliograph.serving.brokers.transport import Batch, Transport
from heliograph.serving.output import Output

T = TypeVar("T")
LONG = 1 << 16  # bytes of one of the messages
PAUSE = 0.1  # seconds between looks at what was told


class Broker(Protocol):
    """Both sides of a broker: the service's, and that of a sensor and of a reader, who know nothing of the service."""

    def transport(self) -> Transport:
        """The service's side, made anew, as after a restart."""

    async def send(self, bodies: Sequence[bytes]) -> None:
        """Send messages as a sensor does, in order; return when the broker has them."""

    async def published(self) -> Sequence[bytes]:
        """The bodies of all outputs that a reader has heard so far, in order."""


def check_transport(broker: Broker, messages: int = 100, patience: float = 20.0) -> bool:
    """Check the contract of a transport on a broker under which nothing was sent yet.

    Messages come whole and in order, and `receive` waits for them, until it is cancelled. What was acknowledged does
    not come again after a restart; what was not comes again, with what was sent while nobody read. What has a number is
    at the broker, in order, when `publish` returns. Nothing takes longer than `patience` seconds. Copies may come, and
    what was sent before the first transport listened may be lost.

    Returns whether what comes again comes in order. If not, the window of a service has to be longer than that takes.

    Raises:
        AssertionError: naming what does not hold.
    """
    return asyncio.run(_Check(broker, messages, patience).all())


class _Check:
    """One broker's examination."""

    def __init__(self, broker: Broker, messages: int, patience: float):
        self.broker, self.messages, self.patience = broker, messages, patience
        self.silence = patience / 20  # as long nothing comes where there is nothing
        self._numbers = count()

    async def all(self) -> bool:
        """Each promise in turn, to one service after another."""
        async with self._service() as transport:
            await self._listening(transport)
            sent = await self._sent()
            assert await self._until(transport, sent) == sent, "receive: expected new messages in order"
            await self._silent(transport)
        async with self._service() as transport:
            again = await self._for_a_while(transport)
            assert not again, f"acknowledge: expected nothing to come again, got {len(again)} messages"
            sent = await self._sent()
            await self._until(transport, sent[: len(sent) // 2], acknowledge=False)
            await self._for_a_while(transport)
        sent += await self._sent()
        async with self._service() as transport:
            result = await self._until(transport, sent)
            assert set(result) == set(sent), "acknowledge: expected no more than what was not acknowledged"
        await self._published()
        return result == sent

    @asynccontextmanager
    async def _service(self) -> AsyncIterator[Transport]:
        """A transport until it is closed."""
        transport = self.broker.transport()
        try:
            yield transport
        finally:
            await self._soon("close", transport.close())

    async def _listening(self, transport: Transport) -> None:
        """Greet until the service hears: before its first start a broker may keep nothing."""
        greeting = self._bodies(1)
        observation = asyncio.ensure_future(self._until(transport, greeting))
        while not observation.done():
            await self._soon("send", self.broker.send(greeting))
            await asyncio.wait({observation}, timeout=self.silence / 2)
        assert await observation == greeting, "receive: expected the bytes that were sent"
        await self._silent(transport)

    async def _published(self) -> None:
        """Closing right after `publish` loses nothing that has a number."""
        outputs = [Output(i, "a.b", "final", body) for i, body in enumerate(self._bodies(self.messages), 1)]
        now = Output(None, "a.b", "provisional", b"now")
        async with self._service() as transport:
            await self._soon("publish", transport.publish([]))
            await self._soon("publish", transport.publish([now, *outputs]))
        expected, result = [output.body for output in outputs], list[bytes]()
        for _ in range(1 + int(self.patience / PAUSE)):
            published = await self._soon("told", self.broker.published())
            result = _once(body for body in published if body != now.body)
            if len(result) >= len(expected):
                break
            await asyncio.sleep(PAUSE)
        missing = len(set(expected) - set(result))
        assert not missing, f"publish: expected {len(expected)} outputs at the broker, {missing} are not"
        assert result == expected, "publish: expected the outputs in order, and nothing else"

    async def _sent(self) -> list[bytes]:
        bodies = self._bodies(self.messages)
        await self._soon("send", self.broker.send(bodies))
        return bodies

    async def _until(self, transport: Transport, bodies: Sequence[bytes], acknowledge: bool = True) -> list[bytes]:
        """Receive until all of these have come; each once, in the order in which they came first."""
        result = list[bytes]()

        async def listen() -> None:
            while set(bodies) - set(result):
                result.extend(await self._taken(await transport.receive(), acknowledge))

        try:
            await asyncio.wait_for(listen(), self.patience)
        except TimeoutError:
            missing, count_ = len(set(bodies) - set(result)), len(bodies)
            what = f"receive: expected {count_} messages within {self.patience:g} s, {missing} did not come"
            raise AssertionError(what) from None
        return _once(result)

    async def _for_a_while(self, transport: Transport, acknowledge: bool = False) -> list[bytes]:
        """What comes until the wait is cancelled."""
        try:
            return await self._taken(await asyncio.wait_for(transport.receive(), self.silence), acknowledge)
        except TimeoutError:
            return []

    async def _silent(self, transport: Transport) -> None:
        """Take copies of what was acknowledged late, until none come."""
        while await self._for_a_while(transport, acknowledge=True):
            pass

    async def _taken(self, batch: Batch | None, acknowledge: bool) -> list[bytes]:
        assert batch is not None, "receive: expected to wait for messages, got None, which says that all ends"
        assert batch.payloads, "receive: expected to wait for messages, got a batch of none"
        if acknowledge:
            await self._soon("acknowledge", batch.acknowledge())
        return list(batch.payloads)

    async def _soon(self, what: str, waiting: Awaitable[T]) -> T:
        try:
            return await asyncio.wait_for(waiting, self.patience)
        except TimeoutError:
            raise AssertionError(f"{what}: expected an end within {self.patience:g} s") from None

    def _bodies(self, count_: int) -> list[bytes]:
        """Bodies that were not sent before; the first is long."""
        return [
            b'{"number":%d,"\xce\xa9":"%s"}' % (next(self._numbers), b"" if i else b"x" * LONG) for i in range(count_)
        ]


def _once(bodies: Iterable[bytes]) -> list[bytes]:
    return list(dict.fromkeys(bodies))
