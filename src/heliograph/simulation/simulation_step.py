"""One step of a simulation: the plant moves, its nodes receive measurements, every filter is stepped."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.model.estimate import Estimate
from heliograph.model.markov_jump_models import ModalPlant
from heliograph.model.over_time import at
from heliograph.model.plant import AbstractPlant, AnyPlant
from heliograph.numerics.check import fail
from heliograph.numerics.module import Module
from heliograph.numerics.types import PyTree
from heliograph.random_affine.memories_of_channels import condition_on_memories
from heliograph.simulation.network_filters import AllFilters
from heliograph.simulation.random_keys import INITIAL, PROCESS, WORLD, draw_key
from heliograph.simulation.transmission.channel_draws import (
    PLANT,
    move_modes,
    number_memory_seeds,
    start_modes,
)
from heliograph.simulation.transmission.medium import AbstractMedium
from straightline import present


class World(Module):
    """A network as it is simulated: the plant, the transmission to the nodes, and all filters."""

    plant: AnyPlant
    medium: AbstractMedium
    filters: AllFilters

    def init(self, key: jax.Array) -> PyTree:
        """Return the state before the first step of the run with this key, as a tuple.

        Its entries: the state x (n,) of the plant; the state of the medium, which is all channels; the states of all
        filters; the states of the links between neighbours, by fusion; and the states of the plant's memories, its
        modes.
        """
        plant = at(self.plant, k=0)
        if isinstance(plant, ModalPlant) and plant.rates is not None:
            expected = "transitions of a plant's modes by steps (with rates filter recordings, simulate T = exp(G dt))"
            raise fail("simulation", expected, "rates of switches")
        x = plant.sample_initial(draw_key(key, k=0, source=WORLD, purpose=INITIAL))
        modes = start_modes(plant, key, self._memory_numbers)
        edges = {name: mesh.edges.init(key) for name, mesh in self.filters.meshes.items()}
        return x, self.medium.init(key), self.filters.init(), edges, modes

    @property
    def _memory_numbers(self) -> np.ndarray:
        """Numbers that seed the draws of the plant's memories (memories,)."""
        return number_memory_seeds({PLANT: self.plant}, self.plant)[PLANT]

    def step(self, carry: PyTree, key: jax.Array, row: tuple[jax.Array, jax.Array]) -> tuple[PyTree, PyTree]:
        """Step the world over step k: return its next state, and what is recorded of the step.

        Args:
            carry: state before the step: x (n,) of the plant, states of the medium (all channels to the nodes), of the
                filters and of the links between neighbours, and the modes of the plant's memories (Markov chains).
            key: random key of the run.
            row: (k, inputs of the plant over step k).

        Returns:
            The next state, and "truth" (n,), "measurements" (node, received) by group of nodes, "transmissions" by
            group (why senders with a trigger sent), and all that `AllFilters.step` puts out, with estimated angles
            within half a turn of the true ones.
        """
        x, medium, states, edges, modes = carry
        k, u = row
        # The plant moves, in the present modes of its memories, and its nodes receive.
        plant = condition_on_memories(at(self.plant, k), modes)
        x = plant.plus(plant.transition(x, u), plant.sample_noise(draw_key(key, k, WORLD, PROCESS), u))
        medium, z = self.medium.receive(medium, x, u, key, k)
        # Measurements that always arrive in full are marked, so that native code need not look for NaN.
        z = tuple(present(values) if full else values for values, full in zip(z, self.filters.complete, strict=True))
        # Draw which reports to a centre and which messages between neighbours arrive; then step all filters.
        drawn: dict[str, PyTree] = {}
        edges_after: dict[str, PyTree] = {}
        for name, by_report in self.filters.reporting.items():
            drawn[name] = by_report.uplinks.draw(key, k)
        for name, mesh in self.filters.meshes.items():
            edges_after[name], drawn[name] = mesh.edges.draw(edges[name], key, k)
        states, outputs = self.filters.step(states, z, u, k, drawn)
        modes = move_modes(self.plant, modes, key, k, self._memory_numbers)
        after = x, self.medium.feed_back(medium, outputs["estimates"]), states, edges_after, modes
        results = {
            "truth": x,
            "measurements": z,
            "transmissions": self.medium.reasons(medium),
            **_turn_angles_to_truth(plant, x, outputs),
        }
        return after, results


def _turn_angles_to_truth(plant: AbstractPlant, x: jax.Array, outputs: dict[str, PyTree]) -> dict[str, PyTree]:
    """Return the outputs with estimated angles moved by full turns to within half a turn of the truth x.

    Then x - xhat is the error of an angle.
    """
    if not plant.circular:
        return outputs

    def turn(estimate: Estimate) -> Estimate:
        """Return an estimate with its angles within half a turn of those of x, the true state."""
        return replace(estimate, mean=plant.near(jnp.asarray(estimate.mean), x))

    estimates = {key: outputs[key] for key in ("estimates", "fused")}
    return {**outputs, **jax.tree.map(turn, estimates, is_leaf=lambda leaf: isinstance(leaf, Estimate))}
