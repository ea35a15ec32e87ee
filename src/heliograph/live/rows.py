"""Events in the order of time: the rows that they make, what of them is final, and the verdict on one more."""

from bisect import bisect_left
from typing import TypeAlias

import numpy as np

from heliograph.live.event import Known, Verdict
from heliograph.numerics.types import Float

Key: TypeAlias = "tuple[float, int, int]"  # of a row: time, place of the node (-1: inputs), sequence
BEFORE = -2  # the place of what stands before everything at its time


class HeldRow:
    """A row of the tape: its slot there, its numbers (all that nodes heard, inputs given, time), and its events."""

    def __init__(self, key: Key, slot: int, size: int):
        self.key, self.slot, self.numbers = key, slot, np.empty(size + 1)
        self.numbers.fill(np.nan)
        self.numbers[-1] = key[0]
        self.events: dict[tuple[int, int, float], Float[np.ndarray, " size"]] = {}

    def observe(self) -> bool:
        """Whether some event of it is a node's; the others are inputs."""
        return any(place >= 0 for place, _, _ in self.events)


class Rows:
    """The rows held, sorted; the first is the base, of which only the state after it is needed.

    `joint`: all events of one time make one row. `places`: of each node's numbers in a row, of the inputs' last.
    """

    def __init__(self, base: HeldRow, joint: bool, places: list[slice], capacity: int):
        self.held, self.keys = [base], [base.key]
        self.joint, self.places, self.capacity = joint, places, capacity

    def hold(self, rows: list[HeldRow]) -> None:
        """Hold these rows, in their order, in place of all others."""
        self.held, self.keys = rows, [row.key for row in rows]

    def key(self, event: Known) -> Key:
        """The row that an event belongs to."""
        return (event.time, 0, 0) if self.joint else (event.time, event.place, event.sequence)

    def base(self, watermark: float) -> int:
        """Where the newest row older than the watermark stands: the base, once this is the watermark."""
        return max(bisect_left(self.keys, (watermark,)) - 1, 0)

    def after(self, time: float) -> int:
        """Where the first row after a time stands."""
        return bisect_left(self.keys, (time, np.inf))

    def verdict(self, event: Known, watermark: float, ahead: float) -> Verdict:
        """The verdict on an event, once this is the watermark."""
        if event.time > event.arrival + ahead:
            return "future"
        if self.key(event) > self.keys[-1]:  # as most are: nothing can be said against what is newest
            return "used"
        base = self.finalise(watermark)[0]
        place, row = self.find(event)
        held = None if row is None else row.events.get(event.name)
        if place < base or (place == base and held is None):
            return "late"
        if row is None:
            return "used"
        if held is not None:
            return "duplicate" if np.array_equal(held, event.values, equal_nan=True) else "conflict"
        there = row.numbers[self.places[event.place]]
        return "conflict" if np.any(~np.isnan(there) & ~np.isnan(event.values)) else "used"

    def find(self, event: Known) -> tuple[int, HeldRow | None]:
        """Where the event's row stands, and the row, if there is one."""
        key = self.key(event)
        if key > self.keys[-1]:
            return len(self.keys), None
        place = bisect_left(self.keys, key)
        there = self.keys[place] == key
        return place, self.held[place] if there else None

    def insert(self, place: int, row: HeldRow) -> None:
        """Hold one row more, where `find` said."""
        self.keys.insert(place, row.key)
        self.held.insert(place, row)

    def place(self, key: Key) -> int:
        """Where the row of this key stands, or would."""
        return bisect_left(self.keys, key)

    def remove(self, place: int) -> None:
        """Hold one row less."""
        del self.keys[place], self.held[place]

    def fill(self, row: HeldRow, event: Known) -> None:
        """Take what an event has into its row; NaN is nothing."""
        there = row.numbers[self.places[event.place]]
        if row.events:
            np.copyto(there, event.values, where=~np.isnan(event.values))
        else:  # nothing is there yet
            there[:] = event.values
        row.events[event.name] = event.values

    def finalise(self, watermark: float) -> tuple[int, int]:
        """Where the base has to move to, and how many rows of these become final for want of room."""
        by_time = self.base(watermark)
        base = max(by_time, len(self.held) - 1 - self.capacity)
        return base, base - by_time

    def drop(self, base: int) -> tuple[list[HeldRow], list[HeldRow]]:
        """Move the base there: the rows that are final now, and those that are no longer needed."""
        final, left = self.held[1 : base + 1], self.held[:base]
        del self.held[:base], self.keys[:base]
        return final, left
