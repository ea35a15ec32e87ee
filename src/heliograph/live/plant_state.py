"""State of one plant of a fleet: its rows, its time, and changes that can be undone.

A leap is a jump in time that one clock alone has made so far (`clock_leap`); rows before the watermark, the newest
confirmed arrival less the window, become final, and are never stepped again.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from math import inf
from typing import NamedTuple

from heliograph.live.clock_leap import ARRIVAL, ClockLeap, find_contradicted_leap
from heliograph.live.event import INPUTS, CheckedEvent
from heliograph.live.health.link_counts import LinkCounts
from heliograph.live.sorted_rows import HeldRow, Key, SortedRows
from heliograph.live.undoable_changes import Change, RowBeforeLeap, RowContent, UndoneLeap, WithdrawnEvent


@dataclass
class PlantState:
    """State of one plant: its rows, of which those from `first_changed` on have to be stepped again.

    Attributes:
        name: name of the plant.
        rows: the rows held, in order of time.
        now: time of the newest arrival.
        origin: date from which times are counted; None if times are numbers.
        version: number of commits.
        first_changed: index of the first row to step again; None if all are up to date.
        forced: number of rows that became final early, for lack of room.
        links: counts of the messages, by node.
        changes: changes since the last finalisation, for `undo_changes`.
        leap: a leap in time that no other clock has confirmed; None if there is none.
        silence: row of the newest step at which nothing came, which is no row of the history; None if there is none.
        row_before_leap: row before a leap, after which all rows held are; None where that is among them, or there is no
            leap.
        undone_leaps: what was taken back since the last finalisation, for `undo_changes`.
        remarked: how often each filter's remark was said, by node and filter.
        begun: time of the message with which it began, from which on a node may be silent.
    """

    name: str
    rows: SortedRows
    now: float
    origin: datetime | None = None
    version: int = 0
    first_changed: int | None = None
    forced: int = 0
    links: dict[str, LinkCounts] = field(default_factory=dict)
    changes: list[Change] = field(default_factory=list)
    leap: ClockLeap | None = None
    silence: HeldRow | None = None
    row_before_leap: RowBeforeLeap | None = None
    undone_leaps: list[UndoneLeap] = field(default_factory=list)
    remarked: dict[tuple[str, str], int] = field(default_factory=dict)
    begun: float = 0.0

    @property
    def confirmed(self) -> float:
        """Return the time by which rows become final: the newest arrival, or that before a leap in doubt.

        A leap, a jump in time that one clock alone has shown, is in doubt until another clock confirms it or it is
        `believed`.
        """
        return self.now if self.leap is None or self.leap.believed else self.leap.now

    @property
    def clock(self) -> tuple[float, ClockLeap | None]:
        """Return what later events may set back: the time of the newest arrival, and the leap that led to it."""
        return self.now, self.leap

    @clock.setter
    def clock(self, clock: tuple[float, ClockLeap | None]) -> None:
        """Set the time of the newest arrival, and the leap that led to it, as `clock` returned them."""
        self.now, self.leap = clock

    def undo_contradicted_leap(
        self, clock: str, time: float, longest_gap: float, agreed: bool, names: Sequence[str]
    ) -> None:
        """Undo a leap (a jump in time that one clock alone showed) if a new event's date shows that it was an error.

        That is so if the event is dated in the gap over which the time jumped. One message of the leap's own clock is
        not enough if the leap is believed: it is noted, and a second one counts.

        Args:
            clock: name of the clock's node, or `ARRIVAL`.
            time: the time that the clock says.
            longest_gap: the longest gap in time that is no leap.
            agreed: whether another clock says the same.
            names: names of the nodes in their order, then that of the inputs.
        """
        found = find_contradicted_leap(self.leap, self.now, time, longest_gap)
        if self.leap is None or found is None:
            return
        leap, newest_arrival = found
        if agreed or leap.is_taken_back_by(clock, time, newest_arrival):
            self.undo_leap(leap, longest_gap, names)
        # The leap's own clock goes on from before it for the first time: its next message may undo the leap.
        elif clock == leap.clock:
            self.leap = self.leap.with_back(leap, time)

    def pass_time(self, clock: str, time: float, now: float, longest_gap: float, agreed: bool) -> None:
        """Advance the plant's time to `now`, the arrival of an event that was used.

        A jump by more than `longest_gap` at once, where no other clock says the same, is recorded as a leap: it may be
        the error of one clock. Rows do not become final by it until an event of another clock, dated after the jump,
        confirms it, or it is believed because no other clock could confirm it.

        Args:
            clock: name of the node whose event it is, or `ARRIVAL` if its arrival was given.
            time: the event's time by that clock.
            now: arrival of the event.
            longest_gap: longest gap that needs no other clock.
            agreed: whether another clock says the same.
        """
        leap, newest_before = self.leap, self.now
        if agreed:  # two clocks: there is no doubt about the time
            leap = None
        elif leap is not None:
            # An event dated before the leap says nothing of the present, nor does the leap's own message again.
            if time < leap.time - longest_gap or (time == leap.time and clock == leap.clock):
                return
            leap = self._confirm_leap(clock, leap, time, longest_gap)
        # Record a new leap, unless an earlier one is in doubt: then this event only lies behind that one.
        jumps = now > newest_before + longest_gap
        if jumps and not agreed and (leap is None or leap.believed):
            # Per node the time of its newest count and of its newest measurement: they are set back if the leap is.
            moments = {node: (link.at, link.latest) for node, link in self.links.items()}
            leap = ClockLeap(time=time, since=time, now=newest_before, moments=moments, clock=clock, earlier=leap)
        self.now, self.leap = max(newest_before, now), leap

    def _confirm_leap(self, clock: str, leap: ClockLeap, time: float, longest_gap: float) -> ClockLeap | None:
        """Return what is left of a leap once an event of `clock` was dated after its jump.

        Another clock confirms the leap at once: None is left. The clock that made it confirms it when the plant has
        gone on for as long as the jump was (`is_over`): the earlier leaps are left. Before that, a second message of
        this clock makes the leap believed, unless a node that was heard shortly before the jump could still confirm it.
        Inputs have no clock; ARRIVAL is the clock of arrivals.
        """
        if clock != leap.clock:
            return None
        if leap.is_over(self.now):
            return leap.earlier
        others = (link.latest for node, link in self.links.items() if node not in (clock, INPUTS))
        if clock != ARRIVAL and any(latest >= max(leap.now - longest_gap, 0.0) for latest in others):
            return leap
        return leap.as_believed()

    def undo_leap(self, leap: ClockLeap, longest_gap: float, names: Sequence[str]) -> bool:
        """Go back to before a leap, a jump in time that one clock showed in error: drop its rows, and set time back.

        The slots of the rows are freed at the next finalisation. Returns False, and changes nothing, if no row from
        before the leap is known any more.

        Args:
            leap: the newest leap, or an earlier one.
            longest_gap: longest jump that is no leap: rows from so long before the leap's far side on are of the leap.
            names: names of the nodes in their order, then that of the inputs.
        """
        held = self.rows.held
        first_after = self.rows.first_from(leap.time - longest_gap)  # index of the first row of the leap
        # If all rows held are of the leap, only the row kept from before it is left.
        all_after, row_before_leap = first_after == 0, self.row_before_leap
        if all_after and row_before_leap is None:
            return False
        # The first row held is the base, whose events are final: they stay counted as used.
        not_final = held[max(first_after, 1) :]
        self._count_withdrawn(not_final, leap, names)
        removed_rows = held[first_after:]
        # Remember what `undo_changes` needs to restore this.
        self.undone_leaps.append(
            UndoneLeap(
                held=held,
                row_before_leap=row_before_leap,
                changes=len(self.changes),
                removed_rows=removed_rows,
                rows=not_final,
            )
        )
        if all_after and row_before_leap is not None:
            self.rows.replace_rows([row_before_leap.row])  # later rows are stepped from it again
            self.row_before_leap = None
        else:
            self.rows.replace_rows(held[:first_after])
        # Rows from `first_changed` on were to be stepped again: nothing is to be done if all of them are gone.
        if self.first_changed is not None and self.first_changed >= len(self.rows.held):
            self.first_changed = None
        self.now, self.leap = leap.now, leap.earlier
        return True

    def _count_withdrawn(self, rows: Sequence[HeldRow], leap: ClockLeap, names: Sequence[str]) -> None:
        """Count the events in these rows as withdrawn, not used, in the counts of their nodes.

        Args:
            rows: the rows of a leap that is undone, since its clock was wrong.
            leap: the leap, with each node's times from before it.
            names: names of the nodes in their order, then that of the inputs.
        """
        counts: dict[str, int] = {}
        for row in rows:
            for node, _running_count, _time in row.events:  # node: its index, -1 for the inputs
                counts[names[node]] = counts.get(names[node], 0) + 1
        for name, count in counts.items():
            # The times in a node's counts become those from before the leap, `leap.moments`.
            self.link_counts(name).count_withdrawn(count, leap.moments.get(name))

    def holds_rows_before(self, leap: ClockLeap, time: float, longest_gap: float) -> bool:
        """Return whether rows from before a leap are held, and `time` comes after the first of them.

        Then an event of this time still has its place among them if the leap is undone.
        """
        return self.rows.first_from(leap.time - longest_gap) > 0 and time > self.rows.keys[0][0]

    def take_withdrawn(self) -> tuple[list[WithdrawnEvent], list[int]]:
        """Return the events withdrawn since the last call, and the slots (lines of the table) of their rows.

        An event is withdrawn, after it had been used, if a later message showed that its clock was wrong: the leap in
        time that it made was undone.
        """
        leaps, self.undone_leaps = self.undone_leaps, []
        events = [WithdrawnEvent(*name) for leap in leaps for row in leap.rows for name in row.events]
        return events, [row.slot for leap in leaps for row in leap.removed_rows]

    def add_event(
        self, event: CheckedEvent, key: Key, take_slot: Callable[[], int], width: int, losses: tuple[str, int] | None
    ) -> None:
        """Add an event to the row with its key, or to a new row; record the change for `undo_changes`.

        Args:
            event: a node's measurement, or inputs, checked.
            key: key of its row.
            take_slot: called for the slot of a new row: its index in the table of live states.
            width: how many numbers a row has before its time: measurements of all nodes, and inputs.
            losses: (name of the event's node, column of a row for how many messages were lost before it) for a sender
                whose running count says this; else None.
        """
        index, row = self.rows.find_row(key)
        if row is None:
            row = HeldRow(key, take_slot(), width)
            self.rows.keys.insert(index, key)
            self.rows.held.insert(index, row)
            change = Change(row, before=None)
        else:
            change = Change(row, before=RowContent(row.numbers.copy(), dict(row.events)))
        self.rows.write_event(row, event)
        if losses is not None:
            node, column = losses
            self._write_lost(index, row, event, node, column)  # may also record changes of later rows
        self.changes.append(change)  # last, since callers take the newest change for the event's own row
        # Rows from `first_changed` on are to be stepped again.
        self.first_changed = index if self.first_changed is None else min(self.first_changed, index)

    def _write_lost(self, index: int, row: HeldRow, event: CheckedEvent, node: str, column: int) -> None:
        """Write into an event's row how many messages were lost just before it, unless the message says it itself.

        The number follows from the node's running count. An event that came out of order also corrects the number of
        the node's next event.

        Args:
            index: index of the event's row.
            row: the event's row.
            event: the event.
            node: name of the event's node.
            column: column of the number of lost messages in a row.
        """
        if row.numbers[column] == row.numbers[column]:  # not NaN: the message says it
            return
        newest_count = self.links[node].newest if node in self.links else -1
        row.numbers[column], corrected = self.rows.count_lost(index, event, column, newest_count)
        for later_row, number in corrected:
            self.changes.append(Change(later_row, RowContent(later_row.numbers.copy(), dict(later_row.events))))
            later_row.numbers[column] = number

    def undo_changes(self) -> list[int]:
        """Undo all changes since the last finalisation, as if their events had not come; return the slots set free.

        There are two kinds of changes: an event was added to a row (`changes`), or rows were removed because a jump of
        the time turned out to be a clock's error (`undone_leaps`). They are undone in reverse order. A slot is a row's
        line in the table of filter states.
        """
        changed_keys = [row.key for row, _ in self.changes]
        freed = list[int]()
        for undone in reversed(self.undone_leaps):
            freed += self._undo_since(undone.changes)  # the events that came after the rows were removed
            self.rows.replace_rows(undone.held)  # the rows from before they were removed
            self.row_before_leap = undone.row_before_leap
        freed += self._undo_since(0)
        self.undone_leaps = []
        # Step again from the first row that was changed: never row 0, which is final.
        first = min(map(self.rows.find_index, changed_keys), default=len(self.rows.held))
        index = max(first, 1)
        self.first_changed = index if index < len(self.rows.held) else None
        return freed

    def _undo_since(self, count: int) -> list[int]:
        """Undo the changes after the first `count`, newest first; return the slots that are free again."""
        slots = []
        for row, before in reversed(self.changes[count:]):
            if before is None:  # the row was new
                self.rows.remove_row(self.rows.find_index(row.key))
                slots.append(row.slot)
            else:
                row.numbers, row.events = before.numbers, before.events
        del self.changes[count:]
        return slots

    def link_counts(self, node: str) -> LinkCounts:
        """Return the counts of a node's messages; new ones if it has none yet."""
        link = self.links.get(node)
        if link is None:
            link = self.links[node] = LinkCounts()
        return link

    def take_changed_rows(self) -> list[HeldRow]:
        """Return the row before the first one to step again, and all rows after it; [] if all are up to date.

        `first_changed`, the index of the first held row to step again (never 0, the base) or None, becomes None.
        """
        chain = [] if self.first_changed is None else self.rows.held[self.first_changed - 1 :]
        self.first_changed = None
        return chain

    def finalise_rows(self, watermark: float, longest_gap: float) -> tuple[list[HeldRow], list[int]]:
        """Make rows before the watermark final; return them and the slots (lines of the table) that are set free.

        Later rows are stepped from the newest final row, the base, which stays. If a leap (a jump in time of more than
        `longest_gap` by one clock) may still be undone, the newest row before it is kept too. Rows that become final
        early, for lack of room, are counted in `forced`.
        """
        self.changes = []  # from here on they cannot be undone
        base, forced = self.rows.find_base(watermark)
        if not base:  # index 0, the base of before: no row becomes final
            return [], self._free_kept_row([], longest_gap)
        self.forced += forced
        final, left = self.rows.move_base(base)
        return final, self._free_kept_row(left, longest_gap)

    def _free_kept_row(self, left: list[HeldRow], longest_gap: float) -> list[int]:
        """Choose the row to keep in case a leap is undone; return the slots of all other rows that are not held.

        A leap is a jump in time of more than `longest_gap` that one clock alone showed. As long as it may be undone,
        the newest row before it is kept in `row_before_leap`: the plant then goes on from there.

        Args:
            left: rows that are not held any more, in order of time.
            longest_gap: longest jump that is no leap.
        """
        # The oldest leap that may be undone. That with which the plant began has no row before it.
        leaps = [] if self.leap is None else [leap for leap in self.leap.list_with_earlier() if leap.now > -inf]
        leap = leaps[-1] if leaps else None
        kept = self.row_before_leap
        if kept is not None and (leap is None or leap.now != kept.now):  # it was kept for another leap
            left, self.row_before_leap = [*left, kept.row], None
        if leap is not None and self.row_before_leap is None:
            far_side = leap.time - longest_gap  # rows from then on are after the leap
            rows_before_leap = [row for row in left if row.key[0] < far_side]
            if rows_before_leap and self.rows.held[0].key[0] >= far_side:
                newest = rows_before_leap[-1]
                self.row_before_leap = RowBeforeLeap(newest, leap.now)
                left = [row for row in left if row is not newest]
        return [row.slot for row in left]

    @property
    def slots(self) -> list[int]:
        """Return all slots of the plant: the numbers of its rows in the table of estimates.

        They are those of rows held, of the row kept from before a leap, and of rows removed with an undone leap.
        """
        row_before_leap = [] if self.row_before_leap is None else [self.row_before_leap.row]
        removed_rows = [row for leap in self.undone_leaps for row in leap.removed_rows]
        return [row.slot for row in (*self.rows.held, *row_before_leap, *removed_rows)]


class FinalisedPlant(NamedTuple):
    """What `Fleet.finalise_plants` made final of one plant.

    Attributes:
        plant: the plant.
        final: rows that are final now, in order of time.
        newest: its newest row.
        left: slots to free once the rows have been read.
        withdrawn: events that had been used, of a clock that has turned out wrong.
    """

    plant: PlantState
    final: list[HeldRow]
    newest: HeldRow
    left: list[int]
    withdrawn: list[WithdrawnEvent]
