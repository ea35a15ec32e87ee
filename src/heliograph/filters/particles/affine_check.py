"""Whether a function written in JAX is affine in some of its arguments, given the others: read off its operations.

Each number of the traced program has a degree: KNOWN, a constant of the program; GIVEN, a function of the other
arguments alone; AFFINE, a sum of given numbers and of arguments times given numbers; OTHER, anything else, or what is
not recognised as less.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend import core

from heliograph.numerics.float64 import in_float64
from heliograph.numerics.numpy_or_jax import called_program

KNOWN, GIVEN, AFFINE, OTHER = -1, 0, 1, 2  # degrees, in their order
MOVES = ("reshape", "broadcast_in_dim", "transpose", "squeeze", "slice", "concatenate", "rev", "copy", "expand_dims",
         "split", "stack", "unstack")  # fmt: skip
LOOKUPS = ("gather", "dynamic_slice")  # the first operand is moved, by indices


class _EntryDegrees(NamedTuple):
    """Degrees of an array's entries, and its value where all of them are known."""

    degree: np.ndarray
    value: Any = None

    @property
    def is_zero(self) -> np.ndarray:
        """Which entries are known zeros."""
        return np.zeros(self.degree.shape, bool) if self.value is None else np.asarray(self.value) == 0


@in_float64
def is_affine(function: Callable[..., jax.Array], x: np.ndarray, indices: Sequence[int], *others: np.ndarray) -> bool:
    """Return whether f(x, *others) is seen to be affine in the entries of x at these indices, whatever all others are.

    Each entry of each result has a degree: KNOWN, GIVEN (it does not depend on x at these indices), AFFINE in them, or
    OTHER. Degrees are found operation by operation.

    Args:
        function: f, in operations of jax.numpy.
        x: a point (n,), of which only the shape matters.
        indices: the entries of x in which f should be affine.
        others: further arguments of f, of which only the shapes matter.
    """
    program = jax.make_jaxpr(function)(x, *others)
    degree = np.full(x.shape, GIVEN)
    degree[list(indices)] = AFFINE
    arguments = [_EntryDegrees(degree), *(_EntryDegrees(np.full(np.shape(argument), GIVEN)) for argument in others)]
    return all(np.all(result.degree <= AFFINE) for result in _classify_dependence(program, arguments))


def _classify_dependence(program: core.ClosedJaxpr, arguments: Sequence[_EntryDegrees]) -> list[_EntryDegrees]:
    """Return the degrees of a program's results, operation by operation.

    A degree says how an entry depends on the entries asked about: KNOWN, GIVEN (not at all), AFFINE or OTHER.
    """
    values = dict(zip(program.jaxpr.invars, arguments, strict=True))
    values.update(zip(program.jaxpr.constvars, map(_trace_known_array, program.consts), strict=True))

    def read(atom: Any) -> _EntryDegrees:
        """Return the degrees of an operand: a literal number, or a result of an earlier operation."""
        return _trace_known_array(atom.val) if isinstance(atom, core.Literal) else values[atom]

    for equation in program.jaxpr.eqns:
        inputs = [read(atom) for atom in equation.invars]
        values.update(zip(equation.outvars, _degrees_of_operation(equation, inputs), strict=True))
    return [read(atom) for atom in program.jaxpr.outvars]


def _trace_known_array(value: Any) -> _EntryDegrees:
    """Return the degrees of a constant array: KNOWN for each entry, with the array as their value."""
    return _EntryDegrees(np.full(np.asarray(value).shape, KNOWN), value)


def _degrees_of_operation(equation: Any, x: list[_EntryDegrees]) -> list[_EntryDegrees]:
    """Return the degrees of the results of one traced operation (a JAX equation), from the degrees of its operands x.

    A function is affine in its variables if all its results are at most AFFINE. Degrees are of single entries of an
    array. KNOWN: a constant, with its value; GIVEN: no function of the variables; AFFINE: a sum of given numbers and of
    variables times given numbers; OTHER: anything else.
    """
    name, params = equation.primitive.name, equation.params

    def compute(arrays: list[Any]) -> list[Any]:
        """Return the results of the operation on these arrays."""
        results = equation.primitive.bind(*(jnp.asarray(array) for array in arrays), **params)
        return list(results) if equation.primitive.multiple_results else [results]

    # An operation that calls a traced program (as a jitted function): the degrees of its results.
    if (called := called_program(equation)) is not None:
        return _classify_dependence(called, x)
    # Constants give constants, and given operands (no functions of the variables) given results.
    if all(operand.value is not None for operand in x):
        return [_trace_known_array(value) for value in compute([operand.value for operand in x])]
    shapes = [out.aval.shape for out in equation.outvars]
    if all(np.all(operand.degree <= GIVEN) for operand in x):
        return [_EntryDegrees(np.full(shape, GIVEN)) for shape in shapes]
    # Operations that move numbers move their degrees alike.
    if name in MOVES:
        return [_EntryDegrees(np.asarray(degree)) for degree in compute([operand.degree for operand in x])]
    if name in LOOKUPS and all(index.value is not None for index in x[1:]):
        moved = compute([x[0].degree, *(index.value for index in x[1:])])
        return [_EntryDegrees(np.asarray(degree)) for degree in moved]
    # Sums and products, by the degrees of their operands.
    return [_EntryDegrees(np.broadcast_to(_degree_of_arithmetic(name, params, x), shape)) for shape in shapes]


def _degree_of_arithmetic(name: str, params: dict[str, Any], x: list[_EntryDegrees]) -> Any:
    """Return the degrees, entry by entry, of the result of an operation on operands x; OTHER if it is not listed here.

    A traced function is walked through operation by operation to see whether it is affine in some of its arguments, the
    variables. A degree is a number, KNOWN (a constant) < GIVEN (no function of the variables) < AFFINE in them < OTHER,
    so that a sum has the larger one of its terms. `name`: name of the operation (a JAX primitive); `params`: its
    parameters; `x`: degrees of each operand's entries, with their values if all are constants.
    """
    match name:
        case "add" | "add_any" | "sub":
            return np.maximum(x[0].degree, x[1].degree)
        case "neg" | "real":
            return x[0].degree
        case "convert_element_type" if np.dtype(params["new_dtype"]).kind == "f":
            return x[0].degree
        case "reduce_sum":
            return np.max(x[0].degree, axis=tuple(params["axes"]), initial=KNOWN)
        case "mul":  # of numbers of which one is given; a known zero makes the product zero
            zero = x[0].is_zero | x[1].is_zero
            return np.where(zero, GIVEN, _degree_of_product(x[0].degree, x[1].degree))
        case "div":
            return np.where(x[1].degree <= GIVEN, x[0].degree, OTHER)
        case "integer_pow" if params["y"] == 1:
            return x[0].degree
        case "select_n":  # a choice by the first operand among the others
            cases = np.max([one.degree for one in x[1:]], axis=0)
            return np.where(x[0].degree <= GIVEN, cases, OTHER)
        case "dot_general":
            return _degree_of_contraction(x[0], x[1], params["dimension_numbers"])
    return np.asarray(OTHER)


def _degree_of_product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the degrees of products of numbers of degrees a and b, entry by entry.

    Degrees are ordered: KNOWN (a constant) < GIVEN (no function of the variables) < AFFINE in them < OTHER. If one
    factor is at most GIVEN, the product has the degree of the other; of two factors that depend on the variables it is
    OTHER.
    """
    return np.where(np.minimum(a, b) <= GIVEN, np.maximum(a, b), OTHER)


def _degree_of_contraction(a: _EntryDegrees, b: _EntryDegrees, dimensions: Any) -> np.ndarray:
    """Return the degrees of the sums of products that a contraction (dot_general) of a and b makes.

    The degrees in their order are KNOWN (a constant), GIVEN (no function of the variables), AFFINE (in the variables)
    and OTHER. A product with a known zero does not count. A sum is OTHER if some product has an OTHER factor or two
    AFFINE ones. Else it is AFFINE if some product has an AFFINE factor, and GIVEN if none has. KNOWN is not needed, as
    operations on constants alone are computed. `dimensions` are JAX's contracted and batch axes.
    """

    def count(of_a: np.ndarray, of_b: np.ndarray) -> np.ndarray:
        """Return for each sum how many of its products have both of these properties."""
        return np.asarray(jax.lax.dot_general(of_a.astype(float), of_b.astype(float), dimensions))

    affine_terms = count(a.degree >= AFFINE, ~b.is_zero) + count(~a.is_zero, b.degree >= AFFINE)
    other_terms = count(a.degree >= OTHER, ~b.is_zero) + count(~a.is_zero, b.degree >= OTHER)
    both_affine = count(a.degree >= AFFINE, b.degree >= AFFINE)
    return np.where(other_terms + both_affine > 0, OTHER, np.where(affine_terms > 0, AFFINE, GIVEN))
