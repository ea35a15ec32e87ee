"""Serialisation of a timeline: arrays in NumPy's own format, under a head of JSON."""

import json
from collections.abc import Mapping, Sequence
from io import BytesIO
from typing import Any
from zipfile import BadZipFile

import numpy as np

from heliograph.live.rows import HeldRow, Key
from heliograph.numerics.check import fail, shown

HEAD = "head"


def packed(head: Mapping[str, object], arrays: Mapping[str, np.ndarray]) -> bytes:
    """Serialise a head and arrays."""
    file = BytesIO()
    written = np.frombuffer(json.dumps(head).encode(), dtype=np.uint8)
    np.savez(file, allow_pickle=False, **{HEAD: written, **arrays})
    return file.getvalue()


def unpacked(data: bytes) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Read a head and arrays."""
    try:
        with np.load(BytesIO(data), allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        return json.loads(arrays.pop(HEAD).tobytes()), arrays
    except (BadZipFile, ValueError, KeyError, OSError, EOFError, TypeError):
        raise fail("snapshot", "what save returned", shown(data)) from None


def row_arrays(rows: Sequence[HeldRow]) -> dict[str, np.ndarray]:
    """Return keys of rows, and their events as arrays: row, name, values one after another."""
    events = [(i, *name, values) for i, row in enumerate(rows) for name, values in row.events.items()]
    return {
        "row.time": np.array([row.key[0] for row in rows]),
        "row.name": np.array([row.key[1:] for row in rows], dtype=np.int64),
        "event.name": np.array([event[:3] for event in events], dtype=np.int64).reshape(-1, 3),
        "event.time": np.array([event[3] for event in events]),
        "event.values": np.concatenate([np.zeros(0), *(event[4] for event in events)]),
    }


def rows_from(arrays: Mapping[str, np.ndarray], numbers: np.ndarray, sizes: Mapping[int, int]) -> list[HeldRow]:
    """Restore rows in consecutive slots, from the `numbers` of each and the `sizes` of the values by node."""
    rows = []
    for i, (time, (place, sequence)) in enumerate(zip(arrays["row.time"], arrays["row.name"], strict=True)):
        key: Key = (float(time), int(place), int(sequence))
        rows.append(HeldRow(key, i, numbers.shape[1] - 1))
        rows[-1].numbers[:] = numbers[i]
    begin = 0
    for (i, place, sequence), time in zip(arrays["event.name"].tolist(), arrays["event.time"].tolist(), strict=True):
        values = arrays["event.values"][begin : begin + sizes[place]]
        begin += sizes[place]
        rows[i].events[place, sequence, time] = values
    return rows
