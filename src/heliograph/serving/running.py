"""A service by its options: what it reads from, where it keeps its state, who shares it, and who may look."""

import asyncio
import os
import socket
import sys
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from shlex import quote

from heliograph.numerics.check import check_count, fail
from heliograph.serving.brokers.broker import connected
from heliograph.serving.brokers.partition import Part
from heliograph.serving.brokers.pipe import Pipe
from heliograph.serving.brokers.url import Address
from heliograph.serving.fleet import Fleet, Options
from heliograph.serving.lanes import Lanes
from heliograph.serving.loop import Takes, serve_until, signals
from heliograph.serving.service import Service
from heliograph.serving.sharing import keep_sharing
from heliograph.serving.storage.identity import identity
from heliograph.serving.storage.in_memory_store import InMemoryStore
from heliograph.serving.storage.store_protocol import Damage, StoreProtocol
from heliograph.simulation.network import Network

NOTHING = "none"  # the store that keeps nothing
LISTED = 10  # damaged plants in one line


@dataclass(frozen=True)
class ServiceSettings:
    """What a service is to be; `parts`: how many parts of the plants several processes share among them;
    `anew`: names of plants that begin anew.

    Raises:
        ValueError: parts without a store and a broker, which all processes share; a snapshot without a store.
    """

    network: Network
    options: Options
    store: str | None = None
    process: str = ""
    snapshot: Path | None = None
    broker: Address | None = None
    parts: int | None = None
    page: str | None = None
    anew: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.snapshot is not None:
            if self.store is None:
                raise fail("--from-snapshot", "a store to begin in (--store FILE)", "none")
            if not self.snapshot.is_file():
                raise fail(f"snapshot {self.snapshot}", "a store's file", "nothing of that name")
        if self.anew and self.store is None:
            raise fail("--anew", "a store that has the plants (--store FILE)", "none")
        if self.parts is not None:
            check_count("--parts", self.parts)
            if self.store is None or self.broker is None:
                raise fail("--parts", "a store and a broker that all processes share", "not both")


def store_of(network: str, given: str | None, parts: int | None) -> str | None:
    """The place that keeps the state, as it was given; else a file here that is called as the network is.

    None keeps nothing. Processes that share parts must all be told where.
    """
    if given is not None or parts is not None:
        return None if given == NOTHING else given
    place, _, name = network.rpartition(":")
    file, name = (place, f"-{name}") if name.isidentifier() and place else (network, "")
    stem = Path(file).stem if file.endswith(".py") else file.rpartition(".")[2]
    return f"{stem}{name}.db"


async def run(settings: ServiceSettings) -> None:
    """Serve until the messages end, or until SIGTERM or SIGINT."""
    async with _watched(settings) as look:
        lanes = Lanes(settings.network)
        if lanes.uneven:
            what = f"predictions depend on when others are asked for: {lanes.uneven}"
            print(f"heliograph: warning: {what}", file=sys.stderr)
        if settings.parts is None:
            await _alone(settings, lanes, look)
        else:
            await _shared(settings, lanes, look, settings.parts)


Look = Callable[[Service], Takes]


@asynccontextmanager
async def _watched(settings: ServiceSettings) -> AsyncIterator[Look]:
    """Services as a page shows them, if there is one."""
    if settings.page is None:
        yield lambda service: service
        return
    from heliograph.serving.page import door, shown
    from heliograph.serving.watch import Watch

    watch = Watch(settings.network.states)
    async with shown(watch, door(settings.page)):
        yield watch.over


async def _alone(settings: ServiceSettings, lanes: Lanes, look: Look) -> None:
    """One process: all messages."""
    stop = asyncio.Event()
    fleet = Fleet(lanes, settings.options)
    store = _open_store(settings, fleet)
    resumed, service = store.count() > 0, Service(fleet, store, _say)
    try:
        with signals(stop):
            transport = Pipe() if settings.broker is None else connected(settings.broker)
            await serve_until(stop, look(service), transport)
    finally:
        store.close()
    if resumed and service.known:
        anew = f"to begin anew, delete {store.name} or name another --store"
        _say(f"{service.known} messages were known already or came after what was final; {anew}")


def _open_store(settings: ServiceSettings, fleet: Fleet) -> StoreProtocol:
    """Where the state is kept, with what it begins from."""
    if settings.store is None:
        return InMemoryStore()
    from heliograph.serving.storage.store import Store

    mine = identity(fleet)
    store = Store(settings.store, mine, settings.process)
    if settings.snapshot is not None:
        store.begin_from(str(settings.snapshot), mine)
    store.begin_anew(settings.anew)
    if store.damaged:
        _say(f"store {store.name}: {report_damage(store.damaged)}")
    _say(f"the state is kept in {store.name}, plants so far: {store.count()} (--store {NOTHING} keeps nothing)")
    return store


def report_damage(plants: Mapping[str, Damage]) -> str:
    """What a user is told of plants that are damaged: their names, and whether these are as they were written."""
    named = " ".join(f"--anew {quote(name)}" for name in list(plants)[:LISTED])
    more = "" if len(plants) <= LISTED else f" and {len(plants) - LISTED} more"
    new = (
        ""
        if all(plant.named for plant in plants.values())
        else "; one has lost its name, so that no new plant begins before"
    )
    return f"damaged plants, whose messages are refused until they begin anew ({named}{more}){new}"


def _say(what: str) -> None:
    print(f"heliograph: {what}", file=sys.stderr)


async def _shared(settings: ServiceSettings, lanes: Lanes, look: Look, parts: int) -> None:
    """One process of several: the parts that it leases."""
    from heliograph.serving.storage.database import engine_at
    from heliograph.serving.storage.leases import Leases
    from heliograph.serving.storage.store import Store

    place, broker = str(settings.store), settings.broker
    assert broker is not None  # as Wanted checked
    fleet = Fleet(lanes, settings.options)
    first = _open_store(settings, fleet)
    assert isinstance(first, Store)  # as Wanted checked
    first.close()
    mine = identity(fleet)

    async def serve(number: int, stop: asyncio.Event) -> None:
        store = Store(place, mine, f"part {number} of {parts}", opened=first)  # who has it tells what it had to tell
        try:
            service = look(Service(Fleet(lanes, settings.options), store, _say))
            await serve_until(stop, service, connected(broker, Part(number, parts)))
        finally:
            store.close()

    name = settings.process or f"{socket.gethostname()} {os.getpid()}"
    engine = engine_at(place)
    try:
        await keep_sharing(Leases(engine, name, parts), serve)
    finally:
        engine.dispose()
