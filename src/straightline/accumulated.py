"""Compiled programs over consecutive runs: some results summed over them, others returned run by run."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from straightline.compiled import addresses, aligned
from straightline.folding import DTYPES
from straightline.llvm.module import written
from straightline.machine import WIDEST, Tiers, features, narrow
from straightline.program import Program, Summed, row_length


class Accumulated:
    """Code of a program with one argument that differs between runs, the number of the run.

    `common` says of each result, leaf by leaf, whether all runs share it, and `summed` whether it is summed.
    """

    def __init__(self, program: Program, summed: Summed):
        differs = [n == summed.number for n in range(len(program.inputs))]
        self.summed = summed
        self.types = [DTYPES[b.type] for n, b in enumerate(program.inputs) if n != summed.number]
        self.code = written(program, differs, WIDEST, features()[2], summed=summed)
        self.common = self.code.common
        self.blocks = Tiers(self.code.blocks, (narrow(), WIDEST))
        self.once = None if self.code.once is None else Tiers(self.code.once, (1, 1))

    def memory(self, runs: int, lanes: int, in_flight: int) -> tuple[float, float, float]:
        """Bytes of results of so many single runs, of sums of so many lanes, and of variables of those in flight."""
        length = row_length(WIDEST, self.summed.batches)
        collected = sums = 0.0
        for buffer, summed, common in zip(self.code.outputs, self.summed.outputs, self.common, strict=True):
            if summed:
                sums += 8.0 * buffer.size * length
            elif not common:
                collected += float(buffer.size) * np.dtype(DTYPES[buffer.type]).itemsize
        return runs * collected, lanes * sums, float(self.code.shared) + in_flight * float(self.code.scratch)

    def begin(self, arguments: Sequence[Any], runs: int) -> "Begun":
        """Compute everything that the runs share, from the arguments other than the number of the run.

        The code is made for as many runs as will follow.
        """
        return Begun(self, arguments, runs)


class Begun:
    """A program with its arguments; `shared` has the results that all runs share, None for all others."""

    def __init__(self, program: Accumulated, arguments: Sequence[Any], runs: int):
        self.program = program
        self.arguments = [np.ascontiguousarray(x, dtype=t) for x, t in zip(arguments, program.types, strict=True)]
        self.memory = aligned(program.code.shared)
        self.shared: list[np.ndarray | None] = [None] * len(program.common)
        if program.once is not None:
            number, results = np.zeros(1, np.uint32), [np.empty(0)] * len(program.common)
            pointers = self._pointers(number, results)
            once = program.once.machine(1)
            once.run(pointers.ctypes.data, 0, 0, 1, 1)
        for n, (buffer, offset) in enumerate(zip(program.code.outputs, program.code.places, strict=True)):
            if program.common[n]:
                kind = np.dtype(DTYPES[buffer.type])
                held = self.memory[offset : offset + buffer.size * kind.itemsize]
                self.shared[n] = held.view(kind).reshape(buffer.shape).copy()
        self._machine = None if all(program.common) else program.blocks.machine(-(-runs // WIDEST))

    def zeros(self) -> list[np.ndarray]:
        """Return sums over no runs, of each summed result: (..., batch), rows as `folded` takes them."""
        length = row_length(WIDEST, self.program.summed.batches)
        return [np.zeros((*b.shape, length)) for b, s in self._outputs() if s]

    def add(self, runs: np.ndarray, sums: Sequence[np.ndarray]) -> list[np.ndarray | None]:
        """Add runs to the sums; return the other results, (run, ...), None for those that are shared or summed.

        Runs are computed in blocks of consecutive ones, each several times as many as a vector has.
        """
        numbers = np.ascontiguousarray(runs, dtype=np.uint32)
        # Outputs of the code: the sums themselves, or an array with a row for each run.
        totals = iter(sums)
        results: list[np.ndarray] = []
        given: list[np.ndarray | None] = []
        for (buffer, summed), common in zip(self._outputs(), self.program.common, strict=True):
            if summed:
                results.append(next(totals))
            else:
                shape = (0,) if common else (len(numbers), *buffer.shape)
                results.append(np.empty(shape, DTYPES[buffer.type]))
            given.append(None if summed or common else results[-1])
        # Compute all blocks of runs.
        if len(numbers) and self._machine is not None:
            scratch = aligned(self.program.code.scratch)
            pointers = self._pointers(numbers, results)
            blocks = -(-len(numbers) // self._machine.width)
            self._machine.run(pointers.ctypes.data, scratch.ctypes.data, 0, blocks, len(numbers))
        return given

    def _outputs(self) -> list[tuple[Any, bool]]:
        return list(zip(self.program.code.outputs, self.program.summed.outputs, strict=True))

    def _pointers(self, numbers: np.ndarray, results: Sequence[np.ndarray]) -> np.ndarray:
        position = self.program.summed.number
        inputs = [*self.arguments[:position], numbers, *self.arguments[position:]]
        every = [*inputs, *self.program.code.tables, *results, self.memory]
        return np.array(addresses(every), dtype=np.uint64)
