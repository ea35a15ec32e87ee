"""Runs of a native program, dealt to lanes whose sums are apart: a lane's runs are computed by one thread at a time."""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from heliograph.engine.choice import get_thread_pool
from heliograph.engine.size_thresholds import BLOCK
from heliograph.numerics.types import PyTree
from heliograph.simulation.recordings.smoothed import ReducedRuns
from heliograph.simulation.runs.lanes import (
    LANES,
    Progress,
    advance_in_chunks,
    count_runs_by_batch,
    split_into_chunks,
)


class NativeProgram(NamedTuple):
    """A program begun with a network's numbers; `tree` is the structure of what its runs return, an `OfStep`."""

    begun: Any
    tree: Any


class _RunningChunk(NamedTuple):
    """A chunk that threads simulate: the numbers of its runs, lane after lane, and what each lane collects of them.

    To iterate over `collected_by_lane` waits for the lanes; each has an array (run, ...) or None for each leaf.
    """

    runs: np.ndarray
    collected_by_lane: Iterator[list[np.ndarray | None]]


class NativeRuns:
    """Runs of a native program, chunk by chunk, in lanes.

    BLOCK runs are a block; block b belongs to lane b mod LANES, which has sums of its own. A lane adds its blocks one
    after another, and the lanes' sums are added in one order, so that no bit depends on the number of threads. Threads
    compute the first chunk from the moment that this is made, while the caller makes the next program ready, or
    finishes the runs of the last one.
    """

    def __init__(
        self, code: NativeProgram, first_run: int, runs: int, chunk: int, memory: list[list[np.ndarray]] | None = None
    ):
        """Divide the runs into chunks, and start the first one.

        Args:
            code: the program.
            first_run: number of the first run.
            runs: number of runs.
            chunk: number of runs between two reports of progress.
            memory: arrays in which to sum, left by earlier runs; they are put back into the list in the end. None
                allocates new ones. For a few nodes and runs, allocating takes as long as computing.
        """
        self.code, self.first_run, self.runs = code, first_run, runs
        self.memory: list[list[np.ndarray]] = [] if memory is None else memory
        self.sums: list[list[np.ndarray] | None] = [None] * LANES  # of each lane; None until it has a run
        # The lanes are threads of one processor: a chunk need not fill them all (`wide`).
        self.chunks = split_into_chunks(LANES, wide=False, runs=runs, chunk=chunk)
        self._first = self._start(self.chunks[0])

    def complete(self, progress: Progress | None) -> ReducedRuns:
        """Return the sums over all runs and what is collected of each run, after computing the remaining chunks.

        `progress` is called after each chunk with the number of runs done and the number of all runs.
        """
        collected_by_chunk = advance_in_chunks(self._advance, self.chunks, self.runs, progress)
        return self._total()._replace(collected=self._join_chunks(collected_by_chunk))

    def _start(self, blocks: range) -> "_RunningChunk":
        """Let threads simulate these blocks of runs: each lane is a thread, which takes its blocks in order.

        Block b belongs to lane b mod LANES, and a lane adds its runs to sums of its own, so that results do not depend
        on the number of threads.
        """
        numbers, program = np.array(blocks), self.code.begun
        runs_of_lane = {lane: self._list_runs(numbers[numbers % LANES == lane]) for lane in range(LANES)}
        lanes_with_runs = [lane for lane, runs in runs_of_lane.items() if len(runs)]

        def simulate_lane(lane: int) -> list[np.ndarray | None]:
            """Return what is collected of a lane's runs, and add them to the lane's sums; runs in its own thread."""
            sums = self.sums[lane] = self.sums[lane] or program.make_zero_sums(self.memory)
            collected: list[np.ndarray | None] = program.add_runs(runs_of_lane[lane], sums)
            return collected

        return _RunningChunk(
            runs=np.concatenate([runs_of_lane[lane] for lane in lanes_with_runs]),
            collected_by_lane=get_thread_pool().map(simulate_lane, lanes_with_runs),  # begins at once
        )

    def _advance(self, start: int, blocks: int) -> list[np.ndarray | None]:
        """Return what is collected of the runs in `blocks` blocks from block `start` on, in order, as a list of leaves.

        A leaf is (run, ...), or None if all runs share it.
        """
        # The first chunk has been running since this object was made.
        is_first = start == self.chunks[0].start
        running = self._first if is_first else self._start(range(start, start + blocks))
        # Join each leaf over all lanes, and sort its runs by their numbers.
        order = np.argsort(running.runs, kind="stable")
        leaves: list[np.ndarray | None] = []
        for values_by_lane in zip(*running.collected_by_lane, strict=True):
            leaves.append(None if values_by_lane[0] is None else to_double(np.concatenate(values_by_lane)[order]))
        return leaves

    def _list_runs(self, blocks: np.ndarray) -> np.ndarray:
        """Return the runs of these blocks, without those beyond the last."""
        runs = (self.first_run + BLOCK * blocks[:, None] + np.arange(BLOCK)).ravel()
        return runs[runs < self.first_run + self.runs]

    def _total(self) -> ReducedRuns:
        """Return the sums over all runs, by batch of runs, without what is collected.

        A result that is the same in all runs is not summed: its value in one run stands in the place of its sum. The
        arrays of the lanes' sums go back to the memory for later runs.
        """
        program = self.code.begun
        sums_of_lanes = [sums for sums in self.sums if sums is not None]
        totals = iter(program.add_partial_sums(sums_of_lanes))
        self.memory += sums_of_lanes
        leaves: list[np.ndarray | None] = []
        # `shared`: for each result its value if all runs share it, else None. `summed`: whether it is one to be summed.
        for shared_value, is_summed in zip(program.shared, program.summed, strict=True):
            if shared_value is not None:
                leaves.append(to_double(shared_value))
            else:
                leaves.append(next(totals) if is_summed else None)  # None: collected by run
        are_common = [shared_value is not None for shared_value in program.shared]
        return ReducedRuns(
            sums=jax.tree.unflatten(self.code.tree, leaves),
            common=jax.tree.unflatten(self.code.tree, are_common),
            runs=count_runs_by_batch(self.first_run, self.first_run + self.runs),
            collected=None,
        )

    def _join_chunks(self, collected_by_chunk: Sequence[list[np.ndarray | None]]) -> PyTree:
        """Return what is collected of all runs (run, ...), from a list of results (run, ...) or None for each chunk.

        A result that is the same in all runs is None in every chunk. The program has its value in one run (`shared`,
        None for other results), of which a view is repeated for all runs.
        """
        leaves: list[Any] = []
        for shared_value, *values_by_chunk in zip(self.code.begun.shared, *collected_by_chunk, strict=True):
            if shared_value is not None:
                leaves.append(np.broadcast_to(to_double(shared_value), (self.runs, *shared_value.shape)))
            elif len(values_by_chunk) > 1 and values_by_chunk[0] is not None:
                leaves.append(np.concatenate(values_by_chunk))
            else:  # a single chunk need not be copied; None: the result is summed, not collected
                leaves.append(values_by_chunk[0])
        return jax.tree.unflatten(self.code.tree, leaves).collected


def to_double(array: np.ndarray) -> np.ndarray:
    """Return results in double precision, whatever they were computed in; whole numbers and flags as they are."""
    return array.astype(float) if array.dtype == np.float32 else array
