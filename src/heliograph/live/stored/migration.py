"""Carrying stored plants over to a network that has changed."""

import json
from collections.abc import Callable, Mapping, Sequence
from itertools import count
from math import prod
from typing import Any, NamedTuple

import jax
import numpy as np

from heliograph.live.fleet import Fleet
from heliograph.live.sorted_rows import BEFORE
from heliograph.live.stored.old_layout import (
    can_read_layout,
    describe_old_layout,
    place_flags,
    relocate_parts,
    split_by_path,
)
from heliograph.live.stored.plant_codec import BEFORE_LEAP, PlantParts, pack_plant, unpack_plant
from heliograph.live.stored.snapshot import Identity
from heliograph.numerics.check import fail
from heliograph.numerics.types import Bool, Float, PyTree
from heliograph.simulation.network import Network

DESCRIPTION = "description"  # key of an identity: its numbers and the layout of its rows, as JSON
MOST = 64  # numbers of an array that are stored; of a longer one only a hash is
LISTED = 4  # entries of an array that are named
SAME = ("precision", "states", "inputs")  # what the rows of a plant mean


def describe_network(fleet: Fleet, covariances: bool = False) -> str:
    """Return the numbers of a network by name, and where the state of each filter stands in a row, as JSON.

    Args:
        fleet: the plants of the network.
        covariances: whether its rows are of a version before 0.3.0, in which states held covariances.
    """
    network = fleet.network
    parts: dict[str, PyTree] = {"plant": network.plant}
    parts |= {f"node {name!r}": node for name, node in network.nodes.items()}
    parts |= {f"fusion {name!r}": fusion for name, fusion in (network.fused | network.meshes).items()}
    filters, size = _filter_columns(fleet, covariances)
    # Before 0.3.0 no probabilities of modes were among the outputs.
    outputs = fleet.pool.step_rows.outputs.size - (np.count_nonzero(_mode_columns(fleet)) if covariances else 0)
    layout = {
        "nodes": {name: network.nodes[name].received for name in network.names},
        "given": fleet.program.given,
        "state": size,
        "outputs": int(outputs),
        "filters": filters,
    }
    return json.dumps({"values": {name: _numbers_by_path(tree) for name, tree in parts.items()}, "layout": layout})


def _mode_columns(fleet: Fleet) -> Bool[np.ndarray, " outputs"]:
    """Return which of a network's outputs are probabilities of modes."""
    results = np.zeros(fleet.pool.step_rows.outputs.size, bool)
    for place in fleet.program.places:
        results[slice(*(place.modes or (0, 0)))] = True
    return results


def _numbers_by_path(tree: PyTree) -> dict[str, object]:
    """Return the numbers of a tree by the path of their attributes."""
    results: dict[str, object] = {}
    for path, leaf in jax.tree_util.tree_flatten_with_path(tree)[0]:
        if isinstance(leaf, jax.Array | np.ndarray | np.generic | int | float):
            array = np.asarray(leaf)
            results[jax.tree_util.keystr(path)] = array.tolist() if array.size <= MOST else f"{array.size} numbers"
    return results


def _filter_columns(fleet: Fleet, covariances: bool) -> tuple[dict[str, dict[str, list[Any]]], int]:
    """Return {name of filter: {path of leaf: [shape, first column, end]}}, and how many columns the states have.

    `covariances`: as before version 0.3.0, when states held covariances.
    """
    network, flat, free = fleet.network, fleet.pool.step_rows.state, count()
    by_kind, central, *rest = flat.tree(np.zeros(flat.size))
    results: dict[str, dict[str, list[Any]]] = {}

    def number_columns(state: PyTree) -> dict[str, np.ndarray]:
        """Return the numbers of the next free columns, in the shape of each leaf, by its path."""
        shapes: Mapping[str, Sequence[int]] = {path: part.shape for path, part in split_by_path(state).items()}
        shapes = describe_old_layout(shapes) if covariances else shapes
        return {
            path: np.array([next(free) for _ in range(prod(shape))]).reshape(shape) for path, shape in shapes.items()
        }

    def note(name: str, path: str, columns: np.ndarray) -> None:
        """Add a leaf to the results; its columns stand side by side."""
        begin = int(columns.flat[0]) if columns.size else 0
        results.setdefault(name, {})[path] = [list(columns.shape), begin, begin + columns.size]

    # Filters of nodes stand by kind, (filter x node, ...); central ones by name.
    for (group, filters), state in zip(network.kinds, by_kind, strict=True):
        names = [f"{node}/{name}" for name in filters for node in network.groups[group]]
        for path, leaf in number_columns(state).items():
            for name, of_filter in zip(names, leaf, strict=True):
                note(name, path, np.asarray(of_filter))
    for name, state in sorted(central.items()):
        for path, leaf in number_columns(state).items():
            note(f"{Network.FUSED}/{name}", path, leaf)
    # What centres and neighbours remember goes on only if the nodes are the same, which are part of its name.
    for path, leaf in number_columns(rest).items():
        note(f"memory of the fusions of {', '.join(network.names)}", path, leaf)
    return results, next(free)


class PlantMigration:
    """Migration of stored plants to another network: takes their bytes, returns those that this network stores.

    A filter goes on with its state where all parts of this have the shape that they had, or are factors of a covariance
    that was there; others begin with the network's initial law. Rows that may still change are stepped again, with the
    new numbers.

    Args:
        fleet: the plants of the network as it is now.
        mine: its identity.
        say: called with a line for each change.
    """

    def __init__(self, fleet: Fleet, mine: Identity, say: Callable[[str], None]):
        self.fleet, self.mine, self._say = fleet, mine, say
        self._old: dict[str, Any] = {}

    def begin(self, what: str, other: Identity) -> None:
        """Report what has changed since the identity `other` of the store `what`.

        Raises:
            ValueError: other states, inputs or precision, or a store that does not say what it holds.
        """
        for name in SAME:
            if self.mine.get(name) != other.get(name):
                expected = f"the {name} that are stored, {other.get(name)!r}, to go on with what fits"
                raise fail(what, expected, repr(self.mine.get(name)))
        try:
            self._old = json.loads(other[DESCRIPTION])["layout"]
            self._old["filters"] = place_flags(self._old["filters"])
            lines = list_changes(self.mine, other)
        except (KeyError, ValueError, TypeError):
            raise fail(what, "a description of the network that it is of", "none") from None
        new = json.loads(self.mine[DESCRIPTION])["layout"]["filters"]
        lines += [f"{name} begins with the initial law" for name in new if not self._has_counterpart(name, new)]
        for line in lines:
            self._say(f"{what}: {line}")

    def _has_counterpart(self, name: str, new: Mapping[str, Mapping[str, Sequence[Any]]]) -> bool:
        """Return whether the filter of this name had a state before that can be read as its state now."""
        shapes_before = {path: shape for path, (shape, _, _) in self._old["filters"].get(name, {}).items()}
        shapes_now = {path: shape for path, (shape, _, _) in new.get(name, {}).items()}
        return can_read_layout(shapes_before, shapes_now)

    def migrate(self, bodies: Mapping[str, bytes]) -> dict[str, bytes]:
        """Return the bytes of plants, by name, as this network stores them."""
        plants = {name: unpack_plant(name, self._translate(body), self.fleet) for name, body in bodies.items()}
        # All rows after the base are stepped with what the network is now.
        for plant in plants.values():
            plant.dirty = 1 if len(plant.rows.held) > 1 else None
        self.fleet.step(plants.values())
        results = {name: pack_plant(plant, self.fleet) for name, plant in plants.items()}
        for plant in plants.values():
            self.fleet.end(plant)
        return results

    def migrate_outputs(self, rows: Float[np.ndarray, "row output"]) -> Float[np.ndarray, "row output"] | None:
        """Return stored outputs with this network's columns; None where they are of other nodes or filters.

        Before 0.3.0 outputs had no probabilities of modes: these become NaN.
        """
        new, without_modes = json.loads(self.mine[DESCRIPTION])["layout"], ~_mode_columns(self.fleet)
        if any(list(self._old[part]) != list(new[part]) for part in ("nodes", "filters")):
            return None
        if rows.shape[1] == len(without_modes):
            return rows
        if rows.shape[1] != np.count_nonzero(without_modes):
            return None
        results = np.full((len(rows), len(without_modes)), np.nan)
        results[:, without_modes] = rows
        return results

    def _translate(self, body: bytes) -> bytes:
        """Return a plant's bytes with the columns, places of nodes and counts of this network; rows not stepped."""
        old = self._old
        nodes_before, network = old["nodes"], self.fleet.network
        same = [
            name
            for name, received in nodes_before.items()
            if name in network.nodes and network.nodes[name].received == received
        ]
        new_index = {i: network.names.index(name) for i, name in enumerate(nodes_before) if name in same} | {-1: -1}
        width = old["state"] + old["outputs"] + 2 * old["given"] + sum(nodes_before.values()) + 2
        parts = PlantParts.of(body, width)
        rows = self._translate_keys(parts, new_index)
        number = {row.number_before: i for i, row in enumerate(rows)}
        table = self._translate_rows(parts.table[[row.number_before for row in rows]], new_index)
        assert table.shape[1] == self.fleet.pool.table.shape[1]
        # Events (row, node, count), in the order of their rows; their values stand one after another.
        sizes = [old["given"] if node < 0 else list(nodes_before.values())[node] for _, node, _ in parts.events]
        values = np.split(parts.values, np.cumsum(sizes)[:-1]) if len(parts.events) else []
        stay = [i for i, (row, node, _) in enumerate(parts.events) if int(node) in new_index and int(row) in number]
        events = [(number[int(row)], new_index[int(node)], int(count)) for row, node, count in parts.events[stay]]
        links = {name: link for name, link in parts.head["links"].items() if name in (*same, "inputs")}
        return PlantParts(
            head=parts.head | {"links": links},
            keys=np.array([(row.node, row.sequence) for row in rows]),
            events=np.array(events, dtype=np.int64),
            table=table,
            times=parts.times[stay],
            values=np.concatenate([np.zeros(0), *(values[i] for i in stay)]),
        ).to_bytes()

    def _translate_keys(self, parts: PlantParts, new_index: Mapping[int, int]) -> list["_MovedRow"]:
        """Return the rows that stay, in the order of their keys here; the row of a node that is gone goes with it.

        First stands the base, or a row kept from before a leap and then the base: these stay in any case.
        """
        joint, first = self.fleet.rows_are_joint, 1 + (parts.head.get(BEFORE_LEAP) is not None)
        rows = []
        for i, (node, sequence) in enumerate(parts.keys.tolist()):
            if i < first or joint or node in new_index:
                node_here = node if joint or node == BEFORE else new_index.get(node, BEFORE)
                rows.append(_MovedRow(float(parts.table[i, -1]), node_here, sequence, i))
        return [*rows[:first], *sorted(rows[first:])]

    def _translate_rows(self, table: np.ndarray, new_index: Mapping[int, int]) -> np.ndarray:
        """Return rows of another network's table with this network's columns.

        A row has (state, outputs, inputs held, step number, measurements by node, inputs, time). States of filters with
        a counterpart are copied, of others the start; outputs stay 0 until the next step.

        Args:
            table: rows of the other network.
            new_index: index here of each node that is here too, by its index there.
        """
        old, pool, program = self._old, self.fleet.pool, self.fleet.program
        given, state = old["given"], old["state"]
        translated = np.zeros((len(table), pool.table.shape[1]))
        translated[:, pool.state] = pool.step_rows.start
        filters = json.loads(self.mine[DESCRIPTION])["layout"]["filters"]
        for name, new in filters.items():
            if self._has_counterpart(name, filters):
                parts = {path: table[:, begin:end].reshape(len(table), *shape)
                         for path, (shape, begin, end) in old["filters"][name].items()}  # fmt: skip
                for path, part in relocate_parts(parts, new).items():
                    _, begin, end = new[path]
                    translated[:, begin:end] = part.reshape(len(table), -1) if end > begin else 0.0
        # Inputs held and step number.
        held = state + old["outputs"]
        step = held + given
        translated[:, pool.held], translated[:, pool.at] = table[:, held:step], table[:, [step]]
        # Measurements by node, NaN of nodes that were not there; inputs and time. `numbers` is a view of a slice.
        numbers, numbers_before = translated[:, pool.numbers], table[:, step + 1 :]
        numbers[:] = np.nan
        numbers[:, program.received :] = numbers_before[:, numbers_before.shape[1] - given - 1 :]
        starts_before = np.cumsum([0, *old["nodes"].values()])
        starts = np.cumsum([0, *(self.fleet.network.nodes[name].received for name in self.fleet.network.names)])
        for i, j in new_index.items():
            if i >= 0:  # a node; -1 stands for the inputs
                numbers[:, starts[j] : starts[j + 1]] = numbers_before[:, starts_before[i] : starts_before[i + 1]]
        return translated


class _MovedRow(NamedTuple):
    """A row by its key, with the index of its node here, and its number among the rows of the other network."""

    time: float
    node: int
    sequence: int
    number_before: int


def list_changes(mine: Identity, other: Identity) -> list[str]:
    """Return a line for each thing that has changed from the identity `other` to `mine`.

    These are options and versions, nodes and filters, numbers of the parts, and functions where nothing else has.
    """
    lines = [
        f"{name}: {other.get(name, 'none')} -> {mine.get(name, 'none')}"
        for name in {**mine, **other}
        if mine.get(name) != other.get(name)
        and not name.startswith("numbers of ")
        and name not in (DESCRIPTION, "what is computed", "layout of the store")
    ]
    # Numbers of the parts that are in both; of long arrays only a hash is known, and of functions the program. What
    # only one of two versions keeps is derived from the others.
    here, there = (json.loads(identity[DESCRIPTION])["values"] for identity in (mine, other))
    same = mine.get("heliograph") == other.get("heliograph")
    for name in here:
        if name in there:
            lines += [
                f"{name}{path}: {line}"
                for path in {**there[name], **here[name]}
                if not path.endswith(".factor")  # of a covariance, which is there too
                and (same or path in there[name].keys() & here[name].keys())
                for line in _describe_changes(there[name].get(path), here[name].get(path))
            ]
            if not lines and mine.get(f"numbers of {name}") != other.get(f"numbers of {name}"):
                lines.append(f"{name}: numbers of a long array")
    if not lines and mine.get("what is computed") != other.get("what is computed"):
        lines.append("functions of the network")
    return lines


def _describe_changes(before: object, after: object) -> list[str]:
    """Return lines on the change of a number or an array, entry by entry where the shape is the same; [] if none."""
    if before == after:
        return []
    try:
        a, b = np.asarray(before, dtype=float), np.asarray(after, dtype=float)
    except (TypeError, ValueError):
        return [f"{before} -> {after}"]
    if a.shape != b.shape or before is None or after is None:
        return [" -> ".join("none" if side is None else f"{side}" for side in (before, after))]
    changed = [tuple(map(int, index)) for index in np.argwhere(a != b)]
    lines = [f"{list(index) if a.size > 1 else ''} {a[index]:.6g} -> {b[index]:.6g}".strip() for index in changed]
    return lines[:LISTED] + ([f"and {len(lines) - LISTED} more of its numbers"] if len(lines) > LISTED else [])
