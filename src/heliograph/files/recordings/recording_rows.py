"""Rows of a recording as columns: put in the order of their times, and with the steps that did not arrive."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from heliograph.files.tables.table import TIME
from heliograph.model.plant import TIME_STEP
from heliograph.numerics.check import InputError, fail
from heliograph.numerics.times.row_times import find_backwards_row
from heliograph.numerics.times.timestamp_order import SECOND, YEAR, find_out_of_order, find_unset_stamps
from heliograph.simulation.network import Network

MOST_OUT = 0.5  # share of the rows below which those that are out of order, or whose times were not set, are refused


class RecordingRows(NamedTuple):
    """Rows of a recording as columns, one row for each time."""

    numbers: np.ndarray  # of the rows in the table, from 1, (rows,)
    time: np.ndarray  # numbers or dates, (rows,)
    measurements: dict[str, np.ndarray]  # by node, (rows, received), NaN where nothing arrived
    inputs: dict[str, np.ndarray]  # by name, (rows,)
    truth: dict[str, np.ndarray]  # true values by state, (rows,)

    def select(self, good: np.ndarray | slice) -> "RecordingRows":
        """Return some of the rows; `good` is a mask, an array of indices, or a slice."""
        # The fields behind numbers and time are dictionaries of columns.
        parts = ({name: values[good] for name, values in part.items()} for part in self[2:])
        return RecordingRows(self.numbers[good], self.time[good], *parts)


def join_recording_rows(parts: Sequence[RecordingRows]) -> RecordingRows:
    """Return the rows of several parts of a table, one after the other."""
    numbers = np.concatenate([part.numbers for part in parts])
    time = np.concatenate([part.time for part in parts])
    # The fields after numbers and time are dictionaries of columns by name.
    columns = (
        {name: np.concatenate([part[i][name] for part in parts]) for name in parts[0][i]}
        for i in range(2, len(RecordingRows._fields))
    )
    return RecordingRows(numbers, time, *columns)


def order_rows(cells: RecordingRows, network: Network, source: str) -> tuple[RecordingRows, list[InputError], int]:
    """Return rows sorted by time, the reasons why other rows are refused, and how many rows came after later ones.

    If time is continuous, a time that is more than a year outside of all others was not set: its row is refused, and
    the other rows are put in the order of their times. If each row is a step, as few rows as possible are refused so
    that times do not go backwards. All rows stay as they are if half of them or more would be refused, or if there is a
    column `dt`, whose numbers belong to the order of the rows. MOST_OUT is this half, and TIME_STEP the column `dt`,
    which networks in continuous time have as an input.

    Args:
        cells: the rows of a table: times, numbers of the rows, measurements and inputs.
        network: the network that they belong to.
        source: name of the table, for errors.
    """
    if find_backwards_row(cells.time) is None:
        return cells, [], 0
    # Decide which rows are refused, by the rule for continuous time or for time in steps. Dates compare as integers.
    dated = cells.time.dtype.kind == "M"
    stamps = cells.time.astype(np.int64) if dated else cells.time
    is_continuous = TIME_STEP in network.inputs
    if is_continuous:
        is_refused = find_unset_stamps(stamps, YEAR if dated else YEAR / SECOND)
        expected = "a time that was set, near the others"
    else:
        is_refused = find_out_of_order(stamps)  # as few as possible, so that the others do not go backwards
        expected = "a time that does not go backwards"
    if TIME_STEP in cells.inputs or np.mean(is_refused) >= MOST_OUT:
        return cells, [], 0
    refused = [
        fail(f"{source}, row {number}, column {TIME!r}", expected, str(time) if dated else f"{time:.10g}")
        for number, time in zip(cells.numbers[is_refused].tolist(), cells.time[is_refused], strict=True)
    ]
    kept = cells.select(~is_refused)
    # Of the other rows, count those after a later one, and sort all by time; rows of equal times keep their order.
    latest_so_far = np.maximum.accumulate(kept.time)
    behind = int(np.count_nonzero(kept.time < latest_so_far))
    return kept.select(np.argsort(kept.time, kind="stable")), refused, behind


class RowsWithMissing(NamedTuple):
    """Rows of a recording, of which some were read and others are missing; all attributes have shape (rows,).

    A missing row has NaN as values, and its time lies between those of rows that were read.

    Attributes:
        numbers: numbers of the rows in the table, from 1.
        read_row: for each row the index, among the rows that were read, of itself or of the last one before it.
        arrived: whether the row itself was read.
    """

    numbers: np.ndarray
    read_row: np.ndarray
    arrived: np.ndarray

    def fill(self, values: np.ndarray) -> np.ndarray:
        """Return the values of all rows, with NaN for missing rows; `values` are those of the rows that were read."""
        filled = np.array(values[self.read_row], dtype=np.float64)
        filled[~self.arrived] = np.nan
        return filled

    def fill_times(self, time: np.ndarray) -> np.ndarray:
        """Return the times of all rows; missing rows are spaced evenly between the rows that were read.

        Rows before the first one that was read are extrapolated from the first two. If only one row was read, all have
        its time. `time` holds the times of the rows that were read.
        """
        missing = np.flatnonzero(~self.arrived)
        filled = np.array(time[self.read_row])
        if len(time) < 2:
            return filled
        # t = t_before + share (t_after - t_before), between the rows that were read before and after it; `share` is
        # negative for rows before the first one.
        before = np.minimum(self.read_row[missing], len(time) - 2)
        numbers = self.numbers[self.arrived]
        share = (self.numbers[missing] - numbers[before]) / (numbers[before + 1] - numbers[before])
        since_row_before = share * (time[before + 1] - time[before]).astype(np.float64)
        filled[missing] += since_row_before.astype("timedelta64[ns]" if time.dtype.kind == "M" else time.dtype)
        return filled


def lacks_second_row(cells: RecordingRows, network: Network, source: str) -> bool:
    """Return whether `cells`, the first readable rows of a table, are too few to date the unreadable rows before them.

    If every row is a step (there is no input dt), the times of those rows are extrapolated from the first two readable
    ones (`RowsWithMissing.fill_times`), so that a single one does not suffice. `order_rows` returns the rows sorted,
    those without a time that can be right left out.
    """
    if TIME_STEP in network.inputs or not len(cells.numbers):
        return False
    ordered, _, _ = order_rows(cells, network, source)
    return len(ordered.numbers) == 1 and int(ordered.numbers[0]) > 1


def insert_missing_rows(numbers: np.ndarray, network: Network, first: int = 1) -> RowsWithMissing:
    """Return the rows with these numbers, and, if every row is a step, also the missing rows between them.

    Without an input dt every row is a step, and steps begin with row number `first`. The result holds for each row its
    number, the index of the last row that was read up to it, and whether the row itself was read. `network.inputs`:
    names of the inputs.
    """
    if TIME_STEP in network.inputs or not len(numbers):
        return RowsWithMissing(numbers, np.arange(len(numbers)), np.ones(len(numbers), dtype=bool))
    steps = np.arange(first, numbers[-1] + 1)
    before = np.maximum(np.searchsorted(numbers, steps, side="right") - 1, 0)
    return RowsWithMissing(steps, before, numbers[before] == steps)
