"""Layout of a row of numbers: where the values of each node's events stand, and how many messages were lost before."""

from collections.abc import Mapping
from math import nan

from heliograph.live.event import INPUTS
from heliograph.live.health.sender_status import count_values_before_losses
from heliograph.live.sorted_rows import list_columns_of_blocks
from heliograph.model.trigger import AbstractTrigger
from heliograph.numerics.check import fail
from heliograph.simulation.network import Network


class RowLayout:
    """Layout of a row, which holds what came for one time: measurements of all nodes, the plant's inputs, the time.

    Nodes are known by their index in the network; the inputs have index -1.

    Attributes:
        names: names of the nodes in their order, then that of the inputs.
        sizes: {name of a node, or of the inputs: (its index, how many numbers its events have)}.
        columns: columns of each node in a row, in their order, then those of the inputs.
        width: how many numbers a row has before its time.
    """

    def __init__(self, network: Network, given: int, triggers: Mapping[str, AbstractTrigger]):
        """Lay out the rows of a network.

        Args:
            network: the network.
            given: number of its inputs without the time step.
            triggers: {node whose sender decides when to send: its trigger}.
        """
        self.names = [*network.names, INPUTS]
        self.sizes = {name: (i, network.nodes[name].received) for i, name in enumerate(network.names)}
        self.sizes[INPUTS] = -1, given
        self.columns = list_columns_of_blocks([size for _, size in self.sizes.values()])
        self.width: int = self.columns[-1].stop
        self._triggers = triggers
        # {index of a node: how many values its messages have, before its numbers of lost messages}, if they have any.
        self._values_before_losses = count_values_before_losses(network, triggers)

    def count_values(self, node: int) -> int:
        """Return how many numbers an event has of the node with this index, -1 for the inputs."""
        columns = self.columns[node]  # the inputs' columns are the last, so that -1 finds them
        return int(columns.stop - columns.start)

    def append_losses(self, node: str, values: list[float]) -> list[float]:
        """Return a message's values, followed by NaN for each number of lost messages if it does not state these.

        A filter of a sender that decides when to send needs to know how many messages were lost before each one: its
        messages are [measured values, numbers of lost messages]. A sender need not state the numbers, since they follow
        from its running count of messages, which later replaces the NaN. Other nodes' values are returned as they are.

        Raises:
            ValueError: values of a sender of single components, whose losses a count of messages does not say.
        """
        _, size = self.sizes[node]
        outputs = self.count_values_alone(node)
        if outputs is None:
            return values
        if len(values) == outputs:
            values = values + [nan] * (size - outputs)
        # Such a sender decides for each component by itself (region "each") and has to state the number of losses of
        # each one that arrived. x == x holds unless x is NaN.
        is_by_component = self._triggers[node].region == "each" and len(values) == size
        lacks_number = is_by_component and any(
            value == value and lost != lost for value, lost in zip(values[:outputs], values[outputs:], strict=True)
        )
        if lacks_number:
            expected = "behind each value how many of its component were lost since the last"
            raise fail(
                f"message of {node!r}, values", expected, "none, and its count is of messages, not of components"
            )
        return values

    def count_values_alone(self, node: str) -> int | None:
        """Return how many values a node's event has without numbers of lost messages; None if it has none of these."""
        return self._values_before_losses.get(self.sizes[node][0])

    def find_lost_column(self, node: int) -> tuple[str, int] | None:
        """Return the node's name and the column of its number of lost messages, or None if it has no such number."""
        outputs = self._values_before_losses.get(node)
        # With one number behind the values, all of a message is lost or none; with several, each component by itself.
        if outputs is None or self.count_values(node) != outputs + 1:
            return None
        return self.names[node], self.columns[node].start + outputs
