"""A service: batches of messages in, lines of JSON to publish out; its whole state is committed in between."""

import gc
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from datetime import UTC, datetime, timedelta
from math import inf
from time import perf_counter
from typing import NamedTuple

from heliograph.live.event import INPUTS
from heliograph.live.fleet import Fleet as Fleet
from heliograph.live.fleet_options import Options as Options
from heliograph.live.health.fleet_warnings import FleetRepeatWatch, RemarkWatch
from heliograph.live.health.implausible_events import AngleWatch
from heliograph.live.network_step_program import NetworkProgram as NetworkProgram
from heliograph.live.plant_state import FinalisedPlant, PlantState
from heliograph.live.sorted_rows import HeldRow
from heliograph.live.stored.plant_codec import pack_plant, unpack_plant
from heliograph.live.undoable_changes import WithdrawnEvent
from heliograph.numerics.check import instance, show_value
from heliograph.numerics.process.garbage_collector import pause_collector
from heliograph.serving.batch_intake import BatchIntake, MessageOutcome, find_plant_name
from heliograph.serving.estimate_writer import EstimateWriter, encode_line
from heliograph.serving.message import AnyMessage, Message, Payload, Read, UnreadMessage, read_messages
from heliograph.serving.neighbour_exchange import NeighbourMessenger
from heliograph.serving.output import Output
from heliograph.serving.published_forecasts import ForecastPublisher, Spans
from heliograph.serving.refusals import WHY, make_refusal_entry, make_refusal_of_message
from heliograph.serving.silent_senders import SilenceWatch, find_dead_senders
from heliograph.serving.storage.store_protocol import ConflictError, Entry, StoredPlant, StoreProtocol
from heliograph.serving.thresholds import Thresholds

LARGE, MILLION = 1000, 1_000_000  # messages of a batch; between two searches for garbage among what such batches made
ROWS = 200_000  # held in memory before the plants with the oldest messages leave it for the store
LEAPT = "a leap in time that no other message confirms: a clock is wrong; it had been used, and is taken back"


class BatchStatistics(NamedTuple):
    """Statistics of the last batch: numbers of messages and outputs, and the seconds in all and for the commit.

    `lag`: age in seconds of the oldest message, where messages carry dates; else the seconds that the batch took.
    """

    messages: int = 0
    outputs: int = 0
    took: float = 0.0
    committed: float = 0.0
    lag: float = 0.0


class Service:
    """A network's filters for any number of plants, fed with messages in whatever order they arrive.

    The service knows no transport: `take` uses a batch and returns the outputs to publish, after the commit. It is
    called by one thread at a time. `malformed` counts unreadable messages, `known` duplicates and late ones.

    Args:
        fleet: the plants of the network.
        store: where the state is committed.
        say: called with a line at the first implausible message, the first vague angle, and each gate that gives in.
        every: seconds after which a hardly changed estimate is published again while senders are silent; None: never.
        forecast: how far ahead provisional estimates are accompanied by forecasts; None for not at all.
        thresholds: levels of which forecasts have the probability that they are passed; none by default.
    """

    def __init__(
        self,
        fleet: Fleet,
        store: StoreProtocol,
        say: Callable[[str], None] | None = None,
        every: float | None = None,
        forecast: Spans | None = None,
        thresholds: Thresholds = (),
    ):
        """Begin with no plant in memory; stored ones are loaded when they are needed. For arguments see the class."""
        instance("fleet", fleet, Fleet, "a Fleet")
        self.fleet, self.store = fleet, store
        self.plants = OrderedDict[str, PlantState]()  # those in memory, in order of their newest message
        # Messages that were malformed, and that were duplicates or late, in all batches; statistics of the last batch.
        self.malformed, self.known, self.last = 0, 0, BatchStatistics()
        # Gives messages to their plants; then what makes outputs: estimates as JSON, messages to neighbours' services,
        # what silence means, and forecasts.
        self._intake, self._writer = BatchIntake(fleet, self.plants), EstimateWriter(fleet.program)
        self._exchange, self._silence = NeighbourMessenger(fleet, self._time_in_messages), SilenceWatch(fleet, every)
        self._ahead = None if forecast is None else ForecastPublisher(fleet, forecast, thresholds)
        # Find doubts on plants, which `_doubt` says. `_say` says the first implausible message, and is then None.
        self._angles, self._remarks, self._held = AngleWatch(fleet), RemarkWatch(fleet), FleetRepeatWatch(fleet)
        self._say, self._doubt = say, say
        self._unsearched = 0  # messages since the last search for garbage
        self._published: int | None = None  # number of the newest output published since the last commit
        self._damage = dict[str, str]()  # what is wrong with plants of the last batch that the store cannot give

    def take(self, payloads: Sequence[Payload]) -> list[Output]:
        """Use messages, each a JSON object or read already, and commit; return the outputs to publish.

        Nothing in a message stops the service: a message that cannot be used is counted and refused, with the reason.
        Without messages, time has passed: plants whose senders decide when to send are stepped to the present, and
        senders that are silent for longer than their timeout are told.
        """
        with pause_collector():  # a batch makes many objects and no cycles, and a search would take a third of its time
            outputs = self._take_batch(payloads) if payloads else self._take_silence(datetime.now(UTC))
            if not payloads or self._silence.looks_between_batches(self.last.lag):
                outputs += self._tell_timeouts(datetime.now(UTC))
            # What a large batch made counts as old, and is searched for garbage once in a million messages.
            if len(payloads) > LARGE:
                gc.freeze()
                gc.unfreeze()
                self._unsearched += len(payloads)
            if self._unsearched > MILLION:
                self._unsearched = 0
                gc.collect()
        return outputs

    def resume(self) -> None:
        """Load stored plants, up to ROWS rows, if senders' silence while the service did not run says something."""
        if (self.fleet.deciding and self.fleet.options.step is not None) or self.fleet.shortest_timeout < inf:
            names = self.store.names()
            for i in range(0, len(names), LARGE):
                if self.fleet.state_table.used < ROWS:
                    self._load_plants(names[i : i + LARGE])
            self._silence.resume(self.plants)

    def _tell_timeouts(self, now: datetime) -> list[Output]:
        """Return provisional estimates of plants in which a sender has newly timed out by now; nothing is committed."""
        late = self._silence.find_plants_overdue(self.plants.values(), now)  # plants, each with the present moment
        self.fleet.pass_silence(late)
        return self._write_provisional([(plant, plant.silence) for plant, _ in late if plant.silence is not None])

    def _take_silence(self, now: datetime) -> list[Output]:
        """Advance plants to `now` without a message: commit rows that become final, publish estimates of the present.

        Where a sender decides when to send, its silence means that it had no reason to. Estimates of silent steps need
        no commit: they can be computed again from the committed state and the clock.
        """
        if self._exchange.sends:  # a node sends to its neighbours at each step, and needs a message to make the step
            steps = self._make_step_messages(now)
            return self._take_batch(steps) if steps else []
        # Rows become final by the time that has passed. Events of a clock that turns out wrong are withdrawn.
        due = self._silence.find_plants_due(self.plants.values(), now)  # plants, each with the step that it is by now
        for plant, step in due:
            self.fleet.advance_time(plant, step)
        finalised = self.fleet.finalise_plants(plant for plant, _ in due)
        changed = {each.plant.name: each.plant for each in finalised if each.left}
        entries = [entry for each in finalised for entry in self._write_withdrawn(each.plant, each.withdrawn)]
        entries += self._write_finals(finalised)
        # Predict silent plants to `now`; publish estimates that have changed; free table rows that are done with.
        self.fleet.pass_silence(due)
        rows = [(plant, plant.silence) for plant, _ in due if plant.silence is not None]
        provisional = self._write_provisional(self._silence.select_for_publication(rows)) if rows else []
        self.fleet.free_slots(finalised)
        try:
            return (self._commit(changed, entries, 0) if changed else []) + provisional
        except ConflictError:  # another process has them now
            self._load_plants(changed)
            return []

    def _make_step_messages(self, now: datetime) -> list[Message]:
        """Return a message for each plant in which a new step has begun, to make its row: null (unchanged) inputs."""
        unchanged: list[float | None] = [None] * self.fleet.program.given
        return [
            Message.model_construct(
                plant=plant.name, node=INPUTS, sequence=int(step), time=now, values=unchanged, inputs=None, arrival=None
            )
            for plant, step in self._silence.find_plants_due(self.plants.values(), now)
        ]

    def _take_batch(self, payloads: Sequence[Payload]) -> list[Output]:
        """Use a batch of payloads and return the outputs to publish; note its statistics in `last`."""
        begun = perf_counter()
        messages = read_messages(payloads)
        names = {name for message in messages if (name := find_plant_name(message)) is not None}
        self._load_plants(names)
        # If another process has committed one of the plants, read it again and repeat.
        while True:
            try:
                outputs, committed = self._take_messages(messages, payloads)
                break
            except ConflictError:
                self._load_plants(names)
        took = perf_counter() - begun
        # Age of the oldest message that has a date.
        dates = [
            message.time for message in messages if isinstance(message, Message) and isinstance(message.time, datetime)
        ]
        lag = (datetime.now(UTC) - min(dates)).total_seconds() if dates else took
        self.last = BatchStatistics(
            messages=len(payloads), outputs=len(outputs), took=took, committed=committed, lag=lag
        )
        return outputs

    def dead_senders(self) -> dict[str, int]:
        """Return for each node whose silence has a meaning in how many plants in memory its sender is dead.

        A sender is dead if it was silent for longer than its rule or its timeout allows.
        """
        dead = dict.fromkeys(self.fleet.watched, 0)
        for nodes in self.dead_by_plant().values():
            for node in nodes:
                dead[node] += 1
        return dead

    def remarks(self) -> Mapping[tuple[str, str], int]:
        """Count, by node and filter that may say so, how often a state was changed as its user should know."""
        return self._remarks.counts

    def dead_by_plant(self) -> dict[str, list[str]]:
        """Return the dead senders of each plant in memory that has one."""
        return find_dead_senders(self.fleet, self.plants)

    def unpublished(self) -> list[Output]:
        """Return outputs that were committed before a restart and may not have been published."""
        known = self._published or 0  # which the next commit records
        return [output for output in self.store.unpublished() if (output.number or 0) > known]

    def published(self, outputs: Sequence[Output]) -> None:
        """Note the largest number of these outputs, which were published; the next commit records it."""
        self._published = max([each.number for each in outputs if each.number is not None], default=self._published)

    def finish(self, ended: bool) -> list[Output]:
        """Commit everything; if messages have `ended` and there is no store, all rows become final."""
        ending_plants = list(self.plants.values()) if ended and not self.store.keeps else []
        finalised = self.fleet.finalise_plants(ending_plants, all_=True)
        entries = self._write_finals(finalised)
        self.fleet.free_slots(finalised)
        return self._commit({}, entries, 0)

    def _take_messages(self, messages: Sequence[Read], payloads: Sequence[Payload]) -> tuple[list[Output], float]:
        """Use messages and commit; return the outputs to publish, and the seconds that the commit took.

        `payloads`: what the messages were read from, one each, to show those that were not used.
        """
        outcomes = self._intake.apply_batch(messages, self._damage, datetime.now(UTC))
        touched = {outcome.plant.name: outcome.plant for outcome in outcomes if outcome.plant is not None}
        self._warn_of_doubts(list(touched.values()))
        entries, malformed, known = self._make_entries_on_unused(messages, payloads, outcomes)
        # Estimates of rows that no later message can change are committed, as entries. Others are only published.
        sent = self._exchange.make_messages(touched.values())
        finalised = self.fleet.finalise_plants(touched.values())
        # Events that were used before a clock turned out wrong, by plant: they are refused after all.
        withdrawn = [*self._intake.replaced, *((each.plant, each.withdrawn) for each in finalised)]
        entries += [entry for plant, events in withdrawn for entry in self._write_withdrawn(plant, events)]
        entries += self._write_finals(finalised)
        # Of plants that used a message, the estimate after the newest row.
        used = {each.plant.name for each in outcomes if each.plant is not None and each.verdict == "used"}
        newest = [(each.plant, each.newest) for each in finalised if each.plant.name in used]
        provisional = self._write_provisional(newest)
        self.fleet.free_slots(finalised)
        begun = perf_counter()
        outputs = self._commit(touched, entries, malformed)
        committed = perf_counter() - begun
        self.malformed += malformed
        self.known += known
        return outputs + sent + provisional, committed

    def _warn_of_doubts(self, plants: Sequence[PlantState]) -> None:
        """Warn by `_doubt`, if it is given, of new doubts: vague angles, repeated readings, and filters' remarks."""
        if self._doubt is not None:
            for name, line in (*self._angles.find_new(plants), *self._held.find_new(plants)):
                self._doubt(f"warning: plant {name!r}, {line}; not said again, nor of other plants")
        for name, line in self._remarks.find_new(plants):  # also counts them, so it is always called
            if self._doubt is not None:
                self._doubt(f"warning: plant {name!r}, {line}")

    def _make_entries_on_unused(
        self, messages: Sequence[Read], payloads: Sequence[Payload], outcomes: Sequence[MessageOutcome]
    ) -> tuple[list[Entry], int, int]:
        """Return refusals of messages that were not used, or not wholly; how many were malformed, and how many known.

        Known messages are duplicates and late ones: they may have been used before a restart. `payloads` has the raw
        content of each message, and `outcomes` its verdict and the reason.
        """
        entries, malformed, known = list[Entry](), 0, 0
        for message, payload, outcome in zip(messages, payloads, outcomes, strict=True):
            if outcome.verdict == "used" and not outcome.notes:  # as most are
                continue
            # Its plant's stored state is damaged. A message that could not be read is a text, and its plant unknown.
            damage = self._damage.get(find_plant_name(message) or "")
            if damage and not isinstance(message, str):
                entries.append(make_refusal_of_message(message, "damaged", damage))
                continue
            # Not read, or of another kind than its plant expects. The content is shown, unless its reader explained it.
            if isinstance(message, str | UnreadMessage) or outcome.verdict is None:
                malformed += 1
                is_explained = isinstance(payload, str | UnreadMessage)  # by who read it: then it need not be shown
                why = outcome.why if is_explained else f"{outcome.why}: {show_value(payload)}"
                entries.append(make_refusal_of_message(message, "malformed", why))
                continue
            known += outcome.verdict in ("duplicate", "late")
            entries += self._make_refusal_entries(message, outcome)
        return entries, malformed, known

    def _make_refusal_entries(self, message: AnyMessage, outcome: MessageOutcome) -> list[Entry]:
        """Return a refusal for a message that was not used, and one for each part of a message that was left out.

        A part is its inputs or single values, as `outcome.notes` says. The first implausible message causes a warning.
        """
        parts = list(outcome.notes)
        if outcome.verdict is not None and outcome.verdict != "used":
            parts.insert(0, (outcome.verdict, outcome.why or WHY[outcome.verdict]))
        for verdict, why in parts:
            if verdict == "implausible":
                self._warn_of_implausible(message, why)
        return [make_refusal_of_message(message, verdict, why) for verdict, why in parts]

    def _warn_of_implausible(self, message: AnyMessage, why: str) -> None:
        """Report the first implausible message by `_say`; later ones are not reported."""
        if self._say is not None:
            plant = f"of plant {message.plant!r} " if message.plant else ""
            what = f"message {message.sequence} of {message.node!r} {plant}is implausible"
            self._say(f"warning: {what}: {why}; such messages are reported as refused and counted, and not said again")
            self._say = None  # once

    def _commit(self, touched: dict[str, PlantState], entries: Sequence[Entry], malformed: int) -> list[Output]:
        """Commit the changed plants and entries; return the outputs to publish.

        If it fails, the plants are dropped from memory and later read again from the store, whose content is true.

        Args:
            touched: the changed plants, by name.
            entries: estimates and reports for the journal.
            malformed: how many messages could not be read.
        """
        bodies = {name: pack_plant(plant, self.fleet) for name, plant in touched.items()} if self.store.keeps else {}
        stored = {name: StoredPlant(touched[name].version, body) for name, body in bodies.items()}
        try:
            outputs = self.store.commit(stored, entries, malformed, self._published)
        except BaseException:
            for name in touched:
                self._forget_plant(name)
            raise
        # After the commit: count versions, and let the plants with the oldest messages leave memory.
        self._published = None
        for name, plant in touched.items():
            plant.version += 1
            self.plants.move_to_end(name)
        while self.store.keeps and self.fleet.state_table.used > ROWS:
            self._forget_plant(next(iter(self.plants)))  # the one with the oldest messages
        return outputs

    def _forget_plant(self, name: str) -> None:
        """Remove a plant from memory and free its rows; a stored state stays in the store."""
        self.fleet.end_plant(self.plants.pop(name))
        self._silence.forget_plant(name)

    def _load_plants(self, names: Iterable[str]) -> None:
        """Load the plants of these names that are not in memory from the store; `_damage` notes the damaged ones."""
        self._damage = {}
        for name, stored in self.store.load([name for name in names if name not in self.plants]).items():
            if stored.damage:
                self._damage[name] = stored.damage
                continue
            plant = self.plants[name] = unpack_plant(name, stored.body, self.fleet)
            plant.version = stored.version
            self._remarks.note_said(plant)  # remarks that were said before are not said again

    def _write_finals(self, finalised: Iterable[FinalisedPlant]) -> list[Entry]:
        """Return entries with final estimates: those of rows that can no longer change and have measurements."""
        rows = [(each.plant, row) for each in finalised for row in each.final if row.has_data()]
        bodies = self._write_estimates(b"final", rows)
        return [Entry(plant.name, "final", body) for (plant, _), body in zip(rows, bodies, strict=True)]

    def _write_withdrawn(self, plant: PlantState, events: Iterable[WithdrawnEvent]) -> Iterator[Entry]:
        """Yield a refusal ("future", LEAPT) of each event that was used before its clock turned out to be wrong."""
        for node, sequence, time in events:  # node: its index, -1 for the inputs
            name = INPUTS if node < 0 else self.fleet.network.names[node]
            identity = {"node": name, "sequence": sequence, "time": self._time_in_messages(plant, time)}
            yield make_refusal_entry(plant.name, identity, "future", LEAPT)

    def _write_provisional(self, rows: Sequence[tuple[PlantState, HeldRow]]) -> list[Output]:
        """Return outputs with the estimates after these rows, forecasts from them, and the status of their senders."""
        outputs = []
        self._silence.note_published(rows)
        forecasts = [None] * len(rows) if self._ahead is None else self._ahead.make_forecasts([row for _, row in rows])
        bodies = self._write_estimates(b"provisional", rows)
        for (plant, _), body, horizons in zip(rows, bodies, forecasts, strict=True):
            # `body` is a JSON object as bytes: members are added before its closing brace, body[:-1].
            if horizons is not None:
                ahead = [{"time": self._time_in_messages(plant, time), "ahead": distance, "estimates": estimates}
                         for time, distance, estimates in horizons]  # fmt: skip
                body = b'%b,"forecast":%b}' % (body[:-1], encode_line(ahead))
            if self.fleet.watched:
                senders = {name: status._asdict() | {"dead": status.dead, "reason": status.reason}
                           for name, status in self.fleet.find_sender_status(plant).items()}  # fmt: skip
                body = b'%b,"senders":%b}' % (body[:-1], encode_line(senders))
            outputs.append(Output(None, plant.name, "provisional", body))
        return outputs

    def _write_estimates(self, kind: bytes, rows: Sequence[tuple[PlantState, HeldRow]]) -> list[bytes]:
        """Return the estimate after each row as a line of JSON; `kind` is "final" or "provisional"."""
        moments = [(plant.name, row.key[0] if plant.origin is None else self._time_in_messages(plant, row.key[0]))
                   for plant, row in rows]  # fmt: skip
        return self._writer.write_lines(kind, moments, self.fleet.outputs([row.slot for _, row in rows]))

    def _time_in_messages(self, plant: PlantState, at: float) -> float | str:
        """Return the time of a row as messages have it: a number, or an ISO date if times have an origin."""
        unit = self.fleet.options.step or 1.0
        return at if plant.origin is None else (plant.origin + timedelta(seconds=at * unit)).isoformat()
