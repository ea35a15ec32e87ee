"""Serialisation of a plant as bytes, which restore the same bits."""

import json
import struct
from datetime import datetime

import numpy as np

from heliograph.live.fleet import Fleet
from heliograph.live.plant import Link, Plant
from heliograph.live.rows import HeldRow

HEAD = struct.Struct("<4q")  # lengths: of the head in bytes, of rows, of events, of their values


def plant_bytes(plant: Plant, fleet: Fleet) -> bytes:
    """Serialise a plant that has no pending changes: a head of JSON, then integers, then doubles."""
    rows = plant.rows.held
    origin = None if plant.origin is None else plant.origin.isoformat()
    links = {node: list(vars(link).values()) for node, link in plant.links.items()}
    head = json.dumps({"now": plant.now, "forced": plant.forced, "origin": origin, "links": links}).encode()
    # Integers: step numbers of the rows, then (row, node, count) of each event.
    events = [(i, name, values) for i, row in enumerate(rows) for name, values in row.events.items()]
    whole = [number for row in rows for number in row.key[1:]]
    whole += [number for i, name, _ in events for number in (i, name[0], name[1])]
    values = np.concatenate([np.zeros(0), *(values for _, _, values in events)])
    return b"".join(
        [
            # Lengths of the parts, then the parts: head, integers, rows, times and values of events.
            HEAD.pack(len(head), len(rows), len(events), len(values)),
            head,
            np.array(whole, dtype="<i8").tobytes(),
            fleet.pool.table[[row.slot for row in rows]].astype("<f8").tobytes(),
            np.array([name[2] for _, name, _ in events], dtype="<f8").tobytes(),
            values.astype("<f8").tobytes(),
        ]
    )


def plant_from(name: str, data: bytes, fleet: Fleet) -> Plant:
    """Restore a plant from bytes, with its rows in slots of the fleet's table."""
    length, count, received, numbers = HEAD.unpack_from(data)
    head, at = json.loads(data[HEAD.size : HEAD.size + length]), HEAD.size + length
    # The parts in the order in which `plant_bytes` writes them.
    whole = np.frombuffer(data, "<i8", 2 * count + 3 * received, at).tolist()
    at += 8 * len(whole)
    width = fleet.pool.table.shape[1]
    table = np.frombuffer(data, "<f8", count * width, at).reshape(count, width)
    at += 8 * table.size
    times = np.frombuffer(data, "<f8", received, at).tolist()
    values = np.frombuffer(data, "<f8", numbers, at + 8 * received)
    # Rows, each in a new slot; then their events.
    rows = [_row(fleet, table[i], whole[2 * i], whole[2 * i + 1]) for i in range(count)]
    begin = 0
    for time, i, node, sequence in zip(times, *(whole[2 * count + j :: 3] for j in range(3)), strict=True):
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
