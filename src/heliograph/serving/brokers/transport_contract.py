"""Contract test of a transport against a real broker: for the transports of the package, and for your own."""

import asyncio
from collections.abc import AsyncIterator, Awaitable, Iterable, Sequence
from contextlib import asynccontextmanager
from itertools import count
from typing import Protocol, TypeVar

from heliograph.serving.brokers.transport import Batch, Transport
from heliograph.serving.output import Output

T = TypeVar("T")
LONG = 1 << 16  # bytes of one of the messages
PAUSE = 0.1  # seconds between looks at the published outputs


class Broker(Protocol):
    """A broker under test, from both sides: the service's transport, and sensors and readers, who do not know of it."""

    def transport(self) -> Transport:
        """Make the service's side anew, as after a restart."""

    async def send(self, bodies: Sequence[bytes]) -> None:
        """Send messages as a sensor does, in order; return when the broker has them."""

    async def published(self) -> Sequence[bytes]:
        """Return the bodies of all outputs that a reader has received so far, in order."""


def check_transport(broker: Broker, messages: int = 100, patience: float = 20.0) -> bool:
    """Check the contract of a transport on a broker to which nothing has been sent yet.

    Messages arrive complete and in order, and `receive` waits for them until it is cancelled. A message that was
    acknowledged is not delivered again after a restart; one that was not is delivered again, together with what was
    sent while nobody was reading. Outputs that have a number are at the broker, in order, when `publish` returns.
    Copies may arrive, and what was sent before the first transport listened may be lost.

    Args:
        broker: both sides of the broker to examine.
        messages: number of messages sent in each part of the check (default 100).
        patience: seconds that a single call may take at most (default 20).

    Returns:
        Whether redelivered messages arrive in order. If not, the window of a service has to be longer than a redelivery
        takes.

    Raises:
        AssertionError: naming the promise that does not hold.
    """
    return asyncio.run(_Examination(broker, messages, patience).check_all())


class _Examination:
    """One examination of a broker, which sends numbered messages and asserts each promise of its transport."""

    def __init__(self, broker: Broker, messages: int, patience: float):
        """Hold the broker, the number of messages to send, and the seconds after which a missing one counts as lost."""
        self.broker, self.messages, self.patience = broker, messages, patience
        self.silence = patience / 20  # seconds without a message after which we assume that there is none
        self._numbers = count()  # numbers the messages

    async def check_all(self) -> bool:
        """Check each promise of a transport; return whether messages that come again come in order.

        The transport is opened and closed three times, as by a service that is restarted.
        """
        # First service: new messages arrive in order, and all are acknowledged.
        async with self._open_transport() as transport:
            await self._start_listening(transport)
            sent = await self._send_new()
            assert await self._receive_until(transport, sent) == sent, "receive: expected new messages in order"
            await self._drain_copies(transport)
        # Second service: none of them arrives again; the next messages, half of them received, stay unacknowledged.
        async with self._open_transport() as transport:
            again = await self._receive_for_a_while(transport)
            assert not again, f"acknowledge: expected nothing to come again, got {len(again)} messages"
            sent = await self._send_new()
            await self._receive_until(transport, sent[: len(sent) // 2], acknowledge=False)
            await self._receive_for_a_while(transport)
        # Third service: all of these arrive again, with those that were sent while nobody was reading.
        sent += await self._send_new()
        async with self._open_transport() as transport:
            received = await self._receive_until(transport, sent)
            assert set(received) == set(sent), "acknowledge: expected no more than what was not acknowledged"
        await self._check_published()
        return received == sent

    @asynccontextmanager
    async def _open_transport(self) -> AsyncIterator[Transport]:
        """Open a transport for a block, and close it at the end."""
        transport = self.broker.transport()
        try:
            yield transport
        finally:
            await self._await_soon("close", transport.close())

    async def _start_listening(self, transport: Transport) -> None:
        """Send greetings until the service receives one: before its first start a broker may store nothing."""
        greeting = self._make_bodies(1)
        observation = asyncio.ensure_future(self._receive_until(transport, greeting))
        while not observation.done():
            await self._await_soon("send", self.broker.send(greeting))
            await asyncio.wait({observation}, timeout=self.silence / 2)
        assert await observation == greeting, "receive: expected the bytes that were sent"
        await self._drain_copies(transport)

    async def _check_published(self) -> None:
        """Check that closing right after `publish` loses no output that has a number."""
        outputs = [Output(i, "a.b", "final", body) for i, body in enumerate(self._make_bodies(self.messages), 1)]
        now = Output(None, "a.b", "provisional", b"now")
        async with self._open_transport() as transport:
            await self._await_soon("publish", transport.publish([]))
            await self._await_soon("publish", transport.publish([now, *outputs]))
        expected, arrived = [output.body for output in outputs], list[bytes]()
        for _ in range(1 + int(self.patience / PAUSE)):
            published = await self._await_soon("published", self.broker.published())
            arrived = _drop_repeated(body for body in published if body != now.body)
            if len(arrived) >= len(expected):
                break
            await asyncio.sleep(PAUSE)
        missing = len(set(expected) - set(arrived))
        assert not missing, f"publish: expected {len(expected)} outputs at the broker, {missing} are not"
        assert arrived == expected, "publish: expected the outputs in order, and nothing else"

    async def _send_new(self) -> list[bytes]:
        """Send `messages` bodies that were not sent before, and return them."""
        bodies = self._make_bodies(self.messages)
        await self._await_soon("send", self.broker.send(bodies))
        return bodies

    async def _receive_until(
        self, transport: Transport, bodies: Sequence[bytes], acknowledge: bool = True
    ) -> list[bytes]:
        """Receive until all of these bodies have arrived; return each once, in the order of first arrival."""
        received = list[bytes]()

        async def receive_all() -> None:
            """Receive batches of the transport, acknowledged if `acknowledge`, until `received` has all `bodies`."""
            while set(bodies) - set(received):
                received.extend(await self._unpack(await transport.receive(), acknowledge))
                await asyncio.sleep(0)  # a transport that never waits would let no time pass

        # A timeout, and not `wait_for`: Python 3.11's may lose the cancellation of what waits inside, and never end.
        try:
            async with asyncio.timeout(self.patience):
                await receive_all()
        except TimeoutError:
            missing, total = len(set(bodies) - set(received)), len(bodies)
            what = f"receive: expected {total} messages within {self.patience:g} s, {missing} did not come"
            raise AssertionError(what) from None
        return _drop_repeated(received)

    async def _receive_for_a_while(self, transport: Transport, acknowledge: bool = False) -> list[bytes]:
        """Receive for `silence` seconds, then cancel; return the bodies that arrived."""
        try:
            async with asyncio.timeout(self.silence):
                batch = await transport.receive()
        except TimeoutError:
            return []
        return await self._unpack(batch, acknowledge)

    async def _drain_copies(self, transport: Transport) -> None:
        """Receive and acknowledge late copies until none arrive."""
        while await self._receive_for_a_while(transport, acknowledge=True):
            pass

    async def _unpack(self, batch: Batch | None, acknowledge: bool) -> list[bytes]:
        """Check a batch that was received, acknowledge it if asked to, and return the bytes of its messages."""
        assert batch is not None, "receive: expected to wait for messages, got None, which says that all ends"
        assert batch.payloads, "receive: expected to wait for messages, got a batch of none"
        if acknowledge:
            await self._await_soon("acknowledge", batch.acknowledge())
        bodies = [body for body in batch.payloads if isinstance(body, bytes)]
        assert len(bodies) == len(batch.payloads), "receive: expected the bytes that were sent"
        return bodies

    async def _await_soon(self, what: str, waiting: Awaitable[T]) -> T:
        """Await an action that a transport must end within the patience of the check."""
        try:
            async with asyncio.timeout(self.patience):
                return await waiting
        except TimeoutError:
            raise AssertionError(f"{what}: expected an end within {self.patience:g} s") from None

    def _make_bodies(self, total: int) -> list[bytes]:
        """Return bodies of messages with new numbers; the first one has a text of LONG bytes.

        The name of the text is a letter of two bytes in UTF-8. It reveals a transport that changes the encoding.
        """
        texts = [b"x" * LONG, *[b""] * (total - 1)][:total]
        return [b'{"number":%d,"\xce\xa9":"%s"}' % (next(self._numbers), text) for text in texts]


def _drop_repeated(bodies: Iterable[bytes]) -> list[bytes]:
    """Return bodies in their order without those that came again."""
    return list(dict.fromkeys(bodies))
