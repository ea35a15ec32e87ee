"""The service at work: receive, take and commit, acknowledge, publish; until the end, or until it is told to stop."""

import asyncio
import signal
from collections.abc import Coroutine, Iterator, Sequence
from contextlib import contextmanager
from typing import Protocol, TypeVar

from heliograph.serving.brokers.transport import Transport
from heliograph.serving.output import Output

T = TypeVar("T")
PATIENCE = (
    10.0  # seconds that a reader has to take what is left when the service stops; what it does not stays journaled
)


class Takes(Protocol):
    """What a service is to the loop; it may be called from another thread, one call at a time."""

    def unpublished(self) -> list[Output]:
        """What was committed before a restart and may not have been told."""

    def take(self, payloads: Sequence[bytes]) -> list[Output]:
        """Use messages and commit; what is to be told of it."""

    def published(self, outputs: Sequence[Output]) -> None:
        """These were told: remembered with the next commit."""

    def finish(self, ended: bool) -> list[Output]:
        """Commit all; what is left to tell, the last time. `ended`: there will be no more messages."""


async def keep_running(service: Takes, transport: Transport) -> None:
    """Serve until the transport ends, or until SIGTERM or SIGINT: then what was received is committed and told."""
    stop = asyncio.Event()
    with signals(stop):
        await serve_until(stop, service, transport)


async def serve_until(stop: asyncio.Event, service: Takes, transport: Transport) -> None:
    """Serve until the transport ends or until `stop`: then what was received is committed and told."""
    try:
        await _publish(service, transport, service.unpublished(), stop)
        ended = await _serve(service, transport, stop)
        await _publish(service, transport, await asyncio.to_thread(service.finish, ended), stop)
        await asyncio.to_thread(service.finish, False)
    finally:
        await transport.close()


async def _serve(service: Takes, transport: Transport, stop: asyncio.Event) -> bool:
    """Whether the transport ended."""
    while not stop.is_set():
        batch = await _unless(stop, transport.receive())
        if batch is None:
            return not stop.is_set()
        outputs = await asyncio.to_thread(service.take, batch.payloads)
        await batch.acknowledge()
        await _publish(service, transport, outputs, stop)
    return False


async def _publish(service: Takes, transport: Transport, outputs: Sequence[Output], stop: asyncio.Event) -> None:
    """Tell the outputs; once it is to stop a reader has PATIENCE, and what it leaves is told after a restart."""
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
    """What is waited for; None if it is to stop before."""
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
    """Have the signals to stop say so."""
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
