"""Runs of a network by native code, block by block; a network of many nodes a few nodes at a time."""

from collections.abc import Callable, Iterator, Sequence
from functools import reduce
from typing import Any

import jax
import numpy as np

from heliograph.codegen.compiled import threads
from heliograph.codegen.engine import attempted
from heliograph.codegen.program import folded
from heliograph.model.over_time import first
from heliograph.numerics.types import PyTree
from heliograph.simulation.medium import medium_of
from heliograph.simulation.network import Network
from heliograph.simulation.node import Node
from heliograph.simulation.results.reducer import AbstractReducer, Result
from heliograph.simulation.results.statistics import BATCHES
from heliograph.simulation.runs.lanes import BLOCK, LANES
from heliograph.simulation.runs.native import Native, native
from heliograph.simulation.smoothed import Part, WithSmoothed
from heliograph.simulation.stepping import AllFilters
from heliograph.simulation.world import World

NODES = 4  # simulated by one program: the plant is simulated again for each so many nodes, which costs a tenth
Progress = Callable[[int, int], None]


def natively(
    network: Network,
    inputs: np.ndarray,
    key: jax.Array,
    reducer: AbstractReducer[Result],
    first_run: int,
    runs: int,
    chunk: int,
    progress: Progress | None,
    part: Part | None = None,
) -> Result | None:
    """Simulate a network by native code and reduce its runs; `part` of it is smoothed.

    Returns None where native code does not support the network or the reducer. Draws depend on names alone, and so do
    nodes that share nothing but the plant: they are simulated a few at a time.
    """
    # With smoothing: one program for filtered and smoothed estimates.
    if part is not None:
        both: WithSmoothed[Result] = WithSmoothed(reducer)
        code = attempted(lambda: _code(network, inputs, key, reducer, part))
        if code is None:
            return None
        return both.finished(*_recorded(code, both, first_run, runs, chunk, progress), network, part)
    # Few nodes, or nodes that share something: one program.
    if len(network.names) <= NODES or not _is_apart(network) or type(reducer).joined is AbstractReducer.joined:
        code = attempted(lambda: _code(network, inputs, key, reducer))
        return (
            None
            if code is None
            else reducer.finish(*_recorded(code, reducer, first_run, runs, chunk, progress), network)
        )
    # Many independent nodes: one program for a few of them, with other numbers.
    results, parts = [], list(_parts(network))
    for number, some in enumerate(parts):
        code = attempted(lambda: _code(some, inputs, key, reducer))  # noqa: B023
        if code is None:
            return None

        def shown(done: int, total: int) -> None:
            if progress is not None:
                progress((number * total + done) // len(parts), total)  # noqa: B023

        results.append(reducer.finish(*_recorded(code, reducer, first_run, runs, chunk, shown), some))
    return reducer.joined(results, network)


def _is_apart(network: Network) -> bool:
    """Test whether nodes, each with filters, share nothing but the plant: no fusion, sensor, hop or memory."""
    local = [node for node in network.nodes.values() if isinstance(node, Node) and node.filters]
    return len(local) == len(network.nodes) and not network.fused and not any(first(n.channel).remembers for n in local)


def _parts(network: Network) -> Iterator[Network]:
    """Yield networks of a few nodes each, those of one structure together."""
    for names in network.groups:
        for start in range(0, len(names), NODES):
            yield Network(network.plant, {name: network.nodes[name] for name in names[start : start + NODES]})


def _code(
    network: Network, inputs: np.ndarray, key: jax.Array, reducer: AbstractReducer[Any], part: Part | None = None
) -> Native:
    filters = AllFilters(network, part and part.kinds)
    return native(
        World(network.plant, medium_of(network), filters), inputs, key, reducer, part and part.smoother(filters)
    )


def _recorded(
    code: Native, reducer: AbstractReducer[Any], first_run: int, runs: int, chunk: int, progress: Progress | None
) -> tuple[PyTree, PyTree]:
    """Carry of the reducer after all runs, and what it collected of them, chunk by chunk."""
    lanes = NativeLanes(code, first_run, first_run + runs)
    blocks = lanes.blocks_of(min(chunk, runs))
    parts = []
    for start in range(0, -(-runs // BLOCK), blocks):
        parts.append(lanes.advance(start, blocks))
        if progress is not None:
            progress(min((start + blocks) * BLOCK, runs), runs)
    return lanes.total(reducer), lanes.joined(parts)


class NativeLanes:
    """Blocks of runs dealt to lanes with separate sums: `Lanes` computed by native code.

    Block j goes to lane j mod LANES whatever the number of cores, and each lane adds its blocks in order, so that
    neither chunks nor cores change a bit of a result.
    """

    def __init__(self, code: Native, first_run: int, stop: int):
        self.code, self.first_run, self.stop = code, first_run, stop
        self.sums: list[list[np.ndarray] | None] = [None] * LANES

    def blocks_of(self, runs: int) -> int:
        """Number of blocks of a chunk of at least this many runs: fewer than there are lanes, or a multiple of them."""
        blocks = -(-runs // BLOCK)
        return blocks if blocks < LANES else LANES * -(-blocks // LANES)

    def advance(self, start: int, blocks: int) -> list[np.ndarray | None]:
        """Simulate `blocks` blocks from number `start` on; return the collected results of their runs in order."""
        numbers = np.arange(start, start + blocks)
        dealt = {lane: self._runs(numbers[numbers % LANES == lane]) for lane in range(LANES)}
        used = [lane for lane, runs in dealt.items() if len(runs)]

        def go(lane: int) -> list[np.ndarray | None]:
            sums = self.sums[lane] = self.sums[lane] or self.code.begun.zeros()
            return self.code.begun.add(dealt[lane], sums)

        result = list(threads().map(go, used))
        order = np.argsort(np.concatenate([dealt[lane] for lane in used]), kind="stable")
        return [None if item[0] is None else np.concatenate(item)[order] for item in zip(*result, strict=True)]

    def _runs(self, blocks: np.ndarray) -> np.ndarray:
        runs = (self.first_run + BLOCK * blocks[:, None] + np.arange(BLOCK)).ravel()
        return runs[runs < self.stop]

    def total(self, reducer: AbstractReducer[Any]) -> PyTree:
        """Carry of the reducer after all runs."""
        # Sums of the lanes, by batch.
        used = [sums for sums in self.sums if sums is not None]
        totals = iter([folded(reduce(np.add, parts), BATCHES) for parts in zip(*used, strict=True)])
        code = self.code.begun
        summed = code.program.summed.outputs
        leaves, common = [], []
        # Results that all runs share stand as of one run.
        for item, is_summed, shared in zip(code.shared, summed, code.program.common, strict=True):
            value = next(totals) if is_summed else None
            leaves.append(item if shared else value)
            common.append(shared)
        count = np.bincount(np.arange(self.first_run, self.stop) % BATCHES, minlength=BATCHES).astype(float)
        sums, same = (jax.tree.unflatten(self.code.tree, x) for x in (leaves, common))
        return reducer.summed(sums, same, count)

    def joined(self, parts: Sequence[list[np.ndarray | None]]) -> PyTree:
        """Collected results of all runs, (run, ...); a view of one where they share it."""
        leaves: list[Any] = []
        for item, *single in zip(self.code.begun.shared, *parts, strict=True):
            if item is not None:
                leaves.append(np.broadcast_to(item, (self.stop - self.first_run, *item.shape)))
            else:
                leaves.append(None if single[0] is None else np.concatenate(single) if len(single) > 1 else single[0])
        return jax.tree.unflatten(self.code.tree, leaves).collected
