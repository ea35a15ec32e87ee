"""Use of a batch without its implausible messages: their plants are restored, and take the rest again."""

from collections import OrderedDict
from collections.abc import Container, Sequence
from datetime import UTC, datetime, time
from math import floor, inf
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from heliograph.live.event import INPUTS, Known, Verdict
from heliograph.live.fleet import Fleet
from heliograph.live.implausible_events import Candidate, Judges
from heliograph.live.leap import ARRIVAL, Leap, find_leap, make_first_leap
from heliograph.live.link_counts import LinkCounts
from heliograph.live.plant import PlantState, Withdrawn
from heliograph.numerics.check import InputError
from heliograph.serving.message import AnyMessage, Read, UnreadMessage, seconds

# Of a message: its plant (None if it began none), a verdict (None if it could not be read), the reason, and notes on
# parts that were left out of a used message.
Outcome: TypeAlias = tuple[PlantState | None, Verdict | None, str, Sequence[str]]
NOTHING: Outcome = None, None, "", ()


class Before(NamedTuple):
    """State of a plant before a batch: whether it existed, its time and its counts."""

    known: bool
    clock: tuple[float, Leap | None]
    links: dict[str, tuple[Any, ...]]


class Brought(NamedTuple):
    """What a message brings: when it was measured and arrived, this machine's clock, and its events.

    Times are numbers from the plant's `origin`; without one there is no clock to compare with.
    """

    at: float
    arrival: float
    clock: float | None
    origin: datetime | None
    event: Known
    inputs: Known | None


class Using:
    """Distribution of messages to their plants; `plants` are those in memory, by name."""

    def __init__(self, fleet: Fleet, plants: OrderedDict[str, PlantState]):
        self.fleet, self.plants, self._judges = fleet, plants, Judges(fleet)
        self._refused: dict[tuple[int, bool], str] = {}  # why, by the number of a message and whether it is its inputs
        self._before: dict[str, Before] = {}
        self._taken: list[Candidate] = []
        self._anew: dict[str, int] = {}  # versions of plants that began anew in this batch
        self.replaced: list[tuple[PlantState, list[Withdrawn]]] = []  # these as they were, with their events

    def apply_batch(self, messages: Sequence[Read], damaged: Container[str], wall: datetime) -> list[Outcome]:
        """Give a batch of messages to their plants, but for damaged ones, and step these; return each one's outcome.

        `wall` is the time by this machine's clock. Afterwards the plants are as if the messages refused as implausible
        had never arrived.
        """
        self._refused, self._anew, self.replaced = self._find_implausible_inputs(messages), {}, []
        outcomes = [NOTHING] * len(messages)
        # One plant after another, so that its memory is near; the messages of a plant in their order.
        by_plant: dict[str, list[int]] = {}
        for i, message in enumerate(messages):
            if (name := plant_of(message)) is None or name not in damaged:
                by_plant.setdefault(name or "", []).append(i)
        left = [i for numbers in by_plant.values() for i in numbers]
        # Each round refuses at least one message, restores its plant, and gives the plant its other messages again.
        while left:
            self._before, self._taken = {}, []
            for i in left:
                try:
                    message = messages[i]
                    if isinstance(message, str):
                        outcomes[i] = None, None, message, ()
                    elif isinstance(message, UnreadMessage):
                        outcomes[i] = self._count_unread(message.read), None, message.why, ()
                    else:
                        outcomes[i] = self._use_message(i, message, wall)
                except InputError as error:  # of another kind than its plant expects
                    assert not isinstance(message, str | UnreadMessage)
                    outcomes[i] = self._count_unread(message), None, str(error), ()
            self.fleet.step({plant.name: plant for _, plant, _, _ in self._taken}.values())
            implausible = self._judges.find_implausible(self._taken)
            # Plants that an implausible message has spoilt go back.
            spoilt = set()
            for i, why in implausible.items():
                number, plant, event, _ = self._taken[i]
                self._refused[number, event.node_index < 0] = why
                spoilt.add(plant.name)
            for name in spoilt:
                self._restore_plant(name)
            left = [i for i in left if plant_of(messages[i]) in spoilt]
        self._taken = []
        return outcomes

    def _find_implausible_inputs(self, messages: Sequence[Read]) -> dict[tuple[int, bool], str]:
        """Return the inputs that lead to no valid prediction from the state before the batch."""
        given = [(i, m, values) for i, m in enumerate(messages) if not isinstance(m, str | UnreadMessage)
                 and (values := m.values if m.node == INPUTS else m.inputs)
                 and len(values) == self.fleet.program.given]  # fmt: skip
        plants = [self.plants.get(message.plant) for _, message, _ in given]
        numbers = np.array([values for *_, values in given], dtype=np.float64)
        why = self._judges.explain_implausible_inputs(plants, numbers)
        return {(i, True): said for (i, _, _), said in zip(given, why, strict=True) if said}

    def _use_message(self, number: int, message: AnyMessage, wall: datetime) -> Outcome:
        """Give a message to its plant; the outcome has none if the plant would begin with a refused message."""
        plant = self._find_plant(message, wall)
        brought = self._read_events(message, plant, wall)
        at, arrival, event, inputs = brought.at, brought.arrival, brought.event, brought.inputs
        # Values beyond limits do not count as received; an event of such values only is implausible.
        screened = self.fleet.screen(message.node, event, plant)
        event, refused, why, spoilt = screened.event, self._refused, screened.why if screened.is_empty else "", None
        if refused:
            why = refused.get((number, event.node_index < 0)) or why
            spoilt = refused.get((number, True)) if inputs is not None else None
        # A new plant begins with a message that is plausible and of a right clock.
        if plant is None and at > arrival + self.fleet.options.ahead:
            return None, "future", "", ()
        if plant is None and why and (inputs is None or spoilt):
            return None, "implausible", why, ()
        given = message.arrival is not None
        if plant is None:
            begins = make_first_leap(*((arrival, ARRIVAL) if given else (at, message.node)))
            plant = self._begin_plant(message.plant, at, brought.origin, begins)
        plant = self._remember(plant, at)
        # Inputs and measurement are used or refused independently.
        notes: list[str] = []
        if inputs is not None and spoilt is None:
            self._give_to_plant(number, plant, inputs, given, brought.clock, message.node)
        elif spoilt is not None:
            plant.link(INPUTS).implausible += 1
            notes.append(f"inputs {message.inputs}: {spoilt}; the rest is used")
        verdict: Verdict = "implausible"
        if not why:
            verdict = self._give_to_plant(number, plant, event, given, brought.clock, message.node)
        self.fleet.count(plant, message.node, screened, verdict)
        if screened.why and verdict == "used":
            notes.append(f"{screened.why}; the rest is used")
        return plant, verdict, why, notes

    def _read_events(self, message: AnyMessage, plant: PlantState | None, wall: datetime) -> Brought:
        """Return the events of a message, its measurement and inputs, with times as numbers of its plant."""
        origin = self._choose_origin(message) if plant is None else plant.origin
        at = message.time
        if origin is not None or not isinstance(at, float):
            at = self._time_as_number(at, origin, message.plant)
        # Without a time of arrival it came when its plant had come so far.
        now = at if plant is None else plant.confirmed
        came = message.arrival
        arrival = max(now, at) if came is None else self._time_as_number(came, origin, message.plant)
        clock = None if origin is None else self._time_as_number(wall, origin, message.plant)
        event, inputs = self.fleet.convert_message(message.node, message.sequence, at, message.values, arrival), None
        if message.inputs is not None:
            inputs = self.fleet.convert_message(INPUTS, message.sequence, at, message.inputs, arrival)
        return Brought(at, arrival, clock, origin, event, inputs)

    def _count_unread(self, message: AnyMessage) -> PlantState | None:
        """Count a message that came and cannot be used as none that was lost; return its plant, if that says so."""
        plant, node = self.plants.get(message.plant), message.node
        if plant is None or (node != INPUTS and node not in self.fleet.network.names):
            return None
        try:
            at = self._time_as_number(message.time, plant.origin, plant.name)
        except InputError:  # a time of another kind
            return None
        link = self._remember(plant, at).link(node)
        link.count_unread(message.sequence, at, self.fleet.periods.get(node, 0))
        return plant

    def _remember(self, plant: PlantState, begun: float) -> PlantState:
        """Return the plant, and store once in a batch what it was before; a new one joins the others."""
        if plant.name not in self.plants:
            self.plants[plant.name] = plant
            self._before[plant.name] = Before(False, (begun, None), {})
        elif plant.name not in self._before:
            links = {name: tuple(vars(link).values()) for name, link in plant.links.items()}
            self._before[plant.name] = Before(True, plant.clock, links)
        return plant

    def _time_as_number(self, moment: float | datetime, origin: datetime | None, plant: str) -> float:
        """Convert a time to a number: of a date, seconds from the origin, or the step that is nearest."""
        at, step = seconds(moment, origin, plant), self.fleet.options.step
        return at if origin is None or step is None else floor(at / step + 0.5)

    def _find_plant(self, message: AnyMessage, wall: datetime) -> PlantState | None:
        """Return the plant of a message; None if it has to begin, or to begin anew since its first clock was wrong.

        That is so where the message goes on from before the leap with which the plant began, and where that is in the
        future of the clock on the wall, with which the message agrees.
        """
        plant, leap = self.plants.get(message.plant), self.fleet.options.leap
        if plant is None or isinstance(message.time, datetime) != (plant.origin is not None):
            return plant
        at = self._time_as_number(message.time, plant.origin, plant.name)
        said = self._time_as_number(message.arrival, plant.origin, plant.name) if message.arrival is not None else at
        first, newest = find_leap(plant.leap, plant.now, said, leap) or (None, at)
        begins = first is not None and first.now == -inf and not plant.holds(first, at, leap)
        clock = message.node if message.arrival is None else ARRIVAL
        if first is not None and begins and first.taken_back_by(clock, said, newest):
            return None
        if plant.origin is not None:
            now = self._time_as_number(wall, plant.origin, plant.name)
            if plant.confirmed > now + leap and abs(at - now) <= leap:
                return None
        return plant

    def _begin_plant(self, name: str, at: float, origin: datetime | None, leap: Leap) -> PlantState:
        """Begin a plant, whose first moment may still turn out wrong; one that begins anew is withdrawn first."""
        plant, old = self.fleet.begin(name, at, origin), self.plants.pop(name, None)
        plant.now, plant.leap, plant.version = at, leap, self._anew.get(name, 0)
        if old is not None:
            plant.version = self._anew[name] = old.version
            events = [Withdrawn(*event) for row in old.rows.held for event in row.events]
            self.replaced.append((old, events))
            for node, sequence, time in events:
                plant.link(INPUTS if node < 0 else self.fleet.network.names[node]).count("future", sequence, time)
            self._before.pop(name, None)
            self._taken = [taken for taken in self._taken if taken[1] is not old]
            self.fleet.end(old)
        return plant

    def _give_to_plant(
        self, number: int, plant: PlantState, event: Known, given: bool, wall: float | None, clock: str
    ) -> Verdict:
        """Let the plant judge an event, and note what it changed."""
        verdict = self.fleet.take(plant, event, given, wall, clock)
        if verdict == "used":
            self._taken.append((number, plant, event, plant.changes[-1][0]))
        return verdict

    def _restore_plant(self, name: str) -> None:
        """Restore a plant to its state before the batch."""
        plant, (known, clock, links) = self.plants[name], self._before[name]
        if known:
            self.fleet.undo(plant, clock)
            plant.links = {name: LinkCounts(*counts) for name, counts in links.items()}
        else:
            self.fleet.end(self.plants.pop(name))

    def _choose_origin(self, message: AnyMessage) -> datetime | None:
        """Return midnight, UTC, before a plant's first message, or the date of step 0; None where times are numbers."""
        if not isinstance(message.time, datetime):
            return None
        if self.fleet.program.dt is None:
            return None if self.fleet.options.step is None else message.time
        return datetime.combine(message.time.astimezone(UTC).date(), time(), UTC)


def plant_of(message: Read) -> str | None:
    """Return the name of the plant of a message; None of one that names none."""
    if isinstance(message, str):
        return None
    return message.read.plant if isinstance(message, UnreadMessage) else message.plant
