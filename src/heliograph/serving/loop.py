"""The loop of a service: receive, take and commit, acknowledge, publish, until the end or a signal to stop."""

import asyncio
import signal
from collections.abc import Coroutine, Iterator, Sequence
from contextlib import contextmanager
from typing import Protocol, TypeVar

from heliograph.serving.brokers.transport import Transport
from heliograph.serving.message import Payload
from heliograph.serving.output import Output

T = TypeVar("T")
PATIENCE = (
    10.0  # seconds that a reader has to take what is left when the service stops; what it does not stays journaled
)


class Takes(Protocol):
    """A service as the loop sees it; it may be called from another thread, one call at a time."""

    def unpublished(self) -> list[Output]:
        """Return outputs that were committed before a restart and may not have been published."""

    def take(self, payloads: Sequence[Payload]) -> list[Output]:
        """Use messages and commit; return the outputs to publish. No messages: nothing came for a while."""

    def published(self, outputs: Sequence[Output]) -> None:
        """Note that these outputs were published; the next commit records it."""

    def finish(self, ended: bool) -> list[Output]:
        """Commit everything; return the last outputs. `ended`: there will be no more messages."""


async def keep_running(service: Takes, transport: Transport) -> None:
    """Serve until the transport ends, or until SIGTERM or SIGINT; then commit and publish what was received.

    Args:
        service: the service, which takes messages and returns outputs.
        transport: where messages come from and outputs go; it is closed at the end.
    """
    stop = asyncio.Event()
    with signals(stop):
        await serve_until(stop, service, transport)


async def serve_until(stop: asyncio.Event, service: Takes, transport: Transport, patience: float | None = None) -> None:
    """Serve until the transport ends or `stop` is set; then commit and publish what was received.

    Args:
        stop: event that ends the loop.
        service: the service, which takes messages and returns outputs.
        transport: where messages come from and outputs go; it is closed at the end.
        patience: seconds without messages after which the service takes that nothing came; None for never.
    """
    try:
        await _publish(service, transport, service.unpublished(), stop)
        ended = await _serve(service, transport, stop, patience)
        await _publish(service, transport, await asyncio.to_thread(service.finish, ended), stop)
        await asyncio.to_thread(service.finish, False)
    finally:
        await transport.close()


async def _serve(service: Takes, transport: Transport, stop: asyncio.Event, patience: float | None) -> bool:
    """Run the loop; return whether the transport ended."""
    while not stop.is_set():
        # The next messages, or after a while that there are none.
        waiting = asyncio.ensure_future(_unless(stop, transport.receive()))
        try:
            while not (await asyncio.wait({waiting}, timeout=patience))[0]:
                await _publish(service, transport, await asyncio.to_thread(service.take, []), stop)
        finally:
            waiting.cancel()
        batch = waiting.result()
        if batch is None:
            return not stop.is_set()
        outputs = await asyncio.to_thread(service.take, batch.payloads)
        await batch.acknowledge()
        await _publish(service, transport, outputs, stop)
    return False


async def _publish(service: Takes, transport: Transport, outputs: Sequence[Output], stop: asyncio.Event) -> None:
    """Publish outputs; after `stop` a reader has PATIENCE seconds, and the rest is published after a restart."""
    telling = asyncio.ensure_future(transport.publish(outputs))
    stopped = asyncio.ensure_future(stop.wait())
    await asyncio.wait({telling, stopped}, return_when=asyncio.FIRST_COMPLETED)
    stopped.cancel()
    try:
        await asyncio.wait_for(telling, PATIENCE)
    except TimeoutError:
        return
    service.published(outputs)


async def _unless(stop: asyncio.Event, waiting: Coroutine[object, object, T]) -> T | None:
    """Await a coroutine; cancel it and return None if `stop` is set first."""
    task, stopped = asyncio.ensure_future(waiting), asyncio.ensure_future(stop.wait())
    await asyncio.wait({task, stopped}, return_when=asyncio.FIRST_COMPLETED)
    stopped.cancel()
    if task.done():
        return task.result()
    while not task.done():  # again: a client may take it for the end of its own wait, as wait_for of Python 3.11 does
        task.cancel()
        await asyncio.wait({task}, timeout=1.0)
    return None if task.cancelled() else task.result()


@contextmanager
def signals(stop: asyncio.Event) -> Iterator[None]:
    """Set `stop` on SIGTERM and SIGINT, for the duration of a block."""
    loop, numbers = asyncio.get_running_loop(), (signal.SIGTERM, signal.SIGINT)
    before = [signal.getsignal(number) for number in numbers]
    for number in numbers:
        loop.add_signal_handler(number, stop.set)
    try:
        yield
    finally:
        for number, handler in zip(numbers, before, strict=True):
            loop.remove_signal_handler(number)
            signal.signal(number, handler)
