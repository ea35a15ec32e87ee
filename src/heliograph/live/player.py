"""Time of a network and its intervals, and its compiled programs, shared by its timelines."""

from functools import cached_property
from weakref import WeakValueDictionary

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.filters.plausibility import why_inputs, why_values
from heliograph.live.event import INPUTS
from heliograph.live.later import Sweeper
from heliograph.live.row_step import RowStep
from heliograph.live.snapshot import Identity, network_identity
from heliograph.model.over_time import first, steps_covered
from heliograph.model.plant import AbstractPlant
from heliograph.numerics.check import fail
from heliograph.simulation.judging import Judges
from heliograph.simulation.network import Network
from heliograph.simulation.node import Node
from heliograph.simulation.stepping import AllFilters, begun

TIME_STEP = "dt"  # the input that a plant of continuous time has
CUTS = ((0.0, 1.0), (0.25, 0.75), (1.0, 0.0))  # of an interval of length one, in the plant's own unit
TOLERANCE = 1e-9  # relative: a few products lose 1e-15


def time_input(network: Network) -> int | None:
    """Return the index of the plant's input that is the time since the previous row; None if time counts steps.

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
    for name, node in network.nodes.items():
        if isinstance(node, Node) and first(node.channel).remembers:
            raise fail("timeline", expected, f"a channel that remembers, at node {name!r}")
        if isinstance(node, Node) and node.trigger is not None:
            raise fail("timeline", expected, f"a sender with a trigger, at node {name!r}")
    return network.inputs.index(TIME_STEP)


def uneven(plant: AbstractPlant, dt: int) -> str:
    """Explain how a plant's prediction over an interval differs from that over its parts; "" if it does not.

    f(f(x, s), t) = f(x, s + t), A(s + t) = A(t) A(s), Q(s + t) = A(t) Q(s) A(t)' + Q(t), with A the Jacobian of f. We
    test these around the initial mean, with all other inputs 1; s = 0 and t = 0 are among the divisions.
    """
    with jax.enable_x64(True):
        mean, spread = np.asarray(plant.initial_mean), np.sqrt(np.diag(np.asarray(plant.initial_covariance)))
        # At the initial mean, and one standard deviation from it.
        for x in (mean, mean + spread):
            for s, t in CUTS:
                whole, parts = _moved(plant, dt, x, (s + t,)), _moved(plant, dt, x, (s, t))
                for what, item, two in zip(("transition", "Jacobian", "noise"), whole, parts, strict=True):
                    gap = float(np.abs(item - two).max())
                    if not gap <= TOLERANCE * max(1.0, float(np.abs(item).max())):
                        return f"{what} over {s:g} and then {t:g} differs by {gap:.3g} from that over {s + t:g}"
    return ""


def _moved(
    plant: AbstractPlant, dt: int, x: np.ndarray, parts: tuple[float, ...]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return state, Jacobian and noise covariance after these intervals."""
    n = len(x)
    state, matrix, spread = jnp.asarray(x), jnp.eye(n), jnp.zeros((n, n))
    for part in parts:
        u = jnp.ones(len(plant.inputs)).at[dt].set(part)
        a = jax.jacfwd(plant.transition)(state, u)
        state, matrix, spread = (
            plant.transition(state, u) + plant.noise_mean(), a @ matrix, a @ spread @ a.T + plant.noise_covariance(u),
        )  # fmt: skip
    return np.asarray(state), np.asarray(matrix), np.asarray(spread)


class Player:
    """A network's filters, compiled, with their arrays: shared by all timelines of the network.

    `step_rows` steps rows of numbers; `uneven` explains why the plant's intervals cannot be divided, "" if they can.
    The rows of a history have `received` measurements and `given` inputs.
    """

    def __init__(self, network: Network):
        self.network, self.dt = network, time_input(network)
        self.uneven = "" if self.dt is None else uneven(first(network.plant), self.dt)
        # Sizes of a row: measurements of all nodes, and inputs other than dt.
        self.claims, self._judges = network.claims(), Judges(network)
        self.received = sum(node.received for node in network.nodes.values())
        self.given = len(network.inputs) - (self.dt is not None)
        with jax.enable_x64(True):
            filters = AllFilters(network, judges=True, tests=True)
            for name, link in filters.reporting.items():
                if link.uplinks.groups:
                    expected = "reports that arrive as they are sent, or the fusion as a filter (centre_filter)"
                    raise fail(f"timeline: fusion {name!r}", expected, "links that chance has a part in")
            self.step_rows = RowStep(network, filters, begun(filters))

    def why(self, outputs: np.ndarray, node: str) -> str | None:
        """Explain why a node's event at a row is implausible, from the outputs after the row; None if it is not."""
        result = self.step_rows.outputs.tree(outputs)
        return (
            why_inputs(self._judges.of_all(result))
            if node == INPUTS
            else why_values(self._judges.of_node(result, node))
        )

    @cached_property
    def sweeper(self) -> Sweeper:
        """Return the smoother of these filters, compiled at the first call.

        Raises:
            ValueError: no filter that can be smoothed.
        """
        return Sweeper(self.network, self.dt)

    @cached_property
    def identity(self) -> Identity:
        """Return the identity of the network and its program, which a saved timeline is compared with."""
        return network_identity(self.network, self.step_rows.program(), {})


_SHARED: WeakValueDictionary[int, Player] = WeakValueDictionary()  # by the id of a network, which its entry keeps


def player(network: Network) -> Player:
    """Return the player of this network, made at the first call."""
    result = _SHARED.get(id(network))
    if result is None:
        result = _SHARED[id(network)] = Player(network)
    return result
