"""Changes of a plant that can be undone: events added to rows, and leaps in time that were taken back."""

from typing import NamedTuple

from heliograph.live.sorted_rows import HeldRow


class WithdrawnEvent(NamedTuple):
    """An event that was used until a later one showed that its clock is wrong."""

    node_index: int
    sequence: int
    time: float


class RowContent(NamedTuple):
    """What a row holds: its numbers, and its events by (index of the node, running count, time)."""

    numbers: list[float]
    events: dict[tuple[int, int, float], list[float]]


class Change(NamedTuple):
    """A row that took an event, and what it held before; None if the row is new."""

    row: HeldRow
    before: RowContent | None


class RowBeforeLeap(NamedTuple):
    """The newest row before a leap in time, and the newest arrival before it."""

    row: HeldRow
    now: float


class UndoneLeap(NamedTuple):
    """What undoing a leap in time (a clock's error) removed from a plant, so that `undo_changes` can restore it.

    Attributes:
        held: all rows held before.
        row_before_leap: `PlantState.row_before_leap` before.
        changes: how many changes had been recorded.
        removed_rows: rows that are not held any more.
        rows: those of them whose estimates were not final.
    """

    held: list[HeldRow]
    row_before_leap: RowBeforeLeap | None
    changes: int
    removed_rows: list[HeldRow]
    rows: list[HeldRow]
