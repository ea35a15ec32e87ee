"""A recursion over rows of data as native code for any number of rows, which the code reads when it is called."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import PyTree

from straightline.call_arrays import allocate_aligned, convert_to_memory, list_addresses
from straightline.constant_folding import DTYPES
from straightline.llvm.module_text import write_module
from straightline.lowering import Value, make_placeholder, trace_function
from straightline.machine_code import TieredCode, find_processor_features
from straightline.nodes import Unsupported
from straightline.program import Program, lower_traced
from straightline.result_memory import make_aligned_array
from straightline.size_limits import ANY_LENGTH, LONGEST
from straightline.strided_arrays import StridedArray


class CompiledScan:
    """Code of a recursion over rows. A call returns the state after the last row, and the outputs of all rows.

    `operations` are those of the start and of one row, `divisions` those of them that divide or take roots.
    """

    def __init__(self, program: Program):
        """Write the code as text of LLVM, which the first call compiles.

        In the program's shapes ANY_LENGTH stands for the number of rows, which the code reads when it is called.
        """
        self._shapes, self._types = [b.shape for b in program.inputs], [DTYPES[b.type] for b in program.inputs]
        self._tree, (*_, fuses) = program.tree, find_processor_features()
        self._code = write_module(program, [False] * len(self._shapes), width=None, fuse=fuses, alone=True)
        self.operations, self.divisions = self._code.operations, self._code.divisions
        self._tiers = TieredCode(self._code.blocks, (1, 1))
        self._refusal: str | None = None  # why LLVM makes no code, "" if it does, None until it was tried

    def generate_code(self, rows: int) -> str:
        """Generate machine code for a first call of so many rows; return why LLVM makes none, "" if it makes code."""
        if self._refusal is None:  # the answer is kept: a later call generates nothing
            try:
                self._tiers.generate_code(rows)
                self._refusal = ""
            except Unsupported as error:
                self._refusal = str(error)
        return self._refusal

    def __call__(self, fixed: PyTree, rows: PyTree) -> PyTree:
        """Return the last state, and the outputs of all rows (rows, ...).

        Args:
            fixed: a tree like that of the example.
            rows: a tree of arrays like those of one row, with a leading axis of rows: one row or more.

        Raises:
            ValueError: arrays of other shapes or types, or no row.
        """
        leaves = jax.tree.leaves((fixed, rows))
        if len(leaves) != len(self._types):
            raise ValueError(f"arguments: expected {len(self._types)} arrays, got {len(leaves)}")
        arrays = [convert_to_memory(x, type) for x, type in zip(leaves, self._types, strict=True)]
        count = self._count_rows(arrays)
        outputs = [make_aligned_array(_of_length(b.shape, count), DTYPES[b.type]) for b in self._code.outputs]
        memory = [*arrays, *self._code.tables, *outputs, allocate_aligned(self._code.shared)]
        pointers, scratch = np.array(list_addresses(memory), np.uint64), allocate_aligned(self._code.scratch)
        # One block; what is the number of runs for other code is that of rows here.
        self._tiers.choose_machine(count).run(pointers.ctypes.data, scratch.ctypes.data, 0, 1, count)
        return jax.tree.unflatten(self._tree, outputs)

    def _count_rows(self, arrays: Sequence[np.ndarray]) -> int:
        """Return the number of rows of a call; raise ValueError unless all arrays have the shapes of the example.

        In the example's shapes, ANY_LENGTH as the first length stands for the number of rows.
        """
        count = next(
            (len(x) for x, s in zip(arrays, self._shapes, strict=True) if s[:1] == (ANY_LENGTH,) and x.ndim), 0
        )
        if not count:
            raise ValueError("rows: expected one row or more, got none")
        for number, (x, shape) in enumerate(zip(arrays, self._shapes, strict=True)):
            if x.shape != (expected := _of_length(shape, count)):
                raise ValueError(f"array {number} of the arguments: expected shape {expected}, got {x.shape}")
        return count


def _of_length(shape: tuple[int, ...], rows: int) -> tuple[int, ...]:
    """Return the shape of an array for so many rows; that of an array without an axis of rows as it is."""
    return (rows, *shape[1:]) if shape[:1] == (ANY_LENGTH,) else shape


def compile_scan(
    begin: Callable[[Any], PyTree],
    step: Callable[[Any, Any, Any], tuple[PyTree, PyTree]],
    fixed: PyTree,
    row: PyTree,
    most: int | None = None,
) -> CompiledScan:
    """Compile a recursion over rows of data into native code, which takes any number of rows.

    It computes what `jax.lax.scan` of the same step does, in double precision, and the bits of a row do not depend on
    how many rows follow.

    Args:
        begin: returns the state before the first row, a tree of arrays, from `fixed`.
        step: returns the state after a row and the row's output, trees of arrays, from `fixed`, the state before the
            row, and the row.
        fixed: a tree of arrays, an example of what is the same for all rows; only shapes and types count, also of the
            next.
        row: a tree of arrays, one row as an example: numbers, arrays or `jax.ShapeDtypeStruct`, one or more.
        most: the largest number of operations; a longer recursion is refused. 400,000 by default.

    Raises:
        Unsupported: an operation that native code does not take, with the line that it comes from.
    """
    find_processor_features()  # refuses a processor that LLVM does not know

    def scan(fixed: PyTree, rows: PyTree) -> tuple[PyTree, PyTree]:
        """Return the last state and the outputs of all rows."""
        return jax.lax.scan(lambda state, row: step(fixed, state, row), begin(fixed), rows)

    # Rows of any number, as placeholders of arrays, with which JAX traces the scan; native code follows from the trace.
    rows = jax.tree.map(lambda x: make_placeholder((ANY_LENGTH, *np.shape(x)), _find_dtype(x)), row)
    program = lower_traced(*trace_function(scan, fixed, rows), most or 2 * LONGEST)
    _check_outputs(program.outputs)
    return CompiledScan(program)


def _find_dtype(x: Any) -> Any:
    """Return the NumPy type of an array's numbers, or of a number of Python, such as float64 of 0.5."""
    return x.dtype if hasattr(x, "dtype") else np.asarray(x).dtype


def _check_outputs(outputs: Sequence[Value]) -> None:
    """Raise Unsupported if an output of rows is no memory of its own, which would be copied row by row.

    It is not if a row's output is the row itself, or what another output is.
    """
    of_rows = [x for x in outputs if x.shape[:1] == (ANY_LENGTH,)]
    buffers = {x.buffer for x in of_rows if isinstance(x, StridedArray) and x.buffer.kind == "scratch"}
    if len(buffers) < len(of_rows):
        raise Unsupported("a scan of which an output is a row itself")
