"""Functions of one run, compiled for many: LLVM IR as code of this machine, called on arrays of runs, on all cores."""

import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from copy import copy
from functools import cache
from types import MappingProxyType
from typing import Any

import jax
import numpy as np
from jaxtyping import PyTree

from straightline.call_arrays import MemoryOfCall, allocate_aligned, convert_to_memory, list_addresses
from straightline.constant_folding import DTYPES
from straightline.llvm.module_text import ModuleText, write_module
from straightline.machine_code import TieredCode, choose_hasty_width, emit_code, find_processor_features
from straightline.nodes import Unsupported
from straightline.program import Program, lower_function
from straightline.result_memory import make_aligned_array
from straightline.size_limits import ALONE, LITTLE, LONGEST, divide_rounded_up

SHARES = 4  # parts of the work for each core, so that one that is held up holds up little


class CompiledFunction:
    """Code for blocks of runs, one for each number of a vector; of `width` runs, or of as many as suit the processor.

    `differs` says of each argument, leaf by leaf, whether each run has its own, along a leading axis, or all runs share
    it; if they share all, there is one run. Results have the same bits whatever the width and the number of cores.
    `operations` are those of a run, `divisions` those of them that divide or take roots. `common` says which results,
    leaf by leaf, are the same of several runs: they follow from shared arguments alone.
    """

    def __init__(self, program: Program, differs: Sequence[bool], width: int | None = None):
        """Write the program's code as text of LLVM, of which the first call makes machine code.

        `differs`: of which arguments each run has its own. `width`: runs of a vector; None for what suits the program.
        """
        self.differs = list(differs)
        self.types = [DTYPES[b.type] for b in program.inputs]
        self.shapes, self.tree = [b.shape for b in program.inputs], program.tree
        # If runs share all arguments, they are one, whose results are computed in the arrays that are returned.
        is_one_run, (_name, _flags, fuses) = not any(self.differs), find_processor_features()
        self.code: ModuleText = write_module(program, self.differs, width, fuse=fuses, alone=is_one_run)
        self.width, self.common = self.code.width, self.code.common
        self.operations, self.divisions = self.code.operations, self.code.divisions
        # Code for blocks of runs, for what all share (if anything), and for one run. Pairs: runs of a vector in quickly
        # made and in optimised code.
        self.blocks = TieredCode(self.code.blocks, (width or choose_hasty_width(self.width), self.width))
        self.once = None if self.code.once is None else TieredCode(self.code.once, (1, 1))
        self.single = TieredCode(self.code.blocks, (1, 1))
        self._refusal: str | None = None  # why LLVM makes no code, "" if it does, None until it was tried
        self._first: list[np.ndarray] = []  # the first arguments, which calls leave out, and their addresses
        self._addresses, self._tables = list[int](), list_addresses(self.code.tables)
        # The number of an argument of which each run has its own: its length is the number of runs.
        self._by_run = self.differs.index(True) if True in self.differs else None
        self._shared: np.ndarray | None = None  # what all runs of all calls share, once it is computed

    def with_first_arguments(self, *arguments: PyTree) -> "CompiledFunction":
        """Return a copy with the same code whose first arguments are bound to these; calls of it leave them out."""
        new, leaves = copy(self), jax.tree.leaves(arguments)
        new._first = [convert_to_memory(x, type) for x, type in zip(leaves, self.types, strict=False)]
        new._check_shapes(new._first, first=0, runs=new._count_runs(new._first))
        new._addresses, new._shared = list_addresses(new._first), None  # what all runs share is computed anew
        return new

    def make_in_place_code(self, runs: int, inputs: Mapping[int, np.ndarray] = MappingProxyType({})) -> "InPlaceCode":
        """Return the same code for so many runs, with arrays of its own for arguments and results, which a call fills.

        Args:
            runs: how many.
            inputs: arrays that stand for some argument arrays, by the argument's number; 0 is the first after the bound
                ones.
        """
        return InPlaceCode(self, runs, inputs)

    def generate_code(self, arrays: Sequence[Any] = ()) -> str:
        """Generate machine code for a first call with these arrays; return "", or why LLVM makes no code."""
        if self._refusal is None:  # not tried yet
            runs = self._count_runs(arrays)
            try:
                if self.once is not None:  # computes what all runs share
                    self.once.generate_code(blocks=1)
                if not all(self.code.common):  # some results differ between runs
                    code_of_runs, width = self._choose_code_and_width(runs)
                    code_of_runs.generate_code(blocks=divide_rounded_up(runs, width))
                self._refusal = ""
            except Unsupported as error:
                self._refusal = str(error)
        return self._refusal

    def _choose_code_and_width(self, runs: int) -> tuple[TieredCode, int]:
        """Return the code for so many runs, and the most runs of its vectors: one run fills no lanes."""
        return (self.single, 1) if runs == 1 else (self.blocks, self.width)

    def _count_runs(self, arrays: Sequence[Any]) -> int:
        """Return the number of runs, the length of an argument that each run has; 1 if there is none."""
        return 1 if self._by_run is None or self._by_run >= len(arrays) else len(arrays[self._by_run])

    def _convert_arguments(self, arguments: PyTree) -> list[np.ndarray]:
        """Return the bound first arguments and then a call's own, leaf by leaf, in the types that the code expects."""
        leaves, count = jax.tree.leaves(arguments), len(self._first)
        if len(leaves) != len(self.types) - count:
            raise ValueError(f"arguments: expected {len(self.types) - count} arrays, got {len(leaves)}")
        arrays = [*self._first, *(convert_to_memory(x, t) for x, t in zip(leaves, self.types[count:], strict=True))]
        self._check_shapes(arrays[count:], count, self._count_runs(arrays))
        return arrays

    def _check_shapes(self, arrays: Sequence[np.ndarray], first: int, runs: int) -> None:
        """Raise ValueError unless arguments from `first` on have their shapes, led by `runs` where runs differ."""
        expected = zip(arrays, self.shapes[first:], self.differs[first:], strict=False)
        for number, (x, shape, differs) in enumerate(expected, first):
            if x.shape != ((runs, *shape) if differs else shape):
                wanted = f"(run, {', '.join(map(str, shape))})" if differs else shape
                raise ValueError(f"array {number} of the arguments: expected shape {wanted}, got {x.shape}")

    def __call__(self, *arguments: PyTree, cores: int | None = None) -> PyTree:
        """Return the results of all runs, with a leading axis of runs.

        Args:
            arguments: trees like the examples; arrays of which each run has its own have a leading axis of runs.
            cores: threads that compute; those of the machine by default.
        """
        return self.compute_calls([arguments], cores)

    def compute_calls(self, calls: Sequence[Sequence[PyTree]], cores: int | None = None) -> PyTree:
        """Return the results of the runs of several calls, one after another, in the same arrays.

        Args:
            calls: the arguments of each call; those that all runs share are the same in all calls.
            cores: threads that compute; those of the machine by default.
        """
        arrays = [self._convert_arguments(arguments) for arguments in calls]
        counts, code = [self._count_runs(x) for x in arrays], self.code
        outputs = [make_aligned_array((sum(counts), *b.shape), DTYPES[b.type]) for b in code.outputs]
        shared = self._compute_shared(arrays[0], outputs)
        if all(code.common):
            return jax.tree.unflatten(self.tree, outputs)
        # What differs between runs, block by block: each call computes its own rows of the outputs.
        code_of_runs, width = self._choose_code_and_width(sum(counts))
        machine, begin = code_of_runs.choose_machine(divide_rounded_up(sum(counts), width)), 0
        for call_arrays, count in zip(arrays, counts, strict=True):
            rows = [x[begin : begin + count] for x in outputs]
            pointers, memory = self._list_addresses(call_arrays, rows, shared), (call_arrays, code.tables, rows, shared)
            self._compute_blocks(MemoryOfCall(machine=machine, pointers=pointers, memory=memory, runs=count), cores)
            begin += count
        return jax.tree.unflatten(self.tree, outputs)

    def _compute_shared(self, arrays: list[np.ndarray], outputs: list[np.ndarray]) -> np.ndarray:
        """Return the memory of the numbers that all runs share, and copy the shared results to `outputs`.

        `self.once` is the code that computes them, None if there are none. If all arguments but the bound first ones
        differ between runs, `self._shared` keeps the memory for later calls.
        """
        if self.once is None:
            return allocate_aligned(self.code.shared)
        shared = self._shared
        if shared is None:
            shared = allocate_aligned(self.code.shared)
            pointers = self._list_addresses(arrays, outputs, shared)
            self.once.choose_machine(1).run(pointers.ctypes.data, 0, 0, 1, 1)  # no scratch; blocks 0 to 1, of 1 run
            self._shared = shared if all(self.differs[len(self._first) :]) else None
        self._copy_shared_outputs(outputs, shared)
        return shared

    def _list_addresses(self, arrays: list[np.ndarray], outputs: list[np.ndarray], shared: np.ndarray) -> np.ndarray:
        """Return addresses as the code expects them: of inputs, tables, outputs, and the memory that runs share."""
        own = list_addresses(arrays[len(self._first) :])
        return np.array([*self._addresses, *own, *self._tables, *list_addresses([*outputs, shared])], dtype=np.uint64)

    def _compute_blocks(self, call: MemoryOfCall, cores: int | None) -> None:
        """Compute all blocks (runs of one vector) of a call, in this thread, or in several if that is much work."""
        blocks, scratch = divide_rounded_up(call.runs, call.machine.width), self.code.scratch
        # Blocks that a thread computes at a time: an even share, SHARES a core, but at least LITTLE operations.
        even_share = divide_rounded_up(blocks, (cores or cpu_count()) * SHARES)
        share = max(even_share, divide_rounded_up(LITTLE, max(self.code.blocks.work, 1)))
        if cores == 1 or share >= blocks:
            return call.compute(0, blocks, scratch)
        starts = range(0, blocks, share)
        list(get_thread_pool().map(lambda start: call.compute(start, min(start + share, blocks), scratch), starts))

    def _copy_shared_outputs(self, outputs: list[np.ndarray], shared: np.ndarray) -> None:
        """Copy the outputs that all runs share (`code.common`) from their bytes in shared memory to every run's row."""
        results = zip(outputs, self.code.common, self.code.offsets, self.code.outputs, strict=True)
        for array, is_common, offset, buffer in results:
            if is_common:
                size = buffer.size * array.itemsize
                array[...] = shared[offset : offset + size].view(array.dtype).reshape(buffer.shape)


class InPlaceCode:
    """Code of a `CompiledFunction` for so many runs, in arrays of its own: a call computes `outputs` from `inputs`.

    What follows from shared arguments of calls is computed in every call. Bits are those of any number of runs.
    """

    def __init__(self, compiled: CompiledFunction, runs: int, inputs: Mapping[int, np.ndarray]):
        """Make the arrays of calls for `runs` runs, and choose how a call computes them.

        `inputs`: arrays that are read in place, by the argument's number behind the bound ones (`compiled._first`).
        """
        code, left_out, self.runs = compiled.code, len(compiled._first), runs
        self._compiled, differs = compiled, compiled.differs[left_out:]
        self.inputs = self._make_inputs(inputs)
        self.outputs = [make_aligned_array((runs, *b.shape), DTYPES[b.type]) for b in code.outputs]
        # Addresses in the order that the code expects; `_memory` keeps the arrays alive, what runs share is its last.
        self._memory = *compiled._first, *self.inputs, *code.tables, *self.outputs, allocate_aligned(code.shared)
        self._pointers = np.array(list_addresses(self._memory), dtype=np.uint64)
        self._scratch, self._is_common = allocate_aligned(code.scratch), all(code.common)
        self._addresses = self._pointers.ctypes.data, self._scratch.ctypes.data
        # The code, and whether a call is so little work that threads would cost more than they save.
        self._code_of_runs, width = compiled._choose_code_and_width(runs)
        self._blocks = divide_rounded_up(runs, width)
        self._needs_one_thread = runs == 1 or self._blocks * code.blocks.work < LITTLE
        # What all runs share is computed now, unless an argument of the calls decides it.
        self._shared_varies = compiled.once is not None and not all(differs)
        if compiled.once is not None and not self._shared_varies:
            self._compute_shared(compiled.once)

    def _make_inputs(self, in_place: Mapping[int, np.ndarray]) -> list[np.ndarray]:
        """Return an array for each argument of a call: the one in `in_place`, by its number, or else a new one.

        Raises:
            ValueError: an array has another shape or type or is not contiguous, or several runs share all arguments.
        """
        compiled, left_out, runs = self._compiled, len(self._compiled._first), self.runs
        arguments = list(zip(compiled.shapes, compiled.types, compiled.differs, strict=True))[left_out:]
        new = [np.zeros((runs, *shape) if differs else shape, type) for shape, type, differs in arguments]
        inputs = [in_place.get(n, x) for n, x in enumerate(new)]
        compiled._check_shapes(inputs, first=left_out, runs=runs)
        if runs != 1 and compiled._by_run is None:
            raise ValueError(f"runs: expected one, since they share all arguments, got {runs}")
        for n, (x, expected) in enumerate(zip(inputs, new, strict=True)):
            if x.dtype != expected.dtype or not x.flags.c_contiguous:
                raise ValueError(f"array {n} read in place: expected contiguous numbers of type {expected.dtype}")
        return inputs

    def __call__(self) -> None:
        """Compute `outputs` from `inputs`: first what all runs share, if it may have changed, and then the runs.

        A block is as many runs as a vector of the machine code has. Many blocks are computed in several threads.
        """
        if self._shared_varies and self._compiled.once is not None:
            self._compute_shared(self._compiled.once)
        if self._is_common:  # all runs share all results
            return
        machine = self._code_of_runs.choose_machine(self._blocks)
        if self._needs_one_thread:
            blocks = divide_rounded_up(self.runs, machine.width)
            machine.run(*self._addresses, 0, blocks, self.runs)
        else:
            call = MemoryOfCall(machine=machine, pointers=self._pointers, memory=self._memory, runs=self.runs)
            self._compiled._compute_blocks(call, cores=None)

    def _compute_shared(self, once: TieredCode) -> None:
        """Compute what all runs share by the code `once`, and copy the shared results to every run's row."""
        once.choose_machine(1).run(self._addresses[0], 0, 0, 1, 1)  # no scratch; blocks 0 to 1, of 1 run
        self._compiled._copy_shared_outputs(self.outputs, self._memory[-1])


class SingleRunCode:
    """Code for one run with its own memory of arguments and results, which a call reads and writes in place.

    `in_place` says which results, leaf by leaf, are written over which arguments, such as a filter's state.
    """

    def __init__(self, program: Program, in_place: Mapping[int, int] = MappingProxyType({})):
        """Write and compile the code of one run, and allocate its arrays of arguments and results.

        `in_place`: numbers of results that are written, after all others, to arrays of arguments; and of the latter.
        """
        all_differ, (*_, fuses) = [True] * len(program.inputs), find_processor_features()
        self.code = write_module(program, differing=all_differ, width=1, fuse=fuses, alone=True, last=in_place)
        level = int(self.code.operations <= ALONE)  # LLVM's: 1, but 0 for a program that would take long to compile
        self.machine, self.tree, self._in_place = emit_code(self.code.blocks, level, width=1), program.tree, in_place
        self._arguments = [(b.shape, DTYPES[b.type]) for b in program.inputs]
        self._allocate_memory([])

    def with_new_memory(self, first: Sequence[np.ndarray]) -> "SingleRunCode":
        """Return a copy of the same code with memory of its own; calls only read its first arguments, `first`."""
        new = copy(self)
        new._allocate_memory(first)
        return new

    def _allocate_memory(self, first: Sequence[np.ndarray]) -> None:
        """Allocate the arrays of calls: arguments, of which `first` are known, and results.

        A result in `_in_place`, which maps results to arguments, is written over its argument: it is the same array.
        """
        given = zip(first, self._arguments, strict=False)
        self.inputs = [np.ascontiguousarray(x, type).reshape(shape) for x, (shape, type) in given]
        self.inputs += [np.zeros(shape, type) for shape, type in self._arguments[len(first) :]]
        new = [np.zeros(b.shape, DTYPES[b.type]) for b in self.code.outputs]
        self.outputs = [self.inputs[self._in_place[k]] if k in self._in_place else x for k, x in enumerate(new)]
        self.scratch, self._shared = allocate_aligned(self.code.scratch), allocate_aligned(self.code.shared)
        arrays = [*self.inputs, *self.code.tables, *self.outputs, self._shared]
        self.pointers = np.array(list_addresses(arrays), dtype=np.uint64)
        self._call = self.machine.run, self.pointers.ctypes.data, self.scratch.ctypes.data

    def __call__(self) -> None:
        """Compute the arrays `outputs` from the arrays `inputs`, by the machine code."""
        run, pointers, scratch = self._call
        run(pointers, scratch, 0, 1, 1)  # blocks 0 to 1, that is one, of 1 run


def compile(
    function: Callable[..., PyTree],
    *examples: PyTree,
    shared: Sequence[int] = (),
    most: int | None = None,
    single: bool = False,
) -> CompiledFunction:
    """Compile a JAX function of one run's arrays into native code for many runs.

    The result is called with arrays that have a leading axis of runs, and returns NumPy arrays that have one too. Runs
    are computed side by side in the lanes of the processor's vectors, on all cores. What depends on shared arguments
    alone is computed once. A run's bits depend neither on its neighbours nor on the number of cores.

    Args:
        function: a function of one run's arguments, which are trees of arrays. JAX must be able to trace it.
        examples: arguments of one run: numbers, arrays or `jax.ShapeDtypeStruct`. Only their shapes and types count.
        shared: positions of the arguments that all runs share. Calls give these without the axis of runs. None by
            default.
        most: the largest number of operations; a longer function is refused. 400,000 by default.
        single: whether numbers are float32, as in JAX by default; a vector then has twice as many runs. Otherwise the
            function is traced under `jax.enable_x64`, where an array may still be of float32.

    Raises:
        Unsupported: an operation that native code does not take, with the line that it comes from.
    """
    find_processor_features()  # refuses a processor that LLVM does not know
    # Which inputs differ between runs: all leaves of the arguments that are not shared.
    differs = [n not in shared for n, example in enumerate(examples) for _ in jax.tree.leaves(example)]
    return CompiledFunction(lower_function(function, *examples, most=most or 2 * LONGEST, single=single), differs)


def compile_one(
    function: Callable[..., PyTree],
    *examples: PyTree,
    in_place: Mapping[int, int] = MappingProxyType({}),
    single: bool = False,
) -> SingleRunCode:
    """Compile a JAX function for one run that is computed again and again, such as a step of a controller.

    The result has memory of its own: lists of arrays `inputs` and `outputs`, one for each leaf. A call takes no
    arguments: it computes `outputs` from `inputs`, and costs less than a microsecond beside the arithmetic.
    `with_new_memory` makes a copy of the same code with other memory.

    Args:
        function: a function of trees of arrays. JAX must be able to trace it.
        examples: arguments; only their shapes and types count.
        in_place: maps a result to the argument that it is written over. Both are numbers of leaves; a negative result
            counts from the last. Empty by default.
        single: whether numbers are float32; by default they are double.

    Raises:
        Unsupported: an operation that native code does not take, with the line that it comes from.
    """
    find_processor_features()  # refuses a processor that LLVM does not know
    program = lower_function(function, *examples, single=single)
    return SingleRunCode(program, {n % len(program.outputs): argument for n, argument in in_place.items()})


def explain(
    function: Callable[..., PyTree], *examples: PyTree, shared: Sequence[int] = (), single: bool = False
) -> str:
    """Say how many operations a function's code would have, or why no code can be made.

    Args:
        function: a function of one run's arguments, as for `compile`.
        examples: arguments of one run; only their shapes and types count.
        shared: positions of the arguments that all runs share; none by default.
        single: whether numbers are float32; by default they are double.

    Returns:
        "57 operations, 3 of them divisions and roots", or "refused: svd at model.py:12".
    """
    try:
        code = compile(function, *examples, shared=shared, single=single)
    except Unsupported as error:
        return f"refused: {error}"
    return describe_counts(code)


def describe_counts(code: CompiledFunction) -> str:
    """Return in words how many operations a run takes."""
    return f"{code.operations} operations{f', {code.divisions} of them divisions and roots' if code.divisions else ''}"


def cpu_count() -> int:
    """Return the number of cores of this machine."""
    return os.cpu_count() or 1


@cache
def get_thread_pool() -> ThreadPoolExecutor:
    """Return the thread pool of the process, one thread for each core."""
    return ThreadPoolExecutor(cpu_count())
