"""Rows in device memory: measurements, the filters' states after them, and the program that steps through them."""

from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.live.static import Static
from heliograph.numerics.float64 import understood
from heliograph.numerics.module import Module
from heliograph.numerics.types import PyTree
from heliograph.simulation.judging import plausible_step, step_without
from heliograph.simulation.network import Network
from heliograph.simulation.stepping import AllFilters

READ = 64  # rows that are read at once
OUTPUTS = "estimates", "fused", "judged", "judged_centrally", "weighed", "weighed_centrally"


class History(NamedTuple):
    """Rows in slots, in any order: measurements of all nodes, inputs (NaN where none was given), and the time.

    For each row there are also the filters' states after it, the inputs held, the step number, and the leaves of the
    outputs.

    Shapes: rows (slot, received + given + 1), held (slot, given), step (slot,).
    """

    rows: jax.Array
    state: PyTree
    held: jax.Array
    step: jax.Array
    outputs: list[jax.Array]

    def parts(self, slot: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Return the measurements, the inputs and the time of a row."""
        given = self.held.shape[1]
        row = self.rows[slot]
        return row[: -given - 1], row[-given - 1 : -1], row[-1]

    def known(self, slot: jax.Array) -> PyTree:
        """Return the filters' states after a row."""
        return jax.tree.map(lambda leaf: leaf[slot], self.state)


class NetworkStep(Module):
    """Step of all filters of a network; `places` are the indices of each group's nodes in a row, (node, received)."""

    filters: AllFilters
    places: tuple[tuple[tuple[int, ...], ...], ...] = eqx.field(static=True)

    def __init__(self, network: Network, filters: AllFilters):
        rows = network.rows()
        self.filters = filters
        self.places = tuple(tuple(tuple(rows[name].tolist()) for name in names) for names in network.groups)

    def step(self, state: PyTree, received: jax.Array, u: jax.Array, k: jax.Array) -> tuple[PyTree, PyTree]:
        """Step all filters, without implausible measurements; return the states and the outputs.

        The outputs are "estimates" by kind and "fused" by name, and the judgements of the measurements, "judged" by
        kind and "judged_centrally" by name; "weighed" and "weighed_centrally" likewise, of filters that weigh.
        """
        after, result = plausible_step(self.filters, state, self.groups(received), u, k)
        return after, {name: result[name] for name in OUTPUTS}

    def judged(self, state: PyTree, received: jax.Array, u: jax.Array, k: jax.Array) -> tuple[PyTree, PyTree]:
        """Step all filters with every measurement, implausible or not."""
        after, result = self.filters.step(state, self.groups(received), u, k)
        return after, {name: result[name] for name in OUTPUTS}

    def without(
        self, first: tuple[PyTree, PyTree], state: PyTree, received: jax.Array, u: jax.Array, k: jax.Array
    ) -> tuple[PyTree, PyTree]:
        """Repeat the step, each filter without the measurements that it finds implausible."""
        after, result = step_without(self.filters, first, state, self.groups(received), u, k)
        return after, {name: result[name] for name in OUTPUTS}

    def groups(self, received: jax.Array) -> list[jax.Array]:
        """Return the measurements of each group's nodes, (node, received)."""
        return [received[np.array(place, dtype=int)] for place in self.places]  # of nodes without a sensor none


Replay = Callable[..., tuple[History, list[jax.Array]]]


@lru_cache
def replay(static: Static, dt: int | None) -> Replay:
    """Compile the program (numbers, history, row, order, (slot, start, stop)) -> (history, outputs after the last row).

    It writes the row to the slot, and steps the filters over the slots order[start:stop], from the state after
    order[start - 1]. The history is donated: its buffers are reused. `dt` is the index of the input that is the time
    since the previous row; None means that time counts steps, in which case the steps between two rows are taken too,
    without measurements. The program does not depend on the number of rows.
    """
    # Continuous time: one step between two rows. Discrete time: as many as their step numbers differ by.
    move = _by_steps if dt is None else _over_time(dt)

    def run(
        numbers: list[jax.Array], history: History, row: jax.Array, order: jax.Array, place: jax.Array
    ) -> tuple[History, list[jax.Array]]:
        item: NetworkStep = static.filled(numbers)
        slot, start, stop = place

        # One row: from the state after the previous one in the order; the results go to the slot of the row.
        def single(i: jax.Array, history: History) -> History:
            now = order[i]
            state, held, step, outputs = move(item, history, order[i - 1], now)
            return history._replace(
                state=jax.tree.map(lambda all_, new: all_.at[now].set(new), history.state, state),
                held=history.held.at[now].set(held),
                step=history.step.at[now].set(step),
                outputs=[all_.at[now].set(new) for all_, new in zip(history.outputs, outputs, strict=True)],
            )

        history = jax.lax.fori_loop(start, stop, single, history._replace(rows=history.rows.at[slot].set(row)))
        return history, [leaf[order[stop - 1]] for leaf in history.outputs]

    return jax.jit(run, donate_argnums=1, compiler_options=understood())


Moved = tuple[PyTree, jax.Array, jax.Array, list[jax.Array]]  # after a row: states, inputs held, step, outputs


def _over_time(dt: int) -> Callable[[NetworkStep, History, jax.Array, jax.Array], Moved]:
    """Return the step over the time between two rows, with the inputs held in between."""

    def move(item: NetworkStep, history: History, before: jax.Array, now: jax.Array) -> Moved:
        step, u = history.step[before] + 1, interval(history, before, now, dt)
        state, outputs = item.step(history.known(before), history.parts(now)[0], u, step)
        return state, held_after(history, before, now), step, jax.tree.leaves(outputs)

    return move


def interval(history: History, before: jax.Array, now: jax.Array, dt: int) -> jax.Array:
    """Return the inputs of a plant of continuous time from one row to another."""
    return jnp.insert(history.held[before], dt, history.parts(now)[2] - history.parts(before)[2])


def _by_steps(item: NetworkStep, history: History, before: jax.Array, now: jax.Array) -> Moved:
    """Take the steps between two rows without measurements, then the step into the row."""
    last = history.parts(now)[2].astype(history.step.dtype)

    def single(k: jax.Array, carry: tuple[PyTree, list[jax.Array]]) -> tuple[PyTree, list[jax.Array]]:
        state, outputs = item.step(carry[0], *at_step(history, before, now, k), k)
        return state, jax.tree.leaves(outputs)

    begun = history.known(before), [leaf[now] for leaf in history.outputs]
    state, outputs = jax.lax.fori_loop(history.step[before] + 1, last + 1, single, begun)
    return state, held_after(history, before, now), last, outputs


def held_after(history: History, before: jax.Array, now: jax.Array) -> jax.Array:
    """Return the inputs held after a row."""
    given = history.parts(now)[1]
    return jnp.where(jnp.isnan(given), history.held[before], given)


def at_step(history: History, before: jax.Array, now: jax.Array, k: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return measurements and inputs at step k, which is the row's or one between it and the previous row."""
    received, _, last = history.parts(now)
    there = k == last.astype(history.step.dtype)
    u = jnp.where(there, held_after(history, before, now), history.held[before])
    return jnp.where(there, received, jnp.nan), u


@jax.jit
def read(outputs: list[jax.Array], slots: jax.Array) -> list[jax.Array]:
    """Read the outputs after the rows in these READ slots; the donated buffers themselves must not be read."""
    return [leaf[slots] for leaf in outputs]


def copied(history: History) -> list[np.ndarray]:
    """Copy the leaves of a history that remains in use."""
    return [np.asarray(leaf) for leaf in _copy(jax.tree.leaves(history))]


@jax.jit
def _copy(leaves: list[jax.Array]) -> list[jax.Array]:
    return [jnp.copy(leaf) for leaf in leaves]
