"""Tables of a service's store, and the checksum of each of their rows."""

from collections.abc import Sequence
from typing import Any
from zlib import crc32

from sqlalchemy import BigInteger, Column, Connection, LargeBinary, MetaData, String, Table, Text, select

# Of these tables: those of layout 1 had no checksums, of 2 no description of the network, of 3 covariances in states,
# of 4 the parts of a state's Gaussian beside its others.
LAYOUT, CARRIED = "5", ("3", "4", "5")  # that of now, and those whose plants can be carried over
# Key of the layout in a store's identity.
LAYOUT_KEY = "layout of the store"
AT_ONCE = 500  # rows that are asked for at once
TABLES = MetaData()
PLANTS = Table("plants", TABLES, Column("name", String(200), primary_key=True), Column("version", BigInteger),
               Column("body", LargeBinary), Column("checksum", BigInteger))  # fmt: skip
JOURNAL = Table("journal", TABLES, Column("last", BigInteger, primary_key=True, autoincrement=False),
                Column("process", String(200)), Column("lines", Text), Column("checksum", BigInteger))  # fmt: skip
NUMBERS = Table("numbers", TABLES, Column("name", String(220), primary_key=True), Column("value", BigInteger),
                Column("checksum", BigInteger))  # fmt: skip
IDENTITY_TABLE = Table("whose", TABLES, Column("name", String(20), primary_key=True), Column("value", Text))


def checksum(name: str | int, *values: str | int | bytes) -> int:
    """Return the CRC-32 of a row's name in the upper 31 of 63 bits, and of the name and all columns in the lower 32.

    So it can be told whether the name of a damaged row is still right.
    """
    return (crc32(f"{name}".encode()) >> 1) << 32 | _checksum_row(name, values)


def is_row_undamaged(written: object, name: object, *values: object) -> bool:
    """Return whether a row matches its stored checksum `written`; a damaged row may contain anything."""
    if not isinstance(name, str | int) or not all(isinstance(value, str | int | bytes) for value in values):
        return False
    return written == checksum(name, *values)  # type: ignore[arg-type]  # checked above


def is_name_undamaged(written: object, name: object) -> bool:
    """Return whether the name of a row is as it was written, whatever became of its values."""
    return isinstance(name, str) and isinstance(written, int) and written >> 32 == crc32(name.encode()) >> 1


def _checksum_row(name: str | int, values: Sequence[str | int | bytes]) -> int:
    """Return the CRC-32 of a row's name and values; each value's length stands before it, to mark where it begins."""
    checksum = crc32(f"{name}".encode())
    for value in values:
        data = value if isinstance(value, bytes) else f"{value}".encode()
        checksum = crc32(data, crc32(f"\0{len(data)}\0".encode(), checksum))
    return checksum


def add_checksum(table: Table, *values: Any) -> dict[str, object]:
    """Return {column: value} of a row with these values in the table's order, and with its checksum as the last."""
    columns = [column.name for column in table.c]
    return dict(zip(columns, (*values, checksum(*values)), strict=True))


def select_plants(connection: Connection, columns: Sequence[Column[object]], names: list[str]) -> list[Any]:
    """Return the stored plants of these names as rows with these columns; names that are not stored have no row.

    The names are asked for in queries of AT_ONCE (500) names, since databases bound the length of a query.
    """
    results: list[Any] = []
    for i in range(0, len(names), AT_ONCE):
        results += connection.execute(select(*columns).where(PLANTS.c.name.in_(names[i : i + AT_ONCE]))).all()
    return results
