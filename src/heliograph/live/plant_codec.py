"""Serialisation of a plant as bytes, which restore the same bits."""

import json
import math
import struct
from datetime import datetime
from typing import Any, NamedTuple

import numpy as np

from heliograph.live.fleet import Fleet
from heliograph.live.plant import Link, Plant
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
        head = json.dumps(self.head).encode()
        numbers = [np.asarray(a, dtype=kind).tobytes() for a, kind in zip(self[1:], TYPES, strict=True)]
        return b"".join([HEAD.pack(len(head), len(self.keys), len(self.events), len(self.values)), head, *numbers])

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
    events = [(i, name, values) for i, row in enumerate(rows) for name, values in row.events.items()]
    return PlantParts(
        head={"now": plant.now, "forced": plant.forced, "origin": origin, "links": links},
        keys=_integers([number for row in rows for number in row.key[1:]], 2),
        events=_integers([number for i, name, _ in events for number in (i, name[0], name[1])], 3),
        table=fleet.pool.table[[row.slot for row in rows]],
        times=np.array([name[2] for _, name, _ in events]),
        values=np.concatenate([np.zeros(0), *(values for _, _, values in events)]),
    ).to_bytes()


def _integers(flat: list[int], width: int) -> np.ndarray:
    return np.array(flat, dtype=np.int64).reshape(-1, width)


def plant_from(name: str, data: bytes, fleet: Fleet) -> Plant:
    """Restore a plant from bytes, with its rows in slots of the fleet's table."""
    head, keys, events, table, times, values = PlantParts.of(data, fleet.pool.table.shape[1])
    # Rows, each in a new slot; then their events.
    rows = [_row(fleet, numbers, *key) for numbers, key in zip(table, keys.tolist(), strict=True)]
    begin = 0
    for time, (i, node, sequence) in zip(times.tolist(), events.tolist(), strict=True):
        end = begin + fleet.size(node)
        rows[i].events[node, sequence, time] = values[begin:end]
        begin = end
    held = fleet.rows(rows[0])
    held.hold(rows)
    links = {node: Link(*numbers) for node, numbers in head["links"].items()}
    origin = head["origin"] and datetime.fromisoformat(head["origin"])
    return Plant(name, held, head["now"], origin, forced=head["forced"], links=links)


def _row(fleet: Fleet, numbers: np.ndarray, node: int, sequence: int) -> HeldRow:
    slot = fleet.pool.take()
    fleet.pool.table[slot] = numbers
    values = numbers[fleet.pool.numbers]
    row = HeldRow((float(values[-1]), node, sequence), slot, len(values) - 1)
    row.numbers[:] = values
    return row
