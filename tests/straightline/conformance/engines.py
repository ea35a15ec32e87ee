"""The results of cases by XLA and by native code, of data, of known numbers and of both."""

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from straightline.compiled import CompiledFunction
from straightline.lowering import Lowering, trace_function, type_of
from straightline.nodes import Buffer
from straightline.program import Program, lower_function
from straightline.size_limits import TABLE
from straightline.strided_arrays import StridedArray
from tests.straightline.conformance.case import Case


def by_xla(cases: Sequence[Case]) -> list[list[np.ndarray]]:
    """Of each run by itself, as XLA computes it; case by case and leaf by leaf, (run, ...)."""

    def one(case: Case, rows: tuple[Any, ...]) -> list[Any]:
        leaves: list[Any] = jax.lax.map(lambda row: jax.tree.leaves(case.function(*row)), rows)
        return leaves

    with jax.enable_x64(True):
        every = jax.jit(lambda columns: [one(c, x) for c, x in zip(cases, columns, strict=True)])(
            [case.arguments for case in cases]
        )
    return [[np.asarray(x) for x in leaves] for leaves in every]


def by_lanes(case: Case) -> list[np.ndarray]:
    """By native code, each run a lane."""
    program = lower_function(lambda *row: jax.tree.leaves(case.function(*row)), *case.row(0))
    return [np.asarray(x) for x in CompiledFunction(program, [True] * len(case.arguments))(*case.arguments)]


def program_of(cases: Sequence[Case], known: Sequence[bool] = (False,) * 4) -> Program:
    """One program for all runs of some cases, of which some arguments are known when it is made and others are data."""
    lowering, inputs, outputs = Lowering(10**7), list[Buffer](), list[Any]()
    for case in cases:
        made, _ = trace_function(lambda *row, f=case.function: jax.tree.leaves(f(*row)), *case.row(0))
        columns: list[Any] = []
        for argument, fixed in zip(case.arguments, known, strict=False):
            if not fixed:
                inputs.append(Buffer("input", type_of(argument), argument.shape, lowering.graph.top))
            columns.append(argument if fixed else StridedArray.of_whole_buffer(inputs[-1]))
        rows: list[list[Any]] = []
        with jax.enable_x64(True):
            for run in range(case.runs):
                row = [
                    c.row(run) if isinstance(c, StridedArray) else lowering.make_known_array(c[run]) for c in columns
                ]
                row = [lowering.nodes(x) if x.size <= TABLE else x for x in row]
                rows.append(lowering.lower_whole_program(made, row))
        outputs += [_stacked(lowering, leaves) for leaves in zip(*rows, strict=True)]
    return Program(lowering.graph, inputs, outputs, jax.tree.structure([0] * len(outputs)))


def _stacked(lowering: Lowering, leaves: Sequence[Any]) -> Any:
    """The results of all runs as one array."""
    if leaves[0].size:
        return np.stack([lowering.nodes(x) for x in leaves])
    shape = (len(leaves), *leaves[0].shape)
    return StridedArray.of_whole_buffer(Buffer("scratch", leaves[0].type, shape, lowering.graph.top))


def by_known(cases: Sequence[Case], known: Sequence[bool]) -> list[np.ndarray]:
    """By native code in one program of all runs, arguments known or not; the leaves of all cases one after another."""
    program = program_of(cases, known)
    data = [a[None] for case in cases for a, k in zip(case.arguments, known, strict=False) if not k]
    return [x[0] for x in CompiledFunction(program, [True] * len(data), 1)(*data)]


def difference(result: np.ndarray, expected: np.ndarray, units: float) -> np.ndarray:
    """Where two results differ: in type and bits, but for the bits of NaN and for so many units of rounding."""
    assert result.dtype == expected.dtype and result.shape == expected.shape, (
        result.dtype, expected.dtype, result.shape, expected.shape,
    )  # fmt: skip
    if expected.dtype.kind != "f":
        return np.asarray(result != expected)
    # XLA takes subnormal numbers for zeros.
    smallest = np.finfo(expected.dtype).tiny
    result, expected = (np.where(np.abs(x) < smallest, np.copysign(0.0, x), x) for x in (result, expected))
    with np.errstate(all="ignore"):
        near = np.abs(result - expected) <= units * np.spacing(np.abs(expected))
    same = (result == expected) & (np.signbit(result) == np.signbit(expected))
    return ~(same | (np.isnan(result) & np.isnan(expected)) | (near & (expected != 0)))
