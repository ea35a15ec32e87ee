"""MCAP files that were cut off, as of a machine that lost its power: what is whole of them."""

import os
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

MAGIC = b"\x89MCAP0\r\n"
DATA_END, FOOTER = 0x0F, 0x02  # records that follow the data
# An end of data without a checksum, and a footer without a summary: all is then found by reading on.
ENDING = struct.pack("<BQI", DATA_END, 4, 0) + struct.pack("<BQQQI", FOOTER, 20, 0, 0, 0) + MAGIC
BLOCK = 1 << 20  # bytes copied at once


def is_cut(path: Path) -> bool:
    """Return whether a file begins as MCAP and does not end so."""
    if not path.is_file() or path.stat().st_size < 2 * len(MAGIC):
        return False
    with path.open("rb") as file:
        begins = file.read(len(MAGIC)) == MAGIC
        file.seek(-len(MAGIC), os.SEEK_END)
        return begins and file.read() != MAGIC


def whole_records(path: Path) -> int:
    """Return the number of bytes up to the end of the last record of data that is whole."""
    size, end = path.stat().st_size, len(MAGIC)
    with path.open("rb") as file:
        while end + 9 <= size:
            file.seek(end)
            kind, length = struct.unpack("<BQ", file.read(9))
            if kind in (DATA_END, FOOTER) or end + 9 + length > size:
                break
            end += 9 + length
    return end


@contextmanager
def whole_part(path: Path) -> Iterator[tuple[Path, int]]:
    """Yield a temporary copy of what is whole, ended as a file of MCAP ends, and its number of bytes of data."""
    end = whole_records(path)
    with TemporaryDirectory() as folder:
        copy = Path(folder) / path.name
        with path.open("rb") as file, copy.open("wb") as whole:
            left = end
            while left and (block := file.read(min(BLOCK, left))):
                whole.write(block)
                left -= len(block)
            whole.write(ENDING)
        yield copy, end
