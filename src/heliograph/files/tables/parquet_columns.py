"""Rows of a Parquet file as columns, a block of rows at a time."""

from collections.abc import Container, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from heliograph.files.tables.table_rows import TableRows, convert_to_nanoseconds, convert_to_numbers
from heliograph.files.text.csv_dialects import check_distinct
from heliograph.files.text.text_file import Progress
from heliograph.numerics.check import fail

if TYPE_CHECKING:
    import pyarrow as pa


def read_parquet_blocks(
    path: Path, only: Container[str] | None, rows: int, progress: Progress | None = None
) -> Iterator[TableRows]:
    """Yield the rows of a Parquet file, a block at a time, so that a long file need not fit in memory.

    Numbers are NaN where the file has null; dates are in nanoseconds.

    Args:
        path: the file.
        only: names of the columns that are read; None for all.
        rows: largest number of rows in one block.
        progress: called with the number of rows read so far and of all rows (default none).

    Raises:
        ValueError: no Parquet file, two columns of one name, a column that holds neither numbers nor dates.
        ModuleNotFoundError: pyarrow is not installed (extra "tables").
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        # Without `pre_buffer`: that would keep what was read until the file is closed, 24 bytes a row of three columns.
        with pq.ParquetFile(path, pre_buffer=False) as file:
            check_distinct(path, file.schema_arrow.names)
            count, total = 0, file.metadata.num_rows
            # Batch by batch: `first` is the number of its first row, counted from 1.
            for batch in file.iter_batches(batch_size=rows):
                first, count = count + 1, count + batch.num_rows
                if progress is not None:
                    progress(count, total)
                yield _convert_table(pa.Table.from_batches([batch]), path, only, first)
    except pa.ArrowInvalid as error:
        raise fail(str(path), "a Parquet file", str(error).splitlines()[0]) from None


def _convert_table(table: "pa.Table", path: Path, only: Container[str] | None, first: int) -> TableRows:
    """Return the rows of a table of Arrow as numbers and dates; an empty cell is NaN, NaT, or MISSING of int64.

    Args:
        table: the table, or a part of one.
        path: its file, for errors.
        only: the columns that are read; None for all.
        first: number of its first row.
    """
    columns = {
        name: _convert_column(column, f"{path}, row {first}, column {name!r}", f"{path}, column {name!r}", first)
        for name, column in zip(table.column_names, table.columns, strict=True)
        if only is None or name in only
    }
    return TableRows(columns, np.arange(first, first + table.num_rows), [])


def _convert_column(column: "pa.ChunkedArray[Any]", where: str, name: str, first: int) -> np.ndarray:
    """Return a column of Arrow as dates, as integers (which may be too large for float64), or as other numbers.

    Decimal numbers without fraction are integers, others become the nearest doubles.

    Args:
        column: the column, or a part of it.
        where: place of its first row, for errors.
        name: place of the column, for errors.
        first: number of its first row.

    Raises:
        ValueError: it holds neither numbers nor dates.
    """
    import pyarrow as pa

    # A dictionary column stores each distinct value once, and an index in each row: expand it.
    if pa.types.is_dictionary(column.type):
        column = column.cast(column.type.value_type)
    kind = column.type
    # Dates and times.
    if pa.types.is_timestamp(kind):
        moments = np.array(column.cast(pa.timestamp(kind.unit)).to_numpy(), dtype=f"datetime64[{kind.unit}]")
        return convert_to_nanoseconds(moments, name, first)
    if pa.types.is_date(kind):
        return convert_to_nanoseconds(column.cast(pa.date32()).to_numpy(), name, first)
    # Integers keep digits that doubles would lose; decimal numbers without fraction are integers.
    if pa.types.is_integer(kind):
        return convert_integers_of_arrow(column)
    if pa.types.is_decimal(kind):
        values = column.to_pylist()
        are_integers = kind.scale <= 0 and all(value is None or abs(value) < 2**63 for value in values)
        if are_integers:
            integers = [None if value is None else int(value) for value in values]
            return convert_integers_of_arrow(pa.chunked_array([pa.array(integers, pa.int64())]))
        return np.array([np.nan if value is None else float(value) for value in values], dtype=np.float64)
    # All other numbers; a column without values (null) is NaN.
    if not (pa.types.is_null(kind) or (pa.types.is_primitive(kind) and not pa.types.is_temporal(kind))):
        raise fail(where, "numbers", f"{kind} {column[:1].to_pylist()}")
    return np.array(column.cast(pa.float64(), safe=False).to_numpy(), dtype=np.float64)


def convert_integers_of_arrow(column: "pa.ChunkedArray[Any]") -> np.ndarray:
    """Return integers of Arrow as numbers, without doubles in between: these would round large ones beside a null."""
    return convert_to_numbers(column.fill_null(0).to_numpy(), column.is_null().to_numpy())
