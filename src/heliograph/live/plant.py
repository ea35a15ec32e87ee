"""One plant of a fleet: its rows, the verdict on each message, and the counts of its links."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from typing import NamedTuple, TypeAlias

from heliograph.live.event import Known, Verdict
from heliograph.live.rows import HeldRow, Key, Rows

Position: TypeAlias = tuple[int, int, float, int, float]  # of a node's running count: first, newest, at, lost, latest


GAP = 1 << 14  # more messages in a row are not lost: the count began anew (LoRaWAN's MAX_FCNT_GAP)


@dataclass
class Link:
    """Counts of the messages of a node by verdict, and its running count, in which gaps are lost messages.

    The running count of the node goes from `first` to `newest`, which was measured at time `at`. A smaller number with
    a later time means that the node was restarted; a larger one with an earlier time is from before the restart.

    Attributes:
        first: smallest running count since the node's last start; -1 before the first message.
        newest: greatest running count since then.
        at: time of the measurement with the greatest count.
        lost: gaps in the running count that no message has filled.
        used, duplicate, conflict, late, future, implausible: numbers of messages by verdict.
        dropped: single values beyond the limits of the node.
        latest: time of the newest measurement that was used; -1 before the first.
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
    latest: float = -1.0

    def count(self, verdict: Verdict, sequence: int, time: float, period: int = 0) -> None:
        """Count one message. A late, implausible or future message was received too, so it fills a gap.

        `period`: after how many messages the count begins at 0 again; 0 if it does not.
        """
        setattr(self, verdict, getattr(self, verdict) + 1)
        sequence = self._unwrapped(sequence, time, period)
        if verdict == "used":
            self.latest = max(self.latest, time)
            if sequence - 1 == self.newest >= 0 and time >= self.at:  # the next, as most are
                self.newest, self.at = sequence, time
                return
        if verdict in ("duplicate", "conflict"):
            return
        if verdict in ("future", "implausible"):  # its time may be wrong: it says nothing of the order
            time = self.at
        # First message, or the node was restarted: count from here.
        if self.newest < 0 or (sequence < self.newest and time > self.at):
            self.first, self.newest, self.at = sequence, sequence, time
        # A gap above the newest count: its messages are lost, until they arrive.
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

    def _unwrapped(self, sequence: int, time: float, period: int) -> int:
        """Return a count that goes on where the node's own begins at 0 again; one that is too far is a new start."""
        if not period or self.newest < 0:
            return sequence
        ahead, behind = (sequence - self.newest) % period, (self.newest - sequence) % period
        if time >= self.at:
            return self.newest + ahead if ahead <= GAP else sequence
        return self.newest - behind if behind <= min(GAP, self.newest) else sequence

    @property
    def position(self) -> Position:
        """Return where the running count stands."""
        return self.first, self.newest, self.at, self.lost, self.latest

    def withdraw(self, sequence: int, time: float, before: Position | None) -> None:
        """Count a message of a wrong clock, which was used, as one from the future; `before`: the position before."""
        self.used -= self.newest == sequence
        self.first, self.newest, self.at, self.lost, self.latest = before or Link().position
        self.count("future", sequence, time)


class Leap(NamedTuple):
    """A leap in time of which one message speaks: its time, the newest arrival before it, and the counts before it.

    Any later message of that time or after it confirms it. One that goes on from before it contradicts it.
    """

    time: float
    now: float
    links: dict[str, Position]


class Withdrawn(NamedTuple):
    """An event that was used until a later one showed that its clock is wrong."""

    node_index: int
    sequence: int
    time: float


# A row that took an event, with its numbers and events before; None if the row is new.
Change: TypeAlias = tuple[HeldRow, tuple[list[float], dict[tuple[int, int, float], list[float]]] | None]


@dataclass
class Plant:
    """State of one plant: its rows, of which those from `dirty` on have to be stepped again.

    Attributes:
        name: name of the plant.
        rows: the rows held, in order of time.
        now: time of the newest arrival.
        origin: date from which times are counted; None if times are numbers.
        version: number of commits.
        dirty: index of the first row to step again; None if all are up to date.
        forced: number of rows that became final early, for lack of room.
        links: counts of the messages, by node.
        changes: changes since the last finalisation, for `undo`.
        leap: a leap in time that no second message has confirmed; None if there is none.
        silence: row of the newest step at which nothing came, which is no row of the history; None if there is none.
        contradicted: times of leaps that were contradicted, whose rows go at the next finalisation.
    """

    name: str
    rows: Rows
    now: float
    origin: datetime | None = None
    version: int = 0
    dirty: int | None = None
    forced: int = 0
    links: dict[str, Link] = field(default_factory=dict)
    changes: list[Change] = field(default_factory=list)
    leap: Leap | None = None
    silence: HeldRow | None = None
    contradicted: list[float] = field(default_factory=list)

    @property
    def confirmed(self) -> float:
        """Return the newest arrival of which more than one message, or another clock, speaks."""
        return self.now if self.leap is None else self.leap.now

    @property
    def clock(self) -> tuple[float, Leap | None]:
        """Return the newest arrival, and a leap to it that nothing has confirmed."""
        return self.now, self.leap

    @clock.setter
    def clock(self, clock: tuple[float, Leap | None]) -> None:
        """Set the newest arrival and the leap to what they were; nothing is contradicted."""
        self.now, self.leap = clock
        self.contradicted = []

    def pass_time(self, time: float, now: float, most: float, sure: bool, names: Sequence[str]) -> None:
        """Let time pass to `now` by an event at `time`; more than `most` at once is a leap, unless it is sure.

        Args:
            time: time of the event.
            now: its arrival.
            most: longest gap that needs no second message.
            sure: whether another clock says the same.
            names: names of the nodes in their order, then that of the inputs.
        """
        leap, before = self.leap, self.confirmed
        if leap is not None and not sure and (time == leap.time or time <= before):
            return  # of the same message, or of the same moment; or late, which says nothing of now
        if leap is not None and now < leap.time - most:
            self.contradict(names)
        elif leap is not None:
            before = self.now
        positions = {node: link.position for node, link in self.links.items()}
        self.leap = Leap(time, before, positions) if now > before + most and not sure else None
        self.now = max(before, now)

    def contradict(self, names: Sequence[str]) -> None:
        """Take back a leap: its rows go with the next finalisation, and counts and time are what they were."""
        assert self.leap is not None
        for row in self.rows.held[1:]:
            for node, sequence, time in row.events if row.key[0] == self.leap.time else ():
                self.link(names[node]).withdraw(sequence, time, self.leap.links.get(names[node]))
        self.contradicted.append(self.leap.time)
        self.now, self.leap = self.leap.now, None

    def withdraw(self) -> tuple[list[Withdrawn], list[int]]:
        """Remove the rows of contradicted leaps; return their events, and their slots."""
        if not self.contradicted:
            return [], []
        rows = [row for row in self.rows.held[1:] if row.key[0] in self.contradicted]
        self.contradicted = []
        for row in rows:
            index = self.rows.index(row.key)
            self.rows.remove(index)
            if index < len(self.rows.held):
                self.dirty = index if self.dirty is None else min(self.dirty, index)
        return [Withdrawn(*name) for row in rows for name in row.events], [row.slot for row in rows]

    def take(
        self, event: Known, key: Key, slot: Callable[[], int], width: int, numbered: tuple[str, int] | None
    ) -> None:
        """Add an event to the row with its key, or to a new row in a slot of its own; record the change for `undo`.

        `numbered`: name of a node whose transmissions are counted, and the column of the number of those lost.
        """
        index, row = self.rows.find(key)
        if row is None:
            row = HeldRow(key, slot(), width)
            self.rows.keys.insert(index, key)
            self.rows.held.insert(index, row)
            change: Change = row, None
        else:
            change = row, (row.numbers.copy(), dict(row.events))
        self.rows.fill(row, event)
        if numbered is not None and row.numbers[numbered[1]] != row.numbers[numbered[1]]:  # it does not say by itself
            name, column = numbered
            newest = self.links[name].newest if name in self.links else -1
            row.numbers[column], others = self.rows.count_lost(index, event, column, newest)
            for other, number in others:
                self.changes.append((other, (other.numbers.copy(), dict(other.events))))
                other.numbers[column] = number
        self.changes.append(change)  # last: that of the event itself
        self.dirty = index if self.dirty is None else min(self.dirty, index)

    def undo(self) -> list[int]:
        """Undo the recorded changes; return the slots that are free again. Rows that had been stepped become dirty."""
        slots = []
        for row, before in reversed(self.changes):
            if before is None:
                self.rows.remove(self.rows.index(row.key))
                slots.append(row.slot)
            else:
                row.numbers, row.events = before
        index = min((self.rows.index(row.key) for row, _ in self.changes), default=len(self.rows.held))
        self.dirty = index if index < len(self.rows.held) else None
        self.changes = []
        return slots

    def link(self, node: str) -> Link:
        """Return the counts of a node."""
        link = self.links.get(node)
        if link is None:
            link = self.links[node] = Link()
        return link

    def chain(self) -> list[HeldRow]:
        """Return the rows to step again, and before them the row from which they start."""
        chain = [] if self.dirty is None else self.rows.held[self.dirty - 1 :]
        self.dirty = None
        return chain

    def finalise(self, watermark: float) -> tuple[list[HeldRow], list[int]]:
        """Make rows up to the watermark final; return them and the slots that are no longer needed."""
        self.changes = []
        base, forced = self.rows.finalise(watermark)
        if not base:
            return [], []
        self.forced += forced
        final, left = self.rows.drop(base)
        return final, [row.slot for row in left]
