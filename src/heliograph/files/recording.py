"""Recordings in files: a table of times, inputs and measurements, whose rows follow one another in time."""

import warnings
from collections import Counter
from collections.abc import Callable, Mapping
from difflib import get_close_matches
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from heliograph.files.table import TIME, Rows, columns_of, read_back_name, read_rows, write_table
from heliograph.files.table_rows import KeptRows, RowsAsColumns, keep_rows, order_rows
from heliograph.model.checks.inputs import find_time_step_fault
from heliograph.model.plant import TIME_STEP
from heliograph.numerics.check import InputError, fail, flag, instance
from heliograph.numerics.module import readable
from heliograph.numerics.times.dates import seconds_between
from heliograph.numerics.times.row_times import backwards, backwards_text
from heliograph.numerics.types import append_unit
from heliograph.simulation.network import Network

if TYPE_CHECKING:
    from heliograph.files.stores.tables import StoreTable


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
    columns = columns_of(table, source, reader.only)
    rows = len(next(iter(columns.values()), ()))
    return reader.read(Rows(columns, np.arange(1, rows + 1), []))


def read_recording_rows(
    source: "Path | StoreTable", network: Network, strict: bool, ignore_unknown: bool
) -> tuple[Recording, list[str], list[str]]:
    """Read a recording as `read_recording` does, of which a row that cannot be read is refused alone unless `strict`.

    Where the network counts steps such a row is a step in which nothing arrived and inputs stayed as they were. Unless
    `strict`, rows of continuous time are put in the order of their times.

    Returns:
        The recording, why rows were refused, and lines on what was put in order.

    Raises:
        ValueError: what `read_recording` refuses of a table as a whole; no row that can be read.
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
        ValueError: names that coincide, another format, or a folder that cannot be written.
        ModuleNotFoundError: Parquet without pyarrow (extra "tables").
    """
    instance("recording", recording, Recording, "a Recording")
    instance("network", network, Network, "a Network")
    columns = {TIME: recording.time, **dict(zip(network.inputs, recording.inputs.T, strict=True))}
    for node, names in _list_received_columns(network).items():
        if node in recording.measurements:
            columns |= {name[0]: z for name, z in zip(names, recording.measurements[node].T, strict=True)}
    if recording.truth is not None:
        columns |= dict(zip(_truth_columns(network).values(), recording.truth.T, strict=True))
    write_table(columns, path)


def _truth_columns(network: Network) -> dict[str, str]:
    """Return the name of the column of each state's true value, unless a node's component has it."""
    received = {name for node in _list_received_columns(network).values() for names in node for name in names}
    return {state: f"truth.{state}" for state in network.states if f"truth.{state}" not in received}


def _map_headers(network: Network) -> dict[str, str]:
    """Return {header that a column may have: name of the column}.

    A header is the name, with the unit of its state, input or output ("range (m)") or without, also as `write_table`
    writes what no cell can hold.
    """
    received = {node: receiver.received_names for node, receiver in network.nodes.items()}
    names = [*network.states, *network.inputs, *(name for components in received.values() for name in components)]
    headers = {append_unit(name): str(name) for name in names}
    headers |= {f"truth.{append_unit(name)}": f"truth.{name}" for name in network.states}
    for node, components in received.items():
        headers |= {f"{node}.{append_unit(name)}": f"{node}.{name}" for name in components}
    as_written = {read_back_name(header): name for header, name in headers.items()}
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
        notes: lines on what was put in order.
    """

    def __init__(self, network: Network, source: str, strict: bool, ignore_unknown: bool):
        self.network, self.source, self._strict = network, source, strict
        self._headers = _map_headers(network)
        self.only: Mapping[str, str] | None = self._headers if ignore_unknown else None
        self.refused, self.notes = list[InputError](), list[str]()

    @property
    def names(self) -> set[str]:
        """Return the names that a column may have."""
        return {TIME, *self._headers}

    def read(self, rows: Rows) -> Recording:
        """Return the rows that can be read.

        Raises:
            ValueError: unknown, missing or doubled columns; times that go backwards; a row that cannot be read, where
                reading is strict. One line that names the row, from 1, and the column.
        """
        return self.arrange(self.read_cells(rows))

    def arrange(self, cells: RowsAsColumns) -> Recording:
        """Return rows as a recording; unless reading is strict, in the order of their times.

        Raises:
            ValueError: times that go backwards, where reading is strict or each row is a step in most cases.
        """
        if not self._strict:
            cells, refused, note = order_rows(cells, self.network, self.source)
            self.refused += refused
            self.notes += [note] if note else []
        kept = keep_rows(cells.numbers, self.network)
        time = kept.fill_times(cells.time)
        u = _make_inputs(self.network, cells.inputs, time, kept, self.source)
        measurements = {node: kept.fill(values) for node, values in cells.measurements.items()}
        if not cells.truth:
            return Recording(measurements, u, time)
        unknown = np.full(len(cells.time), np.nan)
        truth = [kept.fill(cells.truth.get(state, unknown)) for state in self.network.states]
        return Recording(measurements, u, time, np.stack(truth, axis=1))

    def read_cells(self, rows: Rows) -> RowsAsColumns:
        """Return what stands in the rows that can be read, each by itself.

        Raises:
            ValueError: what `read` refuses, but for times that go backwards.
        """
        columns = {self._headers.get(name, name): values for name, values in rows.columns.items()}
        checks = _RowChecks(self.source, rows.numbers, self._strict)
        cells = _read_cells(columns, self.network, checks)
        self.refused += [*rows.refused, *checks.refused]
        return cells.of(checks.good)


class _RowChecks:
    """Refuses rows of a table that cannot be read: the first is an error, or each is noted with the reason.

    Attributes:
        good: of each row whether nothing was wrong so far.
        refused: why rows were refused.
    """

    def __init__(self, source: str, numbers: np.ndarray, strict: bool):
        self.source, self.numbers, self._strict = source, numbers, strict
        self.good = np.ones(len(numbers), dtype=bool)
        self.refused = list[InputError]()

    def refuse(self, bad: np.ndarray, column: str, expected: str, came: Callable[[int], str]) -> None:
        """Refuse the rows of a mask, unless they were refused before.

        Args:
            bad: the mask, (rows,).
            column: name of the column that is wrong.
            expected: what was expected there.
            came: what stands in a row instead.

        Raises:
            ValueError: one of them, where reading is strict.
        """
        for row in np.flatnonzero(bad & self.good).tolist():
            where = f"{self.source}, row {self.numbers[row]}, column {column!r}"
            error = fail(where, expected, came(row))
            if self._strict:
                raise error
            self.refused.append(error)
        self.good &= ~bad


def _read_cells(columns: Mapping[str, np.ndarray], network: Network, checks: _RowChecks) -> RowsAsColumns:
    """Return what stands in the columns of a table; rows that cannot be read are refused by `checks`."""
    inputs, received, source = network.inputs, _list_received_columns(network), checks.source
    # A relay whose measurements are left out altogether loses its filter only.
    for name in () if network.relays is None else network.relays.relays:
        if not any(column in columns for names in received[name] for column in names):
            del received[name]  # its own filter is left out
    if TIME in inputs:
        raise fail("input names", f"none called {TIME!r}, which is the recording's own column", list(inputs))
    expected = [(TIME,), *((name,) for name in inputs), *(names for node in received.values() for names in node)]
    truth_columns = _truth_columns(network)
    _refuse_unknown(columns, [*expected, *((name,) for name in truth_columns.values())], source)
    time = _read_times(columns, _find_column(columns, (TIME,), source), checks)
    measurements = {}
    for node, components in received.items():
        found = [_find_column(columns, names, source) for names in components]
        measurements[node] = np.stack([_read_measurements(columns, column, checks) for column in found], axis=1)
    # An input dt may be left out.
    given = {
        name: _read_complete(columns, _find_column(columns, (name,), source), checks)
        for name in inputs
        if name != TIME_STEP or name in columns
    }
    truth = {
        state: _read_measurements(columns, name, checks) for state, name in truth_columns.items() if name in columns
    }
    return RowsAsColumns(checks.numbers, time, measurements, given, truth)


def _make_inputs(
    network: Network, given: Mapping[str, np.ndarray], time: np.ndarray, rows: "KeptRows", source: str
) -> np.ndarray:
    """Return the inputs (rows, inputs); raise ValueError where times go backwards or a time step is impossible.

    A missing dt is the difference of the times.
    """
    row = backwards(time)
    if row is not None:
        where = f"{source}, row {rows.numbers[row]}, column {TIME!r}"
        raise fail(where, "a time that does not go backwards", backwards_text(time, row))
    _warn_of_equal_times(time, source)
    u = np.zeros((len(time), len(network.inputs)))
    for i, name in enumerate(network.inputs):
        u[:, i] = given[name][rows.of] if name in given else seconds_between(time)
        if name == TIME_STEP and (fault := find_time_step_fault(u[:, i])):
            raise fail(f"{source}, row {rows.numbers[fault.row]}, column {name!r}", fault.expected, fault.came)
    return u


def _list_received_columns(network: Network) -> dict[str, list[tuple[str, ...]]]:
    """Return the allowed column names of each node's components, the preferred one first."""
    names = {node: receiver.received_names for node, receiver in network.nodes.items()}
    uses = Counter([TIME, *network.inputs])
    for node, components in names.items():
        uses.update([*components, *(f"{node}.{name}" for name in components)])

    def allowed(node: str, name: str) -> tuple[str, ...]:
        full = f"{node}.{name}"
        if uses[name] > 1:
            return (full,)
        return (name, full) if len(names) == 1 else (full, name)

    return {node: [allowed(node, name) for name in components] for node, components in names.items()}


def _refuse_unknown(columns: Mapping[str, np.ndarray], expected: list[tuple[str, ...]], source: str) -> None:
    """Raise one line with the closest known name if a column belongs to nothing of the network."""
    known = [name for names in expected for name in names]
    for column in columns:
        if column not in known:
            close = get_close_matches(column, known, 1)
            closest = f" (closest: {close[0]!r})" if close else ""
            listed = ", ".join(names[0] for names in expected)
            raise fail(f"{source}, header", f"only the columns {listed}", f"the unknown {column!r}{closest}")


def _find_column(columns: Mapping[str, np.ndarray], names: tuple[str, ...], source: str) -> str:
    """Return which of these names a column has; raise unless exactly one does."""
    present = [name for name in names if name in columns]
    if len(present) != 1:
        came = f"both {' and '.join(map(repr, present))}" if present else f"only {', '.join(columns)}"
        raise fail(f"{source}, header", f"one column {names[0]!r}", came)
    return present[0]


def _read_times(columns: Mapping[str, np.ndarray], name: str, checks: _RowChecks) -> np.ndarray:
    """Return the times of the rows, dates where the column holds dates."""
    values = np.asarray(columns[name])
    if values.dtype.kind != "M":
        return _read_complete(columns, name, checks)
    checks.refuse(np.isnat(values), name, "a date", lambda row: "an empty cell")
    return values.astype("datetime64[ns]")


def _warn_of_equal_times(time: np.ndarray, source: str) -> None:
    """Warn where most rows have the time of the row before: stamps that were cut or rounded look like this."""
    _, counts = np.unique(time, return_counts=True)
    if len(time) > 2 and 2 * len(counts) <= len(time):
        shared = int(counts[counts > 1].sum())
        warnings.warn(
            f"{source}, column {TIME!r}: {shared} of {len(time)} rows share their time with another row, as stamps do "
            f"that lost their digits; {len(counts)} times in all",
            stacklevel=6,
        )


def _read_complete(columns: Mapping[str, np.ndarray], name: str, checks: _RowChecks) -> np.ndarray:
    """Return the numbers of a column in which every cell has to have one."""
    values = columns[name] if columns[name].dtype.kind == "i" else _read_numbers(columns, name, checks.source)
    checks.refuse(~np.isfinite(values), name, "a finite number", _describe_cell(values))
    return values


def _read_measurements(columns: Mapping[str, np.ndarray], name: str, checks: _RowChecks) -> np.ndarray:
    """Return the numbers of a column, NaN where a cell is empty."""
    values = _read_numbers(columns, name, checks.source)
    checks.refuse(np.isinf(values), name, "a finite number, or none where it did not arrive", _describe_cell(values))
    return values


def _read_numbers(columns: Mapping[str, np.ndarray], name: str, source: str) -> np.ndarray:
    """Return a column as doubles; raise ValueError if it has dates."""
    if columns[name].dtype.kind == "M":
        raise fail(f"{source}, column {name!r}", "numbers", "dates")
    return np.asarray(columns[name], dtype=np.float64)


def _describe_cell(values: np.ndarray) -> Callable[[int], str]:
    """Return what says in words what stands in a row of a column."""
    return lambda row: "an empty cell" if np.isnan(values[row]) else f"{values[row]}"
