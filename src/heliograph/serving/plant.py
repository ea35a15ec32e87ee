"""One plant of a fleet: the rows it holds, the verdict on each message, and its links' tallies."""

from dataclasses import dataclass, field
from datetime import datetime

from heliograph.live.event import Verdict
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
    """Rows held, of which those from `dirty` on have to be stepped anew.

    `now` is the newest arrival; `forced`: rows that became final before their time, for want of room. `origin`: the
    moment that its times are counted from, where they are dates. `version` counts its commits.
    """

    name: str
    rows: Rows
    now: float
    origin: datetime | None = None
    version: int = 0
    dirty: int | None = None
    forced: int = 0
    links: dict[str, Link] = field(default_factory=dict)

    def link(self, node: str) -> Link:
        """The tally of a node."""
        found = self.links.get(node)
        if found is None:
            found = self.links[node] = Link()
        return found

    def chain(self) -> list[HeldRow]:
        """The rows to step over again, after the one that they begin from."""
        chain = [] if self.dirty is None else self.rows.held[self.dirty - 1 :]
        self.dirty = None
        return chain

    def settle(self, watermark: float) -> tuple[list[HeldRow], list[int]]:
        """The rows that are final once this is the watermark, and the slots that are not needed any more."""
        base, forced = self.rows.settle(watermark)
        if not base:
            return [], []
        self.forced += forced
        final, left = self.rows.drop(base)
        return final, [row.slot for row in left]
