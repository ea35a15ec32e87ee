"""The service: batches of messages in, what is to be told out; all that it knows is committed in between."""

import gc
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from time import perf_counter
from typing import NamedTuple

from heliograph.live.event import Verdict
from heliograph.numerics.check import InputError, instance, shown
from heliograph.serving.fleet import Finalised, Fleet
from heliograph.serving.json_lines import Teller, line
from heliograph.serving.message import Message, read_message
from heliograph.serving.output import Output
from heliograph.serving.plant import Plant
from heliograph.serving.storage.plant_codec import plant_bytes, plant_from
from heliograph.serving.storage.store_protocol import ConflictError, Entry, StoredPlant, StoreProtocol
from heliograph.serving.using import Using

ROWS = 200_000  # that are held in memory before plants which were not heard for long leave it for the store
WHY: dict[Verdict, str] = {
    "duplicate": "held already",
    "conflict": "held already with other values, which stay",
    "late": "before what is final",
    "future": "later than it can be: a clock is wrong",
    "implausible": "no filter could use it",
}


class Taken(NamedTuple):
    """What the last batch was: numbers of messages and outputs, and the seconds that it took in all and to commit.

    `lag`: how long ago the oldest of its messages was measured, where they carry dates; else what it took.
    """

    messages: int
    outputs: int
    took: float
    committed: float
    lag: float


class Service:
    """A network's filters, for any number of plants, fed with messages in whatever order they come.

    It knows no transport: `take` uses a batch and gives what is to be told of it, after the commit. One call at a time.
    `malformed` and `known` count messages that could not be read, and duplicates and late ones. `say` is called once,
    with a line, when the first message is refused as implausible.
    """

    def __init__(self, fleet: Fleet, store: StoreProtocol, say: Callable[[str], None] | None = None):
        instance("fleet", fleet, Fleet, "a Fleet")
        self.fleet, self.store, self._say = fleet, store, say
        self.plants = OrderedDict[str, Plant]()  # those in memory, the last that was heard last
        self.malformed, self.known, self.last = 0, 0, Taken(0, 0, 0.0, 0.0, 0.0)
        self._teller, self._using = Teller(fleet.lanes), Using(fleet, self.plants)
        self._published: int | None = None  # up to where, since the last commit
        self._damage = dict[str, str]()  # what is wrong with plants of the last batch that the store cannot give

    def take(self, payloads: Sequence[bytes]) -> list[Output]:
        """Use messages, each a JSON object, and commit; what is to be told of it.

        Nothing in a message stops the service: what cannot be used is counted and told, with the reason.
        """
        with _without_collection():
            return self._take(payloads)

    def _take(self, payloads: Sequence[bytes]) -> list[Output]:
        begun = perf_counter()
        messages = [_read(payload) for payload in payloads]
        self._load({message.plant for message in messages if isinstance(message, Message)})
        while True:
            try:
                outputs, committed = self._taken(messages, payloads)
                break
            except ConflictError:
                self._load({message.plant for message in messages if isinstance(message, Message)})
        took = perf_counter() - begun
        dates = [
            message.time for message in messages if isinstance(message, Message) and isinstance(message.time, datetime)
        ]
        lag = (datetime.now(UTC) - min(dates)).total_seconds() if dates else took
        self.last = Taken(len(payloads), len(outputs), took, committed, lag)
        return outputs

    def unpublished(self) -> list[Output]:
        """What was committed before a restart and may not have been told."""
        return self.store.unpublished()

    def published(self, outputs: Sequence[Output]) -> None:
        """These were told: remembered with the next commit."""
        self._published = max(
            (output.number for output in outputs if output.number is not None), default=self._published
        )

    def finish(self, ended: bool) -> list[Output]:
        """Commit all. Where nothing is kept and there will be no more messages, all rows become final."""
        last = list(self.plants.values()) if ended and not self.store.keeps else []
        converged = self.fleet.finalise(last, all_=True)
        entries = self._finals(converged)
        self.fleet.forget(converged)
        return self._commit({}, entries, 0)

    def _taken(self, messages: Sequence[Message | str], payloads: Sequence[bytes]) -> tuple[list[Output], float]:
        """Use messages and commit; what is to be told, and how long the commit took."""
        touched, used, entries, malformed, known = dict[str, Plant](), set[str](), list[Entry](), 0, 0
        damage = [self._damage.get(m.plant) if isinstance(m, Message) else None for m in messages]
        outcomes = iter(self._using.use([m for m, why in zip(messages, damage, strict=True) if why is None]))
        for message, payload, damaged in zip(messages, payloads, damage, strict=True):
            if isinstance(message, Message) and damaged is not None:
                entries.append(_refusal(message, "damaged", damaged))
                continue
            plant, verdict, why, notes = next(outcomes)
            if isinstance(message, str) or verdict is None:
                malformed += 1
                entries.append(_refused(None, {}, "malformed", f"{why}: {shown(payload)}"))
                continue
            if plant is not None:
                touched[plant.name] = plant
            if verdict == "used":
                used.add(message.plant)
            else:
                known += verdict in ("duplicate", "late")
                entries.append(_refusal(message, verdict, why or WHY[verdict]))
            entries += [_refusal(message, "implausible", note) for note in notes]
            if verdict == "implausible" or notes:
                self._warn(message, why or notes[0])
        converged = self.fleet.finalise(touched.values())
        entries += self._finals(converged)
        provisional = self._provisional([item for item in converged if item.plant.name in used])
        self.fleet.forget(converged)
        begun = perf_counter()
        outputs = self._commit(touched, entries, malformed)
        committed = perf_counter() - begun
        self.malformed += malformed
        self.known += known
        return outputs + provisional, committed

    def _warn(self, message: Message, why: str) -> None:
        """Say once that something is implausible."""
        if self._say is not None:
            plant = f"of plant {message.plant!r} " if message.plant else ""
            what = f"message {message.sequence} of {message.node!r} {plant}is implausible"
            self._say(f"warning: {what}: {why}; such messages are reported as refused and counted, and not said again")
            self._say = None

    def _commit(self, touched: dict[str, Plant], entries: Sequence[Entry], malformed: int) -> list[Output]:
        """Keep what changed. If that fails, what is in memory of it is forgotten: the store is right."""
        stored = {}
        if self.store.keeps:
            stored = {
                name: StoredPlant(plant.version, plant_bytes(plant, self.fleet)) for name, plant in touched.items()
            }
        try:
            outputs = self.store.commit(stored, entries, malformed, self._published)
        except BaseException:
            for name in touched:
                self.fleet.end(self.plants.pop(name))
            raise
        self._published = None
        for name, plant in touched.items():
            plant.version += 1
            self.plants.move_to_end(name)
        while self.store.keeps and self.fleet.pool.used > ROWS:
            self.fleet.end(self.plants.popitem(last=False)[1])
        return outputs

    def _load(self, names: Iterable[str]) -> None:
        """Have the plants of these names in memory, where they are kept."""
        self._damage = {}
        for name, item in self.store.load([name for name in names if name not in self.plants]).items():
            if item.damage:
                self._damage[name] = item.damage
                continue
            plant = self.plants[name] = plant_from(name, item.body, self.fleet)
            plant.version = item.version

    def _finals(self, converged: Iterable[Finalised]) -> list[Entry]:
        """What is told once: the rows that are final now and in which something was heard."""
        rows = [(item.plant, row) for item in converged for row in item.final if row.observe()]
        outputs = self.fleet.outputs([row.slot for _, row in rows])
        return [
            Entry(plant.name, "final", self._estimates("final", plant, row.key[0], numbers))
            for (plant, row), numbers in zip(rows, outputs, strict=True)
        ]

    def _provisional(self, converged: Sequence[Finalised]) -> list[Output]:
        """What is known now."""
        outputs = self.fleet.outputs([item.newest.slot for item in converged])
        return [
            Output(None, plant.name, "provisional", self._estimates("provisional", plant, newest.key[0], numbers))
            for (plant, _, newest, _), numbers in zip(converged, outputs, strict=True)
        ]

    def _estimates(self, kind: str, plant: Plant, at: float, outputs: list[float]) -> bytes:
        moment = at if plant.origin is None else (plant.origin + timedelta(seconds=at)).isoformat()
        return self._teller.estimates(kind, plant.name, moment, outputs)


@contextmanager
def _without_collection() -> Iterator[None]:
    """A batch makes many objects and no cycles: searching for some would take half of its time."""
    before = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if before:
            gc.enable()


def _read(payload: bytes) -> Message | str:
    """The message, or why it is none."""
    try:
        return read_message(payload)
    except InputError as error:
        return str(error)


def _refusal(message: Message, why: str, detail: str) -> Entry:
    moment = message.time.isoformat() if isinstance(message.time, datetime) else message.time
    parts = {"node": message.node, "sequence": message.sequence, "time": moment}
    return _refused(message.plant, parts, why, detail)


def _refused(plant: str | None, parts: dict[str, object], why: str, detail: str) -> Entry:
    results = {"kind": "refused", "plant": plant, "node": None, "sequence": None, "time": None}
    return Entry(plant or "", "refused", line(results | parts | {"reason": why, "detail": detail}))
