"""Steps of many plants of one network: one compiled program, however many rows are due.

Plants come and go without compilation, and no bit of an estimate depends on which other rows are stepped in the same
call.
"""

from functools import lru_cache, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.live.history import NetworkStep
from heliograph.live.player import player
from heliograph.live.static import Static, cast
from heliograph.model.estimate import Claim
from heliograph.numerics.check import fail, instance
from heliograph.numerics.float64 import understood
from heliograph.numerics.types import Float, PyTree
from heliograph.simulation.judging import implausible
from heliograph.simulation.network import FUSED, Network
from heliograph.simulation.results.by_name import by_name
from heliograph.simulation.stepping import AllFilters


class Flat(NamedTuple):
    """Layout of a tree whose leaves are concatenated in a row of doubles; integers are exact up to 2^53."""

    structure: jax.tree_util.PyTreeDef
    shapes: tuple[tuple[int, ...], ...]
    kinds: tuple[str, ...]

    @property
    def size(self) -> int:
        """Length of a row."""
        return sum(int(np.prod(shape)) for shape in self.shapes)

    def tree(self, row: jax.Array | np.ndarray) -> PyTree:
        """Restore the tree from a row, with the shapes and dtypes of the original leaves."""
        parts, begin = [], 0
        for shape, kind in zip(self.shapes, self.kinds, strict=True):
            end = begin + int(np.prod(shape))
            parts.append(row[begin:end].reshape(shape).astype(kind))
            begin = end
        return self.structure.unflatten(parts)


def flat_like(tree: PyTree) -> Flat:
    """Return the layout of a tree of arrays."""
    leaves, structure = jax.tree.flatten(tree)
    return Flat(structure, tuple(leaf.shape for leaf in leaves), tuple(str(leaf.dtype) for leaf in leaves))


def row_of(tree: PyTree) -> jax.Array:
    """Concatenate the leaves of a tree of arrays in a row of doubles."""
    return jnp.concatenate([jnp.zeros(0), *(jnp.ravel(leaf).astype(np.float64) for leaf in jax.tree.leaves(tree))])


TOGETHER = 16  # lanes of one turn of the loop: they fill the vectors of a processor
WIDTH = 512  # lanes of one call


class JudgementAt(NamedTuple):
    """Columns of the parts of a judgement."""

    distance: int
    arrived: int
    reason: int
    input: int


class WeighedAt(NamedTuple):
    """Columns of what a filter that weighs made of each of its components."""

    value: tuple[int, ...]
    variance: tuple[int, ...]
    weight: tuple[int, ...]


class Place(NamedTuple):
    """Columns of a filter's estimate among the outputs: first of its mean, first of its covariance, and its judgement.

    `judgement` is None for a fusion rule, which receives no measurement; `weighed` of a filter that weighs nothing.
    """

    node: str
    filter: str
    claim: Claim
    mean: int
    covariance: int
    judgement: JudgementAt | None
    weighed: WeighedAt | None


class Lanes:
    """A network's step as a function of rows: (state, received, inputs, step number) to (state, outputs).

    The outputs are the leaves of the estimates and each filter's judgement of what it received; `places` gives their
    columns. A filter leaves out the measurements that it finds implausible.

    Args:
        network: the network, with at least one filter.

    Raises:
        ValueError: no network, or one without filters.
    """

    def __init__(self, network: Network):
        instance("network", network, Network, "a Network")
        if not any(network.claims().values()):
            raise fail("network", "at least one filter to run", "none")
        shared = player(network)
        self.network, self.dt, self.uneven = network, shared.dt, shared.uneven
        self.received, self.given, self.inputs = shared.received, shared.given, len(network.inputs)
        with jax.enable_x64(True):
            network_step = NetworkStep(network, AllFilters(network, judges=True))
            self._numbers, static = cast(network_step)
            self.state, self.start = flat_like(shared.start), np.asarray(row_of(shared.start))
            row = shared.start, np.zeros(self.received), np.zeros(self.inputs), np.asarray(0)
            like = jax.eval_shape(lambda numbers, *row: static.filled(numbers).judged(*row)[1], self._numbers, *row)
        self.outputs = flat_like(like)
        self.places = self._places()
        self._run = _program(static, self.state, self.outputs, self.received, self.inputs)

    def program(self) -> str:
        """Return the lowered program as text, which two processes compare to see that they compute the same."""
        with jax.enable_x64(True):
            text: str = self._run.lower(self._numbers, np.zeros((WIDTH, self._columns)), np.int32(0)).as_text()
        return text

    @property
    def _columns(self) -> int:
        return self.state.size + self.received + self.inputs + 1

    def step(self, rows: Float[np.ndarray, "lane column"]) -> Float[np.ndarray, "lane column"]:
        """Step each row, WIDTH at a time; return (state, outputs) of each."""
        done = np.empty((len(rows), self.state.size + self.outputs.size))
        filled = np.zeros((WIDTH, self._columns))
        for begin in range(0, len(rows), WIDTH):
            count = min(WIDTH, len(rows) - begin)
            filled[:count] = rows[begin : begin + count]
            with jax.enable_x64(True):
                result = self._run(self._numbers, filled, np.int32(-(-count // TOGETHER)))
            done[begin : begin + count] = np.asarray(result)[:count]
        return done

    def _places(self) -> tuple[Place, ...]:
        """Locate each filter's estimate, by reading a row that holds its own column numbers as a row of estimates."""
        result = jax.tree.map(lambda leaf: leaf.astype(int), self.outputs.tree(np.arange(float(self.outputs.size))))
        mean = by_name(self.network, result, lambda part: np.asarray(part.mean), -3)
        covariance = by_name(self.network, result, lambda part: np.asarray(part.covariance), -4)
        judged, weighed = self._judged(result), self._weighed(result)
        return tuple(
            Place(node, name, claim, int(mean[node][name].flat[0]), int(covariance[node][name].flat[0]),
                  judged[node].get(name), weighed.get((node, name)))
            for node, filters in self.network.claims().items()
            for name, claim in filters.items()
        )  # fmt: skip

    def _weighed(self, outcome: PyTree) -> dict[tuple[str, str], WeighedAt]:
        """Return the columns of what each filter that weighs made of its components, by node and filter."""
        parts = {
            place: [np.asarray(part)[f, i] for part in outcome["weighed"][kind]]
            for place, (kind, f, i) in self.network.places().items()
            if outcome["weighed"][kind] is not None
        }
        central = {(FUSED, name): list(item) for name, item in outcome["weighed_centrally"].items() if item is not None}
        return {
            place: WeighedAt(*(tuple(map(int, part)) for part in columns))
            for place, columns in (parts | central).items()
        }

    def _judged(self, outcome: PyTree) -> dict[str, dict[str, JudgementAt]]:
        """Return the columns of each part of a judgement, by node and filter."""
        local = {"estimates": outcome["judged"], "fused": {}}
        parts = [by_name(self.network, local, partial(_part, i), -2) for i in range(len(JudgementAt._fields))]
        result = {
            node: {name: JudgementAt(*(int(part[node][name]) for part in parts)) for name in filters}
            for node, filters in parts[0].items()
        }
        central = outcome["judged_centrally"]
        return result | {FUSED: {name: JudgementAt(*(int(part) for part in item)) for name, item in central.items()}}


def _part(i: int, judged: PyTree) -> np.ndarray:
    return np.asarray(judged[i])


@lru_cache
def _program(static: Static, state: Flat, outputs: Flat, received: int, inputs: int) -> PyTree:
    """Compile (numbers, rows, turns) to rows as a loop over TOGETHER lanes, so that results do not depend on turns."""

    def run(numbers: list[jax.Array], rows: jax.Array, turns: jax.Array) -> jax.Array:
        item: NetworkStep = static.filled(numbers)

        # A row is cut into (state, received, inputs, step number).
        def parts(row: jax.Array) -> tuple[PyTree, jax.Array, jax.Array, jax.Array]:
            known, rest = row[: state.size], row[state.size :]
            u, k = rest[received : received + inputs], rest[-1].astype(np.int64)
            return state.tree(known), rest[:received], u, k

        # One step with all measurements, and whether a filter finds one of them implausible.
        def judged(row: jax.Array) -> tuple[jax.Array, jax.Array]:
            after, result = item.judged(*parts(row))
            return jnp.concatenate([row_of(after), row_of(result)]), implausible(result)

        # The step again, for each filter without the measurements that it finds implausible.
        def without(row: jax.Array, stepped: jax.Array) -> jax.Array:
            first = state.tree(stepped[: state.size]), outputs.tree(stepped[state.size :])
            return jnp.concatenate([row_of(part) for part in item.without(first, *parts(row))])

        # TOGETHER lanes at once; the second step is taken only if a lane needs it.
        def turn(i: jax.Array, done: jax.Array) -> jax.Array:
            some = jax.lax.dynamic_slice_in_dim(rows, i * TOGETHER, TOGETHER)
            stepped, bad = jax.vmap(judged)(some)
            stepped = jax.lax.cond(
                jnp.any(bad),
                lambda: jnp.where(bad[:, None], jax.vmap(without)(some, stepped), stepped),
                lambda: stepped,
            )
            return jax.lax.dynamic_update_slice_in_dim(done, stepped, i * TOGETHER, 0)

        width = jax.eval_shape(judged, rows[0])[0].shape[0]
        stepped: jax.Array = jax.lax.fori_loop(0, turns, turn, jnp.zeros((WIDTH, width)))
        return stepped

    return jax.jit(run, compiler_options=understood())
