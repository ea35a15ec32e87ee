"""What later rows of a tape say of an earlier moment: the program that sweeps back over them."""

from collections.abc import Callable
from functools import lru_cache
from typing import TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.filters.base import AbstractFilter
from heliograph.filters.retained import AbstractRetained
from heliograph.fusion.rules import Fusion
from heliograph.live.mould import Mould, cast
from heliograph.live.tape import Ears, Tape, at_step, interval
from heliograph.model.estimate import Claim, Estimate
from heliograph.numerics.check import InputError, fail
from heliograph.numerics.compiler import understood
from heliograph.numerics.module import Module
from heliograph.numerics.types import PyTree
from heliograph.simulation.gathering import Fused
from heliograph.simulation.judging import reasons
from heliograph.simulation.network import FUSED, Network
from heliograph.simulation.stepping import AllFilters

Retained: TypeAlias = "tuple[dict[int, AbstractRetained], dict[str, AbstractRetained]]"  # by kind, and by name


class Sweep(Module):
    """The filters of a network that can be smoothed, by `kinds`, and the fusions of these."""

    ears: Ears
    fusions: tuple[Fused, ...]
    kinds: tuple[int, ...] = eqx.field(static=True)
    structure: jax.tree_util.PyTreeDef = eqx.field(static=True)  # of what is told after a row

    def step(
        self, tape: Tape, row: jax.Array, state: PyTree, heard: jax.Array, u: jax.Array, k: jax.Array
    ) -> tuple[PyTree, Retained]:
        """One step of all into a row, with what a sweep back over it needs; without what was implausible there."""
        own, central = reasons(self.structure.unflatten([leaf[row] for leaf in tape.told]))
        skip = own, {name: central[name] for name in self.ears.filters.central}
        after, found = self.ears.filters.step(state, self.ears.groups(heard), u, k, skip=skip)
        return after, ({kind: found["retained"][kind] for kind in self.kinds}, found["retained_centrally"])

    def start(self, tape: Tape, slot: jax.Array) -> PyTree:
        """The filters' states after a row of the tape."""
        own, central, *_ = tape.known(slot)
        return own, {name: central[name] for name in self.ears.filters.central}, (), (), {}

    def told(self, steps: Retained, later: PyTree) -> tuple[dict[int, Estimate], dict[str, Estimate]]:
        """Estimates after a step given what is later, by kind and by name; fused ones of these."""
        own, central = _each(lambda step, later: step.told(step.smoothed(later)), steps, later)
        parts = [own.get(kind) for kind in range(max(self.kinds, default=-1) + 1)]
        for item in self.fusions:
            central |= item.step((), parts, jnp.asarray(0))[1]
        return own, central


def _each(function: Callable[..., object], steps: Retained, *rest: PyTree) -> PyTree:
    """A function of one filter's step for those of each kind, (filter, node, ...), and for the central ones."""
    own = {
        kind: jax.vmap(jax.vmap(function))(step, *(part[0][kind] for part in rest)) for kind, step in steps[0].items()
    }
    return own, {name: function(step, *(part[1][name] for part in rest)) for name, step in steps[1].items()}


def _back(step: AbstractRetained, later: PyTree, before: AbstractRetained) -> PyTree:
    return step.back(later, before.mean, before.covariance)


Place: TypeAlias = "tuple[jax.Array, jax.Array]"  # where a row stands in the order, and a step at it or before it
Into: TypeAlias = "Callable[[Sweep, Tape, jax.Array, Place], Retained]"


@lru_cache
def sweep_back(mould: Mould, dt: int | None) -> Callable[..., PyTree]:
    """The program (numbers, tape, order, (begin, stop)) -> estimates after the row order[begin], given those after it.

    Rows are order[begin:stop], begin > 0. What a step leaves is computed anew from the state before it, and so is what
    is between rows where time counts steps.
    """
    into, earlier = (_into_step, _earlier_step) if dt is None else (_into_row(dt), _earlier_row)

    def run(numbers: list[jax.Array], tape: Tape, order: jax.Array, place: jax.Array) -> PyTree:
        item: Sweep = mould.filled(numbers)
        begin, stop = place
        last = stop - 1, tape.step[order[stop - 1]]
        count = stop - 1 - begin if dt is not None else last[1] - tape.step[order[begin]]
        blank = jax.tree.map(
            lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(lambda: into(item, tape, order, last))
        )

        def one(i: jax.Array, carry: tuple[Place, Retained, PyTree]) -> tuple[Place, Retained, PyTree]:
            now, steps, later = carry
            before = into(item, tape, order, now)
            passed, ends = _each(_back, steps, later, before), _each(lambda step: step.end(), before)
            later = jax.tree.map(lambda a, b: jnp.where(i == 0, a, b), ends, passed)
            return earlier(tape, order, now), before, later

        begun = last, blank, _each(lambda step: step.end(), blank)
        _, steps, later = jax.lax.fori_loop(0, count + 1, one, begun)
        return item.told(steps, later)

    return jax.jit(run, compiler_options=understood())


def _into_row(dt: int) -> Into:
    def into(item: Sweep, tape: Tape, order: jax.Array, place: Place) -> Retained:
        before, now = order[place[0] - 1], order[place[0]]
        u = interval(tape, before, now, dt)
        return item.step(tape, now, item.start(tape, before), tape.parts(now)[0], u, tape.step[now])[1]

    return into


def _earlier_row(tape: Tape, order: jax.Array, place: Place) -> Place:
    return place[0] - 1, tape.step[order[place[0] - 1]]


def _into_step(item: Sweep, tape: Tape, order: jax.Array, place: Place) -> Retained:
    """By way of the steps from the row before, at which nothing was heard."""
    before, now, k = order[place[0] - 1], order[place[0]], place[1]

    def one(j: jax.Array, state: PyTree) -> PyTree:
        return item.step(tape, now, state, *at_step(tape, before, now, j), j)[0]

    state = jax.lax.fori_loop(tape.step[before] + 1, k, one, item.start(tape, before))
    return item.step(tape, now, state, *at_step(tape, before, now, k), k)[1]


def _earlier_step(tape: Tape, order: jax.Array, place: Place) -> Place:
    row, k = place
    return jnp.where(k - 1 == tape.step[order[row - 1]], row - 1, row), k - 1


class Sweeper:
    """The program of a network, with its numbers, and how its results are called."""

    def __init__(self, network: Network, dt: int | None, structure: jax.tree_util.PyTreeDef):
        self.network = network
        kinds = tuple(k for k, kind in enumerate(network.kinds) if _retains(_of(network, k, kind.filters[0])))
        items = {name: item for name, item in network.fused.items() if isinstance(item, AbstractFilter)}
        central = {name: item for name, item in items.items() if _retains(item)}
        if not kinds and not central:
            raise fail(
                "smoothing", "a filter that keeps its covariance and says how its state moves", "none in the network"
            )
        alone = Network(network.plant, network.nodes, central, network.relays, network.common)
        fusions = tuple(item for item in AllFilters(network).fusions if self._fuses(item, kinds))
        with jax.enable_x64(True):
            self.item = Sweep(Ears(network, AllFilters(alone, kinds)), fusions, kinds, structure)
            self._numbers, mould = cast(self.item)
        self._run = sweep_back(mould, dt)

    def _fuses(self, item: Fused, kinds: tuple[int, ...]) -> bool:
        return item.quantizers is None and all(kind in kinds for source in item.sources for kind, _ in source)

    def estimates(self, tape: Tape, order: np.ndarray, begin: int, stop: int) -> dict[str, dict[str, Estimate]]:
        """Estimates after a row given the rows after it, by node and filter."""
        with jax.enable_x64(True):
            own, fused = self._run(self._numbers, tape, order, np.array([begin, stop], dtype=np.int32))
        found: dict[str, dict[str, Estimate]] = {name: {} for name in self.network.names}
        for k, told in own.items():
            for f, name in enumerate(self.network.kinds[k].filters):
                for i, node in enumerate(self.network.groups[self.network.kinds[k].group]):
                    found[node][name] = _one(told, told.claim, (f, i))
        claims = {node: {name: told.claim for name, told in filters.items()} for node, filters in found.items()}
        for name, told in fused.items():
            item, claim = self.network.fused[name], told.claim
            if isinstance(item, Fusion):
                claim = item.claim([claims[node][item.filter] for node in self.network.nodes_with(item.filter)])
            found.setdefault(FUSED, {})[name] = _one(told, claim, ())
        return {node: filters for node, filters in found.items() if filters}


def _one(told: Estimate, claim: Claim, where: tuple[int, ...]) -> Estimate:
    return Estimate(np.asarray(told.mean)[where], np.asarray(told.covariance)[where], claim)


def _of(network: Network, kind: int, name: str) -> AbstractFilter:
    return network.nodes[network.groups[network.kinds[kind].group][0]].filters[name]


def _retains(item: AbstractFilter) -> bool:
    """Whether a filter can be smoothed."""
    u, z = np.zeros(len(item.inputs)), np.zeros(item.received)
    try:
        with jax.enable_x64(True):
            state = jax.tree.map(jnp.asarray, item.init())
            eqx.filter_eval_shape(lambda one, state: one.step_retained(state, z, u, 0), item, state)
    except InputError:
        return False
    return True
