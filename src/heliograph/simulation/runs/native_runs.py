"""Runs of a network by native code, block by block; a network of many nodes a few nodes at a time."""

from collections.abc import Iterator, Sequence
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
from heliograph.simulation.runs.lanes import BLOCK, LANES, Progress, batch_counts, in_chunks
from heliograph.simulation.runs.native import Native, native
from heliograph.simulation.smoothed import Part, Recorded, finished
from heliograph.simulation.stepping import AllFilters
from heliograph.simulation.world import World

NODES = 4  # simulated by one program: the plant is simulated again for each so many nodes, which costs a tenth


def natively(
    network: Network,
    inputs: np.ndarray,
    key: jax.Array,
    reducer: AbstractReducer[Result],
    first_run: int,
    runs: int,
    chunk: int,
    progress: Progress | None,
    smoothing: Part | None = None,
) -> Result | None:
    """Simulate a network by native code and reduce its runs; a part of it is smoothed.

    Returns None where native code does not support the network or the reducer. Draws depend on names alone, and so do
    nodes that share nothing but the plant: they are simulated a few at a time.
    """
    # Smoothing, few nodes, or nodes that share something: one program.
    whole = smoothing is not None or len(network.names) <= NODES or not _is_apart(network)
    if whole or type(reducer).joined is AbstractReducer.joined:
        code = attempted(lambda: _code(network, inputs, key, reducer, smoothing))
        return (
            None
            if code is None
            else finished(reducer, _recorded(code, first_run, runs, chunk, progress), network, smoothing)
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

        results.append(finished(reducer, _recorded(code, first_run, runs, chunk, shown), some, None))
    return reducer.joined(results, network)


def _is_apart(network: Network) -> bool:
    """Test whether nodes, each with filters, share nothing but the plant: no fusion, sensor, hop or memory."""
    nodes = [node for node in network.nodes.values() if isinstance(node, Node) and node.filters]
    return len(nodes) == len(network.nodes) and not network.fused and not any(first(n.channel).remembers for n in nodes)


def _parts(network: Network) -> Iterator[Network]:
    """Yield networks of a few nodes each, those of one structure together."""
    for names in network.groups:
        for start in range(0, len(names), NODES):
            yield Network(network.plant, {name: network.nodes[name] for name in names[start : start + NODES]})


def _code(
    network: Network, inputs: np.ndarray, key: jax.Array, reducer: AbstractReducer[Any], smoothing: Part | None = None
) -> Native:
    filters = AllFilters(network, smoothing and smoothing.kinds)
    world = World(network.plant, medium_of(network), filters)
    return native(world, inputs, key, reducer, smoothing and smoothing.smoother(filters))


def _recorded(code: Native, first_run: int, runs: int, chunk: int, progress: Progress | None) -> Recorded:
    """Sums over all runs, and what is collected of them, chunk by chunk."""
    lanes = NativeLanes(code, first_run, first_run + runs)
    parts = in_chunks(lanes.advance, LANES, False, (runs, chunk), progress)
    return lanes.total()._replace(collected=lanes.joined(parts))


class NativeLanes:
    """Blocks of runs dealt to lanes with separate sums, computed by native code."""

    def __init__(self, code: Native, first_run: int, stop: int):
        self.code, self.first_run, self.stop = code, first_run, stop
        self.sums: list[list[np.ndarray] | None] = [None] * LANES

    def advance(self, start: int, blocks: int) -> list[np.ndarray | None]:
        """Simulate `blocks` blocks from number `start` on; return the collected results of their runs in order."""
        numbers = np.arange(start, start + blocks)
        dealt = {lane: self._runs(numbers[numbers % LANES == lane]) for lane in range(LANES)}
        used = [lane for lane, runs in dealt.items() if len(runs)]

        def go(lane: int) -> list[np.ndarray | None]:
            sums = self.sums[lane] = self.sums[lane] or self.code.begun.zeros()
            return self.code.begun.add(dealt[lane], sums)

        collected = list(threads().map(go, used))
        order = np.argsort(np.concatenate([dealt[lane] for lane in used]), kind="stable")
        return [None if blocks[0] is None else np.concatenate(blocks)[order] for blocks in zip(*collected, strict=True)]

    def _runs(self, blocks: np.ndarray) -> np.ndarray:
        runs = (self.first_run + BLOCK * blocks[:, None] + np.arange(BLOCK)).ravel()
        return runs[runs < self.stop]

    def total(self) -> Recorded:
        """Sums over all runs, by batch."""
        # Sums of the lanes, by batch.
        used = [sums for sums in self.sums if sums is not None]
        totals = iter([folded(reduce(np.add, parts), BATCHES) for parts in zip(*used, strict=True)])
        code = self.code.begun
        summed = code.program.summed.outputs
        leaves, common = [], []
        # Results that all runs share stand as of one run.
        for fixed, is_summed, shared in zip(code.shared, summed, code.program.common, strict=True):
            value = next(totals) if is_summed else None
            leaves.append(fixed if shared else value)
            common.append(shared)
        sums, same = (jax.tree.unflatten(self.code.tree, x) for x in (leaves, common))
        return Recorded(sums, same, batch_counts(self.first_run, self.stop), None)

    def joined(self, parts: Sequence[list[np.ndarray | None]]) -> PyTree:
        """Collected results of all runs, (run, ...); a view of one where they share it."""
        leaves: list[Any] = []
        for fixed, *single in zip(self.code.begun.shared, *parts, strict=True):
            if fixed is not None:
                leaves.append(np.broadcast_to(fixed, (self.stop - self.first_run, *fixed.shape)))
            else:
                leaves.append(None if single[0] is None else np.concatenate(single) if len(single) > 1 else single[0])
        return jax.tree.unflatten(self.code.tree, leaves).collected
