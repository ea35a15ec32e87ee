"""Recordings and estimates in files: a table of times, inputs and measurements; one of means and covariances."""

import warnings
from collections import Counter
from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import NamedTuple

import numpy as np

from heliograph.files.table import TIME, columns_of, read_back_name, write_table
from heliograph.model.estimate import Estimate, is_sound
from heliograph.model.inputs import find_time_step_fault
from heliograph.model.plant import TIME_STEP
from heliograph.numerics.check import fail, flag, instance
from heliograph.numerics.module import readable
from heliograph.numerics.times.dates import seconds_between
from heliograph.numerics.times.row_times import backwards, backwards_text
from heliograph.numerics.types import append_unit
from heliograph.simulation.network import Network
from heliograph.simulation.results.record import Record


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
    headers = _map_headers(network)
    columns = columns_of(table, source, headers if flag("ignore_unknown", ignore_unknown) else None)
    return _make_recording({headers.get(name, name): values for name, values in columns.items()}, network, source)


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
    """Return the name that a column has here by the header that it may have.

    That is the name, with the unit of its state, input or output ("range (m)") or without, also as `write_table` writes
    what no cell can hold.
    """
    received = {node: receiver.received_names for node, receiver in network.nodes.items()}
    names = [*network.states, *network.inputs, *(name for of in received.values() for name in of)]
    headers = {append_unit(name): str(name) for name in names}
    headers |= {f"truth.{append_unit(name)}": f"truth.{name}" for name in network.states}
    headers |= {f"{node}.{append_unit(name)}": f"{node}.{name}" for node, of in received.items() for name in of}
    plain = [TIME, *headers.values()]
    return (
        {read_back_name(header): name for header, name in headers.items()}
        | headers
        | dict(zip(plain, plain, strict=True))
    )


def _make_recording(columns: Mapping[str, np.ndarray], network: Network, source: str) -> Recording:
    """Make the recording from a table's columns: measurements by node, inputs, times, and the truth if there."""
    inputs, received = network.inputs, _list_received_columns(network)
    # A relay whose measurements are left out altogether loses its filter only.
    for name in () if network.relays is None else network.relays.relays:
        if not any(column in columns for names in received[name] for column in names):
            del received[name]  # its own filter is left out
    if TIME in inputs:
        raise fail("input names", f"none called {TIME!r}, which is the recording's own column", list(inputs))
    expected = [(TIME,), *((name,) for name in inputs), *(a for node in received.values() for a in node)]
    true = _truth_columns(network)
    _refuse_unknown(columns, [*expected, *((name,) for name in true.values())], source)

    def find(names: tuple[str, ...]) -> str:
        return _find(columns, names, source)

    # Time must not go backwards.
    time = _read_times(columns, find((TIME,)), source)
    row = backwards(time)
    if row is not None:
        came = backwards_text(time, row)
        raise fail(f"{source}, row {row + 1}, column {TIME!r}", "a time that does not go backwards", came)
    _warn_of_equal_times(time, source)
    measurements = {
        node: np.stack([_read_measurements(columns, find(names), source) for names in components], axis=1)
        for node, components in received.items()
    }
    # Inputs; a missing dt is the difference of the times.
    u = np.zeros((len(time), len(inputs)))
    for i, name in enumerate(inputs):
        fill = name == TIME_STEP and name not in columns
        u[:, i] = seconds_between(time) if fill else _complete(columns, find((name,)), source)
        if name == TIME_STEP and (fault := find_time_step_fault(u[:, i])):
            raise fail(f"{source}, row {fault.row + 1}, column {name!r}", fault.expected, fault.came)
    if not any(name in columns for name in true.values()):
        return Recording(measurements, u, time)
    unknown = np.full(len(time), np.nan)
    known = [true.get(state, "") for state in network.states]
    truth = [_read_measurements(columns, name, source) if name in columns else unknown for name in known]
    return Recording(measurements, u, time, np.stack(truth, axis=1))


def estimate_columns(record: Record) -> dict[str, np.ndarray]:
    """Return the estimates of a recording as columns."""
    columns = [(TIME, record.time)]
    several = len(record.estimates) > 1, any(len(filters) > 1 for filters in record.estimates.values())
    for node, filters in record.estimates.items():
        for name, estimate in filters.items():
            prefix = "".join(f"{label}." for label, used in zip((node, name), several, strict=True) if used)
            columns += [(prefix + key, values) for key, values in _make_columns(record.states, record.units, estimate)]
            later = {} if record.smoothed is None else record.smoothed.estimates.get(node, {})
            if name in later:
                known = _make_columns(record.states, record.units, later[name])
                columns += [(f"{prefix}smoothed.{key}", _pad_start(values, len(record.time))) for key, values in known]
    twice = [name for name, count in Counter(name for name, _ in columns).items() if count > 1]
    if twice:
        raise fail("columns of the estimates", "distinct names", f"{twice[0]!r} more than once")
    return dict(columns)


def write_estimates(record: Record, path: str | Path) -> None:
    """Write `estimate_columns` to a CSV or Parquet file, as a whole or not at all; in CSV, valid is 1 or 0.

    Args:
        record: the result of `run`.
        path: the file, ending in .csv or .parquet.

    Raises:
        ValueError: another format, or a folder that cannot be written.
        ModuleNotFoundError: Parquet without pyarrow (extra "tables").
    """
    instance("record", record, Record, "a Record")
    write_table(estimate_columns(record), path)


def make_header(name: str, unit: str | None) -> str:
    """Return the name of a column, with its unit where there is one."""
    return f"{name} ({unit})" if unit else str(name)


def _make_columns(states: Sequence[str], units: Mapping[str, str], estimate: Estimate) -> list[tuple[str, np.ndarray]]:
    """Return the columns that show an estimate: means, standard deviations and covariances as claimed, and validity."""
    mean, bound = np.asarray(estimate.mean), np.asarray(estimate.covariance)
    if mean.ndim != 2:
        raise fail("record", "the run over one recording", f"estimates of shape {mean.shape}")
    columns = []
    for i, state in enumerate(states):
        columns.append((make_header(state, units.get(state)), mean[:, i]))
        if estimate.claim != "none":
            variance = bound[:, i, i]
            columns.append(
                (make_header(f"{state}.sd", units.get(state)), np.sqrt(np.where(variance >= 0, variance, np.nan)))
            )
    # Covariances of two states have the product of their units.
    if estimate.claim != "none":
        for i, a in enumerate(states):
            for j in range(i + 1, len(states)):
                of = " ".join(units[name] for name in (a, states[j]) if name in units)
                columns.append((make_header(f"cov.{a}.{states[j]}", of), bound[:, i, j]))
    return [*columns, ("valid", is_sound(estimate))]


def _pad_start(values: np.ndarray, rows: int) -> np.ndarray:
    """Extend a column at its start by NaN, or false, to a number of rows."""
    none = np.full(rows - len(values), np.nan if values.dtype.kind == "f" else False)
    return np.concatenate([none.astype(values.dtype), values])


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


def _find(columns: Mapping[str, np.ndarray], names: tuple[str, ...], source: str) -> str:
    present = [name for name in names if name in columns]
    if len(present) != 1:
        came = f"both {' and '.join(map(repr, present))}" if present else f"only {', '.join(columns)}"
        raise fail(f"{source}, header", f"one column {names[0]!r}", came)
    return present[0]


def _read_times(columns: Mapping[str, np.ndarray], name: str, source: str) -> np.ndarray:
    """Return the times of the rows, dates where the column holds dates."""
    values = np.asarray(columns[name])
    if values.dtype.kind != "M":
        return _complete(columns, name, source)
    _refuse(np.isnat(values), np.full(len(values), np.nan), f"column {name!r}", "a date", source)
    return values.astype("datetime64[ns]")


def _warn_of_equal_times(time: np.ndarray, source: str) -> None:
    """Warn where most rows have the time of the row before: stamps that were cut or rounded look like this."""
    _, counts = np.unique(time, return_counts=True)
    if len(time) > 2 and 2 * len(counts) <= len(time):
        shared = int(counts[counts > 1].sum())
        warnings.warn(
            f"{source}, column {TIME!r}: {shared} of {len(time)} rows share their time with another row, as stamps do "
            f"that lost their digits; {len(counts)} times in all",
            stacklevel=4,
        )


def _complete(columns: Mapping[str, np.ndarray], name: str, source: str) -> np.ndarray:
    values = columns[name] if columns[name].dtype.kind == "i" else _numbers(columns, name, source)
    _refuse(~np.isfinite(values), values, f"column {name!r}", "a finite number", source)
    return values


def _read_measurements(columns: Mapping[str, np.ndarray], name: str, source: str) -> np.ndarray:
    """Return a column of measurements, NaN where none arrived; an infinite one is refused."""
    values = _numbers(columns, name, source)
    _refuse(
        np.isinf(values),
        values,
        f"column {name!r}",
        "a finite number, or none where it did not arrive",
        source,
    )
    return values


def _numbers(columns: Mapping[str, np.ndarray], name: str, source: str) -> np.ndarray:
    if columns[name].dtype.kind == "M":
        raise fail(f"{source}, column {name!r}", "numbers", "dates")
    return np.asarray(columns[name], dtype=np.float64)


def _refuse(bad: np.ndarray, values: np.ndarray, what: str, expected: str, source: str) -> None:
    if np.any(bad):
        row = int(np.argmax(bad))
        came = "an empty cell" if np.isnan(values[row]) else f"{values[row]}"
        raise fail(f"{source}, row {row + 1}, {what}", expected, came)
