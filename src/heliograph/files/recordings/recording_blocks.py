"""Recordings too long to be held: the rows of a file in blocks, each of which goes on where the one before it ended."""

import warnings
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from heliograph.files.recordings.recording import Recording, RowReader
from heliograph.files.recordings.recording_rows import RecordingRows, join_recording_rows, lacks_second_row
from heliograph.files.recordings.row_order_across_blocks import BlockOrderCheck
from heliograph.files.tables.block_size import USUAL_BLOCK, BlockSize
from heliograph.files.tables.table import read_row_blocks
from heliograph.files.tables.table_rows import TableRows
from heliograph.files.text.text_file import Progress
from heliograph.numerics.check import InputError, fail
from heliograph.simulation.network import Network

SHOWN = 3  # rows that were refused and are kept, with the reason


class RecordingBlocks:
    """Rows of a CSV or Parquet file, read in blocks: one after another they are the recording of the whole file.

    Iterating reads them. A row that cannot be read is refused alone unless reading is strict; within a block rows are
    put in the order of their times. Inputs and time steps go on from block to block, and so do the steps of rows that
    did not arrive.

    Args:
        path: the file.
        network: the network that the columns belong to.
        strict: whether a row that cannot be read is an error, or is refused alone.
        ignore_unknown: whether columns that the network does not know are left out.
        block: how much is read at a time; each block but the last has so many rows.
        progress: called with how much of the file is read, and of how much (default none).

    Attributes:
        refused: how many rows were refused so far.
        reasons: why, of the first of them.
        rows: how many rows were given out so far.
        doubts: warnings that reading gave.
    """

    def __init__(
        self,
        path: Path,
        network: Network,
        strict: bool,
        ignore_unknown: bool,
        block: BlockSize = USUAL_BLOCK,
        progress: Progress | None = None,
    ):
        """Prepare to read a table in blocks; `strict`: a row that cannot be read is an error, else refused alone."""
        self._path = path
        self._strict = strict
        self._block = block
        self._progress = progress
        self._reader = RowReader(network, str(path), strict, ignore_unknown)
        self._last_number = 0  # of the rows read so far, refused ones included
        self._done, self._total = 0, 0  # how much of the file is read, and of how much, as progress has it
        self.refused = 0  # how many rows
        self.reasons = list[InputError]()  # of the first of them
        self.rows = 0  # that were yielded
        self.doubts = list[str]()  # warnings

    @property
    def notes(self) -> list[str]:
        """Return a line on how many rows were sorted by time, or [] if none were."""
        return self._reader.notes

    @property
    def expected_rows(self) -> int:
        """Return the estimated number of rows of the file: rows read so far, divided by the share of the file read."""
        return round(self._last_number * self._total / max(self._done, 1))

    def __iter__(self) -> Iterator[Recording]:
        """Yield the recording in blocks of `self._block.rows` rows.

        Raises:
            RowsNotInBlocksError: the order of the rows, or the kind of their times, depends on all rows together.
            ValueError: `read_recording` would refuse the table, or no row can be read.
        """
        parts = read_row_blocks(self._path, self._reader.only, self._strict, self._block, self._note_progress)
        for block in cut_recordings(self._yield_recordings(parts), self._block.rows):
            yield block
            self.rows += len(block.time)
        if not self.rows:
            raise self.reasons[0] if self.reasons else fail(str(self._path), "at least one row", "none")

    def _yield_recordings(self, parts: Iterable[TableRows]) -> Iterator[Recording]:
        """Yield parts of a table as recordings, each of which goes on from the last row of the one before it.

        Each part is sorted by itself, and `BlockOrderCheck` makes sure that all rows are sorted then. Rows that the
        reader refused, and warnings on a part (`doubts`), are collected over all parts. `order.last` is the last row of
        the part before, from which missing times and inputs are filled; `put_in_order` sorts a part by time.
        """
        order = BlockOrderCheck(self._path, self._reader.network)
        for unordered in self._yield_cells(parts):
            cells = self._reader.put_in_order(unordered)
            self._note_refused(self._reader.refused)
            self._reader.refused = []
            if not len(cells.numbers):
                continue
            last_before = order.last
            order.check_block(unordered, cells)
            with warnings.catch_warnings(record=True) as doubts:
                warnings.simplefilter("always", UserWarning)
                recording = self._reader.make_recording(cells, last_before)
            self.doubts += [str(doubt.message) for doubt in doubts]
            yield recording
        order.check_left_out_rows()

    def _yield_cells(self, parts: Iterable[TableRows]) -> Iterator[RecordingRows]:
        """Yield the rows of each part of a table that can be read, as they came.

        Rows at the table's beginning may be unreadable. If each row is a step, their times follow from the first two
        readable rows. So a single readable row at the beginning is held back and joined with the next part.
        """
        held: RecordingRows | None = None  # rows held back, while nothing was yielded
        is_first = True  # whether no row was yielded yet
        for rows in parts:
            self._last_number = int(rows.numbers[-1]) if len(rows.numbers) else self._last_number
            if not len(rows.numbers):
                self._note_refused(rows.refused)
                continue
            cells = self._reader.read_cells(rows)
            if held is not None and held.time.dtype != cells.time.dtype:  # `BlockOrderCheck` will refuse these
                yield held
                held, is_first = None, False
            # The held row goes before these; if they are still too few, both are held.
            cells = cells if held is None else join_recording_rows([held, cells])
            held = None
            if is_first and lacks_second_row(cells, self._reader.network, str(self._path)):
                held = cells
                continue
            is_first = is_first and not len(cells.numbers)
            yield cells
        if held is not None:
            yield held

    def _note_progress(self, done: int, total: int) -> None:
        """Keep how many bytes of the file are read and how many there are, and call `progress` if there is one."""
        self._done, self._total = done, total
        if self._progress is not None:
            self._progress(done, total)

    def _note_refused(self, errors: list[InputError]) -> None:
        """Count rows that were refused, and keep the first SHOWN reasons."""
        self.refused += len(errors)
        self.reasons += errors[: SHOWN - len(self.reasons)]


def cut_recordings(parts: Iterable[Recording], rows: int) -> Iterator[Recording]:
    """Yield a recording in blocks of `rows` rows from parts of any lengths; the last block may have fewer rows."""
    held, count = list[Recording](), 0  # what was not yielded yet, and its rows
    for part in parts:
        held.append(part)
        count += len(part.time)
        if count < rows:
            continue
        joined = _join_recordings(held)
        for begin in range(0, count - rows + 1, rows):
            yield _select_rows(joined, slice(begin, begin + rows))
        rest = count % rows  # rows behind the last whole block
        held, count = [_select_rows(joined, slice(count - rest, None))], rest
    if count:
        yield _join_recordings(held)


def _join_recordings(parts: list[Recording]) -> Recording:
    """Return the rows of several recordings, one after the other."""
    if len(parts) == 1:
        return parts[0]
    measurements = {node: np.concatenate([part.measurements[node] for part in parts]) for node in parts[0].measurements}
    inputs = np.concatenate([part.inputs for part in parts])
    time = np.concatenate([part.time for part in parts])
    truth = None if parts[0].truth is None else np.concatenate([np.asarray(part.truth) for part in parts])
    return Recording(measurements, inputs, time, truth)


def _select_rows(recording: Recording, rows: slice) -> Recording:
    """Return the rows of a recording that the slice `rows` selects."""
    measurements = {node: values[rows] for node, values in recording.measurements.items()}
    truth = None if recording.truth is None else recording.truth[rows]
    return Recording(measurements, recording.inputs[rows], recording.time[rows], truth)
