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
        """Find the node whose messages are made, if the network is the program of a single node of a mesh.

        Args:
            fleet: the plants.
            moment: returns a row's time as messages have it, from its plant and the number of the time.
        """
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
        The returned rows are due now, and were not due before the plant's recorded changes.
        """
        # The first change of a row tells whether it had the node's measurement before all of them.
        measured_before: dict[int, bool] = {}  # by id of the row
        new_rows = set[int]()
        for row, before in plant.changes:
            events_before = {} if before is None else before.events
            measured_before.setdefault(id(row), self._has_measurement(events_before))
            if before is None:
                new_rows.add(id(row))
        held, due = plant.rows.held, []
        index_of_newest_before = max((i for i, row in enumerate(held) if id(row) not in new_rows), default=0)
        for i, row in enumerate(held[1:], 1):  # row 0 is final
            is_measured, is_followed = self._has_measurement(row.events), i + 1 < len(held)
            was_measured = measured_before.get(id(row), is_measured)  # a row without a change is as it was
            was_followed = id(row) not in new_rows and i < index_of_newest_before
            if (is_measured or is_followed) and not (was_measured or was_followed):
                due.append(row)
        return due

    def _has_measurement(self, events: Iterable[tuple[int, int, float]]) -> bool:
        """Return whether events include the node's measurement, or for a node without a sensor any neighbour's message.

        Without a sensor, neighbours' messages are the first sign that a step has begun. An event is (number of the
        sender, count, time): number 0 is the node itself, greater ones its neighbours, negative ones inputs.
        """
        assert self._node is not None
        has_sensor = self._node.measured[0] > 0  # `measured`: how many numbers the node and its neighbours measure
        return any(node == 0 or (node > 0 and not has_sensor) for node, _, _ in events)

    def _make_row_messages(self, plant: PlantState, row: HeldRow) -> list[Output]:
        """Return a row's message to each neighbour, whose values are [mean, covariance, measurement].

        Mean and covariance are the node's estimate before the row; the covariance stands row by row.
        """
        assert self._node is not None
        state_table, network = self.fleet.state_table, self.fleet.network
        # A row's state has the filters of nodes, then the central ones by name, among which the node's is.
        _, central, *_ = state_table.step_rows.state.tree(state_table.table[row.slot, state_table.state])
        mean, covariance = self._node.sent(central[self._name].before)
        measurement = row.numbers[: self._node.measured[0]]
        values = np.concatenate([mean, np.ravel(covariance), measurement]).tolist()
        step = int(row.key[0])  # also the running count, as there is one message a step
        message = {"plant": plant.name, "node": network.names[0], "sequence": step, "values": values}
        body = to_json(message | {"time": self._moment(plant, row.key[0])}, inf_nan_mode="null")
        return [Output(None, plant.name, "message", body, name) for name in self._node.receivers]
