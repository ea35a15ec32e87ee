"""Messages that the service of a node sends to its neighbours' services, in a fusion without a centre."""

from collections.abc import Callable, Iterable

import numpy as np
from pydantic_core import to_json

from heliograph.live.fleet import Fleet
from heliograph.live.plant_state import PlantState
from heliograph.live.sorted_rows import HeldRow
from heliograph.serving.output import Output
from heliograph.simulation.mesh.node_filter import NodeFilter

Moment = Callable[[PlantState, float], float | str]


class NeighbourMessenger:
    """Makes a node's messages to its neighbours: one a step, with the estimate before the step and the measurement.

    A step's message goes with the measurement; from a node without a sensor when anything of the step comes, and where
    a measurement is missing when the next step has begun. A message that is lost is lost: what neighbours claim stands.

    Args:
        fleet: the plants; of a network that is no single node nothing is sent.
        moment: time of a row of a plant, as messages have it.
    """

    def __init__(self, fleet: Fleet, moment: Moment):
        """Find the node's filter if the network is a single node; `moment` returns a row's time as in messages."""
        self.fleet, self._moment = fleet, moment
        nodes = {name: filter for name, filter in fleet.network.fused.items() if isinstance(filter, NodeFilter)}
        # Name and filter of the node; "" and None if the network is no single node, which sends nothing.
        self._name = next(iter(nodes), "")
        self._node = nodes.get(self._name)

    @property
    def sends(self) -> bool:
        """Return whether this is a node that sends messages to its neighbours."""
        return self._node is not None

    def make_messages(self, plants: Iterable[PlantState]) -> list[Output]:
        """Return the messages to neighbours that are due after the events since rows last became final.

        There are none if the network is not a single node.
        """
        if self._node is None:
            return []
        return [
            output
            for plant in plants
            for row in self._find_due_rows(plant)
            for output in self._make_row_messages(plant, row)
        ]

    def _find_due_rows(self, plant: PlantState) -> list[HeldRow]:
        """Return the rows (steps) whose message to the neighbours became due since rows last became final.

        A message is due once its row has the node's measurement, or once there is a later row: the step is then over.
        """
        assert self._node is not None
        # `plant.changes`: (row, what it was then), where None stands for a new row. By changed row: whether it had the
        # node's measurement then.
        measured_before: dict[int, bool] = {}
        for row, old in plant.changes:
            measured_before.setdefault(id(row), old is not None and self._has_measurement(old[1]))
        new = {id(row) for row, old in plant.changes if old is None}
        held, due = plant.rows.held, []
        # The last row that was there before; those ahead of it that were there too were followed, and so due, already.
        newest_before = max((i for i, row in enumerate(held) if id(row) not in new), default=0)
        for i, row in enumerate(held[1:], 1):
            followed_before = id(row) not in new and i < newest_before
            was_due_before = followed_before or measured_before.get(id(row), self._has_measurement(row.events))
            is_due = self._has_measurement(row.events) or i + 1 < len(held)
            if is_due and not was_due_before:
                due.append(row)
        return due

    def _has_measurement(self, events: Iterable[tuple[int, int, float]]) -> bool:
        """Return whether events include the node's measurement, or for a node without a sensor any neighbour's message.

        Without a sensor, neighbours' messages are the first sign that a step has begun. An event is (number of the
        sender, count, time): number 0 is the node itself, greater ones its neighbours, negative ones inputs.
        """
        assert self._node is not None
        return any(node == 0 or (node > 0 and not self._node.measured[0]) for node, _, _ in events)

    def _make_row_messages(self, plant: PlantState, row: HeldRow) -> list[Output]:
        """Return a row's message to each neighbour: the estimate and covariance before the row, and its measurement."""
        assert self._node is not None
        state_table, network = self.fleet.state_table, self.fleet.network
        _, central, *_ = state_table.step_rows.state.tree(state_table.table[row.slot, state_table.state])
        mean, covariance = self._node.sent(central[self._name].before)
        measurement = row.numbers[: self._node.measured[0]]
        values = np.concatenate([mean, np.ravel(covariance), measurement]).tolist()
        time = int(row.key[0])
        message = {"plant": plant.name, "node": network.names[0], "sequence": time, "values": values}
        body = to_json(message | {"time": self._moment(plant, row.key[0])}, inf_nan_mode="null")
        return [Output(None, plant.name, "message", body, name) for name in self._node.receivers]
