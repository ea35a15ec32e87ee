"""Carrying stored plants over to a network that has changed."""

import json
from collections.abc import Callable, Mapping, Sequence
from math import prod
from typing import Any, NamedTuple

import jax
import numpy as np

from heliograph.live.event import INPUTS
from heliograph.live.fleet import Fleet
from heliograph.live.sorted_rows import BEFORE
from heliograph.live.stored.network_changes import DESCRIPTION, SAME, list_changes
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

MOST = 64  # numbers of an array that are stored; of a longer one only a hash is


def describe_network(fleet: Fleet, covariances: bool = False) -> str:
    """Return the numbers of a network by name, and where the state of each filter stands in a row, as JSON.

    This is stored with a plant's rows: another network finds there what has changed, and which columns to read.

    Args:
        fleet: the plants of the network.
        covariances: whether its rows are of a version before 0.3.0, in which states held covariances.
    """
    network = fleet.network
    parts: dict[str, PyTree] = {"plant": network.plant}
    parts |= {f"node {name!r}": node for name, node in network.nodes.items()}
    parts |= {f"fusion {name!r}": fusion for name, fusion in (network.fused | network.meshes).items()}
    filters, size = _number_state_columns(fleet, covariances)
    outputs = fleet.state_table.step_rows.outputs.size
    if covariances:  # before 0.3.0 no probabilities of modes were among the outputs
        outputs -= int(np.count_nonzero(_find_mode_columns(fleet)))
    layout = {
        "nodes": {name: network.nodes[name].received for name in network.names},
        "given": fleet.program.given,
        "state": size,
        "outputs": outputs,
        "filters": filters,
    }
    return json.dumps({"values": {name: _list_numbers_by_path(tree) for name, tree in parts.items()}, "layout": layout})


def _find_mode_columns(fleet: Fleet) -> Bool[np.ndarray, " outputs"]:
    """Return the mask of a network's outputs that is true where an output is the probability of a mode."""
    results = np.zeros(fleet.state_table.step_rows.outputs.size, bool)
    for columns in fleet.program.filter_columns:
        if columns.modes is not None:
            begin, end = columns.modes
            results[begin:end] = True
    return results


def _list_numbers_by_path(tree: PyTree) -> dict[str, object]:
    """Return {path of a tree's leaf: its numbers as nested lists, or their count if there are more than MOST}."""
    results: dict[str, object] = {}
    for path, leaf in jax.tree_util.tree_flatten_with_path(tree)[0]:
        if isinstance(leaf, jax.Array | np.ndarray | np.generic | int | float):
            array = np.asarray(leaf)
            results[jax.tree_util.keystr(path)] = array.tolist() if array.size <= MOST else f"{array.size} numbers"
    return results


class _ColumnCounter:
    """Counts the columns of a row's states, one part after another, and notes which each part of a filter takes.

    Args:
        covariances: whether parts are as before version 0.3.0, when states held covariances, not their factors.

    Attributes:
        filters: {name of filter: {path of a part of its state: [shape, first column, end]}}.
        count: how many columns have been counted so far, which is also the next free one.
    """

    def __init__(self, covariances: bool):
        """Begin at column 0; `covariances`: whether states hold covariances instead of their factors L and D."""
        self._covariances = covariances
        self.filters: dict[str, dict[str, list[Any]]] = {}
        self.count = 0

    def number_parts(self, state: PyTree) -> dict[str, np.ndarray]:
        """Return {path of an array of a filter's state: its column numbers, in its shape}, from `count` on."""
        shapes: Mapping[str, Sequence[int]] = {path: part.shape for path, part in split_by_path(state).items()}
        shapes = describe_old_layout(shapes) if self._covariances else shapes
        columns = {}
        for path, shape in shapes.items():
            size = prod(shape)
            columns[path] = np.arange(self.count, self.count + size).reshape(shape)
            self.count += size
        return columns

    def note_part(self, filter_name: str, path: str, columns: np.ndarray) -> None:
        """Note in `filters` where a part of a filter's state stands: [its shape, first column, end of its columns].

        `columns` has the column of each number of the part, in its shape; they stand side by side.
        """
        first = int(columns.flat[0]) if columns.size else 0
        self.filters.setdefault(filter_name, {})[path] = [list(columns.shape), first, first + columns.size]


def _number_state_columns(fleet: Fleet, covariances: bool) -> tuple[dict[str, dict[str, list[Any]]], int]:
    """Return {name of filter: {path of a part: [shape, first column, end]}}, and how many columns the states have.

    A part is one array of a filter's state, such as the mean.

    Args:
        fleet: the plants of the network.
        covariances: whether to count as before version 0.3.0, when states held covariances, not their factors.
    """
    network, flat, counter = fleet.network, fleet.state_table.step_rows.state, _ColumnCounter(covariances)
    # A row's state has the filters of nodes by kind, the central ones by name, then what fusions remember. Only shapes
    # count here: the tree is made of zeros.
    states_by_stack, central, *memory = flat.tree(np.zeros(flat.size))
    # Filters of one kind stand side by side: the leading axis of each part is (filter x node).
    for (group, filters), state in zip(network.stacks, states_by_stack, strict=True):
        names = [f"{node}/{name}" for name in filters for node in network.groups[group]]
        for path, columns in counter.number_parts(state).items():
            for name, columns_of_filter in zip(names, columns, strict=True):
                counter.note_part(name, path, np.asarray(columns_of_filter))
    for name, state in sorted(central.items()):
        for path, columns in counter.number_parts(state).items():
            counter.note_part(f"{Network.FUSED}/{name}", path, columns)
    # What fusions remember is carried over only if the nodes are the same: their names are part of its name.
    for path, columns in counter.number_parts(memory).items():
        counter.note_part(f"memory of the fusions of {', '.join(network.names)}", path, columns)
    return counter.filters, counter.count


class PlantMigration:
    """Migration of stored plants to another network: takes their bytes, returns those that this network stores.

    A filter goes on with its state where all parts of this have the shape that they had, or are factors of a covariance
    that was there; others begin with the network's initial law. Rows that may still change are stepped again.

    Args:
        fleet: the plants of the network as it is now.
        mine: its identity.
        say: called with a line for each change.
    """

    def __init__(self, fleet: Fleet, mine: Identity, say: Callable[[str], None]):
        """Hold the arguments (see the class); `begin` then reads what is stored."""
        self.fleet, self.mine, self._say = fleet, mine, say
        self._old: dict[str, Any] = {}  # "layout" of the network that is stored, as `describe_network` writes it

    def begin(self, what: str, other: Identity) -> None:
        """Read the layout of the network whose plants are stored, and report each change since; called once, first.

        Args:
            what: name of the store, which stands before each line.
            other: identity of the network that is stored.

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
        """Return whether the stored state of the filter of this name can be read as its state now.

        `new`: by filter and path of a part of its state now [shape, first column, end].
        """
        shapes_before = {path: shape for path, (shape, _, _) in self._old["filters"].get(name, {}).items()}
        shapes_now = {path: shape for path, (shape, _, _) in new.get(name, {}).items()}
        return can_read_layout(shapes_before, shapes_now)

    def migrate(self, bodies: Mapping[str, bytes]) -> dict[str, bytes]:
        """Return {name of a plant: its bytes as this network stores them}, from the bytes that are stored.

        The plants are in the fleet only for as long as it takes to step their rows again.
        """
        plants = {name: unpack_plant(name, self._translate_plant(body), self.fleet) for name, body in bodies.items()}
        # All rows after the base are stepped again, with the network as it is now.
        for plant in plants.values():
            plant.first_changed = 1 if len(plant.rows.held) > 1 else None
        self.fleet.step(plants.values())
        results = {name: pack_plant(plant, self.fleet) for name, plant in plants.items()}
        for plant in plants.values():
            self.fleet.end_plant(plant)
        return results

    def migrate_outputs(self, rows: Float[np.ndarray, "row output"]) -> Float[np.ndarray, "row output"] | None:
        """Return stored outputs with this network's columns, or None if they are of other nodes or filters.

        Before 0.3.0, outputs had no probabilities of modes; these become NaN.
        """
        new_layout = json.loads(self.mine[DESCRIPTION])["layout"]
        if any(list(self._old[kind]) != list(new_layout[kind]) for kind in ("nodes", "filters")):
            return None
        is_old_column = ~_find_mode_columns(self.fleet)
        if rows.shape[1] == len(is_old_column):
            return rows
        if rows.shape[1] != np.count_nonzero(is_old_column):
            return None
        results = np.full((len(rows), len(is_old_column)), np.nan)
        results[:, is_old_column] = rows
        return results

    def _translate_plant(self, stored: bytes) -> bytes:
        """Return a stored plant's bytes with the columns, node indices and counts of this network; no row is stepped.

        Rows, events and counts of a node that is gone, or that receives another number of values now, are left out.
        """
        # {node: how many numbers it receives}, in the network that stored the plant, and in this one.
        network, sizes_before = self.fleet.network, self._old["nodes"]
        sizes_here = {name: node.received for name, node in network.nodes.items()}
        kept = [name for name, received in sizes_before.items() if sizes_here.get(name) == received]
        # {index of a node that stays, in the other network: its index here}.
        index_here = {i: network.names.index(name) for i, name in enumerate(sizes_before) if name in kept}
        index_here[-1] = -1  # the inputs
        parts = PlantParts.from_bytes(stored, self._count_columns_before())
        rows = self._select_rows(parts, index_here)  # keys of the rows that stay, and which rows they were
        table = self._translate_table(parts.table[[row.number_before for row in rows]], index_here)
        assert table.shape[1] == self.fleet.state_table.table.shape[1]  # rows as this network has them
        events, times, values = self._translate_events(parts, rows, index_here)
        links = {name: link for name, link in parts.head["links"].items() if name in (*kept, INPUTS)}
        return PlantParts(
            head=parts.head | {"links": links},
            keys=np.array([(row.node, row.sequence) for row in rows]),
            events=events,
            table=table,
            times=times,
            values=values,
        ).to_bytes()

    def _count_columns_before(self) -> int:
        """Return how many columns the table of the other network, whose state was saved, has.

        They are (state, outputs, inputs that hold, step number, measurements by node, inputs that came, time).
        """
        old = self._old
        return int(old["state"] + old["outputs"] + 2 * old["given"] + sum(old["nodes"].values()) + 2)

    def _select_rows(self, parts: PlantParts, index_here: Mapping[int, int]) -> list["_MovedRow"]:
        """Return the rows of a stored plant to keep, in the order of their keys in this network.

        Rows of nodes that this network lacks are left out. The first row (the base of all later ones) stays, and so
        does one before it, held until a jump of a clock is confirmed. `index_here`: {index in the old network: here}.
        """
        joint = self.fleet.rows_are_joint  # whether events of several nodes share a row
        always_kept = 1 + (parts.head.get(BEFORE_LEAP) is not None)
        rows = []
        for i, (node, sequence) in enumerate(parts.keys.tolist()):
            if i < always_kept or joint or node in index_here:
                node_here = node if joint or node == BEFORE else index_here.get(node, BEFORE)
                time = float(parts.table[i, -1])
                rows.append(_MovedRow(time, node_here, sequence, number_before=i))
        return [*rows[:always_kept], *sorted(rows[always_kept:])]

    def _translate_events(
        self, parts: PlantParts, rows: Sequence["_MovedRow"], index_here: Mapping[int, int]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return three arrays on the events that stay: their (row, node, count), their times, and all their values.

        The shapes are (events, 3), (events,), and (numbers,), where events' values follow one another.

        Args:
            parts: the stored plant.
            rows: the rows that stay.
            index_here: maps a node's index in the other network to its index in this one.
        """
        row_here = {row.number_before: i for i, row in enumerate(rows)}
        # An event of inputs (node -1) has as many values as there are inputs, any other as many as its node receives.
        received, stored = list(self._old["nodes"].values()), parts.events.tolist()
        sizes = [self._old["given"] if node < 0 else received[node] for _, node, _ in stored]
        values = np.split(parts.values, np.cumsum(sizes)[:-1]) if sizes else []
        stay = [i for i, (row, node, _) in enumerate(stored) if node in index_here and row in row_here]
        events = [(row_here[row], index_here[node], count) for row, node, count in (stored[i] for i in stay)]
        kept_values = np.concatenate([np.zeros(0), *(values[i] for i in stay)])
        return np.array(events, dtype=np.int64), parts.times[stay], kept_values

    def _translate_table(self, table: np.ndarray, index_here: Mapping[int, int]) -> np.ndarray:
        """Return rows of the other network's table with this network's columns.

        A row has (state, outputs, inputs held, step number, measurements by node, inputs, time). Outputs stay 0 until
        the next step.

        Args:
            table: rows of the other network, (row, column there).
            index_here: maps a node's index in the other network to its index in this one; -1 for the inputs.
        """
        old, state_table = self._old, self.fleet.state_table
        translated = np.zeros((len(table), state_table.table.shape[1]))
        translated[:, state_table.state] = self._translate_states(table)
        # The first columns there of the inputs that hold, of the step number, and of the measurements.
        held = old["state"] + old["outputs"]
        step = held + old["given"]
        measured = step + 1
        translated[:, state_table.held_inputs] = table[:, held:step]
        translated[:, state_table.step_number] = table[:, step:measured]
        translated[:, state_table.numbers] = self._translate_numbers(table[:, measured:], index_here)
        return translated

    def _translate_states(self, table: np.ndarray) -> np.ndarray:
        """Return the states (rows, columns of this network) of rows of the old network's table (rows, old columns).

        A filter that the old network had too keeps its state; any other begins with the initial law.
        """
        states = np.tile(self.fleet.state_table.step_rows.start, (len(table), 1))
        filters = json.loads(self.mine[DESCRIPTION])["layout"]["filters"]
        for name, parts_here in filters.items():
            if not self._has_counterpart(name, filters):
                continue
            parts = {
                path: table[:, begin:end].reshape(len(table), *shape)
                for path, (shape, begin, end) in self._old["filters"][name].items()
            }
            for path, part in relocate_parts(parts, parts_here).items():
                _, begin, end = parts_here[path]
                if end > begin:  # a part may have no number at all
                    states[:, begin:end] = part.reshape(len(table), -1)
        return states

    def _translate_numbers(self, numbers_before: np.ndarray, index_here: Mapping[int, int]) -> np.ndarray:
        """Return (row, measurements by node, inputs, time) in this network's order; new nodes get NaN.

        `numbers_before` are those of the other network. `index_here` maps a node's index there to its index here.
        """
        network, measurement_count = self.fleet.network, self.fleet.program.received
        input_and_time_count = self._old["given"] + 1  # these come last in both, behind the measurements
        numbers = np.full((len(numbers_before), measurement_count + input_and_time_count), np.nan)
        numbers[:, measurement_count:] = numbers_before[:, -input_and_time_count:]
        # The first column of each node, and the end of the last one's; a node has as many columns there as here.
        old_starts = np.cumsum([0, *self._old["nodes"].values()])
        starts = np.cumsum([0, *(network.nodes[name].received for name in network.names)])
        for old, new in index_here.items():
            if old >= 0:  # -1 stands for the inputs
                numbers[:, starts[new] : starts[new + 1]] = numbers_before[:, old_starts[old] : old_starts[old + 1]]
        return numbers


class _MovedRow(NamedTuple):
    """A row by its key, with the index of its node here, and its number among the rows of the other network."""

    time: float
    node: int
    sequence: int
    number_before: int
