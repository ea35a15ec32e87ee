"""The program of a network on live data: its step as a function of rows, and the input that is its time step."""

from functools import cached_property

from heliograph.live.stored.snapshot import Identity, network_identity
from heliograph.model.checks.split_intervals import explain_uneven_prediction, find_indivisible_part
from heliograph.model.over_time import first, steps_covered
from heliograph.model.plant import TIME_STEP
from heliograph.numerics.caching import share_by_object
from heliograph.numerics.check import fail, instance
from heliograph.simulation.network import Network
from heliograph.simulation.node import Node
from heliograph.simulation.rows.row_smoother import RowSmoother
from heliograph.simulation.rows.row_step import RowStep


def find_time_input(network: Network) -> int | None:
    """Return the index of the plant's input dt, the time since the previous row; None if time counts steps.

    Raises:
        ValueError: a plant with the input dt in a network with parts that need step numbers: they vary over time or
            have memory.
    """
    if TIME_STEP not in network.inputs:
        return None
    expected = f"no part that goes by steps where the plant's time does not (its input {TIME_STEP!r})"
    if steps_covered(network) is not None:
        raise fail("timeline", expected, f"one that covers {steps_covered(network)} steps")
    if network.relays is not None:
        raise fail("timeline", expected, "relays that talk in slots")
    if what := find_indivisible_part(network.plant):
        raise fail("timeline", expected, what)
    for name, node in network.nodes.items():
        if isinstance(node, Node) and (what := find_indivisible_part(None, node.sensor, node.channel, node.trigger)):
            raise fail("timeline", expected, f"{what}, at node {name!r}")
    return network.inputs.index(TIME_STEP)


class NetworkProgram:
    """A network's step on rows, `step_rows`, one for each plant; plants come and go without compilation.

    `filter_columns` gives the columns of each filter's estimate and judgement among its outputs.

    `uneven` explains why the plant's intervals cannot be divided, "" if they can. Rows have `received` measurements and
    `given` inputs without the time step, whose number among the inputs is `dt`; None where time counts steps.

    Args:
        network: the network, with at least one filter.

    Raises:
        ValueError: no network, or one without filters.
    """

    def __init__(self, network: Network):
        """Compile the step of a network on rows; raise ValueError if it has no filter.

        A row is what came for one time: the measurements of all nodes, and the plant's inputs.
        """
        instance("network", network, Network, "a Network")
        self.network, self.claims, self.dt = network, network.claims(), find_time_input(network)
        if not any(self.claims.values()):
            raise fail("network", "at least one filter to run", "none")
        # Words on how one prediction over a time differs from several over its parts; "" if it does not.
        self.uneven = "" if self.dt is None else explain_uneven_prediction(first(network.plant), self.dt)
        # Sizes of a row: measurements of all nodes, and inputs other than dt.
        self.received = sum(node.received for node in network.nodes.values())
        self.given = len(network.inputs) - (self.dt is not None)
        self.step_rows = RowStep(network)
        self.filter_columns = self.step_rows.columns

    @cached_property
    def smoother(self) -> RowSmoother:
        """Return the smoother of these filters, compiled at the first call.

        Raises:
            ValueError: no filter that can be smoothed.
        """
        return RowSmoother(self.network, self.dt)

    @cached_property
    def identity(self) -> Identity:
        """Return versions, names and hashes of numbers of the network, by which a saved timeline is recognised."""
        return network_identity(self.network, self.step_rows.program, {})


shared_program = share_by_object(NetworkProgram)  # returns a network's program, which it makes at the first call
