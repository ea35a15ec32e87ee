"""Runs of a native program, dealt to lanes whose sums are apart: a lane's runs are computed by one thread at a time."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from heliograph.engine.choice import get_thread_pool
from heliograph.engine.size_thresholds import BLOCK
from heliograph.numerics.types import PyTree
from heliograph.simulation.runs.lanes import LANES, count_runs_by_batch
from heliograph.simulation.smoothed import ReducedRuns


class NativeProgram(NamedTuple):
    """A program begun with a network's numbers; `tree` is the structure of what its runs return, an `OfStep`."""

    begun: Any
    tree: Any


class NativeLanes:
    """Blocks of runs dealt to lanes with separate sums, computed by native code."""

    def __init__(self, code: NativeProgram, first_run: int, stop: int, memory: list[list[np.ndarray]]):
        """Begin with no sums.

        Args:
            code: the program.
            first_run: number of the first run.
            stop: number after that of the last run.
            memory: sums of an earlier simulation that nobody needs, taken for those of this one, and given back. To
                allocate those of a few nodes and runs would take as long as to compute them.
        """
        self.code, self.first_run, self.stop, self.memory = code, first_run, stop, memory
        self.sums: list[list[np.ndarray] | None] = [None] * LANES

    def advance(self, start: int, blocks: int) -> list[np.ndarray | None]:
        """Simulate `blocks` blocks from number `start` on; return what is collected of their runs in order, by leaf.

        A leaf is (run, ...), None where all runs share it.
        """
        numbers = np.arange(start, start + blocks)
        runs_of_lane = {lane: self._list_runs(numbers[numbers % LANES == lane]) for lane in range(LANES)}
        used = [lane for lane, runs in runs_of_lane.items() if len(runs)]

        def simulate_lane(lane: int) -> list[np.ndarray | None]:
            """Add a lane's runs to its sums; return what is collected of them."""
            sums = self.sums[lane] = self.sums[lane] or self.code.begun.make_zero_sums(self.memory)
            collected: list[np.ndarray | None] = self.code.begun.add_runs(runs_of_lane[lane], sums)
            return collected

        collected_by_lane = list(get_thread_pool().map(simulate_lane, used))
        # Each leaf of all lanes, with the runs sorted by their numbers; None where all runs share it.
        order = np.argsort(np.concatenate([runs_of_lane[lane] for lane in used]), kind="stable")
        leaves: list[np.ndarray | None] = []
        for parts in zip(*collected_by_lane, strict=True):
            leaves.append(None if parts[0] is None else to_double(np.concatenate(parts)[order]))
        return leaves

    def _list_runs(self, blocks: np.ndarray) -> np.ndarray:
        """Return the runs of these blocks, without those beyond the last."""
        runs = (self.first_run + BLOCK * blocks[:, None] + np.arange(BLOCK)).ravel()
        return runs[runs < self.stop]

    def total(self) -> ReducedRuns:
        """Return the sums over all runs, by batch, and give their memory back; nothing that is collected."""
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
        sums, same = (jax.tree.unflatten(self.code.tree, x) for x in (leaves, common))
        return ReducedRuns(sums=sums, common=same, runs=count_runs_by_batch(self.first_run, self.stop), collected=None)

    def join_chunks(self, parts: Sequence[list[np.ndarray | None]]) -> PyTree:
        """Return what is collected of all runs (run, ...), from what `advance` returned of each chunk of them.

        A result that all runs share is a view of one.
        """
        leaves: list[Any] = []
        for fixed, *chunks in zip(self.code.begun.shared, *parts, strict=True):
            if fixed is not None:
                leaves.append(np.broadcast_to(to_double(fixed), (self.stop - self.first_run, *fixed.shape)))
            elif len(chunks) > 1 and chunks[0] is not None:
                leaves.append(np.concatenate(chunks))
            else:  # one chunk is not copied; None is what is not collected
                leaves.append(chunks[0])
        return jax.tree.unflatten(self.code.tree, leaves).collected


def to_double(array: np.ndarray) -> np.ndarray:
    """Return results in double precision, whatever they were computed in; whole numbers and flags as they are."""
    return array.astype(float) if array.dtype == np.float32 else array
