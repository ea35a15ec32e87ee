"""Intake of a batch of messages: plants that an implausible one has changed are restored, and take the rest again."""

from collections import OrderedDict
from collections.abc import Container, Sequence
from datetime import datetime
from math import inf
from typing import Any, NamedTuple

import numpy as np

from heliograph.live.clock_leap import ARRIVAL, ClockLeap, find_contradicted_leap, make_first_leap
from heliograph.live.event import INPUTS, CheckedEvent, Verdict
from heliograph.live.fleet import Fleet
from heliograph.live.health.implausible_events import CandidateEvent, JudgementReader
from heliograph.live.health.link_counts import LinkCounts
from heliograph.live.plant_state import PlantState
from heliograph.live.undoable_changes import WithdrawnEvent
from heliograph.numerics.check import InputError
from heliograph.serving.message import AnyMessage, Read, UnreadMessage
from heliograph.serving.refusals import WHY
from heliograph.serving.timed_events import EventReader, TimedEvents


class MessageOutcome(NamedTuple):
    """What became of a message.

    Attributes:
        plant: its plant; None if it began none.
        verdict: the verdict on it; None if it could not be read.
        why: the reason, where it was not used; else "".
        notes: on parts that were left out of a message that was used, or for another reason: the verdict on each, and
            why.
    """

    plant: PlantState | None = None
    verdict: Verdict | None = None
    why: str = ""
    notes: Sequence[tuple[Verdict, str]] = ()


class PlantBeforeBatch(NamedTuple):
    """State of a plant before a batch.

    Attributes:
        known: whether it was in memory.
        clock: its newest arrival, and the leap in time that led there, if any (`PlantState.clock`).
        links: by node the fields of its `LinkCounts`.
    """

    known: bool
    clock: tuple[float, ClockLeap | None]
    links: dict[str, tuple[Any, ...]]


class BatchIntake:
    """Gives the messages of a batch to their plants; `plants` are those in memory, by name."""

    def __init__(self, fleet: Fleet, plants: OrderedDict[str, PlantState]):
        """Prepare to give messages to plants; there is no batch yet.

        Args:
            fleet: steps the plants.
            plants: the plants in memory, by name; those that begin are added, and those that never were are removed.
        """
        self.fleet, self.plants = fleet, plants
        self._events, self._judges = EventReader(fleet), JudgementReader(fleet)
        # Of the present batch. Why events are refused: {(number of the message, whether its inputs are meant): reason}.
        self._refused: dict[tuple[int, bool], str] = {}
        self._anew: dict[str, int] = {}  # plants that began anew: the versions that the store has of them
        self.replaced: list[tuple[PlantState, list[WithdrawnEvent]]] = []  # the plants before that, with their events
        # Of the present round in the batch: plants as they were before it, and the events that they used, to be judged.
        self._before: dict[str, PlantBeforeBatch] = {}
        self._taken: list[CandidateEvent] = []

    def apply_batch(self, messages: Sequence[Read], damaged: Container[str], wall: datetime) -> list[MessageOutcome]:
        """Give a batch of messages to their plants, step these, and return the outcome of each message.

        That a message is implausible (too far from the forecast to be true) shows only once its plant has used it. Such
        messages are refused, and afterwards the plants are as if they had never arrived.

        Args:
            messages: the messages, read; one that could not be read says why.
            damaged: names of the plants whose stored state is damaged: their messages are left alone.
            wall: the time by this machine's clock.
        """
        # Of this batch: refused events, plants that began anew, and the former plants that these replaced.
        self._refused, self._anew, self.replaced = self._find_implausible_inputs(messages), {}, []
        outcomes = [MessageOutcome()] * len(messages)
        # Numbers of messages by plant: one plant is served after another, so that its memory is near. Messages that
        # could not be read have no plant, and stand under "".
        numbers_by_plant: dict[str, list[int]] = {}
        for i, message in enumerate(messages):
            name = find_plant_name(message)
            if name is None or name not in damaged:
                numbers_by_plant.setdefault(name or "", []).append(i)
        waiting = [i for numbers in numbers_by_plant.values() for i in numbers]
        # Each round refuses at least one message, restores its plant, and gives the plant its other messages again.
        while waiting:
            # States of the plants before this round, by which it can be undone, and the messages that they took.
            self._before, self._taken = {}, []
            for i in waiting:
                outcomes[i] = self._take_message(i, messages[i], wall)
            restored = self._refuse_implausible()
            waiting = [i for i in waiting if find_plant_name(messages[i]) in restored]
        self._taken = []
        return outcomes

    def _refuse_implausible(self) -> set[str]:
        """Step the plants that took events, restore those with implausible events, and return the restored names.

        Each implausible event is noted in `_refused` with its reason, by (number of its message, whether it is inputs).
        Its plant is restored to its state before the batch, so that the caller must apply its other events again.
        """
        plants_by_name = {candidate.plant.name: candidate.plant for candidate in self._taken}
        self.fleet.step(plants_by_name.values())
        to_restore = set[str]()
        for i, why in self._judges.find_implausible(self._taken).items():
            candidate = self._taken[i]
            self._refused[candidate.number, candidate.event.is_inputs] = why
            to_restore.add(candidate.plant.name)
        for name in to_restore:
            self._restore_plant(name)
        return to_restore

    def _take_message(self, number: int, message: Read, wall: datetime) -> MessageOutcome:
        """Give a message to its plant, as far as it was read; return its outcome.

        Args:
            number: the message's number in the batch.
            message: the message, or what could be read of it, or why nothing could.
            wall: the time by this machine's clock.
        """
        if isinstance(message, str):  # the reason why it could not be read at all
            return MessageOutcome(why=message)
        if isinstance(message, UnreadMessage):
            return MessageOutcome(self._count_unread(message), why=message.why)
        try:
            return self._use_message(number, message, wall)
        except InputError as error:  # its plant expects another kind of message
            return MessageOutcome(self._count_unread(UnreadMessage(message, str(error))), why=str(error))

    def _find_implausible_inputs(self, messages: Sequence[Read]) -> dict[tuple[int, bool], str]:
        """Return {(number of a message, True): reason} for inputs that lead to no valid prediction.

        The keys are those of `_refused`; True says that the message's inputs are meant, not its measurement. The
        prediction starts from the plant's state before the batch. A message has inputs beside its measurement, or only
        inputs (its node is INPUTS).
        """
        numbers, plants, inputs = list[int](), list[PlantState | None](), []
        for i, message in enumerate(messages):
            if isinstance(message, str | UnreadMessage):
                continue
            values = message.values if message.node == INPUTS else message.inputs
            if values and len(values) == self.fleet.program.given:  # as many as the network has inputs
                numbers.append(i)
                plants.append(self.plants.get(message.plant))
                inputs.append(values)
        reasons = self._judges.explain_implausible_inputs(plants, np.array(inputs, dtype=np.float64))
        return {(i, True): why for i, why in zip(numbers, reasons, strict=True) if why}

    def _use_message(self, number: int, message: AnyMessage, wall: datetime) -> MessageOutcome:
        """Give a message to its plant, and say whether it is used, or why not.

        A message has a node's measurement, the plant's inputs, or both: each is an event. The outcome has no plant if a
        plant would begin with a refused message. `number`: the message's in the batch. `wall`: this machine's time.
        """
        plant = self._find_plant(message, wall)
        timed = self._events.read_events(message, plant, wall)
        # Values beyond the node's limits count as not received; if none is left, the event is implausible.
        screened = self.fleet.screen_event(message.node, timed.event, plant)
        why, why_inputs = screened.why if screened.is_empty else "", None
        # What an earlier round found implausible, in the event or in the inputs that came with it; most often nothing.
        if self._refused:
            why = self._refused.get((number, timed.event.is_inputs)) or why
            why_inputs = self._refused.get((number, True)) if timed.inputs is not None else None
        if plant is None:
            refusal = self._refuse_as_first(timed, why, why_inputs)
            if refusal is not None:
                return refusal
            plant = self._begin_plant_by_message(message, timed)
        plant = self._note_plant_before_batch(plant, timed.at)  # so that it can be restored
        # Inputs and measurement are used or refused independently.
        verdict_on_inputs = self._use_inputs(number, plant, message, timed, why_inputs)
        verdict = self._give_to_plant(number, plant, message, screened.event, timed.clock, why)
        self.fleet.count_event(plant, message.node, screened, verdict)
        # What is said of parts that were left out: the verdict on each, and why.
        notes = list[tuple[Verdict, str]]()
        # Inputs that share the measurement's verdict need no word of their own, unless they are what is implausible.
        if verdict_on_inputs == "implausible" or verdict_on_inputs not in ("used", "duplicate", verdict):
            notes.append((verdict_on_inputs, f"inputs {message.inputs}: {why_inputs or WHY[verdict_on_inputs]}"))
        if screened.why and verdict == "used":
            notes.append(("implausible", screened.why))
        ending = "; the rest is used" if verdict == "used" else ""
        notes = [(verdict_on_part, note + ending) for verdict_on_part, note in notes]
        return MessageOutcome(plant, verdict, "" if verdict != "implausible" else why, notes)

    def _refuse_as_first(self, timed: TimedEvents, why: str, why_inputs: str | None) -> MessageOutcome | None:
        """Return the refusal of a message with which no plant can begin, or None if one can.

        It must not be dated in the future, since its clock would be wrong, and something in it must be plausible.

        Args:
            timed: the events of the message.
            why: why its measurement is implausible; "" where it is not.
            why_inputs: the same of its inputs; None where they are plausible, or there are none.
        """
        if timed.at > timed.arrival + self.fleet.options.ahead:
            return MessageOutcome(verdict="future")
        nothing_is_plausible = why and (timed.inputs is None or why_inputs)
        return MessageOutcome(verdict="implausible", why=why) if nothing_is_plausible else None

    def _begin_plant_by_message(self, message: AnyMessage, timed: TimedEvents) -> PlantState:
        """Return a new plant that begins with a message.

        Its first moment counts as a leap in time by one clock, which may be wrong: that of arrivals, or the sender's.
        """
        has_arrival = message.arrival is not None
        leap = make_first_leap(timed.arrival, ARRIVAL) if has_arrival else make_first_leap(timed.at, message.node)
        return self._begin_plant(message.plant, timed.at, timed.origin, leap)

    def _use_inputs(
        self, number: int, plant: PlantState, message: AnyMessage, timed: TimedEvents, why_refused: str | None
    ) -> Verdict:
        """Give the inputs beside a measurement to its plant; return the verdict, "used" where there are none.

        Args:
            number: the message's number in the batch.
            plant: the plant.
            message: the message.
            timed: the message's events, with times as numbers.
            why_refused: the reason if the inputs are known to be implausible, else None.
        """
        if timed.inputs is None:
            return "used"
        verdict = self._give_to_plant(number, plant, message, timed.inputs, timed.clock, why_refused)
        if verdict == "conflict" and plant.rows.holds_values(timed.inputs):  # two nodes say the same inputs
            return "duplicate"
        if verdict not in ("used", "duplicate"):
            plant.link_counts(INPUTS).count_verdict(verdict)
        return verdict

    def _count_unread(self, unread: UnreadMessage) -> PlantState | None:
        """Count a message that came but cannot be used, and what it is refused for; it is not counted as lost.

        Returns its plant; None where plant, node or time of the message are none that is known.
        """
        message = unread.read
        plant, node = self.plants.get(message.plant), message.node
        if plant is None or (node != INPUTS and node not in self.fleet.network.names):
            return None
        try:
            at = self._events.time_as_number(message.time, plant.origin, plant.name)
        except InputError:  # a time of another kind
            return None
        link = self._note_plant_before_batch(plant, at).link_counts(node)
        if unread.counted:
            link.count_unread(message.sequence, at, self.fleet.periods.get(node, 0))
        if unread.reason is not None:
            link.count_refused(unread.reason)
        return plant

    def _note_plant_before_batch(self, plant: PlantState, begun: float) -> PlantState:
        """Note a plant's state, so that `_restore_plant` can undo what the round does to it; return the plant.

        Its first event in a round does this. A new plant is added to the plants in memory; `begun` is the time of its
        first event.
        """
        if plant.name not in self.plants:
            self.plants[plant.name] = plant
            self._before[plant.name] = PlantBeforeBatch(known=False, clock=(begun, None), links={})
        elif plant.name not in self._before:
            links = {name: tuple(vars(link).values()) for name, link in plant.links.items()}
            self._before[plant.name] = PlantBeforeBatch(known=True, clock=plant.clock, links=links)
        return plant

    def _find_plant(self, message: AnyMessage, wall: datetime) -> PlantState | None:
        """Return the plant of a message; None if it has to begin, or to begin anew because its first time was wrong.

        The first message of a plant sets its time by one clock only, which may be wrong. It was if this message is
        dated long before it and `is_taken_back_by` says so; or if this machine's time (`wall`) agrees with this message
        while the plant's time is far ahead. "Far" is more than `longest_gap`.
        """
        # The plant as stored, and the longest jump in time that is believed of one clock.
        plant, longest_gap = self.plants.get(message.plant), self.fleet.options.leap
        has_other_kind_of_time = plant is not None and isinstance(message.time, datetime) != (plant.origin is not None)
        if plant is None or has_other_kind_of_time:  # such a message is refused later
            return plant
        # Times as numbers since the plant's origin (a date, if its times are dates).
        at = self._events.time_as_number(message.time, plant.origin, plant.name)
        # The clock that decides (of arrivals, where an arrival was given, else the sender's), and the time it shows.
        clock, clock_time = message.node, at
        if message.arrival is not None:
            clock, clock_time = ARRIVAL, self._events.time_as_number(message.arrival, plant.origin, plant.name)
        # `first`: the jump in time that this message contradicts, if any; `newest`: the newest arrival after that. If
        # the plant began with it (its `now` is -inf: nothing came before it), all of the plant was wrong.
        first, newest = find_contradicted_leap(plant.leap, plant.now, clock_time, longest_gap) or (None, at)
        began_with_it = first is not None and first.now == -inf and not plant.holds_rows_before(first, at, longest_gap)
        if first is not None and began_with_it and first.is_taken_back_by(clock, clock_time, newest):
            return None
        # Does this machine's time agree with the message, and not with the plant?
        if plant.origin is not None:
            now = self._events.time_as_number(wall, plant.origin, plant.name)
            is_plant_ahead, is_message_right = plant.confirmed > now + longest_gap, abs(at - now) <= longest_gap
            if is_plant_ahead and is_message_right:
                return None
        return plant

    def _begin_plant(self, name: str, at: float, origin: datetime | None, leap: ClockLeap) -> PlantState:
        """Return a new plant that begins at the time `at`; a later message may still show that this time was wrong.

        If a plant of this name exists, its clock was wrong: it ends, its events become refusals (`replaced`), and are
        counted as from the future. `leap`: the jump in time, by one clock, with which the plant begins.
        """
        plant = self.fleet.begin_plant(name, at, origin)
        old = self.plants.pop(name, None)
        plant.now, plant.leap, plant.version = at, leap, self._anew.get(name, 0)
        if old is not None:
            # The store has the old plant: the new one takes over its version, also if it is restored in this batch.
            plant.version = self._anew[name] = old.version
            events = [WithdrawnEvent(*event) for row in old.rows.held for event in row.events]
            self.replaced.append((old, events))
            for node_index, sequence, time in events:  # index -1: the inputs
                node = INPUTS if node_index < 0 else self.fleet.network.names[node_index]
                plant.link_counts(node).count("future", sequence, time)
            # Forget the old plant's state before the batch, and those of its events that were taken in this batch.
            self._before.pop(name, None)
            self._taken = [taken for taken in self._taken if taken.plant is not old]
            self.fleet.end_plant(old)
        return plant

    def _give_to_plant(
        self,
        number: int,
        plant: PlantState,
        message: AnyMessage,
        event: CheckedEvent,
        wall: float | None,
        why_implausible: str | None,
    ) -> Verdict:
        """Give an event to its plant and return the verdict; if it is used, note it as one to be judged (`_taken`).

        One that is known to be implausible changes nothing, and is called so if nothing else is wrong with it.

        Args:
            number: number of its message in the batch.
            plant: the plant.
            message: its message; the clock of the message's node dates the event.
            event: the event, a measurement or inputs.
            wall: time by the clock on the wall, None if it is not known.
            why_implausible: why it is implausible, as is known already; None or "" where it is not.
        """
        if why_implausible:
            watermark = max(plant.confirmed, event.arrival) - self.fleet.options.window
            key, ahead = plant.rows.make_key(event), self.fleet.options.ahead
            verdict = plant.rows.judge_event(event, key, watermark, ahead)
            return "implausible" if verdict == "used" else verdict
        arrival_known = message.arrival is not None
        verdict = self.fleet.take_event(plant, event, arrival_known, wall, clock=message.node)
        if verdict == "used":
            row, _ = plant.changes[-1]  # the newest change: the row that holds the event now, and what it held before
            self._taken.append(CandidateEvent(number, plant, event, row))
        return verdict

    def _restore_plant(self, name: str) -> None:
        """Restore a plant to its state before the batch; one that began in the batch is removed."""
        plant, before = self.plants[name], self._before[name]
        if before.known:
            self.fleet.undo_events(plant, before.clock)
            plant.links = {node: LinkCounts(*counts) for node, counts in before.links.items()}
        else:
            self.fleet.end_plant(self.plants.pop(name))


def find_plant_name(message: Read) -> str | None:
    """Return the name of a message's plant, or None if the message could not be read at all."""
    if isinstance(message, str):  # the reason why it could not be read
        return None
    return message.read.plant if isinstance(message, UnreadMessage) else message.plant
