"""Steps of many plants of one network: one compiled program, however many are due.

So plants come and go without compiling, and no bit of an estimate depends on whose steps were taken beside it.
"""

from functools import lru_cache, partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.filters.base import AbstractFilter
from heliograph.live.mould import Mould, cast
from heliograph.live.player import player
from heliograph.live.tape import Ears
from heliograph.model.estimate import Claim
from heliograph.numerics.check import fail, instance
from heliograph.numerics.compiler import understood
from heliograph.numerics.over_runs import runs_last
from heliograph.numerics.small_matrix import squared_distance
from heliograph.numerics.types import Float, PyTree
from heliograph.serving.flat import Flat, flat_like, row_of
from heliograph.simulation.by_name import by_name
from heliograph.simulation.network import FUSED, Network
from heliograph.simulation.stepping import AllFilters

TOGETHER = 16  # lanes of one turn of the loop: they fill the vectors of a processor
WIDTH = 512  # lanes of one call


class Place(NamedTuple):
    """Where a filter's estimate begins in what is told: its mean, its covariance, its surprise (None: it has none)."""

    node: str
    filter: str
    claim: Claim
    mean: int
    covariance: int
    surprise: int | None


class Lanes:
    """A network's step as a function of rows: (state, heard, inputs, number of the step) to (state, told).

    `told` is the estimates' leaves, and of each node's filter its normalised innovation squared and how many numbers
    were heard; `places` says where.
    """

    def __init__(self, network: Network):
        instance("network", network, Network, "a Network")
        if not any(network.claims().values()):
            raise fail("network", "at least one filter to run", "none")
        shared = player(network)
        self.network, self.dt, self.uneven = network, shared.dt, shared.uneven
        self.received, self.given, self.inputs = shared.received, shared.given, len(network.inputs)
        with jax.enable_x64(True):
            ears = Ears(network, AllFilters(network))
            self._numbers, mould = cast(ears)
            self.state, self.start = flat_like(shared.start), np.asarray(row_of(shared.start))
            row = shared.start, np.zeros(self.received), np.zeros(self.inputs), np.asarray(0)
            like = jax.eval_shape(lambda numbers, *row: _step(mould.filled(numbers), *row)[1], self._numbers, *row)
        self.told = flat_like(like)
        self.places = self._places()
        self._run = _program(mould, self.state, self.received, self.inputs)

    def program(self) -> str:
        """What is computed, as a text on which two processes agree."""
        with jax.enable_x64(True):
            text: str = self._run.lower(self._numbers, np.zeros((WIDTH, self._columns)), np.int32(0)).as_text()
        return text

    @property
    def _columns(self) -> int:
        return self.state.size + self.received + self.inputs + 1

    def step(self, rows: Float[np.ndarray, "lane column"]) -> Float[np.ndarray, "lane column"]:
        """Step each row; (state, told) of each."""
        done = np.empty((len(rows), self.state.size + self.told.size))
        filled = np.zeros((WIDTH, self._columns))
        for begin in range(0, len(rows), WIDTH):
            count = min(WIDTH, len(rows) - begin)
            filled[:count] = rows[begin : begin + count]
            with jax.enable_x64(True):
                found = self._run(self._numbers, filled, np.int32(-(-count // TOGETHER)))
            done[begin : begin + count] = np.asarray(found)[:count]
        return done

    def _places(self) -> tuple[Place, ...]:
        """Where each number is told: a row of the numbers of its columns is named as a row of estimates would be."""
        found = jax.tree.map(lambda leaf: leaf.astype(int), self.told.tree(np.arange(float(self.told.size))))
        mean = by_name(self.network, found, lambda part: np.asarray(part.mean), -3)
        covariance = by_name(self.network, found, lambda part: np.asarray(part.covariance), -4)
        surprise = by_name(self.network, {"estimates": found["surprise"], "fused": {}}, np.asarray, -3)
        return tuple(
            Place(node, name, claim, int(mean[node][name].flat[0]), int(covariance[node][name].flat[0]),
                  None if node == FUSED else int(surprise[node][name].flat[0]))
            for node, filters in self.network.claims().items()
            for name, claim in filters.items()
        )  # fmt: skip


@lru_cache
def _program(mould: Mould, state: Flat, received: int, inputs: int) -> PyTree:
    """(numbers, rows, turns) to rows: a loop over TOGETHER lanes, so that what is computed does not depend on turns."""

    def run(numbers: list[jax.Array], rows: jax.Array, turns: jax.Array) -> jax.Array:
        item: Ears = mould.filled(numbers)

        def one(row: jax.Array) -> jax.Array:
            known, rest = row[: state.size], row[state.size :]
            u, k = rest[received : received + inputs], rest[-1].astype(np.int64)
            after, told = _step(item, state.tree(known), rest[:received], u, k)
            return jnp.concatenate([row_of(after), row_of(told)])

        def turn(i: jax.Array, done: jax.Array) -> jax.Array:
            some = jax.lax.dynamic_slice_in_dim(rows, i * TOGETHER, TOGETHER)
            return jax.lax.dynamic_update_slice_in_dim(done, jax.vmap(one)(some), i * TOGETHER, 0)

        width = jax.eval_shape(one, rows[0]).shape[0]
        stepped: jax.Array = jax.lax.fori_loop(0, turns, turn, jnp.zeros((WIDTH, width)))
        return stepped

    return jax.jit(run, compiler_options=understood())


def _step(item: Ears, state: PyTree, heard: jax.Array, u: jax.Array, k: jax.Array) -> tuple[PyTree, dict[str, PyTree]]:
    """One step of all filters, and what is told of it."""
    after, told = item.step(state, heard, u, k)
    groups = item.groups(heard)
    surprise = []
    for kind, own in zip(item.filters.alike, state[0], strict=True):
        z = jnp.tile(groups[kind.group], (kind.count, 1))
        each = eqx.filter_vmap(partial(_surprise, u=u, k=k), in_axes=(eqx.if_array(0), 0, 0))
        both = each(kind.filters, own, z)
        surprise.append(both.reshape(kind.count, kind.nodes, 2))
    return after, told | {"surprise": tuple(surprise)}


def _surprise(item: AbstractFilter, state: PyTree, z: jax.Array, u: jax.Array, k: jax.Array) -> jax.Array:
    """e' S^-1 e of the numbers that were heard, and how many these are: what it is on average if S is the truth."""
    _, innovation = item.correct(item.predict(state, u, k), z, k)
    value, covariance = jnp.asarray(innovation.value), jnp.asarray(innovation.covariance)
    there = ~jnp.isnan(value)
    known = jnp.where(there[:, None] & there, covariance, jnp.eye(len(value)))
    squared = _distance(known, jnp.where(there, value, 0.0)) if len(value) else jnp.zeros(())
    return jnp.stack([jnp.where(there.any(), squared, jnp.nan), jnp.sum(there).astype(np.float64)])


@runs_last
def _distance(covariance: jax.Array, value: jax.Array) -> jax.Array:
    return squared_distance(covariance, value)
