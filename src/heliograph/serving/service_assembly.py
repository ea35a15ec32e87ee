"""Assembly of a service from its settings: transport, store, sharing among processes, and the page."""

import asyncio
import contextlib
import logging
import sys
from collections.abc import AsyncIterator, Callable, Coroutine
from contextlib import asynccontextmanager
from dataclasses import dataclass
from math import inf
from typing import TYPE_CHECKING, Protocol

from heliograph.live.fleet import Fleet
from heliograph.live.network_step_program import NetworkProgram
from heliograph.numerics.check import fail, instance
from heliograph.numerics.process.plugins import BROKERS, find_plugin
from heliograph.serving.brokers.broker_address import Address
from heliograph.serving.brokers.line_reader import LineReader, redirected_file
from heliograph.serving.brokers.pipe import Pipe
from heliograph.serving.brokers.source_translator import Translator
from heliograph.serving.brokers.transport import LOG, WHOLE, Part, TakenOverError, Transport
from heliograph.serving.device_status_service import DeviceStatusService
from heliograph.serving.service import Service
from heliograph.serving.service_loop import (
    AbandonedError,
    BatchService,
    StoppableWork,
    serve_until,
    set_stop_on_signals,
)
from heliograph.serving.settings import NOTHING, SHORTEST, ServiceSettings
from heliograph.serving.storage.store_protocol import (
    AwayError,
    InMemoryStore,
    StoreProtocol,
    describe_damaged_plants,
    identity,
)
from heliograph.serving.waiting_service import WaitingService, retry_while_away
from heliograph.simulation.network import Network

if TYPE_CHECKING:
    from heliograph.serving.storage.store import Store

STANDARD_INPUT = 0
Serve = Callable[[int, asyncio.Event], Coroutine[object, object, None]]


def make_transport(address: Address, part: Part = WHOLE, translator: Translator | None = None) -> Transport:
    """Return the transport for one part of the plants through the broker at this address.

    Args:
        address: the broker. Its `kind` selects the protocol: mqtt, nats or opc.tcp. For any other kind, the entry point
            of that name in the group `heliograph.brokers`, which another package offers, makes the transport.
        part: the part of the plants whose messages are read, if several processes share them; by default all.
        translator: reads messages on topics of other systems, in their formats; None: only topics of the service.

    Raises:
        ValueError: no address, part or translator; an OPC UA server without sources; a broker that no package offers.
    """
    instance("address", address, Address, "an Address")
    instance("part", part, Part, "a Part")
    if translator is not None:
        instance("translator", translator, Translator, "a Translator, or None")
    # Each client is imported only where it is used: they are optional packages.
    if address.kind == "opc.tcp":
        if translator is None:
            raise fail(f"{address}", "sources in the network's file, by identifiers of variables", "none")
        from heliograph.serving.brokers.opcua import OpcUa

        return OpcUa(address, translator)
    if address.kind == "mqtt":
        from heliograph.serving.brokers.mqtt import Mqtt

        return Mqtt(address, part, translator)
    if address.kind == "nats":
        from heliograph.serving.brokers.nats import Nats

        return Nats(address, part, translator)
    make = find_plugin(BROKERS, address.kind)
    if make is None:
        raise fail(f"{address}", "mqtt, nats, opc.tcp, or a package that offers the broker", address.kind)
    transport: Transport = make(address, part, translator)
    return transport


class PartLeases(Protocol):
    """Leases on the parts of the plants that this process may serve."""

    term: float

    def renew(self) -> set[int]:
        """Renew the leases; return the parts of this process."""

    def release(self, number: int) -> None:
        """Release one part."""

    def leave(self) -> None:
        """Release all parts."""


@dataclass
class _ServedPart:
    """A part that is being served, and the event that ends it."""

    work: asyncio.Task[None]
    stop: asyncio.Event

    async def end(self) -> None:
        """Stop the service of this part, after it has committed and published what it received."""
        self.stop.set()
        with contextlib.suppress(TakenOverError):
            await self.work


async def serve_leased_parts(leases: PartLeases, serve: Serve) -> None:
    """Serve the leased parts until SIGTERM or SIGINT; `serve(part, stop)` serves one until `stop` is set.

    When a process joins, the others finish some of their parts and leave them to it. When one dies, its parts become
    free after a term; whoever takes one over first publishes what was committed and not published.
    """
    stop = asyncio.Event()
    parts: dict[int, _ServedPart] = {}
    with set_stop_on_signals(stop):
        try:
            while not stop.is_set():
                await _serve_exactly(parts, leases, serve)
                with contextlib.suppress(TimeoutError):  # renew the leases several times in their term
                    await asyncio.wait_for(stop.wait(), leases.term / 5)
        finally:
            await asyncio.gather(*[part.end() for part in parts.values()])
            with contextlib.suppress(AwayError):  # they end by themselves
                await asyncio.to_thread(leases.leave)


async def _serve_exactly(parts: dict[int, _ServedPart], leases: PartLeases, serve: Serve) -> None:
    """Start and stop services so that `parts`, by number those that are served, are exactly the leased ones."""
    _drop_ended(parts)
    try:
        leased = await asyncio.to_thread(leases.renew)
    except AwayError as error:  # nobody else can lease them either
        LOG.warning("%s; trying again", error)
        return
    # Stop those that are no longer leased, all at once, and only then release each.
    gone = [number for number in parts if number not in leased]
    await asyncio.gather(*[parts[number].end() for number in gone])
    for number in gone:
        del parts[number]
        await asyncio.to_thread(leases.release, number)
    # Start the new ones.
    for number in sorted(leased - parts.keys()):
        stop = asyncio.Event()
        parts[number] = _ServedPart(asyncio.ensure_future(serve(number, stop)), stop)


def _drop_ended(parts: dict[int, _ServedPart]) -> None:
    """Remove the parts of the plants whose service ended by itself; raise the error by which it failed.

    If another process took the part over, this is only logged. `parts` holds by number the parts that are served here.
    """
    for number, part in list(parts.items()):
        if part.work.done():
            del parts[number]
            try:
                part.work.result()  # raises what the service raised
            except TakenOverError as error:
                LOG.warning("%s", error)


async def run_service(settings: ServiceSettings) -> None:
    """Serve until the messages end, or until SIGTERM or SIGINT.

    `settings.parts`: into how many parts the plants are divided, of which this process serves some; None for all alone.
    """
    _log_to_stderr()
    async with _serve_watch_page(settings) as wrap:  # wrap(service): the same service, shown on the page
        program = await _compile_steps(settings.network)
        if program is None:
            return
        if program.uneven:  # filters for which one prediction over a time is not two over its halves
            what = f"predictions depend on when others are asked for: {program.uneven}"
            print(f"heliograph: warning: {what}", file=sys.stderr)
        if settings.parts is None:
            await _serve_alone(settings, program, wrap)
        else:
            await _serve_shared(settings, program, wrap, settings.parts)


async def _compile_steps(network: Network) -> NetworkProgram | None:
    """Compile the steps of a network in a thread, while the page answers; None if it is said to stop meanwhile."""
    stop = asyncio.Event()
    with set_stop_on_signals(stop):
        try:
            program = await StoppableWork(stop).call(NetworkProgram, network)
        except AbandonedError:
            return None
    return None if stop.is_set() else program


def _log_to_stderr() -> None:
    """Log what happens to connections to standard error, unless the program has configured its log."""
    if not LOG.handlers and not logging.getLogger().handlers:
        handler = logging.StreamHandler()
        handler.setFormatter(logging.Formatter("heliograph: %(message)s"))
        LOG.addHandler(handler)
        LOG.setLevel(logging.INFO)


WrapService = Callable[[Service], BatchService]


@asynccontextmanager
async def _serve_watch_page(settings: ServiceSettings) -> AsyncIterator[WrapService]:
    """Serve the page, if one is asked for, in a `with` block; yield what wraps a service so that the page shows it."""
    if settings.page is None:
        yield lambda service: service
        return
    from heliograph.files.sources.topic_reader import TopicReader
    from heliograph.serving.observation.page import parse_page_address, serve_page
    from heliograph.serving.observation.service_watch import watch_of

    table = settings.sources
    uncounted = set() if table is None else TopicReader(table, settings.network).nodes_without_count
    watch = watch_of(settings.network, settings.name, uncounted)
    async with serve_page(watch, parse_page_address(settings.page, hosts=settings.hosts)):
        yield watch.wrap


async def _serve_alone(settings: ServiceSettings, program: NetworkProgram, wrap: WrapService) -> None:
    """Serve all plants in this process, until the messages end or a signal stops it.

    Args:
        settings: settings of the service.
        program: the network's compiled step.
        wrap: wraps a service so that the page shows it.
    """
    stop = asyncio.Event()
    # `reader` reads messages that other programs make, where the network's file has sources, which describe them and
    # then say how long a step is.
    reader = None if settings.sources is None else Translator(settings.sources, settings.network, settings.others)
    step = settings.options.step if reader is None else reader.sources.step_seconds
    fleet = Fleet(program, settings.options._replace(step=step))
    fleet.periods = {} if reader is None else reader.sources.periods
    with set_stop_on_signals(stop), contextlib.ExitStack() as owning:
        # The store first, whose state the service goes on from.
        store = await asyncio.to_thread(retry_while_away, lambda: _open_store(settings, fleet, owning), stop)
        has_plants = store.count() > 0
        service = Service(fleet, store, _print_to_stderr, settings.every, settings.forecast, settings.thresholds)
        try:
            service.resume()
            transport = _open_transport(settings, reader)
            # Devices may say when they go offline: the last status of each is kept in the store too.
            shown = wrap(service)
            if reader is not None:
                shown = DeviceStatusService(shown, reader.sources.device_statuses, store)
            await serve_until(stop, WaitingService(shown, stop), transport, _choose_patience(fleet))
        finally:
            store.close()
    # Say which parts of other programs' messages were not used.
    for line in [] if reader is None else reader.left_out():
        _print_to_stderr(line)
    # The same messages may have been used in an earlier run: nothing else shows it.
    if has_plants and service.known:
        anew = f"to begin anew, delete {store.name} or name another --store"
        _print_to_stderr(f"{service.known} messages were known already or came after what was final; {anew}")


def _choose_patience(fleet: Fleet) -> float | None:
    """Return the seconds without a message after which silence is evaluated, or None if silence has no meaning.

    It is the length of a step if that is known, but at least SHORTEST. Else it is SHORTEST if some node has a timeout
    (`shortest_timeout` is inf if none has).
    """
    if fleet.options.step is not None:
        return max(fleet.options.step, SHORTEST)
    return SHORTEST if fleet.shortest_timeout < inf else None


def _open_transport(settings: ServiceSettings, reader: Translator | None) -> Transport:
    """Return the transport of all plants' messages and outputs: a broker, or standard input and output.

    Args:
        settings: says which broker, if any, and whether each estimated state is published on a topic of its own too.
        reader: reads messages of other programs, as the sources in the network's file describe them; None without any.
    """
    if settings.broker is None:
        return _add_states(settings, _open_pipe(settings, reader))
    return _add_states(settings, make_transport(settings.broker, translator=reader))


def _add_states(settings: ServiceSettings, transport: Transport) -> Transport:
    """Return a transport that also publishes each estimated state on a topic of its own, if settings ask for it."""
    if settings.states is None:
        return transport
    from heliograph.serving.brokers.state_topics import StatePublishing

    return StatePublishing(transport, settings.states, settings.network.states)


def _open_pipe(settings: ServiceSettings, reads: Translator | None) -> Pipe:
    """Return the transport from standard input to standard output; `reads` reads messages of other programs."""
    path = redirected_file(STANDARD_INPUT)
    return Pipe(STANDARD_INPUT, reader=LineReader(settings.network, reads, path, settings.ignore_unknown))


def _open_store(settings: ServiceSettings, fleet: Fleet, owning: contextlib.ExitStack | None = None) -> StoreProtocol:
    """Open the store, with the snapshot and the plants to begin anew, and report its state.

    Args:
        settings: address of the store, snapshot to begin from, plants to begin anew; no store means memory alone.
        fleet: all plants that are filtered with this network.
        owning: holds the store for this service alone until it is closed; None where processes share it.
    """
    if settings.store is None:
        return InMemoryStore()
    if owning is not None:
        from heliograph.serving.storage.store_owner import own_store

        owning.enter_context(own_store(settings.store, settings.process))
    from heliograph.live.stored.migration import PlantMigration
    from heliograph.serving.storage.store import Store

    # Plants of another network are carried over where that is allowed.
    mine = identity(fleet)
    migration = PlantMigration(fleet, mine, _print_to_stderr) if settings.accept_changes else None
    store = Store(settings.store, mine, settings.process, carrier=migration)
    if settings.snapshot is not None:
        store.begin_from(settings.snapshot, mine, migration)
    store.begin_anew(settings.anew)
    # Its state, in words.
    if store.damaged:
        _print_to_stderr(f"store {store.name}: {describe_damaged_plants(store.damaged)}")
    _print_to_stderr(
        f"the state is kept in {store.name}, plants so far: {store.count()} (--store {NOTHING} keeps nothing)"
    )
    return store


def _print_to_stderr(what: str) -> None:
    """Print a line to the standard error."""
    print(f"heliograph: {what}", file=sys.stderr)


async def _serve_shared(settings: ServiceSettings, program: NetworkProgram, wrap: WrapService, parts: int) -> None:
    """Serve the parts that this process leases, as one of several processes; `wrap` shows services on the page.

    The plants are divided into `parts` parts. Each process takes its share of them for some time (a lease, noted in the
    common store), so that the parts of a process that ends go to others.
    """
    from heliograph.serving.storage.database import open_database
    from heliograph.serving.storage.part_leases import Leases
    from heliograph.serving.storage.store import Store
    from heliograph.serving.storage.store_owner import name_of_process

    # The store is checked once, before any part is served. Only the end of the process stops the wait for it.
    fleet, never = Fleet(program, settings.options), asyncio.Event()
    checked = await asyncio.to_thread(retry_while_away, lambda: _open_store(settings, fleet), never)
    assert isinstance(checked, Store)  # the settings require one
    checked.close()

    async def serve(number: int, stop: asyncio.Event) -> None:
        """Serve one part of the plants, that of this number among `parts`, until `stop` is set.

        As all parts: with the settings of the service, the network's `program`, `wrap`, which shows it on the page, and
        the store that was `checked` before.
        """
        await _serve_part(settings, program, wrap, Part(number, parts), stop, checked)

    # Lease parts under a name that is unique to this process.
    engine = open_database(str(settings.store))
    try:
        leases = Leases(engine, settings.process or name_of_process(), parts)
        await serve_leased_parts(leases, serve)
    finally:
        engine.dispose()


async def _serve_part(
    settings: ServiceSettings,
    program: NetworkProgram,
    wrap: WrapService,
    part: Part,
    stop: asyncio.Event,
    checked: "Store",
) -> None:
    """Serve one part of the plants until `stop` is set; `checked` is the store, which was looked through for damage."""
    from heliograph.serving.storage.store import Store

    assert settings.broker is not None  # the settings require one
    fleet = Fleet(program, settings.options)
    # The journal of a part continues with whichever process serves it.
    store = Store(str(settings.store), identity(fleet), f"part {part.number} of {part.of}", opened=checked)
    try:
        service = wrap(Service(fleet, store, _print_to_stderr, None, settings.forecast, settings.thresholds))
        # Processes that share plants do not step them through silence; that a sender has timed out is published all the
        # same, where there are timeouts.
        patience = SHORTEST if fleet.shortest_timeout < inf and not fleet.deciding else None
        await serve_until(stop, WaitingService(service, stop), make_transport(settings.broker, part), patience)
    finally:
        store.close()
