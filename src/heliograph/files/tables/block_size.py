"""How much of a long table is in memory at a time; it loads nothing, so that commands can name it in their help."""

from typing import NamedTuple


class BlockSize(NamedTuple):
    """How much of a table is read at a time: rows of Parquet, bytes of text."""

    rows: int = 1 << 17
    bytes: int = 1 << 22


USUAL_BLOCK = BlockSize()
