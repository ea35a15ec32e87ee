"""Rows on the device: what was heard at each, what the filters knew after it, and the one program that replays them."""

from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.live.mould import Mould
from heliograph.numerics.compiler import understood
from heliograph.numerics.module import Module
from heliograph.numerics.types import PyTree
from heliograph.simulation.judging import plausible_step, step_without
from heliograph.simulation.network import Network
from heliograph.simulation.stepping import AllFilters

READ = 64  # rows that are read at once
TOLD = "estimates", "fused", "judged", "judged_centrally"


class Tape(NamedTuple):
    """Rows in slots, in any order: what all nodes heard, what inputs were given (NaN where nothing was), and when.

    After each row: the filters' states, the inputs held, the number of the step, and the leaves of what they tell.

    Shapes: rows (slot, received + given + 1), held (slot, given), step (slot,).
    """

    rows: jax.Array
    state: PyTree
    held: jax.Array
    step: jax.Array
    told: list[jax.Array]

    def parts(self, slot: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        """What was heard at a row, what was given, and its time."""
        given = self.held.shape[1]
        row = self.rows[slot]
        return row[: -given - 1], row[-given - 1 : -1], row[-1]

    def known(self, slot: jax.Array) -> PyTree:
        """The filters' states after a row."""
        return jax.tree.map(lambda leaf: leaf[slot], self.state)


class Ears(Module):
    """All filters of a network; `places` of each group's nodes in a row of all that is heard, (node, received)."""

    filters: AllFilters
    places: tuple[tuple[tuple[int, ...], ...], ...] = eqx.field(static=True)

    def __init__(self, network: Network, filters: AllFilters):
        rows = network.rows()
        self.filters = filters
        self.places = tuple(tuple(tuple(rows[name].tolist()) for name in names) for names in network.groups)

    def step(self, state: PyTree, heard: jax.Array, u: jax.Array, k: jax.Array) -> tuple[PyTree, PyTree]:
        """One step of all, without what is implausible; what they tell is "estimates" by kind and "fused" by name.

        And "judged" and "judged_centrally" of what was heard, by kind and by name.
        """
        after, found = plausible_step(self.filters, state, self.groups(heard), u, k)
        return after, {name: found[name] for name in TOLD}

    def judged(self, state: PyTree, heard: jax.Array, u: jax.Array, k: jax.Array) -> tuple[PyTree, PyTree]:
        """The same with all that was heard, implausible or not."""
        after, found = self.filters.step(state, self.groups(heard), u, k)
        return after, {name: found[name] for name in TOLD}

    def without(
        self, first: tuple[PyTree, PyTree], state: PyTree, heard: jax.Array, u: jax.Array, k: jax.Array
    ) -> tuple[PyTree, PyTree]:
        """The step again, where each filter leaves out what it finds implausible."""
        after, found = step_without(self.filters, first, state, self.groups(heard), u, k)
        return after, {name: found[name] for name in TOLD}

    def groups(self, heard: jax.Array) -> list[jax.Array]:
        """What each group's nodes heard, (node, received)."""
        return [heard[np.array(place)] for place in self.places]


Replay = Callable[..., tuple[Tape, list[jax.Array]]]


@lru_cache
def replay(mould: Mould, dt: int | None) -> Replay:
    """The program (numbers, tape, row, order, (slot, start, stop)) -> (tape, what is told after the last row).

    It writes the row to the slot, and steps the filters over the slots order[start:stop], from the state after
    order[start - 1]. The tape is given away. `dt`: which input is the time since the row before; None where time counts
    steps: then the steps between two rows are taken too, with nothing heard. Compiling never knows how many there are.
    """
    move = _by_steps if dt is None else _over_time(dt)

    def run(
        numbers: list[jax.Array], tape: Tape, row: jax.Array, order: jax.Array, place: jax.Array
    ) -> tuple[Tape, list[jax.Array]]:
        item: Ears = mould.filled(numbers)
        slot, start, stop = place

        def one(i: jax.Array, tape: Tape) -> Tape:
            now = order[i]
            state, held, step, told = move(item, tape, order[i - 1], now)
            return tape._replace(
                state=jax.tree.map(lambda all_, new: all_.at[now].set(new), tape.state, state),
                held=tape.held.at[now].set(held),
                step=tape.step.at[now].set(step),
                told=[all_.at[now].set(new) for all_, new in zip(tape.told, told, strict=True)],
            )

        tape = jax.lax.fori_loop(start, stop, one, tape._replace(rows=tape.rows.at[slot].set(row)))
        return tape, [leaf[order[stop - 1]] for leaf in tape.told]

    return jax.jit(run, donate_argnums=1, compiler_options=understood())


Moved = tuple[PyTree, jax.Array, jax.Array, list[jax.Array]]  # after a row: states, inputs held, step, what is told


def _over_time(dt: int) -> Callable[[Ears, Tape, jax.Array, jax.Array], Moved]:
    """One step over the time between two rows, with the inputs held in between."""

    def move(item: Ears, tape: Tape, before: jax.Array, now: jax.Array) -> Moved:
        step, u = tape.step[before] + 1, interval(tape, before, now, dt)
        state, told = item.step(tape.known(before), tape.parts(now)[0], u, step)
        return state, held_after(tape, before, now), step, jax.tree.leaves(told)

    return move


def interval(tape: Tape, before: jax.Array, now: jax.Array, dt: int) -> jax.Array:
    """The inputs of a plant of continuous time from one row to another."""
    return jnp.insert(tape.held[before], dt, tape.parts(now)[2] - tape.parts(before)[2])


def _by_steps(item: Ears, tape: Tape, before: jax.Array, now: jax.Array) -> Moved:
    """The steps between two rows with nothing heard, and that of the row, to which its own inputs lead."""
    last = tape.parts(now)[2].astype(tape.step.dtype)

    def one(k: jax.Array, carry: tuple[PyTree, list[jax.Array]]) -> tuple[PyTree, list[jax.Array]]:
        state, told = item.step(carry[0], *at_step(tape, before, now, k), k)
        return state, jax.tree.leaves(told)

    begun = tape.known(before), [leaf[now] for leaf in tape.told]
    state, told = jax.lax.fori_loop(tape.step[before] + 1, last + 1, one, begun)
    return state, held_after(tape, before, now), last, told


def held_after(tape: Tape, before: jax.Array, now: jax.Array) -> jax.Array:
    """The inputs held after a row."""
    given = tape.parts(now)[1]
    return jnp.where(jnp.isnan(given), tape.held[before], given)


def at_step(tape: Tape, before: jax.Array, now: jax.Array, k: jax.Array) -> tuple[jax.Array, jax.Array]:
    """What is heard and given at step k, which is the row's or one between it and the row before."""
    heard, _, last = tape.parts(now)
    there = k == last.astype(tape.step.dtype)
    u = jnp.where(there, held_after(tape, before, now), tape.held[before])
    return jnp.where(there, heard, jnp.nan), u


@jax.jit
def read(told: list[jax.Array], slots: jax.Array) -> list[jax.Array]:
    """What was told after the rows in these slots, READ of them: what is on the tape itself must not be looked at."""
    return [leaf[slots] for leaf in told]


def copied(tape: Tape) -> list[np.ndarray]:
    """The leaves of a tape, which goes on to be used."""
    return [np.asarray(leaf) for leaf in _copy(jax.tree.leaves(tape))]


@jax.jit
def _copy(leaves: list[jax.Array]) -> list[jax.Array]:
    return [jnp.copy(leaf) for leaf in leaves]
