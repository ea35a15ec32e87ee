"""Compiled programs of a network, shared by its timelines, and the arrays that the programs are called with."""

from functools import cached_property
from typing import Any
from weakref import WeakValueDictionary

import jax
import numpy as np

from heliograph.filters.plausibility import why_inputs, why_values
from heliograph.live.clock import time_input, uneven
from heliograph.live.event import INPUTS
from heliograph.live.history import History, NetworkStep, replay
from heliograph.live.identity import Identity, network_identity
from heliograph.live.later import Sweeper
from heliograph.live.static import cast
from heliograph.model.over_time import first
from heliograph.numerics.check import fail
from heliograph.numerics.types import PyTree
from heliograph.simulation.judging import Judges
from heliograph.simulation.network import Network
from heliograph.simulation.stepping import AllFilters, begun


class Player:
    """A network's filters, compiled, with their arrays: shared by all timelines of the network.

    `structure` is that of the outputs; `uneven` explains why the plant's intervals cannot be divided, "" if they can.
    The rows of a history have `received` measurements and `given` inputs.
    """

    def __init__(self, network: Network):
        self.network, self.dt = network, time_input(network)
        self.uneven = "" if self.dt is None else uneven(first(network.plant), self.dt)
        # Sizes of a row: measurements of all nodes, and inputs other than dt.
        self.claims, inputs = network.claims(), len(network.inputs)
        self.received = sum(node.received for node in network.nodes.values())
        self.given = inputs - (self.dt is not None)
        with jax.enable_x64(True):
            filters = AllFilters(network, judges=True)
            for name, link in filters.reporting.items():
                if link.uplinks.groups:
                    expected = "reports that arrive as they are sent, or the fusion as a filter (centre_filter)"
                    raise fail(f"timeline: fusion {name!r}", expected, "links that chance has a part in")
            # Arrays apart from structure: the program is called with the arrays only.
            network_step = NetworkStep(network, filters)
            self.numbers, static = cast(network_step)
            self.start = begun(network_step.filters)
            data = self.numbers, self.start, np.zeros(self.received), np.zeros(inputs), np.asarray(0)
            outputs = jax.eval_shape(lambda numbers, *row: static.filled(numbers).step(*row)[1], *data)
        self._like, self.structure = jax.tree.leaves(outputs), jax.tree.structure(outputs)
        self.replay, self._judges = replay(static, self.dt), Judges(network)

    def why(self, outputs: list[np.ndarray], node: str) -> str | None:
        """Explain why a node's event at a row is implausible, from the outputs after the row; None if it is not."""
        result = jax.tree.unflatten(self.structure, outputs)
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
        return Sweeper(self.network, self.dt, self.structure)

    @cached_property
    def identity(self) -> Identity:
        """Return the identity of the network and its program, which a saved timeline is compared with."""
        two = np.zeros(2, dtype=np.int32)
        program: Any = self.replay  # the compiler's functions have no type that says so
        with jax.enable_x64(True):
            history = self.blank(2, 0.0)
            lowered = program.lower(
                self.numbers, history, np.asarray(history.rows[0]), two, np.zeros(3, dtype=np.int32)
            )
        return network_identity(self.network, lowered.as_text(), {})

    def blank(self, slots: int, time: float) -> History:
        """Return an empty history, with the filters' priors in slot 0, at `time`."""
        rows = np.full((1, self.received + self.given + 1), np.nan)
        rows[0, -1] = time
        state = jax.tree.map(lambda leaf: np.asarray(leaf)[None], self.start)
        outputs = [np.zeros((1, *leaf.shape), leaf.dtype) for leaf in self._like]
        begun = rows, state, np.zeros((1, self.given)), np.full(1, -1), outputs
        return self.filled(slots, begun)

    def filled(self, slots: int, some: tuple[PyTree, ...]) -> History:
        """Return a history with these rows in its first slots; the others repeat the first row and are never read."""

        def repeated(part: np.ndarray) -> jax.Array:
            rest = np.repeat(part[:1], slots - len(part), axis=0)
            both = np.concatenate([part, rest])
            copied: jax.Array = jax.device_put(
                both, may_alias=False
            )  # no alias, since a history is donated; device_put compiles nothing
            return copied

        with jax.enable_x64(True):
            return History(*jax.tree.map(repeated, tuple(some)))


_SHARED: WeakValueDictionary[int, Player] = WeakValueDictionary()  # by the id of a network, which its entry keeps


def player(network: Network) -> Player:
    """Return the player of this network, made at the first call."""
    result = _SHARED.get(id(network))
    if result is None:
        result = _SHARED[id(network)] = Player(network)
    return result
