"""Events in order of time: the rows that they form, which rows are final, and the verdict on a new event.

A row is the history's entry for one time, or one event. The watermark is the time before which rows are final; the base
is the newest of these, from whose state later rows are stepped.
"""

from bisect import bisect_left
from collections.abc import Sequence
from math import inf, nan
from typing import TypeAlias

import numpy as np

from heliograph.live.event import CheckedEvent, Verdict

Key: TypeAlias = "tuple[float, int, int]"  # of a row: time, index of the node (-1: inputs), sequence
BEFORE = -2  # the index of what stands before everything at its time


class HeldRow:
    """A row of the history: its slot in the table, its numbers (measurements of all nodes, inputs, time), its events.

    `events` has for each event (index of its node, running count, time) its values. At first there is none, and all of
    the `size` numbers before the time are NaN.
    """

    __slots__ = "events", "key", "numbers", "slot"

    def __init__(self, key: Key, slot: int, size: int):
        """Make a row without events, whose numbers are `size` NaN and then its time.

        Args:
            key: (time, index of the node, running count), by which rows are sorted.
            slot: line of the table of filter states that holds the state after this row.
            size: how many numbers a row has before its time.
        """
        self.key, self.slot = key, slot
        self.numbers = [nan] * size
        self.numbers.append(key[0])
        self.events: dict[tuple[int, int, float], list[float]] = {}

    def has_data(self) -> bool:
        """Return whether the row has a measurement of a node; its other events are inputs, whose node index is -1."""
        return any(node_index >= 0 for node_index, _count, _time in self.events)


class SortedRows:
    """A plant's rows in order of their keys; the first is the base, of which only the state after it is needed.

    Args:
        base: the base, which at first is the only row.
        joint: whether all events of one time form one row.
        columns: columns of each node's numbers in a row, by its index, those of the inputs last.
        capacity: greatest number of rows held behind the base.
    """

    def __init__(self, base: HeldRow, joint: bool, columns: list[slice], capacity: int):
        """Hold the base (the row whose state all later rows follow from) as the only row.

        Args:
            base: the base.
            joint: whether all events of one time form one row.
            columns: columns of each node's numbers in a row, by its index, those of the inputs last.
            capacity: greatest number of rows after the base.
        """
        self.held, self.keys = [base], [base.key]
        self.joint, self.columns_by_node, self.capacity = joint, columns, capacity

    def replace_rows(self, rows: list[HeldRow]) -> None:
        """Replace all rows by these, in their order."""
        self.held, self.keys = rows, [row.key for row in rows]

    def make_key(self, event: CheckedEvent) -> Key:
        """Return the key of the row that an event belongs to: its time alone decides if rows are joint."""
        return (event.time, 0, 0) if self.joint else (event.time, event.node_index, event.sequence)

    def _find_last_before(self, watermark: float) -> int:
        """Return the index of the newest row older than the watermark; 0 if there is none."""
        # (t,) comes before every longer key that begins with t.
        return max(bisect_left(self.keys, (watermark,)) - 1, 0)

    def first_after(self, time: float) -> int:
        """Return the index of the first row after a time."""
        return bisect_left(self.keys, (time, inf))

    def first_from(self, time: float) -> int:
        """Return the index of the first row from a time on."""
        return bisect_left(self.keys, (time,))

    def judge_event(self, event: CheckedEvent, key: Key, watermark: float, ahead: float) -> Verdict:
        """Return the verdict on an event.

        Args:
            event: the event.
            key: the key of the row that it belongs to.
            watermark: rows before this time are final.
            ahead: how much later than its arrival an event may be dated.
        """
        if event.time > event.arrival + ahead:
            return "future"
        if key > self.keys[-1]:  # as most are: nothing can be said against what is newest
            return "used"
        base, _ = self.find_base(watermark)  # index of the newest row that is final
        index, row = self.find_row(key)
        values_held = None if row is None else row.events.get(event.name)
        # A final row takes no event. Of the base it is still known which events it has: a copy of one is no late one.
        if index < base or (index == base and values_held is None):
            return "late"
        if row is None:  # the first event of its row
            return "used"
        if values_held is not None:
            return "duplicate" if np.array_equal(values_held, event.values, equal_nan=True) else "conflict"
        # Two events of a node in one row are fine where they fill different components: NaN, which is not equal to
        # itself, is nothing yet.
        numbers_held = row.numbers[self.columns_by_node[event.node_index]]
        would_overwrite = any(old == old and new == new for old, new in zip(numbers_held, event.values, strict=True))
        return "conflict" if would_overwrite else "used"

    def holds_values(self, event: CheckedEvent) -> bool:
        """Return whether the row of an event already has all those of its values that are not NaN."""
        _, row = self.find_row(self.make_key(event))
        if row is None:
            return False
        held = row.numbers[self.columns_by_node[event.node_index]]
        return all(new != new or new == old for old, new in zip(held, event.values, strict=True))  # NaN != NaN

    def find_row(self, key: Key) -> tuple[int, HeldRow | None]:
        """Return the index of the row with this key, and the row; if there is none, where it would stand, and None."""
        if key > self.keys[-1]:
            return len(self.keys), None
        # Keys have the order of the rows, which is by time first.
        index = bisect_left(self.keys, key)
        exists = self.keys[index] == key
        return index, self.held[index] if exists else None

    def find_index(self, key: Key) -> int:
        """Return the index of the row with this key, or the index at which it would be inserted."""
        return bisect_left(self.keys, key)

    def remove_row(self, index: int) -> None:
        """Remove the row with this index."""
        del self.keys[index], self.held[index]

    def write_event(self, row: HeldRow, event: CheckedEvent) -> None:
        """Write an event's values into its node's columns of a row; NaN keeps the number that is there."""
        columns, values = self.columns_by_node[event.node_index], event.values
        if row.events:  # in a row without events all numbers are NaN
            # Only NaN is not equal to itself; np.isnan of a single number takes far longer.
            present = row.numbers[columns]
            values = [old if new != new else new for old, new in zip(present, values, strict=True)]
        row.numbers[columns] = values
        row.events[event.name] = event.values

    def count_lost(
        self, index: int, event: CheckedEvent, column: int, newest: int
    ) -> tuple[float, list[tuple[HeldRow, float]]]:
        """Return how many of a sender's messages were lost just before an event, by the running count; NaN if unknown.

        A sender counts its messages, so a gap between the counts of two events tells how many were lost between them.
        An event that arrives late changes this number for the sender's next event: that event's row and its new number
        are returned as well, in a list that is empty where there is no later event.

        Args:
            index: index of the event's row.
            event: the event.
            column: column of a row in which the number of lost messages stands.
            newest: count before the event where the rows show none (older rows are final and gone); -1 if there was
                none.
        """
        # The sender's nearest events before and after this one, as (row, running count); None where there is none.
        before = self._find_event_of(event.node_index, range(index - 1, -1, -1))
        after = self._find_event_of(event.node_index, range(index + 1, len(self.held)))
        count = event.sequence
        # The count before the event: of the row before; else what the next event's number says of it.
        if before is not None:
            _, newest = before
        elif after is not None:
            row_after, count_after = after
            lost = row_after.numbers[column]
            newest = count_after - int(lost) - 1 if lost == lost else -1  # lost is NaN (unequal to itself) if unknown
        number = float(count - newest - 1) if 0 <= newest < count else nan
        if after is None:
            return number, []
        row_after, count_after = after
        number_after = float(count_after - count - 1) if count < count_after else nan
        return number, [(row_after, number_after)]

    def _find_event_of(self, node: int, indices: range) -> tuple[HeldRow, int] | None:
        """Return the first row with an event of a node, and the event's running count; None if there is none.

        Args:
            node: index of the node.
            indices: indices of the rows to look at, in this order.
        """
        for i in indices:
            for node_of_event, running_count, _time in self.held[i].events:
                if node_of_event == node:
                    return self.held[i], running_count
        return None

    def find_base(self, watermark: float) -> tuple[int, int]:
        """Return the index of the row that becomes the base, and how many rows become final early, for lack of room.

        The base is the newest final row, from which later rows are stepped. Rows before the watermark become final. At
        most `capacity` rows may be held after the base.
        """
        base_by_time = self._find_last_before(watermark)
        base = max(base_by_time, len(self.held) - 1 - self.capacity)
        return base, base - base_by_time

    def move_base(self, base: int) -> tuple[list[HeldRow], list[HeldRow]]:
        """Make the row with index `base` the base; return the rows that became final, and those that are dropped.

        The base itself stays, as the first row.
        """
        final_rows, dropped_rows = self.held[1 : base + 1], self.held[:base]
        del self.held[:base], self.keys[:base]
        return final_rows, dropped_rows


def list_columns_of_blocks(sizes: Sequence[int]) -> list[slice]:
    """Return the columns of blocks of these sizes, one behind another from column 0."""
    ends = np.cumsum(sizes)
    return [slice(int(end) - size, int(end)) for end, size in zip(ends, sizes, strict=True)]
