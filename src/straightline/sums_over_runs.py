"""Compiled programs over consecutive runs: some results summed over them, others returned run by run."""

from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any

import jax
import numpy as np
from jaxtyping import PyTree

from straightline.call_arrays import allocate_aligned, convert_to_memory, list_addresses
from straightline.compiled import get_thread_pool
from straightline.constant_folding import DTYPES
from straightline.llvm.module_text import write_module
from straightline.lowering import make_placeholder
from straightline.machine_code import TieredCode, choose_hasty_width, find_processor_features
from straightline.program import Program, SummedOutputs, fold_rows_into_batches, lower_function, row_length_of_sums
from straightline.size_limits import divide_rounded_up

PARTS = 64  # sums of their own, which computers of any number of cores share out


class SummingProgram:
    """Compiled program of a run's number and of arguments that all runs share: some results are summed over runs.

    A run is one evaluation of the program, such as one path of a Monte Carlo simulation. `common` says of each result,
    leaf by leaf, whether all runs share it, and `summed` whether it is summed.
    """

    def __init__(self, program: Program, summed: SummedOutputs):
        """Write the code of a program, of which the first call makes machine code.

        `summed` says which results are summed, and which argument (`number`) is the number of the run. Only that
        argument differs between runs. `self.once` is the code that computes what all runs share, None if there is
        nothing. `self.blocks` is the code of everything else, for blocks of runs: as many as a vector has lanes.
        """
        differs = [n == summed.number for n in range(len(program.inputs))]
        self.summed, self.tree = summed, program.tree
        self.types = [DTYPES[b.type] for n, b in enumerate(program.inputs) if n != summed.number]
        _name, _flags, fuses = find_processor_features()
        self.code = write_module(program, differs, width=None, fuse=fuses, summed=summed)
        self.common, self.operations = self.code.common, self.code.operations
        self.width = self.code.width
        # The pairs are the runs of a vector in code that is quickly made (LLVM's level 0) and in optimised code.
        self.blocks = TieredCode(self.code.blocks, (choose_hasty_width(self.width), self.width))
        self.once = None if self.code.once is None else TieredCode(self.code.once, (1, 1))

    def measure_memory(self, runs: int, lanes: int, in_flight: int) -> tuple[float, float, float]:
        """Return three sizes in bytes: of results collected run by run, of sums, and of a computation's variables.

        Args:
            runs: how many runs are collected.
            lanes: how many sums are kept apart, each with a row of numbers for each entry of a summed result.
            in_flight: how many blocks of runs are computed at once, each with variables of its own. Other variables
                exist once, since all runs share them.
        """
        length = row_length_of_sums(self.width, self.summed.batches)  # numbers in the row of one summed result
        bytes_of_run = bytes_of_sums = 0.0
        for buffer, is_summed, is_common in zip(self.code.outputs, self.summed.outputs, self.common, strict=True):
            if is_common:
                continue
            if is_summed:
                bytes_of_sums += 8.0 * buffer.size * length
            else:
                bytes_of_run += float(buffer.size) * np.dtype(DTYPES[buffer.type]).itemsize
        variables = float(self.code.shared) + in_flight * float(self.code.scratch)
        return runs * bytes_of_run, lanes * bytes_of_sums, variables

    def bind_arguments(self, arguments: Sequence[Any], runs: int) -> "SummingProgramWithArguments":
        """Return the program with its arguments (all but the run's number), and what all runs share, computed.

        The code is made for as many runs as will follow.
        """
        return SummingProgramWithArguments(self, arguments, runs)

    def __call__(self, *arguments: PyTree, runs: int, first: int = 0) -> PyTree:
        """Compute runs on all cores; return the pair of sums (..., batch) and of what is collected (run, ...).

        The runs are split into at most PARTS parts. Each part has sums of its own, and these are added in order. The
        parts depend only on the count of runs, so that the result's bits do not depend on the number of cores.

        Args:
            arguments: trees like the examples.
            runs: how many runs to compute.
            first: number of the first run; 0 by default.
        """
        bound, end = self.bind_arguments(jax.tree.leaves(arguments), runs), first + runs
        # A part consists of whole vectors of runs, about a PARTS-th of them.
        part_length = divide_rounded_up(runs, PARTS * self.width) * self.width
        starts = range(first, end, part_length)
        numbers_of_runs = [np.arange(start, min(start + part_length, end)) for start in starts]
        sums = [bound.make_zero_sums() for _ in starts]
        collected = list(get_thread_pool().map(bound.add_runs, numbers_of_runs, sums))
        return jax.tree.unflatten(self.tree, self._join_results_of_parts(bound, sums, collected, first, runs))

    def _join_results_of_parts(
        self,
        bound: "SummingProgramWithArguments",
        sums: Sequence[Sequence[np.ndarray]],
        collected: Sequence[Sequence[np.ndarray | None]],
        first: int,
        runs: int,
    ) -> list[Any]:
        """Return each result, leaf by leaf, from the sums of parts of the runs and from what each part collected.

        A summed result, (..., batch), is the sum over all parts, for each batch of runs. A collected result, (run,
        ...), has the parts one behind another. A result that all runs share was computed once: it is repeated for each
        run, or if it is summed, multiplied by the number of runs of each batch.

        Args:
            bound: the program with its arguments.
            sums: of each part its arrays of sums, one for each summed result that runs do not share.
            collected: of each part an array for each result, None where it is summed or shared.
            first: number of the first run.
            runs: number of all runs.
        """
        totals = iter(bound.add_partial_sums(sums))
        runs_by_batch = _count_runs_by_batch(first, runs, self.summed.batches)
        leaves: list[Any] = []
        # `bound.shared` has the numbers of a result that all runs share, None for a result that differs between runs.
        for shared, is_summed, *parts in zip(bound.shared, self.summed.outputs, *collected, strict=True):
            differs_between_runs = shared is None
            if differs_between_runs:
                leaves.append(next(totals) if is_summed else np.concatenate(parts))
            elif is_summed:
                leaves.append(shared[..., None] * runs_by_batch)
            else:
                leaves.append(np.broadcast_to(shared, (runs, *shared.shape)))
        return leaves


class SummingProgramWithArguments:
    """A summing program whose shared arguments are given; `shared`: results that all runs share, None for others."""

    def __init__(self, program: SummingProgram, arguments: Sequence[Any], runs: int):
        """Convert the arguments, compute once what all runs share, and choose the machine code for the runs to follow.

        Args:
            program: the compiled program.
            arguments: all its arguments but the number of the run, as leaves.
            runs: about how many runs will follow; for many of them optimised code is chosen.
        """
        self.program, self.summed = program, program.summed.outputs
        self.arguments = [convert_to_memory(x, t) for x, t in zip(arguments, program.types, strict=True)]
        # Bytes of the numbers that all runs share, and the results among them.
        self.memory = allocate_aligned(program.code.shared)
        if program.once is not None:
            self._fill_shared_memory(program.once)
        self.shared = self._read_shared_results()
        blocks = divide_rounded_up(runs, program.width)  # a block is as many runs as a vector has
        # Code for the runs; none is needed if they share all results.
        self._machine = None if all(program.common) else program.blocks.choose_machine(blocks)

    def _fill_shared_memory(self, once: TieredCode) -> None:
        """Compute what all runs share into `self.memory`, by the code `once` that was made for it."""
        # The code reads no run's number and writes no run's results: arrays without a meaning stand for both.
        number, results = np.zeros(1, np.uint32), [np.empty(0)] * len(self.program.common)
        pointers = self._list_pointers(number, results)
        # The arguments: addresses of the arrays and of scratch memory (none); blocks 0 to 1, and 1 run.
        once.choose_machine(1).run(pointers.ctypes.data, 0, 0, 1, 1)

    def _read_shared_results(self) -> list[np.ndarray | None]:
        """Return copies of the results that all runs share, from their bytes in `self.memory`; None for all others."""
        code, shared = self.program.code, list[np.ndarray | None]()
        for output, offset, is_common in zip(code.outputs, code.offsets, self.program.common, strict=True):
            if is_common:
                number_type = np.dtype(DTYPES[output.type])
                computed = self.memory[offset : offset + output.size * number_type.itemsize]
                shared.append(computed.view(number_type).reshape(output.shape).copy())
            else:
                shared.append(None)
        return shared

    def make_zero_sums(self, memory: list[list[np.ndarray]] | None = None) -> list[np.ndarray]:
        """Return zeros for the sums of each summed result that runs do not share.

        `add_runs` adds to them, and `add_partial_sums` totals them. `memory` holds lists of sums that nobody needs any
        more: the last list is taken and filled with zeros if its shapes fit.
        """
        length = row_length_of_sums(self.program.width, self.program.summed.batches)
        shapes = [(*buffer.shape, length) for buffer, is_summed in self._list_outputs() if is_summed]
        try:  # not "if memory": another thread may take the last list in between
            taken = [] if memory is None else memory.pop()
        except IndexError:
            taken = []
        if [x.shape for x in taken] != shapes:
            return [np.zeros(shape) for shape in shapes]
        for x in taken:
            x.fill(0.0)
        return taken

    def add_runs(self, runs: np.ndarray, sums: Sequence[np.ndarray]) -> list[np.ndarray | None]:
        """Compute the runs with the numbers `runs`, add them to `sums` in place, and return what is collected.

        That is an array (run, ...) for each leaf of the results, or None if it is summed or if all runs share it.
        """
        numbers = np.ascontiguousarray(runs, dtype=np.uint32)
        outputs, collected = self._allocate_outputs(len(numbers), sums)
        # If runs share all results, there is no code for single runs (`_machine` is None).
        if len(numbers) and self._machine is not None:
            scratch = allocate_aligned(self.program.code.scratch)
            pointers = self._list_pointers(numbers, outputs)
            blocks = divide_rounded_up(len(numbers), self._machine.width)  # a block: the runs of one vector
            # The arguments: addresses of the arrays and of scratch memory; blocks 0 to `blocks`, and the count of runs.
            self._machine.run(pointers.ctypes.data, scratch.ctypes.data, 0, blocks, len(numbers))
        return collected

    def _allocate_outputs(
        self, runs: int, sums: Sequence[np.ndarray]
    ) -> tuple[list[np.ndarray], list[np.ndarray | None]]:
        """Return an array for each output of the code, and the same with None for all that is not collected.

        An output is one of `sums`, a new array (run, ...), or, where all runs share the result, an empty one.
        """
        remaining_sums = iter(sums)
        outputs: list[np.ndarray] = []
        collected: list[np.ndarray | None] = []
        for (buffer, summed), common in zip(self._list_outputs(), self.program.common, strict=True):
            if summed:
                outputs.append(next(remaining_sums))
            else:
                shape = (0,) if common else (runs, *buffer.shape)
                outputs.append(np.empty(shape, DTYPES[buffer.type]))
            collected.append(None if summed or common else outputs[-1])
        return outputs, collected

    def add_partial_sums(self, parts: Sequence[Sequence[np.ndarray]]) -> list[np.ndarray]:
        """Return the total (..., batch) of several parts' sums, for each summed result that runs do not share.

        The first part's sums are overwritten.
        """
        return [
            fold_rows_into_batches(_add_in_order(sums), self.program.summed.batches)
            for sums in zip(*parts, strict=True)
        ]

    def _list_outputs(self) -> list[tuple[Any, bool]]:
        """Return each output of the code, and whether the code adds each run's number to sums in memory there.

        It does for a summed output that differs between runs. The sum of an output that all runs share (`common`) is
        its number times the number of runs, and needs no sums in memory.
        """
        outputs = zip(self.program.code.outputs, self.program.summed.outputs, self.program.common, strict=True)
        return [(buffer, is_summed and not is_common) for buffer, is_summed, is_common in outputs]

    def _list_pointers(self, numbers: np.ndarray, results: Sequence[np.ndarray]) -> np.ndarray:
        """Return the addresses (uint64) that the code expects: of inputs, tables, results and shared memory.

        One argument of the program is the run's number; the array of the runs' `numbers` takes its place.
        """
        position = self.program.summed.number
        inputs = [*self.arguments[:position], numbers, *self.arguments[position:]]
        every = [*inputs, *self.program.code.tables, *results, self.memory]
        return np.array(list_addresses(every), dtype=np.uint64)


def accumulate(
    function: Callable[..., PyTree],
    *examples: PyTree,
    batches: int = 1,
    known: Mapping[int, np.ndarray] = MappingProxyType({}),
    single: bool = False,
) -> SummingProgram:
    """Compile a JAX function of a run's number; return a program that sums its results over runs, or collects them.

    A Monte Carlo simulation is such a function: the run's number makes its random key. Sums take no more memory for
    more runs. The program is called with the arguments and with `runs`; what its method `bind_arguments` returns
    computes runs a few at a time, by `add_runs`.

    Args:
        function: of the arguments, which all runs share, and of the number of the run (uint32); it returns a pair, what
            is summed (real numbers, in a tree) and what is collected run by run (a tree, such as `()`).
        examples: the arguments without the number; shapes and types count alone, but for what is known.
        batches: number of sums that are kept apart, run r in sum r mod `batches`; their scatter gives the standard
            error of a mean; 1 by default.
        known: of examples by their number among the leaves, which entries (a mask) are the example's in every call,
            such as zeros; they are constants of the code. None by default.
        single: whether numbers are float32, and draws those of JAX by default; double unless so. Sums are double.

    Raises:
        Unsupported: an operation that native code does not take, with the line that it comes from.
        ValueError: a function that returns no pair.
    """
    find_processor_features()  # refuses a processor that LLVM does not know
    # The arrays of all arguments, and of some the entries that are constants of the code.
    leaves = jax.tree.leaves(examples)
    known_numbers = {n: (np.asarray(mask), np.asarray(leaves[n])) for n, mask in known.items()}
    # The last argument is the number of the run.
    program = lower_function(function, *examples, make_placeholder((), np.uint32), known=known_numbers, single=single)
    # The results are a pair: its first part is summed, its second collected.
    summed_leaves = _count_summed_leaves(program.tree)
    summed = tuple(n < summed_leaves for n in range(len(program.outputs)))
    return SummingProgram(program, SummedOutputs(outputs=summed, batches=batches, number=len(leaves)))


def _count_summed_leaves(tree: Any) -> int:
    """Return how many leaves of a function's results are summed: those of the first entry of its pair.

    `tree` is the structure of what the function of a run returns: the pair (what is summed, what is collected).

    Raises:
        ValueError: the results are not a pair.
    """
    children, container = tree.children(), tree.node_data()
    if container is None or container[0] is not tuple or len(children) != 2:
        expected = "a pair of what is summed and what is collected"
        raise ValueError(f"function of a run: expected {expected}, got {tree}")
    count: int = children[0].num_leaves
    return count


def _add_in_order(sums: Sequence[np.ndarray]) -> np.ndarray:
    """Return the sum of arrays, added in order into the first, which is overwritten.

    To allocate another array would take longer than the additions.
    """
    total, *others = sums
    for other in others:
        total += other
    return total


def _count_runs_by_batch(first: int, runs: int, batches: int) -> np.ndarray:
    """Return how many of the runs from `first` on each batch has; run r is in batch r mod `batches`.

    Each batch has runs // batches of them. The remaining runs go one each to the batches from first mod `batches` on.
    """
    remaining = np.arange(first, first + runs % batches)
    return np.bincount(remaining % batches, minlength=batches) + runs // batches
