"""Bytes of the structs of C in which a device holds an estimate."""

from collections.abc import Sequence
from typing import NamedTuple

BYTES = {"double": 8, "float": 4, "unsigned char": 1, "int32_t": 4, "uint32_t": 4, "int64_t": 8, "uint64_t": 8}


class StructLayout(NamedTuple):
    """Bytes of a type of C, and of which number its address is a multiple."""

    size: int
    alignment: int


def lay_out_array(type: str, count: int) -> StructLayout:
    """Return the layout of an array of numbers."""
    return StructLayout(BYTES[type] * count, BYTES[type])


def lay_out_struct(parts: Sequence[StructLayout]) -> StructLayout:
    """Return size and alignment, in bytes, of a struct of C with these parts.

    Each part begins at a multiple of its alignment; the whole is filled up to a multiple of the largest of them.
    """

    def round_up(total: int, alignment: int) -> int:
        """Return the next multiple of `alignment`."""
        return -(-total // alignment) * alignment

    total, largest = 0, max(part.alignment for part in parts)
    for part in parts:
        total = round_up(total, part.alignment) + part.size
    return StructLayout(round_up(total, largest), largest)
