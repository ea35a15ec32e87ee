"""State of one plant of a fleet: its rows, its time, and changes that can be undone."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from math import inf
from typing import NamedTuple, TypeAlias

from heliograph.live.clock_leap import ARRIVAL, Leap, find_leap
from heliograph.live.event import INPUTS, CheckedEvent
from heliograph.live.link_counts import LinkCounts
from heliograph.live.sorted_rows import HeldRow, Key, SortedRows


class WithdrawnEvent(NamedTuple):
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
    """What taking back a leap removed from a plant, so that `PlantState.undo` can restore it.

    Attributes:
        held: all rows held before.
        kept: `PlantState.kept` before.
        changes: how many changes had been recorded.
        gone: rows that are not held any more.
        rows: those of them whose estimates were not final.
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
        begun: time of the message with which it began, from which on a node may be silent.
    """

    name: str
    rows: SortedRows
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
    begun: float = 0.0

    @property
    def confirmed(self) -> float:
        """Return the newest arrival that another clock confirms, or that is believed; rows become final by it."""
        return self.now if self.leap is None or self.leap.believed else self.leap.now

    @property
    def clock(self) -> tuple[float, Leap | None]:
        """Return the newest arrival, and the leap in time that led to it where no other clock confirms it."""
        return self.now, self.leap

    @clock.setter
    def clock(self, clock: tuple[float, Leap | None]) -> None:
        """Set the newest arrival and the leap to what they were."""
        self.now, self.leap = clock

    def undo_contradicted_leap(self, clock: str, time: float, most: float, sure: bool, names: Sequence[str]) -> None:
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
        """Advance the time to `now` by an event that was used; more than `most` at once is a leap, unless it is sure.

        Args:
            clock: name of the node whose event it is, or `ARRIVAL` if its arrival was given.
            time: what that clock says.
            now: its arrival.
            most: longest gap that needs no other clock.
            sure: whether another clock says the same.
        """
        leap, before = self.leap, self.now
        if leap is not None and not sure:
            # From before the leap, an event says nothing of the present; one of the leap's own message neither.
            if time < leap.time - most or (time == leap.time and clock == leap.clock):
                return
            leap = self._confirm_leap(clock, leap, time, most)
        elif sure:
            leap = None
        if now > before + most and not sure and (leap is None or leap.believed):
            moments = {node: (link.at, link.latest) for node, link in self.links.items()}
            leap = Leap(time, time, before, moments, clock, earlier=leap)
        self.now, self.leap = max(before, now), leap

    def _confirm_leap(self, clock: str, leap: Leap, time: float, most: float) -> Leap | None:
        """Return what is left of a leap after an event of its farther side: None once it is confirmed."""
        if clock != leap.clock:
            return None
        if leap.is_over(self.now):
            return leap.earlier
        others = (link.latest for node, link in self.links.items() if node not in (clock, INPUTS))
        # A second message by the same clock: believed, unless another node was heard shortly before, which can confirm.
        if clock != ARRIVAL and any(latest >= max(leap.now - most, 0.0) for latest in others):
            return leap
        return leap.as_believed()

    def undo_leap(self, leap: Leap, most: float, names: Sequence[str]) -> bool:
        """Go back to before a leap in time: its rows go with the next finalisation, and time is what it was.

        Returns False, and changes nothing, if the row before it is not known any more. `names`: those of the nodes in
        their order, then that of the inputs.
        """
        held, cut = self.rows.held, self.rows.first_from(leap.time - most)
        if cut == 0 and self.kept is None:
            return False
        # The first row held is the base, whose events are final: they stay counted as used.
        rows = held[max(cut, 1) :]
        counts: dict[str, int] = {}
        for row in rows:
            for node, _, _ in row.events:
                counts[names[node]] = counts.get(names[node], 0) + 1
        for name, count in counts.items():
            self.link(name).count_withdrawn(count, leap.moments.get(name))
        self.aside.append(RowsOfLeap(held, self.kept, changes=len(self.changes), gone=held[cut:], rows=rows))
        # Where all rows held are from after the leap, the row kept from before it is the base again.
        self.rows.hold([self.kept.row] if cut == 0 and self.kept is not None else held[:cut])
        self.kept = self.kept if cut else None
        self.dirty = None if self.dirty is None or self.dirty >= len(self.rows.held) else self.dirty
        self.now, self.leap = leap.now, leap.earlier
        return True

    def holds(self, leap: Leap, time: float, most: float) -> bool:
        """Return whether rows from before a leap are held, and `time` comes after the first of them."""
        return self.rows.first_from(leap.time - most) > 0 and time > self.rows.keys[0][0]

    def take_withdrawn(self) -> tuple[list[WithdrawnEvent], list[int]]:
        """Return the events of leaps that were taken back since the last call, and the slots of their rows."""
        leaps, self.aside = self.aside, []
        events = [WithdrawnEvent(*name) for leap in leaps for row in leap.rows for name in row.events]
        return events, [row.slot for leap in leaps for row in leap.gone]

    def take(
        self, event: CheckedEvent, key: Key, take_slot: Callable[[], int], width: int, numbered: tuple[str, int] | None
    ) -> None:
        """Add an event to the row with its key, or to a new row; record the change for `undo`.

        Args:
            event: the event.
            key: key of its row.
            take_slot: called for the slot of a new row.
            width: how many numbers a row has before its time.
            numbered: name of the event's node and the column of the number of its lost messages, where its running
                count says this; else None.
        """
        index, row = self.rows.find(key)
        if row is None:
            row = HeldRow(key, take_slot(), width)
            self.rows.keys.insert(index, key)
            self.rows.held.insert(index, row)
            change: Change = row, None
        else:
            change = row, (row.numbers.copy(), dict(row.events))
        self.rows.fill(row, event)
        # NaN: the message itself does not say how many were lost before it.
        if numbered is not None and row.numbers[numbered[1]] != row.numbers[numbered[1]]:
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
        for leap in reversed(self.aside):
            slots += self._undo_since(leap.changes)
            self.rows.hold(leap.held)
            self.kept = leap.kept
        slots += self._undo_since(0)
        self.aside = []
        index = max(min(map(self.rows.index, keys), default=len(self.rows.held)), 1)
        self.dirty = index if index < len(self.rows.held) else None
        return slots

    def _undo_since(self, count: int) -> list[int]:
        """Undo the changes after the first `count`, newest first; return the slots that are free again."""
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

    def take_dirty_rows(self) -> list[HeldRow]:
        """Return the rows to step again, behind the row from which they start, and call them up to date; [] if none."""
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
        # The oldest leap that is not confirmed, other than the one with which the plant began.
        leaps = [] if self.leap is None else [leap for leap in self.leap.chain() if leap.now > -inf]
        leap = leaps[-1] if leaps else None
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
        kept = [] if self.kept is None else [self.kept.row]
        gone = [row for leap in self.aside for row in leap.gone]
        return [row.slot for row in (*self.rows.held, *kept, *gone)]
