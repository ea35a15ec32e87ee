"""Cells of a recording's rows: which column holds what, and which rows cannot be read."""

from collections import Counter
from collections.abc import Callable, Mapping
from difflib import get_close_matches

import numpy as np

from heliograph.files.recordings.recording_rows import RecordingRows
from heliograph.files.tables.table import TIME
from heliograph.files.tables.table_rows import convert_to_doubles, find_missing
from heliograph.model.plant import TIME_STEP
from heliograph.numerics.check import InputError, fail
from heliograph.simulation.network import Network


class RowRefusals:
    """Rows of a table that were refused, with the reasons; where reading is strict the first one is raised.

    Attributes:
        good: of each row whether nothing was wrong so far.
        refused: why rows were refused.
    """

    def __init__(self, source: str, numbers: np.ndarray, strict: bool):
        """Begin with all rows good; `numbers` are the rows' numbers in the file.

        If `strict`, the first refusal is raised as an error.
        """
        self.source, self.numbers, self._strict = source, numbers, strict
        self.good = np.ones(len(numbers), dtype=bool)
        self.refused = list[InputError]()

    def refuse(self, bad: np.ndarray, column: str, expected: str, came: Callable[[int], str]) -> None:
        """Refuse the rows of the mask `bad`: note an error for each of them that was not refused before.

        `self.good`, (rows,), marks the rows that are still accepted.

        Args:
            bad: the mask, (rows,).
            column: name of the column that is wrong.
            expected: what was expected there.
            came: function from a row's index to a description of what stands there instead.

        Raises:
            ValueError: a row is refused and reading is strict.
        """
        for row in np.flatnonzero(bad & self.good).tolist():
            where = f"{self.source}, row {self.numbers[row]}, column {column!r}"
            error = fail(where, expected, came(row))
            if self._strict:
                raise error
            self.refused.append(error)
        self.good &= ~bad


def read_cells(columns: Mapping[str, np.ndarray], network: Network, refusals: RowRefusals) -> RecordingRows:
    """Return the columns of a table as times, measurements, inputs and true states; each cell is checked.

    Args:
        columns: the table's cells by name of column, a row for each time.
        network: says which columns there may be: time, inputs, each node's measurements, and true states.
        refusals: notes rows that cannot be read, with the reason, or raises the first one; `source` names the file.
    """
    inputs, source = network.inputs, refusals.source
    # By node, for each component of its measurements, the names that its column may have; one of them must be there.
    received = list_received_columns(network)
    # A relay may have no columns at all: the filters of other nodes do not need what the relay received, so that only
    # its own filter has no data.
    relays = () if network.relays is None else network.relays.relays
    for name in relays:
        if not any(column in columns for names in received[name] for column in names):
            del received[name]
    if TIME in inputs:
        raise fail("input names", f"none called {TIME!r}, which is the recording's own column", list(inputs))
    truth_columns = list_truth_columns(network)
    # For each quantity the names that its column may have, the preferred one first; any other column is refused.
    expected = [
        (TIME,),
        *((name,) for name in inputs),
        *(names for components in received.values() for names in components),
        *((name,) for name in truth_columns.values()),
    ]
    _refuse_unknown_columns(columns, expected, source)
    # Read column by column: `_find_column` returns which of the names a column has, or raises.
    time = _read_times(columns, _find_column(columns, (TIME,), source), refusals)
    measurements = {}
    for node, components in received.items():
        found = [_find_column(columns, names, source) for names in components]
        measurements[node] = np.stack([_read_measurements(columns, column, refusals) for column in found], axis=1)
    # All inputs have to be there, except a time step dt (TIME_STEP), which follows from the times.
    given = {
        name: _read_column_without_gaps(columns, _find_column(columns, (name,), source), refusals)
        for name in inputs
        if name != TIME_STEP or name in columns
    }
    truth = {
        state: _read_measurements(columns, name, refusals) for state, name in truth_columns.items() if name in columns
    }
    return RecordingRows(refusals.numbers, time, measurements, given, truth)


def list_truth_columns(network: Network) -> dict[str, str]:
    """Return {state: name of the column of its true value, "truth.STATE"}.

    A state whose name would be that of a node's component has no such column.
    """
    received = {name for node in list_received_columns(network).values() for names in node for name in names}
    return {state: f"truth.{state}" for state in network.states if f"truth.{state}" not in received}


def list_received_columns(network: Network) -> dict[str, list[tuple[str, ...]]]:
    """Return for each node, and each component that it receives, the allowed column names, the preferred one first.

    `received_names` are the names of what a node receives.
    """
    names = {node: receiver.received_names for node, receiver in network.nodes.items()}
    # How many things each name may be meant for: one alone may be called by it without its node.
    uses = Counter([TIME, *network.inputs])
    for node, components in names.items():
        uses.update([*components, *(f"{node}.{name}" for name in components)])

    def list_allowed(node: str, name: str) -> tuple[str, ...]:
        """Return the names that the column of a node's component may have, the preferred one first.

        `uses` counts for how many components, inputs or other columns a name stands. A name used twice needs the node.
        """
        full = f"{node}.{name}"
        if uses[name] > 1:
            return (full,)
        return (name, full) if len(names) == 1 else (full, name)

    return {node: [list_allowed(node, name) for name in components] for node, components in names.items()}


def _refuse_unknown_columns(columns: Mapping[str, np.ndarray], expected: list[tuple[str, ...]], source: str) -> None:
    """Raise a one-line ValueError with the closest known name if a column is not known to the network.

    `expected` holds for each state, input or component the names that its column may have, the preferred one first.
    `columns`: the table's. `source`: its name, for errors.
    """
    known = [name for names in expected for name in names]
    for column in columns:
        if column not in known:
            close = get_close_matches(column, known, 1)
            closest = f" (closest: {close[0]!r})" if close else ""
            listed = ", ".join(names[0] for names in expected)
            raise fail(f"{source}, header", f"only the columns {listed}", f"the unknown {column!r}{closest}")


def _find_column(columns: Mapping[str, np.ndarray], names: tuple[str, ...], source: str) -> str:
    """Return which of these names, all for the same quantity, a column has; raise if no column or several have one.

    `source`: name of the table, for errors.
    """
    present = [name for name in names if name in columns]
    if len(present) != 1:
        came = f"both {' and '.join(map(repr, present))}" if present else f"only {', '.join(columns)}"
        raise fail(f"{source}, header", f"one column {names[0]!r}", came)
    return present[0]


def _read_times(columns: Mapping[str, np.ndarray], name: str, refusals: RowRefusals) -> np.ndarray:
    """Return the times of the rows, as numbers or as dates; rows without a time are refused.

    `refusals` notes an error for each such row, or raises the first one where reading is strict.
    """
    values = np.asarray(columns[name])
    if values.dtype.kind != "M":
        return _read_column_without_gaps(columns, name, refusals)
    refusals.refuse(np.isnat(values), name, "a date", lambda row: "an empty cell")
    return values.astype("datetime64[ns]")


def _read_column_without_gaps(columns: Mapping[str, np.ndarray], name: str, refusals: RowRefusals) -> np.ndarray:
    """Return the numbers of a column that may have no gaps; rows without a finite number are refused.

    Integers stay integers, since they may be too large for an exact double; a missing one stands as the constant
    MISSING, which `find_missing` knows. `refuse` notes an error for each of these rows, which names the cell as
    `_describe_cell` shows it, or raises the first one where reading is strict.
    """
    values = columns[name] if columns[name].dtype.kind == "i" else _read_numbers(columns, name, refusals.source)
    refusals.refuse(find_missing(values) | ~np.isfinite(values), name, "a finite number", _describe_cell(values))
    return values


def _read_measurements(columns: Mapping[str, np.ndarray], name: str, refusals: RowRefusals) -> np.ndarray:
    """Return the numbers of a column, NaN where a cell is empty; rows with an infinite one are refused."""
    values = _read_numbers(columns, name, refusals.source)
    refusals.refuse(np.isinf(values), name, "a finite number, or none where it did not arrive", _describe_cell(values))
    return values


def _read_numbers(columns: Mapping[str, np.ndarray], name: str, source: str) -> np.ndarray:
    """Return a column as doubles; raise ValueError if it has dates."""
    if columns[name].dtype.kind == "M":
        raise fail(f"{source}, column {name!r}", "numbers", "dates")
    return convert_to_doubles(columns[name])


def _describe_cell(values: np.ndarray) -> Callable[[int], str]:
    """Return a function from the index of a row to a description of the cell there, for errors."""
    return lambda row: "an empty cell" if find_missing(values[row]) else f"{values[row]}"
