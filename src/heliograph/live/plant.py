"""One plant of a fleet: its rows, the verdict on each message, and the counts of its links."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from math import inf
from typing import NamedTuple, TypeAlias

from heliograph.live.event import INPUTS, Known, Verdict
from heliograph.live.leap import ARRIVAL, Leap, Moments, find_leap
from heliograph.live.rows import HeldRow, Key, Rows
from heliograph.model.stuck import Repeats

NO_REPEATS = Repeats()
GAP = 1 << 14  # more messages in a row are not lost: the count began anew (LoRaWAN's MAX_FCNT_GAP)


class ScreenedEvent(NamedTuple):
    """An event without the values that count as not arrived.

    Args:
        event: the event, NaN for these values.
        dropped: how many are beyond the limits of the node, or codes.
        stuck: how many repeat for longer than their noise allows.
        why: which of either, in words.
        repeats: runs of equal readings of the node that end with this event.
    """

    event: Known
    dropped: int = 0
    stuck: int = 0
    why: str = ""
    repeats: Repeats = NO_REPEATS

    @property
    def is_empty(self) -> bool:
        """Whether values were removed and none is left."""
        return bool(self.why) and all(value != value for value in self.event.values)


@dataclass
class LinkCounts:
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
        stuck: single values that repeated for longer than their noise allows.
        repeats: newest readings, and how many in a row are equal to them, of a node that watches for it.
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
    stuck: int = 0
    repeats: Repeats = field(default_factory=Repeats)

    def __post_init__(self) -> None:
        """Take runs of equal readings as they were stored."""
        self.repeats = Repeats.read(self.repeats)

    def count_screened(self, screened: ScreenedEvent, verdict: Verdict) -> None:
        """Count the values that count as not arrived, of an event that was no copy and of a time that could be used."""
        if verdict in ("used", "implausible"):
            self.dropped += screened.dropped
            self.stuck += screened.stuck
            self.repeats = screened.repeats

    def count(self, verdict: Verdict, sequence: int, time: float, period: int = 0) -> None:
        """Count one message. A late, implausible or future message was received too, so it fills a gap.

        `period`: after how many messages the count begins at 0 again; 0 if it does not.
        """
        setattr(self, verdict, getattr(self, verdict) + 1)
        self._go_on(verdict, sequence, time, period)

    def count_unread(self, sequence: int, time: float, period: int = 0) -> None:
        """Count a message of which only count and time could be read: it has no verdict, and fills a gap."""
        self._go_on(None, sequence, time, period)

    def _go_on(self, verdict: Verdict | None, sequence: int, time: float, period: int) -> None:
        """Go on with the running count, in which gaps are lost messages."""
        sequence = self._unwrap_count(sequence, time, period)
        if verdict == "used":
            self.latest = max(self.latest, time)
            if sequence - 1 == self.newest >= 0 and time >= self.at:  # the next, as most are
                self.newest, self.at = sequence, time
                return
        if verdict in ("duplicate", "conflict"):
            return
        if verdict in ("future", "implausible", None):  # its time may be wrong: it says nothing of the order
            time = self.at
        # First message, or the node was restarted: count from here.
        if self.newest < 0 or (sequence < self.newest and time > self.at):
            self.first, self.newest, self.at = sequence, sequence, time
        # A gap above the newest count: its messages are lost, until they arrive.
        elif sequence > self.newest:
            if time >= self.at or sequence - 1 == self.newest:  # the next in any case, if its clock was set back
                self.lost += sequence - self.newest - 1
                self.newest, self.at = sequence, max(time, self.at)
        elif verdict != "used":
            return  # it may have been counted when it first came
        elif sequence < self.first:
            self.lost += self.first - sequence - 1
            self.first = sequence
        elif sequence < self.newest:
            self.lost -= self.lost > 0  # it had only been overtaken

    def _unwrap_count(self, sequence: int, time: float, period: int) -> int:
        """Return a count that goes on where the node's own begins at 0 again; one that is too far is a new start."""
        if not period or self.newest < 0:
            return sequence
        ahead, behind = (sequence - self.newest) % period, (self.newest - sequence) % period
        if time >= self.at:
            return self.newest + ahead if ahead <= GAP else sequence
        return self.newest - behind if behind <= min(GAP, self.newest) else sequence

    def take_withdrawn(self, count: int, before: Moments | None) -> None:
        """Count messages of a wrong clock, which were used, as ones from the future; `before`: the moments before."""
        self.at, self.latest = before or (0.0, -1.0)
        self.used, self.future = max(self.used - count, 0), self.future + count


class Withdrawn(NamedTuple):
    """An event that was used until a later one showed that its clock is wrong."""

    node_index: int
    sequence: int
    time: float


# A row that took an event, with its numbers and events before; None if the row is new.
Change: TypeAlias = tuple[HeldRow, tuple[list[float], dict[tuple[int, int, float], list[float]]] | None]


class BeforeLeap(NamedTuple):
    """The newest row before a leap in time, and the newest arrival before it."""

    row: HeldRow
    now: float


class RowsOfLeap(NamedTuple):
    """Rows that a leap took with it: what was held and kept before, after how many changes, and what goes.

    `rows` are those that go of which no estimate is final.
    """

    held: list[HeldRow]
    kept: BeforeLeap | None
    changes: int
    gone: list[HeldRow]
    rows: list[HeldRow]


@dataclass
class PlantState:
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
        leap: a leap in time that no other clock has confirmed; None if there is none.
        silence: row of the newest step at which nothing came, which is no row of the history; None if there is none.
        kept: row before a leap, after which all rows held are; None where that is among them, or there is no leap.
        aside: what was taken back since the last finalisation, for `undo`.
        remarked: how often each filter's remark was said, by node and filter.
    """

    name: str
    rows: Rows
    now: float
    origin: datetime | None = None
    version: int = 0
    dirty: int | None = None
    forced: int = 0
    links: dict[str, LinkCounts] = field(default_factory=dict)
    changes: list[Change] = field(default_factory=list)
    leap: Leap | None = None
    silence: HeldRow | None = None
    kept: BeforeLeap | None = None
    aside: list[RowsOfLeap] = field(default_factory=list)
    remarked: dict[tuple[str, str], int] = field(default_factory=dict)

    @property
    def confirmed(self) -> float:
        """Return the newest arrival of which another clock speaks too, or which is believed."""
        return self.now if self.leap is None or self.leap.believed else self.leap.now

    @property
    def clock(self) -> tuple[float, Leap | None]:
        """Return the newest arrival, and a leap to it that no other clock confirms."""
        return self.now, self.leap

    @clock.setter
    def clock(self, clock: tuple[float, Leap | None]) -> None:
        """Set the newest arrival and the leap to what they were."""
        self.now, self.leap = clock

    def judge_clock(self, clock: str, time: float, most: float, sure: bool, names: Sequence[str]) -> None:
        """Take back a leap that is contradicted by what a clock says.

        Args:
            clock: name of the node that says so, or `ARRIVAL`.
            time: what it says.
            most: longest gap that is no leap.
            sure: whether another clock says the same.
            names: names of the nodes in their order, then that of the inputs.
        """
        found = find_leap(self.leap, self.now, time, most)
        if self.leap is None or found is None:
            return
        leap, newest = found
        if sure or leap.taken_back_by(clock, time, newest):
            self.undo_leap(leap, most, names)
        elif clock == leap.clock:
            self.leap = self.leap.with_back(leap, time)

    def pass_time(self, clock: str, time: float, now: float, most: float, sure: bool) -> None:
        """Let time pass to `now` by an event that was used; more than `most` at once is a leap, unless it is sure.

        Args:
            clock: name of the node whose event it is, or `ARRIVAL` if its arrival was given.
            time: what that clock says.
            now: its arrival.
            most: longest gap that needs no other clock.
            sure: whether another clock says the same.
        """
        leap, before = self.leap, self.now
        if leap is not None and not sure:
            if time < leap.time - most or (time == leap.time and clock == leap.clock):
                return  # from before it, which says nothing of now; or of the same message
            leap = self._confirm_leap(clock, leap, time, most)
        elif sure:
            leap = None
        if now > before + most and not sure and (leap is None or leap.believed):
            moments = {node: (link.at, link.latest) for node, link in self.links.items()}
            leap = Leap(time, time, before, moments, clock, earlier=leap)
        self.now, self.leap = max(before, now), leap

    def _confirm_leap(self, clock: str, leap: Leap, time: float, most: float) -> Leap | None:
        """Return what is left of a leap after an event on its farther side."""
        if clock != leap.clock:
            return None
        if leap.is_over(self.now):
            return leap.earlier
        others = (link.latest for node, link in self.links.items() if node not in (clock, INPUTS))
        if clock != ARRIVAL and any(latest >= max(leap.now - most, 0.0) for latest in others):
            return leap  # which another node is there to confirm
        return leap.as_believed()

    def undo_leap(self, leap: Leap, most: float, names: Sequence[str]) -> bool:
        """Go back to before a leap in time: its rows go with the next finalisation, and time is what it was.

        Returns False, and changes nothing, if the row before it is not known any more.
        """
        held, cut = self.rows.held, self.rows.first_from(leap.time - most)
        if cut == 0 and self.kept is None:
            return False
        rows = held[max(cut, 1) :]
        counts: dict[str, int] = {}
        for row in rows:
            for node, _, _ in row.events:
                counts[names[node]] = counts.get(names[node], 0) + 1
        for name, count in counts.items():
            self.link(name).take_withdrawn(count, leap.moments.get(name))
        self.aside.append(RowsOfLeap(held, self.kept, len(self.changes), held[cut:], rows))
        self.rows.hold([self.kept.row] if cut == 0 and self.kept is not None else held[:cut])
        self.kept = self.kept if cut else None
        self.dirty = None if self.dirty is None or self.dirty >= len(self.rows.held) else self.dirty
        self.now, self.leap = leap.now, leap.earlier
        return True

    def holds(self, leap: Leap, time: float, most: float) -> bool:
        """Return whether a row from before a leap is held after which a time comes."""
        return self.rows.first_from(leap.time - most) > 0 and time > self.rows.keys[0][0]

    def take_withdrawn(self) -> tuple[list[Withdrawn], list[int]]:
        """Return the events of leaps that were taken back since the last call, and the slots of their rows."""
        aside, self.aside = self.aside, []
        events = [Withdrawn(*name) for one in aside for row in one.rows for name in row.events]
        return events, [row.slot for one in aside for row in one.gone]

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
        slots, keys = list[int](), [row.key for row, _ in self.changes]
        for one in reversed(self.aside):
            slots += self._undo_since(one.changes)
            self.rows.hold(one.held)
            self.kept = one.kept
        slots += self._undo_since(0)
        self.aside = []
        index = max(min(map(self.rows.index, keys), default=len(self.rows.held)), 1)
        self.dirty = index if index < len(self.rows.held) else None
        return slots

    def _undo_since(self, count: int) -> list[int]:
        """Undo the changes but for the first ones; return the slots that are free again."""
        slots = []
        for row, before in reversed(self.changes[count:]):
            if before is None:
                self.rows.remove(self.rows.index(row.key))
                slots.append(row.slot)
            else:
                row.numbers, row.events = before
        del self.changes[count:]
        return slots

    def link(self, node: str) -> LinkCounts:
        """Return the counts of a node."""
        link = self.links.get(node)
        if link is None:
            link = self.links[node] = LinkCounts()
        return link

    def chain(self) -> list[HeldRow]:
        """Return the rows to step again, and before them the row from which they start."""
        chain = [] if self.dirty is None else self.rows.held[self.dirty - 1 :]
        self.dirty = None
        return chain

    def finalise(self, watermark: float, most: float) -> tuple[list[HeldRow], list[int]]:
        """Make rows up to the watermark final; return them and the slots that are no longer needed.

        `most`: longest gap that is no leap; of the rows before a leap the newest is kept.
        """
        self.changes = []
        base, forced = self.rows.finalise(watermark)
        self.forced += forced if base else 0
        final, left = self.rows.drop(base) if base else ([], [])
        # Of leaps that are not confirmed the oldest one, but for that with which the plant began.
        leap = next((one for one in reversed([*self.leap.chain()] if self.leap else []) if one.now > -inf), None)
        if self.kept is not None and (leap is None or leap.now != self.kept.now):
            left, self.kept = [*left, self.kept.row], None
        if leap is not None and self.kept is None and left:
            before = [row for row in left if row.key[0] < leap.time - most]
            if before and self.rows.held[0].key[0] >= leap.time - most:
                self.kept = BeforeLeap(before[-1], leap.now)
                left = [row for row in left if row is not before[-1]]
        return final, [row.slot for row in left]

    @property
    def slots(self) -> list[int]:
        """Return all slots of the plant."""
        rows = [
            *self.rows.held,
            *([] if self.kept is None else [self.kept.row]),
            *(r for a in self.aside for r in a.gone),
        ]
        return [row.slot for row in rows]
