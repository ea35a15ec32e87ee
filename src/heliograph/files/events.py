"""Files of events: one row for each received message, in any order, with names of nodes and possibly dates."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from heliograph.disk.whole_file import FORMATS
from heliograph.files.event_table import SECOND, EventTable
from heliograph.files.recording import write_estimates
from heliograph.files.sources import Reading
from heliograph.files.table import csv_header, csv_lines
from heliograph.live.event import INPUTS, Event, whole
from heliograph.live.recorded import play
from heliograph.model.plant import TIME_STEP
from heliograph.numerics.check import fail, shown
from heliograph.numerics.dates import dates, looks_like_date
from heliograph.simulation.network import Network
from heliograph.simulation.results.record import Record

EXACT = 2.0**53  # up to here doubles hold every whole number
NODE, SEQUENCE, TIME, ARRIVAL, VALUES = "node", "sequence", "time", "arrival", "values"


def holds_events(path: str | Path) -> bool:
    """Return whether a CSV or Parquet file has events instead of rows: it has the columns `node` and `sequence`."""
    path = Path(path)
    if not path.is_file() or path.suffix.lower() not in FORMATS:
        return False
    return {NODE, SEQUENCE} <= set(_header(path))


def read_events(path: str | Path, network: Network) -> tuple[list[Event], np.datetime64 | None]:
    """Read events from a CSV or Parquet file; times are seconds since the returned date if the file has dates.

    Columns: `node` (a name, or "inputs"), `sequence`, `time`, `arrival` (optional: at once), and the values: one column
    for each component, named as the sensor's outputs or the plant's inputs, or one column `values` with all of the
    node's numbers, separated by spaces or as a list. An empty cell did not arrive. Dates are ISO 8601, all with a time
    zone or all without. A sequence keeps every digit. In CSV quotes around a cell mean nothing; in Parquet text is not
    converted to numbers.

    Args:
        path: the file.
        network: the network that the names belong to.

    Returns:
        The events in order of the rows, and the earliest `time` if times are dates, else None.

    Raises:
        ValueError: missing or unknown columns, an invalid cell; one line that names the row, from 1.
    """
    path = Path(path)
    columns = _columns(path)
    components = {name: node.received_names for name, node in network.nodes.items()}
    components[INPUTS] = tuple(name for name in network.inputs if name != TIME_STEP)
    # Unknown columns are most likely misspelt: refuse them.
    known = [NODE, SEQUENCE, TIME, ARRIVAL, VALUES, *(name for names in components.values() for name in names)]
    for name in columns:
        if name not in known:
            raise fail(f"{path}, header", f"only the columns {', '.join(dict.fromkeys(known))}", repr(name))
    for name in (NODE, SEQUENCE, TIME):
        if name not in columns:
            raise fail(f"{path}, header", f"a column {name!r}", f"only {', '.join(columns)}")
    # Rows to events; errors name the row.
    time, arrival, origin = _times(columns, path)
    events = []
    for row, node in enumerate(columns[NODE]):
        where = f"{path}, row {row + 1}"
        if node not in components:
            raise fail(f"{where}, column {NODE!r}", f"one of {', '.join(components)}", shown(node))
        values = _received({name: column[row] for name, column in columns.items()}, components[node], where)
        number = _whole(columns[SEQUENCE][row], f"{where}, column {SEQUENCE!r}")
        events.append(Event(node, number, float(time[row]), values, float(arrival[row])))
    return events, origin


def event_table(path: str | Path, network: Network) -> EventTable:
    """Return the events of a CSV or Parquet file as a table, as `read_messages` returns those of a bag.

    Where the network counts steps a step is a second long, so that an event is as many seconds late as steps.

    Args:
        path: the file.
        network: the network that the names belong to.

    Raises:
        ValueError: what `read_events` refuses.
    """
    events, origin = read_events(path, network)
    counts = TIME_STEP not in network.inputs
    table = EventTable(network, 1.0, 0) if counts and origin is None else EventTable(network)
    since = 0 if origin is None else int(origin.astype("datetime64[ns]").astype(np.int64))
    for event in events:
        logged = event.time if event.arrival is None else event.arrival
        time, arrival = (since + round(moment * SECOND) for moment in (event.time, logged))
        table.add(Reading("", event.node, event.sequence, time, np.asarray(event.values)), arrival)
    return table


def run_events(
    path: Path,
    network: Network,
    out: Path,
    window: float,
    lag: float | None,
    table: EventTable | None = None,
    write: Callable[[Record, Path], None] = write_estimates,
) -> tuple[Record, list[str]]:
    """Return final estimates from a file of events, and a summary in lines: verdicts, and the file of lagged estimates.

    With a lag these are written next to `out` by `write`: estimates.csv becomes estimates.lagged.csv. `table` has the
    events of the file if they were read from messages.

    Raises:
        ValueError: what `read_events` and `Timeline` refuse, a lag beyond the window.
    """
    # Events of a table, or of messages, with the date from which their times count.
    events: Iterable[Event]
    if table is None:
        events, origin = read_events(path, network)
        first = min(event.time for event in events)
    else:
        events, first = table.in_order(), 0.0
        origin = None if table.steps else table.date
    continuous = TIME_STEP in network.inputs
    start = first if continuous else 0.0  # the initial law is that of the first moment
    played = play(network, events, window, lag, start)
    # Summary: verdicts by node, what was forced, and the file of lagged estimates.
    lines = [f"{node}: " + ", ".join(f"{count} {verdict}" for verdict, count in element.items() if count)
             for node, element in played.counts.items() if any(element.values())]  # fmt: skip
    if played.forced:
        lines.append(f"{played.forced} rows became final before their time, for want of room")
    if origin is not None:
        lines.append(f"times in seconds since {np.datetime_as_string(origin, timezone='UTC')}")
    if played.lagged is not None:
        lagged_path = out.with_suffix(f".lagged{out.suffix}")
        write(played.lagged, lagged_path)
        lines.append(f"{lagged_path}: {len(played.lagged.time)} rows, each given what came {lag:g} later")
    return played.final, lines


def _header(path: Path) -> list[str]:
    if path.suffix.lower() == ".parquet":
        import pyarrow.parquet as pq

        try:
            return list(pq.ParquetFile(path).schema_arrow.names)
        except (ValueError, OSError):  # no such file: who reads it says so
            return []
    return csv_header(path)


def _columns(path: Path) -> Mapping[str, Sequence[Any]]:
    """Return the cells as they are stored: text in CSV, any type in Parquet."""
    # Parquet: text is accepted only as names, values and dates.
    if path.suffix.lower() == ".parquet":
        import pyarrow.parquet as pq

        table = pq.ParquetFile(path).read()
        results = {name: column.to_pylist() for name, column in zip(table.column_names, table.columns, strict=True)}
        for name in results.keys() - {NODE, VALUES}:
            for at, cell in enumerate(results[name], 1):
                if isinstance(cell, str) and not (name in (TIME, ARRIVAL) and looks_like_date(cell)):
                    raise fail(f"{path}, row {at}, column {name!r}", "a number", f"text, {shown(cell)}")
        return results
    # CSV: all rows must have as many cells as the header.
    with csv_lines(path) as lines:
        header, *rows = [[cell.strip() for cell in line] for line in lines]
    for number, row in enumerate(rows, 1):
        if len(row) != len(header):
            raise fail(f"{path}, row {number}", f"{len(header)} cells, one for each column", len(row))
    if not rows:
        raise fail(str(path), "at least one row", "none")
    return dict(zip(header, zip(*rows, strict=True), strict=True))


def _times(columns: Mapping[str, Sequence[object]], path: Path) -> tuple[np.ndarray, np.ndarray, np.datetime64 | None]:
    """Return times and arrivals as numbers, and the date that they are counted from if they were dates."""
    parts = [TIME, ARRIVAL] if ARRIVAL in columns else [TIME]
    first = columns[TIME][0]
    # Dates, as seconds from the first of them.
    if hasattr(first, "isoformat") or looks_like_date(str(first)):
        results = [dates(columns[column], f"{path}, column {column!r}") for column in parts]
        for column, values in zip(parts, results, strict=True):
            _refuse_missing(np.isnat(values), f"{path}, column {column!r}")
        origin: np.datetime64 = results[0].min()
        seconds = [(values - origin).astype(np.int64) / 1e9 for values in results]  # exact before they are floats
        return seconds[0], seconds[-1], origin
    # Numbers as they are.
    numbers = [
        np.array([_number(cell, f"{path}, row {row}, column {name!r}") for row, cell in enumerate(columns[name], 1)])
        for name in parts
    ]
    return numbers[0], numbers[-1], None


def _refuse_missing(missing: np.ndarray, name: str) -> None:
    if missing.any():
        raise fail(f"{name}, row {int(np.argmax(missing)) + 1}", "a date", "an empty cell")


def _received(row: Mapping[str, Any], names: Sequence[str], where: str) -> np.ndarray:
    """Return the values of one event."""
    if row.get(VALUES) not in (None, ""):
        cell = row[VALUES]
        parts = cell.replace(";", " ").split() if isinstance(cell, str) else list(np.atleast_1d(cell))
        if len(parts) != len(names):
            raise fail(f"{where}, column {VALUES!r}", f"{len(names)} numbers, {' '.join(names)}", shown(cell))
        return np.array([_number(word, f"{where}, column {VALUES!r}", empty=True) for word in parts])
    return np.array([_number(row.get(name), f"{where}, column {name!r}", empty=True) for name in names])


def _whole(cell: Any, name: str) -> int:
    """Return a count with every digit; a float is accepted if it is an exact integer."""
    try:
        count = int(cell) if isinstance(cell, str) else cell
    except ValueError:
        count = _number(cell, name)
    if isinstance(count, float) and count.is_integer() and abs(count) < EXACT:
        count = int(count)
    return whole(name, count if isinstance(count, int) else cell)


def _number(cell: Any, name: str, empty: bool = False) -> float:
    if empty and (cell is None or cell == ""):
        return np.nan
    try:
        if isinstance(cell, str) and "_" in cell:  # Python's own way to write a number, and nobody else's
            raise ValueError
        number = float(cell)
    except (TypeError, ValueError, OverflowError):
        number = np.inf
    if np.isinf(number) or (np.isnan(number) and not empty):
        raise fail(name, "a number or an empty cell" if empty else "a number", shown(cell))
    return number
