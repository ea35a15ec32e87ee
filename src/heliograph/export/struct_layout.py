"""Bytes of the structs of C in which a device holds an estimate."""

from collections.abc import Sequence
from math import ceil
from typing import NamedTuple

BYTES = {"double": 8, "float": 4, "unsigned char": 1, "int32_t": 4, "uint32_t": 4, "int64_t": 8, "uint64_t": 8}


class StructLayout(NamedTuple):
    """Size of a type of C in bytes, and the number of bytes that its address is a multiple of."""

    size: int
    alignment: int


def lay_out_array(type: str, count: int) -> StructLayout:
    """Return the layout of an array of `count` numbers of a C type, such as "double"."""
    return StructLayout(BYTES[type] * count, BYTES[type])


def lay_out_struct(parts: Sequence[StructLayout]) -> StructLayout:
    """Return size and alignment, in bytes, of a struct of C with these parts.

    Each part begins at a multiple of its alignment. The whole is filled up to a multiple of the largest alignment.
    """

    def round_up(size: int, alignment: int) -> int:
        """Return the least multiple of `alignment` that is not below a size."""
        return ceil(size / alignment) * alignment

    size, largest_alignment = 0, max(part.alignment for part in parts)
    for part in parts:
        begin = round_up(size, part.alignment)
        size = begin + part.size
    return StructLayout(round_up(size, largest_alignment), largest_alignment)
