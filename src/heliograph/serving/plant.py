"""One plant of a fleet: the rows it holds, the verdict on each message, and its links' tallies."""

from dataclasses import dataclass, field
from datetime import datetime

from heliograph.live.event import Known, Verdict
from heliograph.live.rows import HeldRow, Rows

REBOOT = 1000  # a number that falls by more, or to 0, begins anew: the node was started again


@dataclass
class Link:
    """What came from a node: numbers of messages by verdict, and `lost`, the gaps in its counts."""

    newest: int = -1
    lost: int = 0
    used: int = 0
    duplicate: int = 0
    conflict: int = 0
    late: int = 0
    future: int = 0

    def count(self, verdict: Verdict, sequence: int) -> None:
        """Count one message."""
        setattr(self, verdict, getattr(self, verdict) + 1)
        if verdict in ("duplicate", "conflict"):
            return
        if self.newest < 0 or sequence == 0 or sequence < self.newest - REBOOT:
            self.newest = sequence
        elif sequence > self.newest:
            self.lost += sequence - self.newest - 1
            self.newest = sequence
        elif verdict == "used":
            self.lost -= self.lost > 0  # it had only been overtaken
        # what is late may have been counted when it first came


@dataclass
class Plant:
    """Rows held, of which those from `dirty` on have to be stepped anew and those before `base` are final.

    `now` is the newest arrival; `forced`: rows that became final before their time, for want of room. `origin`: the
    moment that its times are counted from, where they are dates. `version` counts its commits.
    """

    name: str
    rows: Rows
    now: float
    origin: datetime | None = None
    version: int = 0
    base: int = 0
    dirty: int | None = None
    forced: int = 0
    links: dict[str, Link] = field(default_factory=dict)

    def link(self, node: str) -> Link:
        """The tally of a node."""
        found = self.links.get(node)
        if found is None:
            found = self.links[node] = Link()
        return found

    def judge(self, event: Known, window: float, ahead: float) -> Verdict:
        """The verdict on an event; its arrival is not yet told to the others."""
        return self.rows.verdict(event, max(self.now, event.arrival) - window, ahead)

    def use(self, event: Known, window: float, slot: int) -> bool:
        """Hold an event, in this slot if it makes a row of its own: whether it does."""
        rows = self.rows
        place, row = rows.find(event)
        new = row is None
        if row is None:
            row = HeldRow(rows.key(event), slot, rows.places[-1].stop)
            rows.insert(place, row)
        rows.fill(row, event)
        self.dirty = place if self.dirty is None else min(self.dirty, place)
        self.now = max(self.now, event.arrival)
        base, forced = rows.settle(self.now - window)
        self.forced += max(0, base - max(base - forced, self.base))
        self.base = base
        return new

    def chain(self) -> list[HeldRow]:
        """The rows to step over again, after the one that they begin from."""
        chain = [] if self.dirty is None else self.rows.held[self.dirty - 1 :]
        self.dirty = None
        return chain

    def end(self) -> "Plant":
        """Have all rows become final."""
        self.base = len(self.rows.held) - 1
        return self

    def settle(self) -> tuple[list[HeldRow], list[int]]:
        """The rows that are final now, and the slots that are not needed any more."""
        final, left = self.rows.drop(self.base) if self.base else ([], [])
        self.base = 0
        return final, [row.slot for row in left]
