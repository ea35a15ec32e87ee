"""A process among several: it serves the parts of the plants that it leases, each with a service of its own."""

import asyncio
import contextlib
from collections.abc import Callable, Coroutine
from dataclasses import dataclass
from typing import Protocol

from heliograph.serving.brokers.retry import LOG
from heliograph.serving.brokers.transport import TakenOverError
from heliograph.serving.loop import signals

Serve = Callable[[int, asyncio.Event], Coroutine[object, object, None]]


class Leased(Protocol):
    """What says which parts are this process's."""

    term: float

    def renew(self) -> set[int]:
        """Those that are."""

    def release(self, number: int) -> None:
        """One that is not any more."""

    def leave(self) -> None:
        """All."""


@dataclass
class _Part:
    """A part at work, and what ends it."""

    work: asyncio.Task[None]
    stop: asyncio.Event

    async def end(self) -> None:
        """What was received is committed and told."""
        self.stop.set()
        with contextlib.suppress(TakenOverError):
            await self.work


async def keep_sharing(leases: Leased, serve: Serve) -> None:
    """Serve the parts that are leased, until SIGTERM or SIGINT; `serve(part, stop)` serves one until `stop`.

    When a process joins, the others finish some of their parts and leave them to it. When one dies, its parts are
    free after a term; who takes one over tells first what was committed and not told.
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
    """Serve those parts that are leased now, and no others."""
    for number, part in list(parts.items()):
        if part.work.done():
            del parts[number]
            try:
                part.work.result()
            except TakenOverError as error:
                LOG.warning("%s", error)
    expected = await asyncio.to_thread(leases.renew)
    gone = [number for number in parts if number not in expected]
    await asyncio.gather(*[parts[number].end() for number in gone])
    for number in gone:
        del parts[number]
        await asyncio.to_thread(leases.release, number)
    for number in sorted(expected - parts.keys()):
        ending = asyncio.Event()
        parts[number] = _Part(asyncio.ensure_future(serve(number, ending)), ending)
