"""Text of a traced program, the same in each process that traces the same: what it computes, with its constants."""

import re
from collections.abc import Mapping, Sequence
from hashlib import sha256
from typing import Any

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal, Var

from heliograph.numerics.types import PyTree

DIGITS = 16  # of a hash
ADDRESS = re.compile(r" at 0x[0-9a-f]+")


def hash_numbers(numbers: PyTree) -> str:
    """Return a hash (DIGITS hexadecimal digits) of a text, or of all numbers in a tree with their shapes and types."""
    if isinstance(numbers, str):
        return sha256(numbers.encode()).hexdigest()[:DIGITS]
    digest = sha256()
    for leaf in jax.tree.leaves(numbers):
        if isinstance(leaf, jax.Array | np.ndarray | np.generic | int | float):
            array = np.asarray(leaf)
            digest.update(f"{array.shape}{array.dtype}".encode() + array.tobytes())
    return digest.hexdigest()[:DIGITS]


def write_program_text(program: ClosedJaxpr) -> str:
    """Return a program that JAX traced as text: its constants and a line for each operation, inner programs by hashes.

    The same function gives the same text in each process, so that a compiled program is found again by it. JAX's own
    text of the lowered program says the same, but takes half as long to write as the trace.
    """
    return _ProgramWriter().write_program(program.jaxpr, program.consts)


class _ProgramWriter:
    """Writer of programs, each once wherever it is called."""

    def __init__(self) -> None:
        """Begin before the first program."""
        self._hashes: dict[int, tuple[object, str]] = {}  # by the identity of programs, which are held

    def write_program(self, jaxpr: Jaxpr, consts: Sequence[Any]) -> str:
        """Return a program as text: its constants and inputs, a line for each operation, and its results.

        Variables are numbered in order, so that programs that differ only in their names have the same text.
        """
        numbers: dict[Var, int] = {}
        constants = self._write_definitions(numbers, jaxpr.constvars)
        values = [self._write_value(value) for value in consts]
        inputs = self._write_definitions(numbers, jaxpr.invars)
        operations = [self._write_line(numbers, equation) for equation in jaxpr.eqns]
        results = self._write_uses(numbers, jaxpr.outvars)
        return "\n".join([f"{constants} = {values}", inputs, *operations, results])

    def _write_line(self, numbers: dict[Var, int], equation: JaxprEqn) -> str:
        """Return the line of an operation: types of its results, its name, its parameters and its arguments."""
        used, how = self._write_uses(numbers, equation.invars), self._write_value(equation.params)
        return f"{self._write_definitions(numbers, equation.outvars)} = {equation.primitive.name} {how} {used}"

    def _write_definitions(self, numbers: dict[Var, int], variables: Sequence[Var]) -> str:
        """Give new variables their numbers in `numbers`, in order, and return their types (with shapes) as text."""
        for variable in variables:
            numbers[variable] = len(numbers)
        return " ".join(str(variable.aval) for variable in variables)

    def _write_uses(self, numbers: Mapping[Var, int], atoms: Sequence[Var | Literal]) -> str:
        """Return the numbers of variables, and literals as they are."""
        return " ".join(self._write_value(x.val) if isinstance(x, Literal) else str(numbers[x]) for x in atoms)

    def _write_value(self, value: Any) -> str:
        """Return the text of a parameter of an operation, the same in each process.

        Arrays and inner programs are written as their hashes, a dictionary by sorted keys, functions and types by name.
        """
        match value:
            case ClosedJaxpr():
                return self._write_hash(value, value.jaxpr, value.consts)
            case Jaxpr():
                return self._write_hash(value, value, ())
            case dict():
                return "{" + ", ".join(f"{name}: {self._write_value(value[name])}" for name in sorted(value)) + "}"
            case tuple() | list():
                return "(" + ", ".join(map(self._write_value, value)) + ")"
            case jax.Array() if jax.numpy.issubdtype(value.dtype, jax.dtypes.prng_key):
                return f"key {self._write_value(np.asarray(jax.random.key_data(value)))}"
            case jax.Array() | np.ndarray():
                return f"{value.dtype}{value.shape} {hash_numbers(np.asarray(value))}"
        # A function makes a derivative, of which a step computes none; a type has its name.
        return getattr(value, "__name__", "") if callable(value) else ADDRESS.sub("", repr(value))

    def _write_hash(self, program: object, jaxpr: Jaxpr, consts: Sequence[Any]) -> str:
        """Return the hash of an inner program's text, which is written once for each `program` object.

        The object is kept with the hash, so that no other object gets its id.
        """
        if id(program) not in self._hashes:
            self._hashes[id(program)] = program, hash_numbers(self.write_program(jaxpr, consts))
        return self._hashes[id(program)][1]
