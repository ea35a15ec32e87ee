"""Serialisation of a plant as bytes, which restore the same bits."""

import json
import math
import struct
from collections.abc import Sequence
from datetime import datetime
from typing import Any, NamedTuple

import numpy as np

from heliograph.live.clock_leap import ClockLeap
from heliograph.live.fleet import Fleet
from heliograph.live.health.link_counts import LinkCounts
from heliograph.live.plant_state import PlantState
from heliograph.live.sorted_rows import HeldRow
from heliograph.live.undoable_changes import RowBeforeLeap

HEAD = struct.Struct("<4q")  # lengths: of the head in bytes, of rows, of events, of their values
TYPES = ("<i8", "<i8", "<f8", "<f8", "<f8")  # of the parts after the head
TABLE = 2  # number of the table among them
BEFORE_LEAP = "before a leap"  # in the head: the arrival before a leap if the first row is the one kept from before it
BEGUN = "begun"  # in the head: when the plant began; absent until version 0.4.0
KEPT = "kept"  # in the head: how many numbers of the table are there, behind a bit for each; all, where it is absent


class PlantParts(NamedTuple):
    """Parts of a plant's bytes, in their order: a head of JSON, integers, then doubles.

    A table that is mostly zeros, as the states of filters that carry probabilities are, has a bit for each number in
    its place, and those whose bits are not all 0.

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
        """Return the parts as bytes: their lengths, the head as JSON, then the arrays one after another."""
        return _pack_parts(self.head, *(array.ravel() for array in self[1:]))

    @staticmethod
    def from_bytes(data: bytes, width: int) -> "PlantParts":
        """Read the parts from bytes, of rows with `width` numbers; raise ValueError if these have another width.

        The bytes begin with four lengths (HEAD): of the head in bytes, and the numbers of rows, events and values. The
        head follows as JSON, and then five arrays with numbers of the TYPES. Of the array TABLE only the numbers that
        are not zero are stored if the head says how many (KEPT).
        """
        length, rows, events, numbers = HEAD.unpack_from(data)
        at = HEAD.size + length  # the byte that is read next
        head, arrays = json.loads(data[HEAD.size : at]), list[np.ndarray]()
        # Node and step of each row; row, node and count of each event; the table; the events' times; their values.
        shapes = ((rows, 2), (events, 3), (rows, width), (events,), (numbers,))
        for number, (kind, shape) in enumerate(zip(TYPES, shapes, strict=True)):
            if number == TABLE and KEPT in head:
                array, at = _unpack_table(data, at, math.prod(shape), head.pop(KEPT))
            else:
                array = np.frombuffer(data, kind, math.prod(shape), at)
                at += array.nbytes
            arrays.append(array.reshape(shape))
        if at != len(data):
            raise ValueError(f"{len(data) - at} bytes more than rows of {width} numbers")
        return PlantParts(head, *arrays)


def pack_plant(plant: PlantState, fleet: Fleet) -> bytes:
    """Return a plant as bytes, which `unpack_plant` reads; it must have no changes that could still be undone.

    A service writes these bytes to its store, so that the plant goes on after a restart. The head has its times, counts
    of messages and newest leap (a jump in time that one clock alone shows). The arrays have its rows, one for each time
    or event whose state is held because late data may still change it, and the events in them.

    Args:
        plant: times, message counts and rows of one plant; a row says by `slot` where its state is.
        fleet: holds the states of all plants' rows in one table, a slot (row of the table) for each.
    """
    # The head, as JSON: times, counts by node, and a leap if a clock showed one.
    head = {
        "now": plant.now,
        "forced": plant.forced,
        BEGUN: plant.begun,
        "origin": None if plant.origin is None else plant.origin.isoformat(),
        "links": {node: list(vars(link).values()) for node, link in plant.links.items()},
        "leap": None if plant.leap is None else _pack_leap(plant.leap),
        BEFORE_LEAP: None if plant.row_before_leap is None else plant.row_before_leap.now,
    }
    # First the row from before a leap, where one is held in case the leap is undone; then all others.
    rows_before_leap = [] if plant.row_before_leap is None else [plant.row_before_leap.row]
    rows = [*rows_before_leap, *plant.rows.held]
    # Whole numbers, one after another: (node, sequence) of each row, and (number of the row, node, sequence) of each
    # event. Their times are no whole numbers, and stand apart; the time of a row is in the table.
    keys = [number for row in rows for number in row.key[1:]]  # a key is (time, node, sequence)
    events_by_row = [(i, *event) for i, row in enumerate(rows) for event in row.events]
    events = [number for i, node, sequence, _ in events_by_row for number in (i, node, sequence)]
    table = fleet.state_table.table[[row.slot for row in rows]].ravel()
    times = [time for *_, time in events_by_row]
    values = [value for row in rows for values in row.events.values() for value in values]
    return _pack_parts(head, keys, events, table, times, values)


def _pack_parts(head: dict[str, Any], *flat_arrays: Sequence[float] | np.ndarray) -> bytes:
    """Return as bytes: the lengths of what follows, the head as JSON, and five flat arrays.

    These are keys, events, table, times and values. HEAD: the struct of the lengths; TYPES: type of the numbers of
    each array; TABLE: index of the table among these; KEPT: entry of the head that says how many of its numbers are
    stored.
    """
    keys, events, _, _, values = flat_arrays  # of shapes (rows, 2), (events, 3) and (numbers,) once they are unpacked
    counts = len(keys) // 2, len(events) // 3, len(values)
    arrays = [np.array(numbers, dtype=kind) for numbers, kind in zip(flat_arrays, TYPES, strict=True)]
    # A table that is mostly zeros is stored as a bit for each number, and the numbers that are not zero.
    table = arrays[TABLE]
    is_stored = table.view("<i8") != 0  # by their bits, so that -0.0 is stored as well
    stored_count = int(np.count_nonzero(is_stored))
    packed = [array.tobytes() for array in arrays]
    if 2 * stored_count < len(table):
        head = head | {KEPT: stored_count}
        packed[TABLE] = np.packbits(is_stored).tobytes() + table[is_stored].tobytes()
    json_head = json.dumps(head).encode()
    return b"".join([HEAD.pack(len(json_head), *counts), json_head, *packed])


def _unpack_table(data: bytes, at: int, size: int, stored: int) -> tuple[np.ndarray, int]:
    """Read a table of `size` numbers, most of them 0, from byte `at` of `data`; return it and the byte after it.

    First there is a bit for each number, 1 if it is stored, and then the `stored` numbers that are.
    """
    byte_count = (size + 7) // 8  # bytes that hold `size` bits
    values_begin = at + byte_count
    bits = np.frombuffer(data, np.uint8, byte_count, at)
    values = np.frombuffer(data, "<f8", stored, values_begin)
    table = np.zeros(size)
    table[np.unpackbits(bits, count=size).astype(bool)] = values
    return table, values_begin + values.nbytes


def unpack_plant(name: str, data: bytes, fleet: Fleet) -> PlantState:
    """Return the plant `name` from what `pack_plant` returned, with its rows in new slots of the fleet's table.

    The bytes hold the rows of live data that late events may still change, with the filters' states after each, and a
    head, {"now", "forced", "begun", "origin", "links", "leap", "before a leap"}: times, counts of messages by node, and
    jumps of clocks that are in doubt. A slot is a line of the fleet's table of filter states.
    """
    parts = PlantParts.from_bytes(data, fleet.state_table.table.shape[1])
    head, rows = parts.head, _make_rows_with_events(parts, fleet)
    # If the plant was stored after a leap (a jump of a clock) that may still be undone, its first row is the one before
    # the leap, which is no row of the history, and the head has the newest arrival before it.
    row_before_leap, moment_before = None, head.get(BEFORE_LEAP)
    if moment_before is not None:
        row_before_leap = RowBeforeLeap(rows.pop(0), moment_before)
    base = rows[0]  # the newest row that is final, from which later ones are stepped
    sorted_rows = fleet.make_rows(base)
    sorted_rows.replace_rows(rows)
    return PlantState(
        name=name,
        rows=sorted_rows,
        now=head["now"],
        origin=head["origin"] and datetime.fromisoformat(head["origin"]),
        forced=head["forced"],
        links={node: LinkCounts(*numbers) for node, numbers in head["links"].items()},
        leap=None if head["leap"] is None else _unpack_leap(head["leap"]),
        row_before_leap=row_before_leap,
        begun=head.get(BEGUN, max(base.key[0], 0.0)),  # of an older version, the time of the base; no step is below 0
    )


def _make_rows_with_events(parts: PlantParts, fleet: Fleet) -> list[HeldRow]:
    """Return the stored rows, each in a new slot of the fleet's table, with their events."""
    rows = [
        _make_held_row(fleet, numbers, node, sequence)
        for numbers, (node, sequence) in zip(parts.table, parts.keys.tolist(), strict=True)
    ]
    # The values of all events follow one another; each has as many as its node sends.
    begin = 0
    for time, (i, node, sequence) in zip(parts.times.tolist(), parts.events.tolist(), strict=True):
        end = begin + fleet.layout.count_values(node)
        rows[i].events[node, sequence, time] = parts.values[begin:end].tolist()
        begin = end
    return rows


def _pack_leap(leap: ClockLeap) -> dict[str, Any]:
    """Return {field of a leap: its value}, of which JSON can be written."""
    return leap._asdict() | {"earlier": None if leap.earlier is None else _pack_leap(leap.earlier)}


def _unpack_leap(packed: Any) -> ClockLeap:
    """Return the leap (jump in time by one clock) that `_pack_leap` packed as a dictionary of its fields.

    Versions up to 0.3.0 wrote a list: its time, the newest arrival before it (`now`), and five numbers of each node, of
    which the third and fifth are times: of the greatest count (`at`), and of the newest measurement (`latest`).
    """
    if isinstance(packed, list):
        time, now, links = packed
        moments = {node: (at, latest) for node, (_, _, at, _, latest) in links.items()}
        return ClockLeap(time=time, since=time, now=now, moments=moments)
    moments = {node: (at, latest) for node, (at, latest) in packed["moments"].items()}
    earlier = packed["earlier"] and _unpack_leap(packed["earlier"])
    return ClockLeap(**packed | {"moments": moments, "earlier": earlier})


def _make_held_row(fleet: Fleet, numbers: np.ndarray, node: int, sequence: int) -> HeldRow:
    """Return a row with the key (time, node, sequence), whose numbers stand in a new slot of the fleet's table."""
    slot = fleet.state_table.take_slot()
    fleet.state_table.table[slot] = numbers
    row = HeldRow((float(numbers[-1]), node, sequence), slot, fleet.layout.width)
    row.numbers = numbers[fleet.state_table.numbers].tolist()
    return row
