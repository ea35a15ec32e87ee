"""PostgreSQL, and so TimescaleDB: the rows of a query in, a table of estimates out, in one transaction."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import psycopg
from psycopg import sql

from heliograph.files.stores.store_address import StoreAddress
from heliograph.numerics.check import InputError, fail

LONGEST = 63  # bytes of a column's name; what is longer would be cut
PLANT, TIME = "plant", "time"
# {kind of a NumPy type: type of the column}. Integers are too large for doubles, such as nanoseconds.
TYPES = {"b": "boolean", "f": "double precision", "M": "timestamptz", "i": "bigint", "u": "numeric"}


def query_postgres(address: StoreAddress) -> tuple[str, dict[str, Any]]:
    """Return the database's name and the columns of a table as lists, read in a transaction that can only read.

    `address` names the server, the database, and either a statement (`query`) or a table, which is read in the order of
    its column `time`. Times come in UTC.

    Raises:
        ValueError: the server is away or refuses; no rows; a name twice. One line.
    """
    # The address's statement, or else all of its table.
    table = sql.SQL("SELECT * FROM {} ORDER BY time").format(sql.Identifier(*address.table.split(".")))
    query: Any = address.query.encode() or table
    try:
        with psycopg.connect(address.url) as connection:
            connection.read_only = True
            connection.execute("SET TIME ZONE 'UTC'")
            cursor = connection.execute(query)
            if cursor.description is None:
                raise fail(str(address), "a query that returns rows", "one that returns none")
            names = [column.name for column in cursor.description]
            rows = cursor.fetchall()
    except (psycopg.Error, OverflowError) as error:  # a date that Python has not
        raise _explain_error(address, error) from None
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise fail(str(address), "columns of different names", f"{twice!r} more than once")
    if not rows:
        raise fail(str(address), "a query with rows", "none")
    return address.database, {name: [row[i] for row in rows] for i, name in enumerate(names)}


def write_postgres(address: StoreAddress, columns: Mapping[str, np.ndarray], plant: str) -> None:
    """Write rows to a table; it is made if it is missing, and its rows of the same times and plant are replaced.

    The table has the columns `plant` (text) and `time` (timestamptz, or numbers), and the other `columns`. Rows of this
    plant from the first to the last of the times are deleted first, so that a repeated call changes nothing. All or
    nothing is written. LONGEST is 63 bytes, beyond which PostgreSQL cuts names; TYPES maps NumPy's kinds to types of
    columns.

    Args:
        address: the store, and the table.
        columns: the rows by column, (rows,) each; one of them is `time`.
        plant: name of the plant, "" of a single one.

    Raises:
        ValueError: the server is away or refuses, a table of other columns, a name that is too long; one line.
    """
    too_long = next((name for name in columns if len(name.encode()) > LONGEST), None)
    if too_long is not None:
        raise fail(str(address), f"columns whose names have at most {LONGEST} bytes", repr(too_long))
    # The parts of the statements: the table, each column with its type, all their names.
    table = sql.Identifier(*address.table_for_estimates.split("."))
    typed = [
        sql.SQL("{} {}").format(sql.Identifier(name), sql.SQL(TYPES[column.dtype.kind]))
        for name, column in columns.items()
    ]
    names = sql.SQL(", ").join(map(sql.Identifier, (PLANT, *columns)))
    cells = [_convert_cells(column) for column in columns.values()]
    times = _convert_cells(np.sort(columns[TIME]))
    try:
        # One transaction, which an error takes back as a whole: make the table, delete this plant's rows, copy the new.
        with psycopg.connect(address.url) as connection:
            make = sql.SQL("CREATE TABLE IF NOT EXISTS {} (plant text NOT NULL, {})")
            connection.execute(make.format(table, sql.SQL(", ").join(typed)))
            remove = sql.SQL("DELETE FROM {} WHERE plant = %s AND time BETWEEN %s AND %s").format(table)
            connection.execute(remove, (plant, times[0], times[-1]))
            with connection.cursor().copy(sql.SQL("COPY {} ({}) FROM STDIN").format(table, names)) as copy:
                for row in zip(*cells, strict=True):
                    copy.write_row((plant, *row))
    except psycopg.Error as error:
        raise _explain_error(address, error) from None


def check_postgres(address: StoreAddress) -> None:
    """Raise ValueError if no server answers at the address, or if it refuses this user."""
    try:
        psycopg.connect(address.url, connect_timeout=10).close()
    except psycopg.Error as error:
        raise _explain_error(address, error) from None


def _convert_cells(column: np.ndarray) -> list[Any]:
    """Return the cells of a column as the server reads them: dates to the microsecond, and None (NULL) for NaN."""
    if column.dtype.kind == "M":
        moments = np.datetime_as_string(column.astype("datetime64[us]")).tolist()
        return [f"{moment}Z" for moment in moments]
    return [None if value != value else value for value in column.tolist()]  # only NaN differs from itself


def _explain_error(address: StoreAddress, error: Exception) -> InputError:
    """Return a one-line error with the first line of the server's message.

    It says whether the server did not answer, or refused what it got.
    """
    first_line = next((line.strip() for line in str(error).splitlines() if line.strip()), type(error).__name__)
    has_no_answer = isinstance(error, psycopg.OperationalError)
    expected = "a server that answers" if has_no_answer else "what the server accepts"
    return fail(str(address), expected, first_line)
