"""Answers of InfluxDB as the columns of one table: of InfluxQL and SQL in JSON, of Flux in annotated CSV."""

import csv
import json
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np

from heliograph.files.stores.store_address import StoreAddress
from heliograph.numerics.check import InputError, fail

SAID = 200  # characters of what a server says
Answer = tuple[str, dict[str, Any]]  # the measurement's name and its columns: lists, and `time` as datetime64[ns]
Row = Mapping[str, Any]


def parse_influxql_response(address: StoreAddress, answer: bytes) -> Answer:
    """Return the table of an answer to InfluxQL; several series, as of GROUP BY, become one, with tags as columns.

    Args:
        address: the store that was asked, for errors and for the name of the table.
        answer: the answer of the server, in JSON.

    Returns:
        The name of the measurement (InfluxDB's table), and its columns.

    Raises:
        ValueError: no answer of InfluxDB, a refusal, only a part of the rows, or no rows; one line.
    """
    try:
        results = json.loads(answer)["results"]  # one for each statement
    except (ValueError, KeyError, TypeError):
        raise fail(str(address), "an answer of InfluxDB in JSON", repr(answer[:40])) from None
    refusal = next((result["error"] for result in results if "error" in result), None)
    if refusal is not None:
        raise fail(str(address), "a query that it answers", shorten_answer(str(refusal)))
    # A series has a name, tags that all its rows share, names of columns, and rows of values.
    all_series = [series for result in results for series in result.get("series", ())]
    if any(part.get("partial") for part in (*results, *all_series)):
        raise fail(str(address), "all rows of the query", "a part of them, as the server limits their number")
    rows = [
        _join_row_with_tags(address, series.get("tags", {}), dict(zip(series["columns"], values, strict=True)))
        for series in all_series
        for values in series["values"]
    ]
    names = [name for series in all_series for name in (*series["columns"], *series.get("tags", {}))]
    measurement = str(all_series[0].get("name", address.table)) if all_series else ""
    # Each series is in order of time by itself.
    is_unsorted = len(all_series) > 1
    return measurement, _make_columns(address, names, rows, read_time=lambda time: int(time), sorts=is_unsorted)


def parse_sql_response(address: StoreAddress, answer: bytes) -> Answer:
    """Return the database's name and the table in an answer of InfluxDB 3 to SQL, a JSON list of objects, one a row.

    Raises:
        ValueError: the answer has another form or no rows.
    """
    try:
        rows = json.loads(answer)
    except ValueError:
        rows = None
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        raise fail(str(address), "rows of InfluxDB 3 in JSON", repr(answer[:40]))
    names = [name for row in rows for name in row]
    return address.database, _make_columns(address, names, rows, read_time=_read_moment, sorts=False)


def parse_flux_response(address: StoreAddress, answer: bytes) -> Answer:
    """Return the measurement's name and the table in an answer to Flux, which consists of tables in CSV.

    Each row of the answer has one field's value at one time. Values of one measurement, one time and the same tags
    are joined to one row, as `pivot` in the query would do. `_time` holds the time and `_measurement` the name. The
    columns `result`, `table`, `_start` and `_stop` are left out.

    Raises:
        ValueError: the answer has another form, an error in it, or no rows.
    """
    try:
        measurement, rows = _join_flux_rows(address, _yield_flux_rows(answer.decode()))
    except InputError:
        raise
    except (ValueError, KeyError, csv.Error):
        raise fail(str(address), "tables of InfluxDB in annotated CSV", repr(answer[:40])) from None
    names = [name for row in rows for name in row]
    return measurement or address.database, _make_columns(address, names, rows, read_time=_read_moment, sorts=True)


def _join_flux_rows(address: StoreAddress, rows: Iterable[dict[str, Any]]) -> tuple[str, list[dict[str, Any]]]:
    """Return the name of the first measurement among rows of Flux, and the rows, values of one time and tags joined.

    Flux is the query language of InfluxDB. It answers with a row for each number: `_time`, `_field` (name), `_value`,
    `_measurement` and tags. A row of the result has all fields of one time, measurement and tags.

    Args:
        address: address of the store, for errors.
        rows: rows as {column: value}; columns are taken out of them.

    Raises:
        ValueError: an error in the place of a row; a tag with the name of a field; two values of a field at one time.
    """
    joined: dict[tuple[object, ...], dict[str, Any]] = {}  # rows of the result, by what their fields have in common
    first_measurement = ""
    for number, row in enumerate(rows):
        # A row may report an error of the query.
        if "error" in row:
            raise fail(str(address), "a query that it answers", shorten_answer(str(row["error"])))
        # Take out the columns that only Flux needs, and name the time "time".
        measurement = str(row.pop("_measurement", ""))
        first_measurement = first_measurement or measurement
        for name in ("result", "table", "_start", "_stop"):
            row.pop(name, None)
        if "_time" in row:
            row["time"] = row.pop("_time")
        if "_field" not in row or "_value" not in row:  # pivoted, or columns of a query's own: a row by itself
            joined[(number,)] = row
            continue
        # What remains in `row` are the time and the tags, which all fields of one row of the result share.
        name, value = str(row.pop("_field")), row.pop("_value")
        key = (measurement, *sorted(row.items()))
        fields = joined.setdefault(key, row.copy())
        # The field has another value at this time already. (A tag of the same name is refused below.)
        if name in fields and name not in row and fields[name] != value:
            remedy = "a query that yields several results, such as a mean and a maximum, sets _field of each"
            raise fail(
                str(address), f"one value of a field at a time ({remedy})", f"two of {name!r} at {row.get('time')}"
            )
        fields |= _join_row_with_tags(address, row, {name: value})
    return first_measurement, list(joined.values())


def _join_row_with_tags(address: StoreAddress, tags: Row, columns: Row) -> dict[str, Any]:
    """Return {**tags, **columns}: a row's columns with its tags (names and texts that InfluxDB gives a whole series).

    `address`: the store, for errors.

    Raises:
        ValueError: a tag and a column have the same name and different values, so that one would be lost.
    """
    shared_name = next((name for name in tags if name in columns and tags[name] != columns[name]), None)
    if shared_name is not None:
        remedy = f"AS in the query, or rename() of Flux, gives {shared_name!r} another"
        raise fail(str(address), f"tags and columns of different names ({remedy})", f"{shared_name!r} for both")
    return {**tags, **columns}


def _yield_flux_rows(text: str) -> Iterable[dict[str, Any]]:
    """Yield the rows of all tables by name of the column, with values of the columns' types; empty ones are None.

    A table has a line of types, one of names, its rows, and then an empty line. READ maps a type to the function that
    reads its cells.
    """
    types: list[str] = []
    names: list[str] = []  # of the columns of this table; [] until they come
    for cells in csv.reader(text.splitlines()):
        if not any(cells):
            names = []
        elif cells[0] == "#datatype":
            types, names = cells, []
        elif cells[0].startswith("#"):  # another annotation
            continue
        elif not names:
            names = cells
        else:
            # Without types, as of an error, cells are texts.
            types_of_row = types if len(types) == len(names) else [""] * len(names)
            yield {
                name: None if cell == "" else READ.get(type_, str)(cell)
                for name, type_, cell in zip(names, types_of_row, cells, strict=True)
                if name  # the first column has annotations alone
            }


# What reads a cell, by the type of its column; others are texts.
READ: dict[str, Callable[[str], Any]] = {
    "double": float,
    "long": int,
    "unsignedLong": int,
    "boolean": lambda cell: cell == "true",
}


def _read_moment(time: object) -> int:
    """Return a date in UTC, such as 2026-11-29T10:00:00.123456789Z, in nanoseconds since 1970."""
    return int(np.datetime64(str(time).removesuffix("Z"), "ns").astype(np.int64))


def _make_columns(
    address: StoreAddress, names: Iterable[str], rows: list[Any], read_time: Callable[[Any], int], sorts: bool
) -> dict[str, Any]:
    """Return rows as the columns of one table.

    Args:
        address: the store that the rows came from, for errors.
        names: names of the columns, which may repeat.
        rows: the rows, each a mapping from the name of a column to its value.
        read_time: converts a time as it stands in a row to nanoseconds since 1970.
        sorts: whether rows are of several series, one after another, and must be put in the order of time.
    """
    if not rows:
        raise fail(str(address), "a query with rows", "none")
    known = list(dict.fromkeys(names))
    if "time" not in known:
        raise fail(str(address), "a query that returns time", f"the columns {', '.join(known)}")
    try:
        moments = np.array([read_time(row["time"]) for row in rows], dtype=np.int64)
    except (KeyError, ValueError, TypeError):
        raise fail(str(address), "a time in each row", "one that is none") from None
    order = np.argsort(moments, kind="stable") if sorts else np.arange(len(rows))
    columns: dict[str, Any] = {name: [rows[i].get(name) for i in order] for name in known}
    columns["time"] = moments[order].view("datetime64[ns]")
    return columns


def shorten_answer(answer: str) -> str:
    """Return what a server says as one line of at most SAID (200) characters, and "..." if there were more."""
    line = " ".join(answer.split())
    return line if len(line) <= SAID else f"{line[:SAID]}..."
