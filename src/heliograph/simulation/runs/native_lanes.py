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
    """Runs of a native program, dealt to lanes with separate sums, chunk by chunk.

    Threads compute the first chunk from the moment that this is made, while the caller does something else: it may make
    the next program ready, or finish the runs of the last one.
    """

    def __init__(
        self, code: NativeProgram, first_run: int, runs: int, chunk: int, memory: list[list[np.ndarray]] | None = None
    ):
        """Start the first chunk of runs; sums are kept for each of LANES lanes.

        Args:
            code: the program.
            first_run: number of the first run.
            runs: number of runs.
            chunk: number of runs between two reports of progress.
            memory: arrays of earlier runs' sums that can be used again, and are given back in the end; None allocates
                new ones. For a few nodes and runs, allocating takes as long as computing.
        """
        self.code, self.first_run, self.runs = code, first_run, runs
        self.memory: list[list[np.ndarray]] = [] if memory is None else memory
        self.sums: list[list[np.ndarray] | None] = [None] * LANES
        self.chunks = split_into_chunks(LANES, wide=False, runs=runs, chunk=chunk)
        self._first = self._start(self.chunks[0])

    def complete(self, progress: Progress | None) -> ReducedRuns:
        """Return the sums over all runs and what is collected of each run, after computing the remaining chunks.

        `progress` is called after each chunk with the number of runs done and the number of all runs.
        """
        collected_by_chunk = advance_in_chunks(self._advance, self.chunks, self.runs, progress)
        return self._total()._replace(collected=self._join_chunks(collected_by_chunk))

    def _start(self, blocks: range) -> "_RunningChunk":
        """Let threads simulate these blocks, each lane's in order."""
        numbers = np.array(blocks)
        runs_of_lane = {lane: self._list_runs(numbers[numbers % LANES == lane]) for lane in range(LANES)}
        used = [lane for lane, runs in runs_of_lane.items() if len(runs)]

        def simulate_lane(lane: int) -> list[np.ndarray | None]:
            """Return what is collected of a lane's runs, and add them to the lane's sums; runs in its own thread."""
            sums = self.sums[lane] = self.sums[lane] or self.code.begun.make_zero_sums(self.memory)
            collected: list[np.ndarray | None] = self.code.begun.add_runs(runs_of_lane[lane], sums)
            return collected

        return _RunningChunk(
            runs=np.concatenate([runs_of_lane[lane] for lane in used]),
            collected_by_lane=get_thread_pool().map(simulate_lane, used),  # begins at once
        )

    def _advance(self, start: int, blocks: int) -> list[np.ndarray | None]:
        """Return what is collected of the runs in `blocks` blocks from block `start` on, in order, as a list of leaves.

        A leaf is (run, ...), or None if all runs share it.
        """
        running = self._first if start == self.chunks[0].start else self._start(range(start, start + blocks))
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
        """Return the sums over all runs, by batch of runs, without what is collected; give the lanes' memory back.

        `shared`: by result its value where it is the same in all runs, else None; `summed`: whether it is summed.
        """
        code = self.code.begun
        used = [sums for sums in self.sums if sums is not None]
        totals = iter(code.add_partial_sums(used))
        self.memory += used
        leaves, common = [], []
        # Results that all runs share stand as of one run.
        for fixed, is_summed in zip(code.shared, code.summed, strict=True):
            by_batch = next(totals) if is_summed and fixed is None else None
            leaves.append(by_batch if fixed is None else to_double(fixed))
            common.append(fixed is not None)
        count = count_runs_by_batch(self.first_run, self.first_run + self.runs)
        sums, same = (jax.tree.unflatten(self.code.tree, x) for x in (leaves, common))
        return ReducedRuns(sums=sums, common=same, runs=count, collected=None)

    def _join_chunks(self, collected_by_chunk: Sequence[list[np.ndarray | None]]) -> PyTree:
        """Return what is collected of all runs (run, ...), from what `_advance` returned for each chunk.

        `shared`: by leaf, the value that all runs share, or None. A shared value is repeated as a view.
        """
        leaves: list[Any] = []
        for shared_value, *values_by_chunk in zip(self.code.begun.shared, *collected_by_chunk, strict=True):
            if shared_value is not None:
                leaves.append(np.broadcast_to(to_double(shared_value), (self.runs, *shared_value.shape)))
            elif len(values_by_chunk) > 1 and values_by_chunk[0] is not None:
                leaves.append(np.concatenate(values_by_chunk))
            else:  # a single chunk need not be copied; None: the leaf is not collected
                leaves.append(values_by_chunk[0])
        return jax.tree.unflatten(self.code.tree, leaves).collected


def to_double(array: np.ndarray) -> np.ndarray:
    """Return results in double precision, whatever they were computed in; whole numbers and flags as they are."""
    return array.astype(float) if array.dtype == np.float32 else array
