"""One plant of a fleet: the rows it holds, the verdict on each message, and its links' tallies."""

from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import datetime
from typing import NamedTuple

import numpy as np

from heliograph.live.event import Known, Verdict
from heliograph.live.rows import HeldRow, Rows
from heliograph.numerics.types import Float


@dataclass
class Link:
    """What came from a node: numbers of messages by verdict, and `lost`, the gaps in its counts that nothing filled.

    Counts run from `first` to `newest`, which was measured at `at`. A smaller number of a later time begins anew: the
    node was started again. A larger one of an earlier time is from before that. `dropped`: single values beyond limits.
    """

    first: int = -1
    newest: int = -1
    at: float = 0.0
    lost: int = 0
    used: int = 0
    duplicate: int = 0
    conflict: int = 0
    late: int = 0
    future: int = 0
    implausible: int = 0
    dropped: int = 0

    def count(self, verdict: Verdict, sequence: int, time: float) -> None:
        """Count one message. What is late, implausible or from the future came, whatever became of it."""
        setattr(self, verdict, getattr(self, verdict) + 1)
        if verdict in ("duplicate", "conflict"):
            return
        if verdict in ("future", "implausible"):  # its time may be wrong: it says nothing of the order
            time = self.at
        if self.newest < 0 or (sequence < self.newest and time > self.at):
            self.first, self.newest, self.at = sequence, sequence, time
        elif sequence > self.newest:
            if time >= self.at:
                self.lost += sequence - self.newest - 1
                self.newest, self.at = sequence, time
        elif verdict != "used":
            return  # it may have been counted when it first came
        elif sequence < self.first:
            self.lost += self.first - sequence - 1
            self.first = sequence
        elif sequence < self.newest:
            self.lost -= self.lost > 0  # it had only been overtaken


class Change(NamedTuple):
    """A row that took an event, and its numbers and events before; None: it was not there."""

    row: HeldRow
    before: tuple[Float[np.ndarray, " size"], dict[tuple[int, int, float], Float[np.ndarray, " values"]]] | None


@dataclass
class Plant:
    """Rows held, of which those from `dirty` on have to be stepped anew.

    `now` is the newest arrival; `forced`: rows that became final before their time, for want of room. `origin`: the
    moment that its times are counted from, where they are dates. `version` counts its commits. `changes` since the last
    events became settled can be undone.
    """

    name: str
    rows: Rows
    now: float
    origin: datetime | None = None
    version: int = 0
    dirty: int | None = None
    forced: int = 0
    links: dict[str, Link] = field(default_factory=dict)
    changes: list["Change"] = field(default_factory=list)

    def take(self, event: Known, slot: Callable[[], int], width: int) -> None:
        """Hold an event that is used, in a row of a slot if it begins one; what changes is remembered."""
        place, row = self.rows.find(event)
        if row is None:
            row = HeldRow(self.rows.key(event), slot(), width)
            self.rows.insert(place, row)
            self.changes.append(Change(row, None))
        else:
            self.changes.append(Change(row, (row.numbers.copy(), dict(row.events))))
        self.rows.fill(row, event)
        self.dirty = place if self.dirty is None else min(self.dirty, place)

    def undo(self) -> list[int]:
        """Hold what was held before the last changes; slots that are free again. What was stepped is dirty."""
        slots = []
        for row, before in reversed(self.changes):
            if before is None:
                self.rows.remove(self.rows.place(row.key))
                slots.append(row.slot)
            else:
                row.numbers[:], row.events = before
        place = min((self.rows.place(row.key) for row, _ in self.changes), default=len(self.rows.held))
        self.dirty = place if place < len(self.rows.held) else None
        self.changes = []
        return slots

    def link(self, node: str) -> Link:
        """The tally of a node."""
        result = self.links.get(node)
        if result is None:
            result = self.links[node] = Link()
        return result

    def chain(self) -> list[HeldRow]:
        """The rows to step over again, after the one that they begin from."""
        chain = [] if self.dirty is None else self.rows.held[self.dirty - 1 :]
        self.dirty = None
        return chain

    def finalise(self, watermark: float) -> tuple[list[HeldRow], list[int]]:
        """The rows that are final once this is the watermark, and the slots that are not needed any more."""
        self.changes = []
        base, forced = self.rows.finalise(watermark)
        if not base:
            return [], []
        self.forced += forced
        final, left = self.rows.drop(base)
        return final, [row.slot for row in left]
