"""Arrays of equal rows in the memory of a few of them, which the system shows again and again until they are written.

A filter's covariances stand still over most rows of a long recording: a million matrices of four states are 128 MB,
which take 25 ms to write and 0.8 to map. The array is NumPy's as any other: contiguous, to be read and written; the
system copies a page of it, for it alone, when it is first written to, and what is written is seen nowhere else.
"""

import ctypes
import math
import mmap
import os
from functools import cache
from typing import Any
from weakref import WeakSet

import numpy as np

LEAST = 1 << 20  # bytes of an array below which it is filled: by then that takes as long
PIECE = 1 << 17  # bytes that are filled and mapped again, at least
PIECES = 32  # of an array at most: the system holds 65,530 for a process
MOST = 512  # arrays that are held at once, of a process

_held: "WeakSet[mmap.mmap]" = WeakSet()  # memory of the arrays that live, counted since pieces are the system's to give


def repeat_row(row: np.ndarray, count: int) -> np.ndarray:
    """Return an array (count, ...) of equal rows, which can be read and written like any other.

    If it has LEAST bytes or more and the system can, it is the same memory mapped again and again, until it is written.

    Args:
        row: the row (...).
        count: how many there are.
    """
    rows = _map_rows(row, count) if row.nbytes * count >= LEAST else None
    if rows is None:  # too small, or the system cannot
        rows = np.empty((count, *row.shape), row.dtype)
        rows[...] = row
    return rows


def _map_rows(row: np.ndarray, count: int) -> np.ndarray | None:
    """Return `count` equal rows, of which only a piece is in memory, mapped again and again; None where that fails.

    A long recording has many equal covariances. The file below lies in memory; the system shows it at every address of
    the array, and copies a page of it only when the page is written to. It fails where the system has no such mapping,
    and is not tried where little memory would be saved.

    Args:
        row: the row, of any shape.
        count: number of rows.
    """
    map_memory, size = _find_system_call(), row.nbytes * count
    # A piece: whole rows in whole pages, at least PIECE bytes, and so long that at most PIECES of them are mapped.
    unit = math.lcm(row.nbytes, mmap.PAGESIZE)
    piece = unit * max(-(-PIECE // unit), -(-size // (unit * PIECES)))  # in bytes; -(-a // b) is a / b rounded up
    saves_little = size < 4 * piece
    if map_memory is None or saves_little or len(_held) >= MOST:
        return None
    try:
        file = os.memfd_create("heliograph-rows", os.MFD_CLOEXEC)
    except OSError:  # no such files here
        return None
    try:
        _fill_file(file, piece, row)
        # Reserve addresses for all rows, given back when the last view of them is gone; then put the piece there again
        # and again, the last time in part.
        addresses = mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE)
        rows: np.ndarray = np.frombuffer(addresses, row.dtype).reshape(count, *row.shape)
        start, read_and_write = rows.ctypes.data, mmap.PROT_READ | mmap.PROT_WRITE
        for offset in range(0, size, piece):
            length, target = min(piece, size - offset), start + offset
            if map_memory(target, length, read_and_write, mmap.MAP_PRIVATE | MAP_FIXED, file, 0) != target:
                return None
    except OSError:  # no memory for it
        return None
    finally:
        os.close(file)
    _held.add(addresses)  # counted, since a process may have only so many mapped pieces
    return rows


def _fill_file(file: int, size: int, row: np.ndarray) -> None:
    """Fill a file (by its descriptor) of `size` bytes with copies of a row; `size` is a multiple of the row's."""
    os.ftruncate(file, size)
    with mmap.mmap(file, size) as memory:
        values: np.ndarray = np.frombuffer(memory, row.dtype).reshape(-1, *row.shape)
        values[...] = row
        del values  # the memory cannot be closed while a view of it is left


MAP_FIXED = 0x10  # of Linux: at this address, in the place of what is mapped there


@cache
def _find_system_call() -> Any:
    """Return the system's function mmap(address, length, protection, flags, file, offset), or None if it is not Linux.

    It maps the bytes of a file into memory.
    """
    if not hasattr(os, "memfd_create"):
        return None
    call = ctypes.CDLL(None, use_errno=True).mmap
    call.restype = ctypes.c_void_p
    call.argtypes = [ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int, ctypes.c_int, ctypes.c_int, ctypes.c_int64]
    return call
