"""The loop of a service: receive, take and commit, acknowledge, publish, until the end or a signal to stop."""

import asyncio
import signal
from collections.abc import Callable, Coroutine, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from time import monotonic
from typing import Any, Protocol, TypeVar

from heliograph.serving.brokers.transport import LOG, Transport
from heliograph.serving.message import Payload
from heliograph.serving.output import Output

T = TypeVar("T")
PATIENCE = 7.0  # seconds from a stop to the end: what is not done then comes again, or is journaled
LEAST = 0.5  # seconds that each piece of work after a stop has in any case


class StoppableWork:
    """Runs the work of a service until a stop, and after it for the time that is left.

    The service is called in a thread of its own, which is not waited for in the end.
    """

    def __init__(self, stop: asyncio.Event):
        """Make the one thread in which the service is called; `stop` is the event that ends the work."""
        self.stop = stop
        self._thread = ThreadPoolExecutor(1)
        self._stopped_at = 0.0  # by the monotonic clock; 0 before a stop

    async def wait_in_time(self, work: "asyncio.Future[T]") -> bool:
        """Wait for work to end, after a stop only for the time that is left; return whether it has ended."""
        stopped = asyncio.ensure_future(self.stop.wait())
        both: set[asyncio.Future[Any]] = {work, stopped}
        await asyncio.wait(both, return_when=asyncio.FIRST_COMPLETED)
        stopped.cancel()
        if not work.done():
            self._stopped_at = self._stopped_at or monotonic()
            await asyncio.wait({work}, timeout=max(self._stopped_at + PATIENCE - monotonic(), LEAST))
        return work.done()

    async def call(self, function: Callable[..., T], *arguments: object) -> T:
        """Return what a function of the service returns, called in the service's thread.

        Raises:
            AbandonedError: it takes longer than is left after a stop, as where programs are compiled.
        """
        work = asyncio.get_running_loop().run_in_executor(self._thread, function, *arguments)
        if not await self.wait_in_time(work):
            raise AbandonedError
        return work.result()


class AbandonedError(Exception):
    """End of a service that was still computing when its time was over: nothing of that is committed."""


class BatchService(Protocol):
    """A service as the loop sees it; it may be called from another thread, one call at a time."""

    def unpublished(self) -> list[Output]:
        """Return outputs that were committed before a restart and may not have been published."""

    def take(self, payloads: Sequence[Payload]) -> list[Output]:
        """Use messages and commit; return the outputs to publish. No messages: nothing came for a while."""

    def published(self, outputs: Sequence[Output]) -> None:
        """Note that these outputs were published; the next commit records it."""

    def finish(self, ended: bool) -> list[Output]:
        """Commit everything; return the last outputs. `ended`: there will be no more messages."""


async def keep_running(service: BatchService, transport: Transport) -> None:
    """Serve until the transport ends, or until SIGTERM or SIGINT; then commit and publish what was received.

    Args:
        service: the service, which takes messages and returns outputs.
        transport: where messages come from and outputs go; it is closed at the end.
    """
    stop = asyncio.Event()
    with set_stop_on_signals(stop):
        await serve_until(stop, service, transport)


async def serve_until(
    stop: asyncio.Event, service: BatchService, transport: Transport, patience: float | None = None
) -> None:
    """Serve until the transport ends or `stop` is set; then commit and publish what was received.

    Args:
        stop: event that ends the loop.
        service: the service, which takes messages and returns outputs.
        transport: where messages come from and outputs go; it is closed at the end.
        patience: seconds without messages after which the service takes that nothing came; None for never.
    """
    ending = StoppableWork(stop)
    try:
        # First what an earlier run has left; then the messages; at last what the end makes final.
        await _publish_in_time(service, transport, service.unpublished(), ending)
        ended = await _serve_batches(service, transport, ending, patience)
        await _publish_in_time(service, transport, await ending.call(service.finish, ended), ending)
        await ending.call(service.finish, False)  # this commit records that the outputs were published
    except AbandonedError:
        LOG.warning("stopped while it computed: the messages that it was taking are not committed, and come again")
    finally:
        await transport.close()


async def _serve_batches(
    service: BatchService, transport: Transport, ending: StoppableWork, patience: float | None
) -> bool:
    """Receive, take and publish until a stop or the transport's end; return whether it was the latter.

    Messages are acknowledged once what was made of them is committed, before it is published.
    """
    stop = ending.stop
    while not stop.is_set():
        # The next messages, or after a while that there are none.
        waiting = asyncio.ensure_future(_await_unless_stopped(stop, transport.receive()))
        try:
            while True:
                done, _pending = await asyncio.wait({waiting}, timeout=patience)
                if done:
                    break
                await _publish_in_time(service, transport, await ending.call(service.take, []), ending)
        finally:
            waiting.cancel()
        batch = waiting.result()
        if batch is None:
            return not stop.is_set()
        outputs = await ending.call(service.take, batch.payloads)
        await batch.acknowledge()
        await _publish_in_time(service, transport, outputs, ending)
    return False


async def _publish_in_time(
    service: BatchService, transport: Transport, outputs: Sequence[Output], ending: StoppableWork
) -> None:
    """Publish outputs and note this in the service, unless a stop comes and publishing is not done in the time left.

    Then the outputs count as unpublished, and are published after a restart.
    """
    publishing = asyncio.ensure_future(transport.publish(outputs))
    if not await ending.wait_in_time(publishing):
        publishing.cancel()
        return
    publishing.result()  # raises what it raised
    service.published(outputs)


async def _await_unless_stopped(stop: asyncio.Event, waiting: Coroutine[object, object, T]) -> T | None:
    """Return what a coroutine returns; if `stop` is set first, cancel it and return None.

    It may still return something in spite of the cancellation: that is returned then.
    """
    task, stopped = asyncio.ensure_future(waiting), asyncio.ensure_future(stop.wait())
    await asyncio.wait({task, stopped}, return_when=asyncio.FIRST_COMPLETED)
    stopped.cancel()
    if task.done():
        return task.result()
    # Again and again: a client may take a cancellation for the end of its own wait, as wait_for of Python 3.11 does.
    while not task.done():
        task.cancel()
        await asyncio.wait({task}, timeout=1.0)
    return None if task.cancelled() else task.result()


@contextmanager
def set_stop_on_signals(stop: asyncio.Event) -> Iterator[None]:
    """Within the `with` block, set `stop` on SIGTERM and SIGINT; then restore the earlier handlers."""
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
