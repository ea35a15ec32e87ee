"""A service: batches of messages in, lines of JSON to publish out; its whole state is committed in between."""

import gc
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from math import isfinite
from time import perf_counter
from typing import NamedTuple

from pydantic_core import to_json

from heliograph.filters.plausibility import in_words
from heliograph.live.event import INPUTS, Verdict
from heliograph.live.fleet import Finalised
from heliograph.live.fleet import Fleet as Fleet
from heliograph.live.fleet import Options as Options
from heliograph.live.lanes import FilterColumns, WeighedAt
from heliograph.live.lanes import Lanes as Lanes
from heliograph.live.plant import Plant
from heliograph.live.plant_codec import plant_bytes, plant_from
from heliograph.live.senders import SenderStatus
from heliograph.numerics.check import InputError, instance, shown
from heliograph.serving.exchange import Exchange
from heliograph.serving.message import Message, Payload, read_message
from heliograph.serving.output import Output
from heliograph.serving.storage.store_protocol import ConflictError, Entry, StoredPlant, StoreProtocol
from heliograph.serving.using import Using


class OutputWriter:
    """Writer of a network's outputs as lines of JSON; numbers that are not finite become null."""

    def __init__(self, lanes: Lanes):
        self._n = len(lanes.network.states)
        self._nodes: dict[str, list[FilterColumns]] = {}
        for columns in lanes.places:
            self._nodes.setdefault(columns.node, []).append(columns)

    def estimates(
        self, kind: str, plant: str, time: float | str, outputs: list[float], senders: Mapping[str, SenderStatus]
    ) -> bytes:
        """Return a line with the estimates of all filters after a row, from its outputs, and the senders."""
        results = {
            node: {columns.filter: self._filter(columns, outputs) for columns in places}
            for node, places in self._nodes.items()
        }
        parts: dict[str, object] = {"kind": kind, "plant": plant, "time": time, "estimates": results}
        if senders:
            parts["senders"] = {name: status._asdict() | {"dead": status.dead} for name, status in senders.items()}
        return line(parts)

    def _filter(self, columns: FilterColumns, outputs: list[float]) -> dict[str, object]:
        n, mean, begin, judged = self._n, columns.mean, columns.covariance, columns.judgement
        # Estimate, without a claim where it is no number.
        covariance = None if columns.claim == "none" else [outputs[i : i + n] for i in range(begin, begin + n * n, n)]
        numbers = all(map(isfinite, (*outputs[mean : mean + n], *outputs[begin : begin + n * n])))
        negative = columns.claim != "none" and min(outputs[begin : begin + n * n : n + 1]) < 0
        claim = columns.claim if numbers and not negative else "none"
        results: dict[str, object] = {"mean": outputs[mean : mean + n], "covariance": covariance, "claim": claim}
        # Squared innovation: of a fusion that of what its nodes received, of a filter as it judged it.
        if columns.tested is not None:
            nis, received = (outputs[column] for column in columns.tested)
            return results | {"nis": nis, "received": int(received) if isfinite(nis) else 0}
        if judged is None:
            return results
        if columns.weighed is not None:
            parts = zip(WeighedAt._fields, columns.weighed, strict=True)
            results["outputs"] = {name: [outputs[i] for i in columns] for name, columns in parts}
        if outputs[judged.reason] > 0:
            why = in_words(outputs[judged.reason], outputs[judged.distance])
            return results | {"nis": None, "received": 0, "implausible": why}
        return results | {"nis": outputs[judged.distance], "received": int(outputs[judged.arrived])}


def line(parts: dict[str, object]) -> bytes:
    """Encode a value as one line of JSON, without the newline."""
    return to_json(parts, inf_nan_mode="null")


ROWS = 200_000  # held in memory before the plants with the oldest messages leave it for the store
WHY: dict[Verdict, str] = {
    "duplicate": "held already",
    "conflict": "held already with other values, which stay",
    "late": "before what is final",
    "future": "later than it can be: a clock is wrong",
    "implausible": "no filter could use it",
}


class Taken(NamedTuple):
    """Statistics of the last batch: numbers of messages and outputs, and the seconds in all and for the commit.

    `lag`: age in seconds of the oldest message, where messages carry dates; else the seconds that the batch took.
    """

    messages: int
    outputs: int
    took: float
    committed: float
    lag: float


class Service:
    """A network's filters for any number of plants, fed with messages in whatever order they arrive.

    The service knows no transport: `take` uses a batch and returns the outputs to publish, after the commit. It is
    called by one thread at a time. `malformed` counts messages that could not be read, `known` duplicates and late
    ones.

    Args:
        fleet: the plants of the network.
        store: where the state is committed.
        say: called once with a line of text, when the first message is refused as implausible.
    """

    def __init__(self, fleet: Fleet, store: StoreProtocol, say: Callable[[str], None] | None = None):
        instance("fleet", fleet, Fleet, "a Fleet")
        self.fleet, self.store, self._say = fleet, store, say
        self.plants = OrderedDict[str, Plant]()  # those in memory, in order of their newest message
        self.malformed, self.known, self.last = 0, 0, Taken(0, 0, 0.0, 0.0, 0.0)
        self._writer, self._using = OutputWriter(fleet.lanes), Using(fleet, self.plants)
        self._exchange = Exchange(fleet, self._moment)
        self._published: int | None = None  # up to where, since the last commit
        self._damage = dict[str, str]()  # what is wrong with plants of the last batch that the store cannot give

    def take(self, payloads: Sequence[Payload]) -> list[Output]:
        """Use messages, each a JSON object or read already, and commit; return the outputs to publish.

        Nothing in a message stops the service: a message that cannot be used is counted and refused, with the reason.
        Without messages, time has passed: plants whose senders decide when to send are stepped to the present.
        """
        with _without_collection():
            return self._take(payloads or self._silence(datetime.now(UTC)))

    def _silence(self, now: datetime) -> list[Message]:
        """Return that nothing came by now, for plants whose steps have dates: inputs that all stay as they were."""
        results, step = list[Message](), self.fleet.options.step
        if step is None or not self.fleet.deciding:
            return results
        # Plants of which the next step has begun.
        for plant in self.plants.values():
            last, nothing = int(plant.now), [None] * self.fleet.lanes.given
            if plant.origin is not None and plant.origin + timedelta(seconds=step * (last + 1)) <= now:
                results.append(
                    Message.model_construct(
                        plant=plant.name,
                        node=INPUTS,
                        sequence=last,
                        time=now,
                        values=nothing,
                        inputs=None,
                        arrival=None,
                    )
                )
        return results

    def _take(self, payloads: Sequence[Payload]) -> list[Output]:
        begun = perf_counter()
        messages = [_read(payload) for payload in payloads]
        self._load({message.plant for message in messages if isinstance(message, Message)})
        # If another process has committed one of the plants, read it again and repeat.
        while True:
            try:
                outputs, committed = self._taken(messages, payloads)
                break
            except ConflictError:
                self._load({message.plant for message in messages if isinstance(message, Message)})
        took = perf_counter() - begun
        # Age of the oldest message.
        dates = [
            message.time for message in messages if isinstance(message, Message) and isinstance(message.time, datetime)
        ]
        lag = (datetime.now(UTC) - min(dates)).total_seconds() if dates else took
        self.last = Taken(len(payloads), len(outputs), took, committed, lag)
        return outputs

    def dead_senders(self) -> dict[str, int]:
        """Count the plants in memory that have a dead sender, by node whose sender decides when to send."""
        dead = dict.fromkeys(self.fleet.deciding, 0)
        for plant in self.plants.values() if dead else ():
            for node, status in self.fleet.senders(plant).items():
                dead[node] += status.dead
        return dead

    def unpublished(self) -> list[Output]:
        """Return outputs that were committed before a restart and may not have been published."""
        return self.store.unpublished()

    def published(self, outputs: Sequence[Output]) -> None:
        """Note that these outputs were published; the next commit records it."""
        self._published = max(
            (output.number for output in outputs if output.number is not None), default=self._published
        )

    def finish(self, ended: bool) -> list[Output]:
        """Commit everything. Without a store, and if there will be no more messages, all rows become final."""
        last = list(self.plants.values()) if ended and not self.store.keeps else []
        finalised = self.fleet.finalise(last, all_=True)
        entries = self._finals(finalised)
        self.fleet.forget(finalised)
        return self._commit({}, entries, 0)

    def _taken(self, messages: Sequence[Message | str], payloads: Sequence[Payload]) -> tuple[list[Output], float]:
        """Use messages and commit; return the outputs to publish, and the seconds of the commit."""
        touched, used, entries, malformed, known = dict[str, Plant](), set[str](), list[Entry](), 0, 0
        # Messages of damaged plants are refused; all others are used.
        damage = [self._damage.get(m.plant) if isinstance(m, Message) else None for m in messages]
        outcomes = iter(self._using.use([m for m, why in zip(messages, damage, strict=True) if why is None]))
        for message, payload, damaged in zip(messages, payloads, damage, strict=True):
            if isinstance(message, Message) and damaged is not None:
                entries.append(_refusal(message, "damaged", damaged))
                continue
            plant, verdict, why, notes = next(outcomes)
            if isinstance(message, str) or verdict is None:
                malformed += 1
                said = why if isinstance(payload, str) else f"{why}: {shown(payload)}"
                entries.append(_refused(None, {}, "malformed", said))
                continue
            # Verdicts: used, known already, or refused with the reason.
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
        # Step what is due; estimates of final rows are committed, provisional ones and messages only published.
        sent = self._exchange.messages(touched.values())
        finalised = self.fleet.finalise(touched.values())
        entries += self._finals(finalised)
        provisional = self._provisional([row for row in finalised if row.plant.name in used])
        self.fleet.forget(finalised)
        begun = perf_counter()
        outputs = self._commit(touched, entries, malformed)
        committed = perf_counter() - begun
        self.malformed += malformed
        self.known += known
        return outputs + sent + provisional, committed

    def _warn(self, message: Message, why: str) -> None:
        """Report the first implausible message, once."""
        if self._say is not None:
            plant = f"of plant {message.plant!r} " if message.plant else ""
            what = f"message {message.sequence} of {message.node!r} {plant}is implausible"
            self._say(f"warning: {what}: {why}; such messages are reported as refused and counted, and not said again")
            self._say = None

    def _commit(self, touched: dict[str, Plant], entries: Sequence[Entry], malformed: int) -> list[Output]:
        """Commit the changed plants. If that fails, forget them in memory: the store is authoritative."""
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
        # After the commit: count versions, and let the plants with the oldest messages leave memory.
        self._published = None
        for name, plant in touched.items():
            plant.version += 1
            self.plants.move_to_end(name)
        while self.store.keeps and self.fleet.pool.used > ROWS:
            self.fleet.end(self.plants.popitem(last=False)[1])
        return outputs

    def _load(self, names: Iterable[str]) -> None:
        """Load the plants of these names from the store, if it keeps any."""
        self._damage = {}
        for name, stored in self.store.load([name for name in names if name not in self.plants]).items():
            if stored.damage:
                self._damage[name] = stored.damage
                continue
            plant = self.plants[name] = plant_from(name, stored.body, self.fleet)
            plant.version = stored.version

    def _finals(self, finalised: Iterable[Finalised]) -> list[Entry]:
        """Return final estimates, each published once: of rows that are final now and received a measurement."""
        rows = [(row_set.plant, row) for row_set in finalised for row in row_set.final if row.has_data()]
        outputs = self.fleet.outputs([row.slot for _, row in rows])
        return [
            Entry(plant.name, "final", self._estimates("final", plant, row.key[0], numbers))
            for (plant, row), numbers in zip(rows, outputs, strict=True)
        ]

    def _provisional(self, finalised: Sequence[Finalised]) -> list[Output]:
        """Return the provisional estimates at the newest rows."""
        outputs = self.fleet.outputs([row.newest.slot for row in finalised])
        return [
            Output(None, plant.name, "provisional", self._estimates("provisional", plant, newest.key[0], numbers))
            for (plant, _, newest, _), numbers in zip(finalised, outputs, strict=True)
        ]

    def _estimates(self, kind: str, plant: Plant, at: float, outputs: list[float]) -> bytes:
        senders = self.fleet.senders(plant) if kind == "provisional" else {}
        return self._writer.estimates(kind, plant.name, self._moment(plant, at), outputs, senders)

    def _moment(self, plant: Plant, at: float) -> float | str:
        """Return the time of a row as messages have it."""
        unit = self.fleet.options.step or 1.0
        return at if plant.origin is None else (plant.origin + timedelta(seconds=at * unit)).isoformat()


@contextmanager
def _without_collection() -> Iterator[None]:
    """Pause garbage collection: a batch makes many objects and no cycles, and a search would take half its time."""
    before = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if before:
            gc.enable()


def _read(payload: Payload) -> Message | str:
    """Parse a message, or return the reason why it is malformed."""
    if not isinstance(payload, bytes):
        return payload
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
