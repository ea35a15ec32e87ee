"""Serialisation of a plant as bytes, which restore the same bits."""

import json
import math
import struct
from collections.abc import Sequence
from datetime import datetime
from typing import Any, NamedTuple

import numpy as np

from heliograph.live.fleet import Fleet
from heliograph.live.plant import Leap, Link, Plant
from heliograph.live.rows import HeldRow

HEAD = struct.Struct("<4q")  # lengths: of the head in bytes, of rows, of events, of their values
TYPES = ("<i8", "<i8", "<f8", "<f8", "<f8")  # of the parts after the head


class PlantParts(NamedTuple):
    """Parts of a plant's bytes, in their order: a head of JSON, integers, then doubles.

    Shapes: keys (rows, 2), the node and step number of each row; events (events, 3), their row, node and count; table
    (rows, width); times (events,) and values (numbers,) of the events.
    """

    head: dict[str, Any]
    keys: np.ndarray
    events: np.ndarray
    table: np.ndarray
    times: np.ndarray
    values: np.ndarray

    def to_bytes(self) -> bytes:
        """Serialise: lengths of the parts, then the parts."""
        return _joined(self.head, *(array.ravel() for array in self[1:]))

    @staticmethod
    def of(data: bytes, width: int) -> "PlantParts":
        """Read bytes, of rows with so many numbers."""
        length, rows, events, numbers = HEAD.unpack_from(data)
        at, arrays = HEAD.size + length, []
        shapes = ((rows, 2), (events, 3), (rows, width), (events,), (numbers,))
        for kind, shape in zip(TYPES, shapes, strict=True):
            arrays.append(np.frombuffer(data, kind, math.prod(shape), at).reshape(shape))
            at += arrays[-1].nbytes
        return PlantParts(json.loads(data[HEAD.size : HEAD.size + length]), *arrays)


def plant_bytes(plant: Plant, fleet: Fleet) -> bytes:
    """Serialise a plant that has no pending changes."""
    rows = plant.rows.held
    origin = None if plant.origin is None else plant.origin.isoformat()
    links = {node: list(vars(link).values()) for node, link in plant.links.items()}
    names = [(i, *name) for i, row in enumerate(rows) for name in row.events]
    return _joined(
        {"now": plant.now, "forced": plant.forced, "origin": origin, "links": links, "leap": plant.leap},
        [number for row in rows for number in row.key[1:]],
        [number for i, node, sequence, _ in names for number in (i, node, sequence)],
        fleet.pool.table[[row.slot for row in rows]].ravel(),
        [time for *_, time in names],
        [value for row in rows for values in row.events.values() for value in values],
    )


def _joined(head: dict[str, Any], *flat: Sequence[float] | np.ndarray) -> bytes:
    """Serialise the head and the flat parts of a plant behind their lengths."""
    text = json.dumps(head).encode()
    counts = len(flat[0]) // 2, len(flat[1]) // 3, len(flat[4])
    numbers = [np.array(a, dtype=kind).tobytes() for a, kind in zip(flat, TYPES, strict=True)]
    return b"".join([HEAD.pack(len(text), *counts), text, *numbers])


def plant_from(name: str, data: bytes, fleet: Fleet) -> Plant:
    """Restore a plant from bytes, with its rows in slots of the fleet's table."""
    head, keys, events, table, times, values = PlantParts.of(data, fleet.pool.table.shape[1])
    # Rows, each in a new slot; then their events.
    rows = [_row(fleet, numbers, *key) for numbers, key in zip(table, keys.tolist(), strict=True)]
    begin = 0
    for time, (i, node, sequence) in zip(times.tolist(), events.tolist(), strict=True):
        end = begin + fleet.size(node)
        rows[i].events[node, sequence, time] = values[begin:end].tolist()
        begin = end
    held = fleet.rows(rows[0])
    held.hold(rows)
    links = {node: Link(*numbers) for node, numbers in head["links"].items()}
    origin = head["origin"] and datetime.fromisoformat(head["origin"])
    leap = None if head["leap"] is None else Leap(*head["leap"])
    return Plant(name, held, head["now"], origin, forced=head["forced"], links=links, leap=leap)


def _row(fleet: Fleet, numbers: np.ndarray, node: int, sequence: int) -> HeldRow:
    slot = fleet.pool.take()
    fleet.pool.table[slot] = numbers
    row = HeldRow((float(numbers[-1]), node, sequence), slot, fleet.width)
    row.numbers = numbers[fleet.pool.numbers].tolist()
    return row
