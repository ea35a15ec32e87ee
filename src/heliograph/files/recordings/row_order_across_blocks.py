"""Order of rows that are read in blocks: whether blocks put in order by themselves are in the order of all rows."""

from pathlib import Path

import numpy as np

from heliograph.files.recordings.recording_rows import RecordingRows
from heliograph.files.tables.table import TIME
from heliograph.model.plant import TIME_STEP
from heliograph.numerics.check import InputError, fail
from heliograph.numerics.times.row_times import backwards_text, find_backwards_row
from heliograph.numerics.times.timestamp_order import SECOND, YEAR
from heliograph.simulation.network import Network


class RowsNotInBlocksError(InputError):
    """Rows of which only all together say in which order they are, or of which kind: one line that names the first."""


class BlockOrderCheck:
    """Compares blocks, each in the order of its times by itself, with what `order_rows` makes of all rows together.

    Sorted blocks of which each begins where the one before it ended are all rows sorted. Where each row is a step the
    fewest rows are left out of all if they are of each block, and none falls behind the block before it. Where time is
    continuous a stamp is left out that is more than a year outside of all others: a block says so of its own rows, so
    what it left out has to be outside of those of all blocks, and there may be no steps of a year beside rows out of
    order, since these may be stretches of stamps that were not set.

    Args:
        path: the file, for errors.
        network: the network that the rows belong to.

    Attributes:
        last: the last row so far; None before the first.
    """

    def __init__(self, path: Path, network: Network):
        """Begin without rows; rows are steps if the network has no input dt."""
        self._path = path
        self._rows_are_steps = TIME_STEP not in network.inputs
        self._first: RecordingRows | None = None  # the first row that was kept, of all blocks
        self.last: RecordingRows | None = None  # the newest one
        self._disordered: RecordingRows | None = None  # two rows, of which the second has an earlier time
        self._jump: RecordingRows | None = None  # two rows that are more than a year apart
        self._left_out = list[RecordingRows]()  # two rows of each block: those with the least and the greatest time

    def check_block(self, came: RecordingRows, ordered: RecordingRows) -> None:
        """Check that a block goes on from the rows before it, and note what decides on the order of all rows.

        A large file is read in blocks, and each block is sorted by itself. The result must be that of sorting all rows;
        if blocks cannot show this, the error makes the caller read the file as a whole.

        Args:
            came: rows of the block in the order in which they came.
            ordered: the rows that remain after sorting the block by time and leaving out stamps that cannot be right.

        Raises:
            RowsNotInBlocksError: only all rows together say in which order they are.
        """
        # All blocks must have times of one kind (numbers or dates).
        if self.last is not None and self.last.time.dtype != ordered.time.dtype:
            where = f"{self._path}, row {ordered.numbers[0]}, column {TIME!r}"
            before = self.last.time.dtype
            raise RowsNotInBlocksError(str(fail(where, f"numbers of the kind before, {before}", ordered.time.dtype)))
        # The block must not begin before the last row of the block before it.
        rows = ordered if self.last is None else _join_times(self.last, ordered)
        if (row := find_backwards_row(rows.time)) is not None:
            raise self._make_refusal(rows.select(slice(row - 1, row + 1)), "a time that does not go backwards")
        self.last = ordered.select(slice(-1, None))
        if self._first is None:
            self._first = ordered.select(slice(1))
        # Where each row is a step, nothing else depends on other blocks.
        if self._rows_are_steps:
            return
        # A step of more than a year together with rows out of order, in whichever blocks: the rows behind the step may
        # all have stamps that were not set, which one block cannot tell.
        if len(jumps := np.flatnonzero(np.diff(rows.time) > _year_in_unit_of(rows.time))):
            self._jump = rows.select(slice(int(jumps[0]), int(jumps[0]) + 2))
        if (row := find_backwards_row(came.time)) is not None:
            self._disordered = came.select(slice(row - 1, row + 1))
        if self._jump is not None and self._disordered is not None:
            raise self._make_refusal(self._disordered, "times in order, in a recording with steps of more than a year")
        # Left out rows are compared with all rows at the end. The earliest and the latest of the block suffice.
        left_out = came.select(~np.isin(came.numbers, ordered.numbers))
        if len(left_out.numbers):
            self._left_out.append(left_out.select(np.array([np.argmin(left_out.time), np.argmax(left_out.time)])))

    def check_left_out_rows(self) -> None:
        """Check that all rows that blocks left out are more than a year before or after all kept rows.

        Only all rows together decide whether a row must be left out, so a single block may have been wrong. `_first`
        and `last` are the first and the last row that was kept. The error makes the caller read the file as a whole.

        Raises:
            RowsNotInBlocksError: a row that was left out is within a year of the kept rows.
        """
        if self._first is None or self.last is None:
            return
        first, last = self._first.time[0], self.last.time[0]
        # It suffices to check two rows of each block: those left out with the least and the greatest time.
        year = _year_in_unit_of(self._first.time)
        for rows in self._left_out:
            for row in range(2):
                if first - year <= rows.time[row] <= last + year:
                    raise self._make_refusal(_join_times(self.last, rows.select(slice(row, row + 1))), "times in order")

    def _make_refusal(self, rows: RecordingRows, expected: str) -> RowsNotInBlocksError:
        """Return the error that names the second of two rows, whose time does not fit that of the first."""
        where = f"{self._path}, row {rows.numbers[1]}, column {TIME!r}"
        return RowsNotInBlocksError(str(fail(where, expected, backwards_text(rows.time, 1))))


def _join_times(before: RecordingRows, after: RecordingRows) -> RecordingRows:
    """Return the rows `before` followed by the rows `after`, with their numbers and times alone."""
    numbers = np.concatenate([before.numbers, after.numbers])
    time = np.concatenate([before.time, after.time])
    return RecordingRows(numbers, time, {}, {}, {})


def _year_in_unit_of(time: np.ndarray) -> np.timedelta64 | float:
    """Return the length of a year in the unit of `time`: a duration for dates, seconds for numbers."""
    return np.timedelta64(YEAR, "ns") if time.dtype.kind == "M" else YEAR / SECOND
