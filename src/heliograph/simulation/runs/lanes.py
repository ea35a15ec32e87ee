"""Blocks of runs dealt to parallel lanes: threads on a processor, one vectorised axis on other devices.

Block j goes to lane j mod LANES whatever the number of cores, and each lane sums its blocks in order, so that neither
chunks nor cores change a bit of a result. Several devices share the lanes by JAX's sharding.
"""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial, reduce
from typing import NamedTuple

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from heliograph.engine.size_thresholds import BLOCK
from heliograph.numerics.float64 import to_numpy
from heliograph.numerics.types import PyTree
from heliograph.simulation.results.statistics import BATCHES

LANES = 8  # of a processor: at most this many cores are used
WIDE_LANES = 256  # of other devices, which want thousands of runs at once

Progress = Callable[[int, int], None]
Advance = Callable[[np.ndarray, PyTree], tuple[PyTree, PyTree]]  # blocks of runs, carry -> carry, collected results


def has_processor_alone() -> bool:
    """Return whether JAX sees nothing but a processor."""
    return len(jax.devices()) == 1 and jax.default_backend() == "cpu"


class RunLanes:
    """Carries of all lanes, and their advance over the blocks of a chunk.

    A lane is a row of blocks that are summed one after another; its carry is the sum so far.
    """

    def __init__(
        self, alone: Advance, together: Advance, start: Callable[[], PyTree], first_run: int, one_by_one: bool = False
    ):
        """Begin before the first block.

        Args:
            alone: advances one lane over blocks (count, BLOCK) of runs, from its carry.
            together: advances all lanes at once, with a leading axis of lanes.
            start: makes the carry of a lane before its first block.
            first_run: number of the first run.
            one_by_one: True to run one lane at a time. Programs that decompose large matrices need this, since two at
                once wait for each other's threads forever.
        """
        self.one_by_one = one_by_one
        self.alone, self.together, self.start, self.first_run = alone, together, start, first_run
        devices, is_processor = len(jax.devices()), jax.default_backend() == "cpu"
        self.wide = devices > 1 or not is_processor
        # The number of lanes is rounded up to a multiple of the number of devices.
        lanes = LANES if is_processor else WIDE_LANES
        self.count = devices * -(-lanes // devices)
        self.carries: PyTree = [None] * self.count  # until a lane is used
        self.pool: ThreadPoolExecutor | None = None

    def advance(self, start: int, blocks: int) -> PyTree:
        """Return what is collected of each run in `blocks` blocks from block number `start` on, as NumPy arrays.

        A block is BLOCK runs. Block b belongs to lane b mod `self.count`: a lane adds up the sums of its blocks one
        after another, so that no bit depends on which lanes run at once. Results are put in the order of the runs.
        """
        numbers = np.arange(start, start + blocks)
        runs = self.first_run + BLOCK * numbers[:, None] + np.arange(BLOCK)  # numbers of the runs (block, BLOCK)
        lanes = [np.flatnonzero(numbers % self.count == lane) for lane in range(self.count)]  # rows of `runs`, by lane
        recorded_by_lane = self._run_on_devices(runs, lanes) if self.wide else self._run_in_threads(runs, lanes)
        blocks_by_lane = np.concatenate(lanes)
        return jax.tree.map(
            lambda *of_lanes: _order_blocks(np.concatenate(of_lanes), blocks_by_lane), *recorded_by_lane
        )

    def _run_in_threads(self, runs: np.ndarray, lanes: list[np.ndarray]) -> list[PyTree]:
        """Return what is recorded of each run, by lane; each lane runs in a thread of its own.

        A lane is a sequence of blocks of runs, whose sums are added one after another to the lane's sums so far, its
        carry (`self.carries`). `runs` (block, BLOCK): numbers of the runs. `lanes`: for each lane the indices of its
        blocks, which are rows of `runs`.
        """

        def advance_lane(lane: int) -> PyTree:
            """Simulate one lane's blocks: add them to the lane's sums, and return what is recorded of their runs.

            From outside: `runs` (block, BLOCK), the numbers of the runs in each block, and `lanes`, the blocks of each
            lane.
            """
            with jax.enable_x64(True):
                carry = self.start() if self.carries[lane] is None else self.carries[lane]
                runs_of_lane = runs[lanes[lane]]
                self.carries[lane], recorded = self.alone(runs_of_lane, carry)
                return to_numpy(recorded)

        if self.pool is None:
            self.pool = ThreadPoolExecutor(1 if self.one_by_one else min(self.count, os.cpu_count() or 1))
        return list(self.pool.map(advance_lane, [lane for lane, blocks in enumerate(lanes) if len(blocks)]))

    def _run_on_devices(self, runs: np.ndarray, lanes: list[np.ndarray]) -> list[PyTree]:
        """Return what is recorded of each run, by lane; all lanes run at once, divided among the devices.

        `runs` (block, BLOCK): numbers of the runs. `lanes`: for each lane the indices of its blocks; all lanes have
        equally many. `self.carries`: the lanes' sums so far, a list before the first call, then stacked on the devices.
        """
        # Arrays are divided along their first axis, of lanes, among all devices.
        sharding = NamedSharding(Mesh(np.array(jax.devices()), ("lane",)), PartitionSpec("lane"))  # type: ignore[no-untyped-call]
        if isinstance(self.carries, list):
            carries = jax.tree.map(lambda leaf: np.stack([leaf] * self.count), to_numpy(self.start()))
            self.carries = jax.device_put(carries, sharding)
        runs_by_lane = jax.device_put(np.stack([runs[blocks] for blocks in lanes]), sharding)
        self.carries, recorded = self.together(runs_by_lane, self.carries)
        on_host = to_numpy(recorded)
        return [jax.tree.map(lambda leaf: leaf[lane], on_host) for lane in range(self.count)]  # noqa: B023

    def total(self) -> PyTree:
        """Return the sum over all runs: the lanes' sums so far (`self.carries`), added always in the same order.

        A fixed order of additions makes every bit of the sum independent of how many lanes ran at once.
        """
        if self.pool is not None:
            self.pool.shutdown()
        if isinstance(self.carries, list):
            lanes = [carry for carry in self.carries if carry is not None]
        else:
            lanes = [jax.tree.map(lambda leaf: np.asarray(leaf)[lane], self.carries) for lane in range(self.count)]  # noqa: B023
        with jax.enable_x64(True):
            return to_numpy(reduce(add_sums, lanes))


class SharedResult(NamedTuple):
    """A result that all runs share, among sums over runs."""

    value: PyTree


def is_shared(leaf: PyTree) -> bool:
    """Return whether a part of the sums over runs is a result that all runs share, and no sum."""
    return isinstance(leaf, SharedResult)


@partial(jax.jit, donate_argnums=0)
def add_sums(total: PyTree, more: PyTree) -> PyTree:
    """Return the sums of two trees, in the memory of the first; values that all runs share stay as they are.

    In place, since of many nodes these are hundreds of megabytes, which take longer to allocate than to add.
    """
    return jax.tree.map(lambda a, b: b if is_shared(b) else a + b, total, more, is_leaf=is_shared)


def split_into_chunks(lanes: int, wide: bool, runs: int, chunk: int) -> list[range]:
    """Return for each chunk of about `chunk` runs the numbers of its blocks; a block is BLOCK runs.

    A chunk has fewer blocks than there are lanes, or a multiple of their number. The last may go beyond the runs.

    Args:
        lanes: how many blocks are computed side by side.
        wide: True if a chunk must have a multiple of `lanes` blocks.
        runs: number of all runs.
        chunk: number of runs that a chunk should have.
    """
    # -(-a // b) is a / b rounded up.
    blocks_of_chunk = -(-min(chunk, runs) // BLOCK)
    if blocks_of_chunk >= lanes or wide:
        blocks_of_chunk = lanes * -(-blocks_of_chunk // lanes)
    all_blocks = -(-runs // BLOCK)
    return [range(start, start + blocks_of_chunk) for start in range(0, all_blocks, blocks_of_chunk)]


def advance_in_chunks(
    advance: Callable[[int, int], PyTree], chunks: list[range], runs: int, progress: Progress | None
) -> list[PyTree]:
    """Return what is collected of each chunk of runs, and report progress after each.

    Args:
        advance: function (number of the first block, number of blocks) that simulates these blocks.
        chunks: numbers of each chunk's blocks, from `split_into_chunks`. A block is BLOCK runs.
        runs: number of all runs.
        progress: called with (number of runs done, `runs`).
    """
    collected = []
    for blocks in chunks:
        collected.append(advance(blocks.start, len(blocks)))
        if progress is not None:
            progress(min(blocks.stop * BLOCK, runs), runs)
    return collected


def count_runs_by_batch(first_run: int, stop: int) -> np.ndarray:
    """Return how many runs from number `first_run` up to `stop` are in each batch, (batch,)."""
    return np.bincount(np.arange(first_run, stop) % BATCHES, minlength=BATCHES).astype(float)


def _order_blocks(recorded: np.ndarray, block_numbers: np.ndarray) -> np.ndarray:
    """Return results recorded by block of runs (block, BLOCK, ...) as (run, ...), in the order of the runs.

    `block_numbers`: number of each recorded block, since blocks were dealt to lanes.
    """
    ordered = np.empty_like(recorded)
    ordered[block_numbers] = recorded
    # Not reshape(-1, ...), which fails if a length is zero.
    return ordered.reshape(recorded.shape[0] * recorded.shape[1], *recorded.shape[2:])
