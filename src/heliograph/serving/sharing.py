"""Sharing of plants among processes: each serves the parts that it leases, with a service for each."""

import asyncio
import contextlib
from collections.abc import Callable, Coroutine
from dataclasses import dataclass
from typing import Protocol

from heliograph.serving.brokers.transport import LOG, TakenOverError
from heliograph.serving.loop import signals

Serve = Callable[[int, asyncio.Event], Coroutine[object, object, None]]


class Leased(Protocol):
    """Source of the parts that this process may serve."""

    term: float

    def renew(self) -> set[int]:
        """Renew the leases; return the parts of this process."""

    def release(self, number: int) -> None:
        """Release one part."""

    def leave(self) -> None:
        """Release all parts."""


@dataclass
class _Part:
    """A part that is being served, and the event that ends it."""

    work: asyncio.Task[None]
    stop: asyncio.Event

    async def end(self) -> None:
        """Stop the service of this part, after it has committed and published what it received."""
        self.stop.set()
        with contextlib.suppress(TakenOverError):
            await self.work


async def keep_sharing(leases: Leased, serve: Serve) -> None:
    """Serve the leased parts until SIGTERM or SIGINT; `serve(part, stop)` serves one until `stop` is set.

    When a process joins, the others finish some of their parts and leave them to it. When one dies, its parts become
    free after a term; whoever takes one over first publishes what was committed and not published.
    """
    stop = asyncio.Event()
    parts: dict[int, _Part] = {}
    with signals(stop):
        try:
            while not stop.is_set():
                await _adjust(parts, leases, serve)
                with contextlib.suppress(TimeoutError):
                    await asyncio.wait_for(stop.wait(), leases.term / 5)
        finally:
            await asyncio.gather(*[part.end() for part in parts.values()])
            await asyncio.to_thread(leases.leave)


async def _adjust(parts: dict[int, _Part], leases: Leased, serve: Serve) -> None:
    """Start and stop services so that exactly the leased parts are served."""
    # Parts whose service ended by itself: another process took them over, or it failed.
    for number, part in list(parts.items()):
        if part.work.done():
            del parts[number]
            try:
                part.work.result()
            except TakenOverError as error:
                LOG.warning("%s", error)
    # Stop those that are no longer leased, then release them; start the new ones.
    expected = await asyncio.to_thread(leases.renew)
    gone = [number for number in parts if number not in expected]
    await asyncio.gather(*[parts[number].end() for number in gone])
    for number in gone:
        del parts[number]
        await asyncio.to_thread(leases.release, number)
    for number in sorted(expected - parts.keys()):
        ending = asyncio.Event()
        parts[number] = _Part(asyncio.ensure_future(serve(number, ending)), ending)
