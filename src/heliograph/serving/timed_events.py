"""The events of a message, with times as numbers that count from a plant's origin."""

from datetime import UTC, datetime, time
from math import floor
from typing import NamedTuple

from heliograph.live.event import INPUTS, CheckedEvent
from heliograph.live.fleet import Fleet
from heliograph.live.plant_state import PlantState
from heliograph.serving.message import AnyMessage, convert_time_to_seconds


class TimedEvents(NamedTuple):
    """The events of a message with times as numbers from the plant's `origin`.

    Attributes:
        at: when it was measured.
        arrival: when it arrived.
        clock: the present by this machine's clock; None where times have no origin to compare with.
        origin: the date from which times are counted; None where they are numbers.
        event: its measurement.
        inputs: its inputs, None if it has none.
    """

    at: float
    arrival: float
    clock: float | None
    origin: datetime | None
    event: CheckedEvent
    inputs: CheckedEvent | None


class EventReader:
    """Reads the events of messages, whose times are dates or numbers, for the plants of a fleet."""

    def __init__(self, fleet: Fleet):
        """Hold the fleet, whose network says what messages have, and whose options say how long a step is."""
        self.fleet = fleet

    def read_events(self, message: AnyMessage, plant: PlantState | None, wall: datetime) -> TimedEvents:
        """Return the events of a message, its measurement and inputs, with times as numbers of its plant.

        `plant` is None if it has not begun. `wall`: the time by this machine's clock.
        """
        origin = self._choose_origin(message) if plant is None else plant.origin
        at = message.time
        if origin is not None or not isinstance(at, float):
            at = self.time_as_number(at, origin, message.plant)
        # Without a time of arrival it arrived when measured, or, if late, when the plant's newest message did.
        if message.arrival is None:
            arrival = at if plant is None else max(plant.confirmed, at)
        else:
            arrival = self.time_as_number(message.arrival, origin, message.plant)
        clock = None if origin is None else self.time_as_number(wall, origin, message.plant)
        event, inputs = self.fleet.convert_message(message.node, message.sequence, at, message.values, arrival), None
        if message.inputs is not None:
            inputs = self.fleet.convert_message(INPUTS, message.sequence, at, message.inputs, arrival)
        return TimedEvents(at=at, arrival=arrival, clock=clock, origin=origin, event=event, inputs=inputs)

    def time_as_number(self, moment: float | datetime, origin: datetime | None, plant: str) -> float:
        """Return a time as a number: of a date the seconds from the plant's origin, or the nearest step.

        `plant` is the plant's name, for errors. `origin` is None if the plant's times are numbers already.
        """
        at, step = convert_time_to_seconds(moment, origin, plant), self.fleet.options.step
        return at if origin is None or step is None else floor(at / step + 0.5)

    def _choose_origin(self, message: AnyMessage) -> datetime | None:
        """Return the date from which a new plant's times are counted, or None if its times are numbers.

        In continuous time it is the midnight (UTC) before the plant's first message. If the network counts steps of a
        known length, it is the time of the first message, which becomes step 0.
        """
        if not isinstance(message.time, datetime):
            return None
        if self.fleet.program.dt is None:
            return None if self.fleet.options.step is None else message.time
        return datetime.combine(message.time.astimezone(UTC).date(), time(), UTC)
