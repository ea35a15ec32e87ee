"""Recordings in files: a table of times, inputs and measurements, whose rows follow one another in time."""

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from heliograph.files.recordings.recording_cells import (
    RowRefusals,
    list_received_columns,
    list_truth_columns,
    read_cells,
)
from heliograph.files.recordings.recording_rows import (
    RecordingRows,
    RowsWithMissing,
    insert_missing_rows,
    join_recording_rows,
    order_rows,
)
from heliograph.files.recordings.time_steps import compare_steps_with_times
from heliograph.files.tables.table import TIME, convert_to_columns, read_rows, write_table
from heliograph.files.tables.table_rows import TableRows
from heliograph.files.tables.table_writer import predict_name_read_back
from heliograph.model.checks.plant_inputs import find_time_step_fault
from heliograph.model.plant import TIME_STEP
from heliograph.numerics.check import InputError, fail, flag, instance
from heliograph.numerics.module import readable
from heliograph.numerics.times.dates import read_compact_date, seconds_between
from heliograph.numerics.times.row_times import (
    backwards_text,
    describe_clock_set_forward,
    fail_of_clock_set_back,
    find_backwards_row,
    find_lost_digits,
    is_mix_of_units,
)
from heliograph.numerics.times.timestamp_order import find_clock_set_back, find_clock_set_forward
from heliograph.numerics.types import append_unit
from heliograph.simulation.network import Network

if TYPE_CHECKING:
    from heliograph.files.stores.store_tables import StoreTable


@readable
class Recording(NamedTuple):
    """Measured data in the form of the arguments of `heliograph.run`: `run(network, *recording)`.

    Shapes: measurements[node] (steps, received), NaN where a component did not arrive; inputs (steps, inputs); time
    (steps,), numbers or dates (datetime64[ns], UTC); truth (steps, n), NaN where it is not known, or None.
    """

    measurements: dict[str, np.ndarray]
    inputs: np.ndarray
    time: np.ndarray
    truth: np.ndarray | None = None


def read_recording(table: object, network: Network, name: str = "recording", ignore_unknown: bool = False) -> Recording:
    """Read measured data for a network from a CSV or Parquet file, a DataFrame, or a dictionary of columns.

    Columns: `time`, numbers or dates of ISO 8601, which never goes backwards; each plant input by its name (an input
    `dt` may be left out: it is the time since the previous row in the unit of `time`, for dates in seconds, and 0 in
    the first row); each received component by `node.name` or, if the name is unique, by `name`. Components are named as
    the sensor's outputs if the channel keeps their number, else z0, z1, ... A measurement that is empty or NaN did not
    arrive. Measurements of a relay may be left out altogether. A column `truth.STATE` holds the true value of a state,
    empty where it is not known. Where most rows have the time of the row before, as of stamps that lost their digits,
    there is a warning.

    Args:
        table: path of the file, DataFrame, or columns by name.
        network: the network that the columns belong to.
        name: name of a table without a file, for errors.
        ignore_unknown: whether columns that the network does not know are left out (default False: they are refused,
            since they may be misspelt).

    Raises:
        ValueError: no table of numbers; unknown, missing or doubled columns; a time or an input that is missing;
            infinite numbers; times that go backwards. One line that names the row, from 1, and the column.
        ModuleNotFoundError: Parquet without pyarrow (extra "tables").
    """
    instance("network", network, Network, "a Network")
    source = str(table) if isinstance(table, str | Path) else name
    reader = RowReader(network, source, strict=True, ignore_unknown=flag("ignore_unknown", ignore_unknown))
    columns = convert_to_columns(table, source, reader.only)
    rows = len(next(iter(columns.values()), ()))
    return reader.read(TableRows(columns, np.arange(1, rows + 1), []))


def read_recording_rows(
    source: "Path | StoreTable", network: Network, strict: bool, ignore_unknown: bool
) -> tuple[Recording, list[str], list[str]]:
    """Read a recording as `read_recording` does; unless `strict`, a row that cannot be read is refused alone.

    If the network counts steps, a refused row is a step in which nothing arrived and inputs did not change. Unless
    `strict`, rows of continuous time are sorted by their times. `RowReader` makes a recording of rows and collects what
    it refuses.

    Returns:
        The recording, the reasons why rows were refused, and lines on rows that were sorted.

    Raises:
        ValueError: `read_recording` would refuse the whole table, or no row can be read.
    """
    reader = RowReader(network, str(source), strict, ignore_unknown)
    rows = read_rows(source, reader.only, strict) if isinstance(source, Path) else source.rows(reader.only)
    recording = reader.read(rows)
    if not len(recording.time):
        raise reader.refused[0] if reader.refused else fail(str(source), "at least one row", "none")
    return recording, [str(error) for error in reader.refused], reader.notes


def write_recording(recording: Recording, network: Network, path: str | Path) -> None:
    """Write a recording to a CSV or Parquet file that `read_recording` reads: time, inputs, measurements, and truth.

    Args:
        recording: the measured data.
        network: the network that the data belong to; it names the columns.
        path: the file, ending in .csv or .parquet.

    Raises:
        ValueError: columns would have the same name, the format is another one, or the folder cannot be written.
        ModuleNotFoundError: Parquet without pyarrow (extra "tables").
    """
    instance("recording", recording, Recording, "a Recording")
    instance("network", network, Network, "a Network")
    columns = {TIME: recording.time, **dict(zip(network.inputs, recording.inputs.T, strict=True))}
    for node, names in list_received_columns(network).items():
        if node in recording.measurements:
            # `read_recording` takes several names for a component; the first one is written.
            columns |= {name[0]: z for name, z in zip(names, recording.measurements[node].T, strict=True)}
    if recording.truth is not None:
        columns |= dict(zip(list_truth_columns(network).values(), recording.truth.T, strict=True))
    write_table(columns, path)


def _map_headers(network: Network) -> dict[str, str]:
    """Return {header that a column may have: name of the column}.

    A header is the column's name with or without the unit of its state, input or output, as in "range (m)". It may also
    be in the form in which `write_table` writes names that no cell can hold. `append_unit` puts the unit behind a name
    that has one.
    """
    received = {node: receiver.received_names for node, receiver in network.nodes.items()}
    names = [*network.states, *network.inputs, *(name for components in received.values() for name in components)]
    headers = {append_unit(name): str(name) for name in names}
    headers |= {f"truth.{append_unit(name)}": f"truth.{name}" for name in network.states}
    for node, components in received.items():
        headers |= {f"{node}.{append_unit(name)}": f"{node}.{name}" for name in components}
    # If headers are equal, the last of these dictionaries prevails: plain names, then names with units, then the rest.
    as_written = {predict_name_read_back(header): name for header, name in headers.items()}
    without_unit = {name: name for name in (TIME, *headers.values())}
    return as_written | headers | without_unit


class RowReader:
    """Reads rows of time of a network from columns, a part of a table at a time.

    Args:
        network: the network that the columns belong to.
        source: name of the table, for errors.
        strict: whether a row that cannot be read is an error, or is refused alone.
        ignore_unknown: whether columns that the network does not know are left out.

    Attributes:
        only: the columns that are read; None for all.
        refused: why rows were refused, in the order of the table.
    """

    def __init__(self, network: Network, source: str, strict: bool, ignore_unknown: bool):
        """Begin without rows; if `strict`, a row that cannot be read is an error, else it is refused alone."""
        self.network, self.source, self._strict = network, source, strict
        self._headers = _map_headers(network)  # {header that a column may have: its name}
        self.only: Mapping[str, str] | None = self._headers if ignore_unknown else None
        self.refused = list[InputError]()
        self._behind = 0  # rows that came after later ones

    @property
    def names(self) -> set[str]:
        """Return the headers that a column of the network's table may have, `time` among them."""
        return {TIME, *self._headers}

    @property
    def notes(self) -> list[str]:
        """Return a line on how many rows came after later ones and were sorted by time, or [] if there are none."""
        if not self._behind:
            return []
        return [f"{self.source}: rows that came after later ones, used in the order of their times: {self._behind}"]

    def read(self, rows: TableRows) -> Recording:
        """Return the rows that can be read.

        `read_cells` checks each row and leaves out those that cannot be read; `arrange_recording` puts the others in
        order and fills what is missing.

        Raises:
            ValueError: unknown, missing or doubled columns; times that go backwards; a row that cannot be read, where
                reading is strict. One line that names the row, from 1, and the column.
        """
        return self.arrange_recording(self.read_cells(rows))

    def arrange_recording(self, cells: RecordingRows) -> Recording:
        """Return rows as a recording; unless reading is strict, in the order of their times.

        Raises:
            ValueError: times that go backwards, where reading is strict or each row is a step in most cases.
        """
        return self.make_recording(self.put_in_order(cells))

    def put_in_order(self, cells: RecordingRows) -> RecordingRows:
        """Return rows sorted by their times, or as they are if reading is strict.

        `self._behind` counts rows that came after later ones. `self.refused` gets the reasons why rows were left out.
        `cells`: the rows that could be read. `order_rows` returns them sorted, the errors of those left out, and how
        many came late.

        Raises:
            ValueError: a clock of local time was set back by an hour: put in order, rows of two hours would be mixed.
        """
        self._refuse_clock_set_back(cells)
        if self._strict:
            return cells
        cells, refused, behind = order_rows(cells, self.network, self.source)
        self.refused += refused
        self._behind += behind
        return cells

    def _refuse_clock_set_back(self, cells: RecordingRows) -> None:
        """Raise ValueError if the dates go back by an hour as local time does when summer time ends."""
        row = find_clock_set_back(cells.time) if cells.time.dtype.kind == "M" else None
        if row is not None:
            raise fail_of_clock_set_back(f"{self.source}, row {cells.numbers[row]}, column {TIME!r}", cells.time, row)

    def make_recording(self, cells: RecordingRows, before: RecordingRows | None = None) -> Recording:
        """Return rows in the order of their times as a recording; refused rows become steps, if every row is a step.

        Args:
            cells: the rows that could be read: their numbers in the table, times, and columns of measurements, inputs
                and true states.
            before: the last row of the block before, None for the first block. Missing times and inputs of these rows
                are filled from it.

        Raises:
            ValueError: times that go backwards, an impossible time step.
        """
        # The row before goes in first, and is left out of the result (`begin`).
        begin, first_number = 0, 1
        if before is not None:
            begin, first_number = 1, int(before.numbers[0])
            cells = join_recording_rows([before, cells])
        # Rows that were refused get a time between their neighbours and NaN as measurements: `fill` sets a column's
        # values into the rows that were read, and NaN into the others.
        rows = insert_missing_rows(cells.numbers, self.network, first_number)
        time = rows.fill_times(cells.time)
        u = _make_inputs(self.network, cells.inputs, time, rows, self.source)
        measurements = {node: rows.fill(values)[begin:] for node, values in cells.measurements.items()}
        truth = None
        if cells.truth:  # of some states, or of all; of others it is unknown
            unknown = np.full(len(cells.time), np.nan)
            states = [rows.fill(cells.truth.get(state, unknown)) for state in self.network.states]
            truth = np.stack(states, axis=1)[begin:]
        return Recording(measurements, u[begin:], time[begin:], truth)

    def read_cells(self, rows: TableRows) -> RecordingRows:
        """Return the times, inputs, measurements and truth of the rows that can be read; each row is checked by itself.

        `self._headers` maps a header that a column may have to the column's name. `refusals.good` is the mask of the
        rows that were not refused. `refusals` collects the errors of refused rows, or raises the first one where
        reading is strict.

        Raises:
            ValueError: the same as of `read`, but not for times that go backwards.
        """
        columns = {self._headers.get(name, name): values for name, values in rows.columns.items()}
        refusals = RowRefusals(self.source, rows.numbers, self._strict)
        cells = read_cells(columns, self.network, refusals)
        self.refused += [*rows.refused, *refusals.refused]
        return cells.select(refusals.good)


def _make_inputs(
    network: Network, given: Mapping[str, np.ndarray], time: np.ndarray, rows: RowsWithMissing, source: str
) -> np.ndarray:
    """Return the inputs (rows, inputs), and warn of doubtful times.

    An input holds its value in rows that were refused. If the table has no time step dt, the differences of the times
    are taken.

    Args:
        network: its inputs.
        given: columns of the inputs that the table has, one value for each row that was read.
        time: times of all rows, the refused ones included.
        rows: of which row that was read each of all rows takes its inputs.
        source: name of the table, for errors.

    Raises:
        ValueError: times go backwards, or a time step is impossible.
    """
    row = find_backwards_row(time)
    if row is not None:
        where = f"{source}, row {rows.numbers[row]}, column {TIME!r}"
        raise fail(where, "a time that does not go backwards", backwards_text(time, row))
    _warn_of_equal_times(time[rows.arrived], source)
    _warn_of_dates_as_numbers(time[rows.arrived], source)
    _warn_of_mixed_units(time[rows.arrived], source, rows.numbers[rows.arrived])
    _warn_of_lost_digits(time[rows.arrived], source)
    _warn_of_clock_set_forward(time[rows.arrived], source, rows.numbers[rows.arrived])
    u = np.zeros((len(time), len(network.inputs)))
    for i, name in enumerate(network.inputs):
        u[:, i] = given[name][rows.read_row] if name in given else seconds_between(time)
        if name == TIME_STEP and name in given:
            u[:, i] = compare_steps_with_times(u[:, i], time, rows.numbers, source)
        if name == TIME_STEP and (fault := find_time_step_fault(u[:, i])):
            raise fail(f"{source}, row {rows.numbers[fault.row]}, column {name!r}", fault.expected, fault.came)
    return u


def _warn_of_equal_times(time: np.ndarray, source: str) -> None:
    """Warn if most rows have the same time as the previous row, as happens to stamps that were cut or rounded."""
    _, counts = np.unique(time, return_counts=True)
    if len(time) > 2 and 2 * len(counts) <= len(time):
        shared = int(counts[counts > 1].sum())
        warnings.warn(
            f"{source}, column {TIME!r}: {shared} of {len(time)} rows share their time with another row, as stamps do "
            f"that lost their digits; {len(counts)} times in all",
            stacklevel=7,
        )


def _warn_of_lost_digits(time: np.ndarray, source: str) -> None:
    """Warn if times are floats so large that their steps lost digits."""
    lost = find_lost_digits(time)
    if lost is not None:
        spacing, step = lost  # of the floats of this size, and of the times
        warnings.warn(
            f"{source}, column {TIME!r}: steps of {step:g} between numbers that are multiples of {spacing:g}: they "
            "lost digits; whole numbers, dates, or times from the first row on keep them",
            stacklevel=7,
        )


def _warn_of_clock_set_forward(time: np.ndarray, source: str, numbers: np.ndarray) -> None:
    """Warn if dates jump forward by an hour, as local time does in spring; `numbers`: of the rows, from 1."""
    row = find_clock_set_forward(time)
    if row is not None:
        description = describe_clock_set_forward(time, row)
        warnings.warn(f"{source}, row {numbers[row]}, column {TIME!r}: {description}", stacklevel=7)


def _warn_of_mixed_units(time: np.ndarray, source: str, numbers: np.ndarray) -> None:
    """Warn if times jump by a factor from one row to the next, as from seconds to milliseconds.

    `numbers` are the numbers of the rows, from 1.
    """
    if time.dtype.kind not in "fiu":
        return
    before, after = time[:-1].astype(float), time[1:].astype(float)
    jumps = np.flatnonzero(is_mix_of_units(before, after))
    if len(jumps):
        row = int(jumps[0]) + 1
        warnings.warn(
            f"{source}, row {numbers[row]}, column {TIME!r}: {time[row]:.14g} after {time[row - 1]:.14g}: "
            "seconds and milliseconds, or such, in one column",
            stacklevel=7,
        )


def _warn_of_dates_as_numbers(time: np.ndarray, source: str) -> None:
    """Warn if all times look like dates without separators, such as 20260131.

    As numbers, such dates do not count time evenly: the day after January 31st is 70 later.
    """
    if len(time) > 1 and (date := read_compact_date(time)):
        warnings.warn(
            f"{source}, column {TIME!r}: {time[0]:.14g} and all others read as dates without separators; they are "
            f"taken as numbers, which do not count time evenly: a date is written as {date}",
            stacklevel=7,
        )
