"""Tables of stores: what came for a query, as columns and as messages; estimates written."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import date
from decimal import Decimal
from typing import Any

import numpy as np

from heliograph.files.estimates.estimates_table import estimate_columns
from heliograph.files.messages.message_files import FileMessage, make_message_of_row
from heliograph.files.stores.store_address import INFLUX, StoreAddress, parse_store
from heliograph.files.tables.table import TIME, convert_to_columns
from heliograph.files.tables.table_rows import TableRows
from heliograph.numerics.check import fail, instance, text
from heliograph.numerics.process.optional_packages import check_installed
from heliograph.simulation.results.record import Record

DIGITS = 15  # of a decimal number, which a double gives back


@dataclass(frozen=True)
class StoreTable:
    """The rows that a store returned for a query; `str` of it is the address.

    Attributes:
        address: where it came from.
        topic: topic of rows without a column `topic`: the measurement's name, or the database's.
        columns: columns of equal length, by name.
    """

    address: StoreAddress
    topic: str
    columns: Mapping[str, Any]

    def __str__(self) -> str:
        """Return the address without secrets, by which errors name the table."""
        return str(self.address)

    def rows(self, only: Mapping[str, str] | None) -> TableRows:
        """Return the table as columns of numbers and dates, with rows numbered from 1.

        `only`: the columns that are read, as keys; None for all.

        Raises:
            ValueError: a column holds text.
        """
        columns = convert_to_columns(self.columns, str(self), only)
        count = len(next(iter(self.columns.values()), ()))
        return TableRows(columns, np.arange(1, count + 1), [])

    def messages(self) -> Iterator[FileMessage]:
        """Yield each row as a message, with dates as text of ISO 8601."""
        names = list(self.columns)
        for number, cells in enumerate(zip(*self.columns.values(), strict=True), 1):
            row = {name: _convert_cell(cell) for name, cell in zip(names, cells, strict=True)}
            yield make_message_of_row(f"{self}, row {number}", row)


def _convert_cell(cell: object) -> object:
    """Return a cell as a message in JSON would have it: dates as text, short decimal numbers as floats.

    Short are DIGITS (15), which a double gives back.
    """
    if isinstance(cell, np.datetime64):
        return f"{cell}Z"
    if isinstance(cell, date):  # `datetime` is a `date`, too
        return cell.isoformat()
    if isinstance(cell, Decimal) and len(cell.as_tuple().digits) <= DIGITS:
        return float(cell)
    return cell


def query_store(address: StoreAddress) -> StoreTable:
    """Return the rows of a store's query or table.

    The reader of the store's kind returns the name of the measurement or database, and the columns.

    Raises:
        ValueError: the server does not answer or refuses, there are no rows, or the URL has neither query nor table.
        ModuleNotFoundError: PostgreSQL without psycopg (extra "postgres").
    """
    if not address.query and not address.table:
        raise fail(str(address), "?query=SELECT... or ?table=NAME behind it", "neither")
    if address.kind in INFLUX:
        from heliograph.files.stores.influx import query_influx as ask
    else:
        check_installed(["psycopg"])
        from heliograph.files.stores.postgres import query_postgres as ask
    return StoreTable(address, *ask(address))


def check_store(address: StoreAddress) -> None:
    """Raise an error now if writing to a store would fail at once.

    Raises:
        ValueError: the server does not answer, or the URL has a query.
        ModuleNotFoundError: PostgreSQL without psycopg (extra "postgres").
    """
    if address.query:
        raise fail(str(address), "the table to write, ?table=NAME", "a query")
    if address.kind in INFLUX:
        from heliograph.files.stores.influx import check_influx as check
    else:
        check_installed(["psycopg"])
        from heliograph.files.stores.postgres import check_postgres as check
    check(address)


def write_columns_to_store(
    address: StoreAddress, columns: Mapping[str, np.ndarray], plant: str, origin: np.datetime64 | None
) -> None:
    """Write the columns of estimates to a table of InfluxDB or PostgreSQL.

    Args:
        address: the store, and the table.
        columns: the columns by name, (rows,) each; one of them is `time`.
        plant: name of the plant, "" of a single one.
        origin: date from which times count in seconds, to make dates of them; None to write times as they are.

    Raises:
        ValueError: InfluxDB would get times that are numbers; the server does not answer or refuses; one line.
    """
    dated = dict(columns)
    if origin is not None and dated[TIME].dtype.kind != "M":
        dated[TIME] = origin.astype("datetime64[ns]") + np.round(1e9 * dated[TIME]).astype("timedelta64[ns]")
    if address.kind in INFLUX:
        from heliograph.files.stores.influx import write_influx

        moments = dated.pop(TIME)
        if moments.dtype.kind != "M":
            raise fail(str(address), "times that are dates", f"the number {moments[0]:g}")
        write_influx(address, dated, moments.astype("datetime64[ns]"), plant)
        return
    from heliograph.files.stores.postgres import write_postgres

    write_postgres(address, dated, plant)


def read_store(url: str) -> dict[str, np.ndarray]:
    """Read a table of InfluxDB or PostgreSQL: the rows of a query, or of a whole table.

    The scheme of the URL chooses server and transport, what follows `?` says what is read:

    - `influx://host:8086/database?query=SELECT ...` asks InfluxDB in InfluxQL, over HTTP; `influxs://` over TLS
    - `influx://host/database?org=NAME&flux=from(...` asks version 2 in Flux, `?sql=SELECT ...` version 3 in SQL
    - `postgresql://user@host/database?query=SELECT ...` asks in SQL, in a transaction that only reads
    - `?table=NAME` in place of a statement reads all of a table, or of a measurement of InfluxDB

    Versions 1, 2 (where a bucket is the database) and 3 of InfluxDB answer to InfluxQL.

    The statement goes to the end of the URL, & included; a % in it is written %25. User and password of InfluxDB, or a
    token alone as password, stand in the URL or in HELIOGRAPH_STORE_USER and HELIOGRAPH_STORE_PASSWORD; those of
    PostgreSQL may also stand where libpq looks.

    Args:
        url: kind of the store, server, database, and the statement or the table that is read.

    Returns:
        Columns by name, each of shape (rows,): numbers as float64, NaN where there is none; dates as datetime64[ns] in
        UTC. `read_recording` takes them.

    Raises:
        ValueError: the server is away or refuses, no rows, no `time` in InfluxDB's answer, a column of text. One line.
        ModuleNotFoundError: PostgreSQL without psycopg (extra "postgres").
    """
    return query_store(parse_store(url)).rows(only=None).columns


def store_estimates(record: Record, url: str, plant: str = "", origin: np.datetime64 | None = None) -> None:
    """Write the estimates of a run to a table of InfluxDB or PostgreSQL: the columns of `write_estimates`.

    Rows of the same times and plant are replaced, so that a call can be repeated. PostgreSQL gets all rows in one
    transaction. Its table is made if it is missing, with the columns `plant`, `time` (to the microsecond) and those of
    the estimates. InfluxDB gets points whose tag is the plant, in requests of four megabytes.

    Args:
        record: the result of `run`.
        url: as for `read_store`, with `?table=NAME`; the table is "estimates" by default.
        plant: name of the plant; "" by default.
        origin: date of time 0 if the record's times are seconds since then; None by default.

    Raises:
        ValueError: the server does not answer or refuses, InfluxDB would get times without dates, or the URL has a
            query.
        ModuleNotFoundError: PostgreSQL without psycopg (extra "postgres").
    """
    instance("record", record, Record, "a Record")
    text("plant", plant)
    if origin is not None:
        instance("origin", origin, np.datetime64, "a numpy.datetime64")
    address = parse_store(url)
    check_store(address)
    write_columns_to_store(address, estimate_columns(record), plant, origin)
