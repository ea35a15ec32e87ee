"""Lowering of a traced function of one run to a graph of scalar operations.

An array of the trace is a NumPy array of nodes (or of keys of random numbers), so that shape operations only move
references; or, if it is long, `StridedArray`. `RULES` has a rule for each operation of JAX, from the files of rules.
"""

import math
import os
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal, Var
from jaxtyping import PyTree

from straightline.graph import Graph
from straightline.nodes import TYPES, Buffer, Node, RandomKey, Type, Unsupported
from straightline.size_limits import LONGEST, TABLE, WRITTEN_OUT
from straightline.strided_arrays import StridedArray

Value = Any  # a NumPy array of nodes or keys, or an array in memory
Rule = Callable[["Lowering", JaxprEqn, list[Value]], Sequence[Value]]

HERE = f"{Path(__file__).parent}{os.sep}"
RULES: dict[str, Rule] = {}  # operation of JAX -> its nodes; arguments are NumPy arrays of nodes
NAMES: dict[Any, str] = {}  # of types of numbers, which NumPy takes long to spell
IN_MEMORY: dict[str, Rule] = {}  # the same of operations that take arrays in memory as they are


class Lowering:
    """Lowering of JAX's operations one after another: each is written as scalar operations (nodes) into a graph."""

    def __init__(self, most: int = 2 * LONGEST) -> None:
        """Begin a program without operations; more than `most` nodes (scalar operations) are refused."""
        self.graph = Graph(most)
        # Programs of custom operations, traced for one run, by the operation and the shapes of its arguments.
        self.kernels: dict[Any, ClosedJaxpr] = {}
        # How many numbers a program within a loop or branch computes, by an estimate.
        self.sizes: dict[Jaxpr, int] = {}
        # A loop whose iterations compute no more numbers than this, all together, is written out iteration by
        # iteration.
        self.written_out = WRITTEN_OUT
        # The factors A and B of each product A B', by the nodes of its entries.
        self.products: dict[Any, tuple[np.ndarray, np.ndarray]] = {}

    def inline_program(self, program: ClosedJaxpr | Jaxpr, inputs: Sequence[Value]) -> list[Value]:
        """Return the results of a traced program for these arguments: its operations are added to the graph.

        Operations that no result needs are left out.
        """
        jaxpr: Any = program
        consts: Sequence[Any] = ()
        if isinstance(program, ClosedJaxpr):
            jaxpr, consts = program.jaxpr, program.consts
        values: dict[Var, Value] = dict(zip(jaxpr.constvars, map(self.make_known_array, consts), strict=True))
        values |= zip(jaxpr.invars, inputs, strict=True)
        for equation in _list_used_equations(jaxpr):
            arguments = [self._look_up_argument(values, v) for v in equation.invars]
            values |= zip(equation.outvars, self.lower_equation(equation, arguments), strict=True)
        return [self._look_up_argument(values, v) for v in jaxpr.outvars]

    def lower_whole_program(self, program: ClosedJaxpr, inputs: Sequence[Value]) -> list[Value]:
        """Return the results of a whole program.

        An empty result has no node that would tell its type, so it becomes an empty view of memory of its type.
        """
        avals: list[Any] = [v.aval for v in program.jaxpr.outvars]
        values = self.inline_program(program, inputs)
        return [x if x.size else self._make_empty_view(a) for x, a in zip(values, avals, strict=True)]

    def _make_empty_view(self, aval: Any) -> StridedArray:
        """Return an array without entries, in memory of the type and shape that JAX says (`aval`)."""
        return StridedArray.of_whole_buffer(Buffer("scratch", type_of(aval), tuple(aval.shape), self.graph.top))

    def lower_equation(self, equation: JaxprEqn, inputs: list[Value]) -> Sequence[Value]:
        """Return the results of one operation of JAX (`equation`) as nodes or arrays in memory, by its rule.

        Raises:
            Unsupported: there is no rule for the operation, or the rule fails; the latter also warns.
        """
        name = equation.primitive.name
        try:
            results = self._apply_rule(equation, name, inputs)
            for variable, value in zip(equation.outvars, results, strict=True):
                aval: Any = variable.aval
                if value.shape != aval.shape:
                    raise ValueError(f"a result of shape {value.shape} for {aval.shape}")
            return results
        except Unsupported as error:
            raise (error if error.where else Unsupported(error.operation, code_line(equation))) from None
        except Exception as error:
            raise make_refusal(name, error, code_line(equation)) from error

    def _apply_rule(self, equation: JaxprEqn, name: str, inputs: list[Value]) -> Sequence[Value]:
        """Return the results of an operation by its rule.

        IN_MEMORY holds the rules that take arrays in memory, and RULES those that take nodes. An operation in both is
        lowered by IN_MEMORY if one of its inputs is in memory.
        """
        if name in IN_MEMORY and (name not in RULES or any(isinstance(x, StridedArray) for x in inputs)):
            return IN_MEMORY[name](self, equation, inputs)
        if name not in RULES:
            raise Unsupported(name)
        return RULES[name](self, equation, [self.nodes(x) for x in inputs])

    def nodes(self, value: Value) -> np.ndarray:
        """Return a value as a NumPy array of nodes (scalar operations); an array in memory is loaded entry by entry."""
        return value.nodes(self.graph) if isinstance(value, StridedArray) else value

    def get_only_node(self, value: Value) -> Node:
        """Return the only entry of a condition, as a node; raise Unsupported if it has several."""
        nodes = self.nodes(value)
        if nodes.size != 1:
            raise Unsupported("a condition for each entry of an array")
        node: Node = nodes.item()
        return node

    def make_known_array(self, number: Any) -> Value:
        """Return an array of known numbers as constants, or as a table in memory if it has more than TABLE numbers.

        An array of objects holds nodes already, and is returned as it is. Random keys become keys of known words.
        """
        if isinstance(number, np.ndarray) and number.dtype == object:
            return number
        if isinstance(number, jax.Array) and jax.numpy.issubdtype(number.dtype, jax.dtypes.prng_key):
            return make_keys(self.make_known_array(np.asarray(jax.random.key_data(number))))
        array = np.asarray(number)
        type = type_of(array)
        if array.size > TABLE:
            return StridedArray.of_whole_buffer(Buffer("table", type, array.shape, self.graph.top, array))
        return arrange_nodes([self.graph.constant(x, type) for x in array.ravel().tolist()], array.shape)

    def _look_up_argument(self, values: dict[Var, Value], v: Any) -> Value:
        """Return the value of an operation's argument: a literal's constant, else what was computed."""
        return self.make_known_array(_convert_literal(v.val, v)) if isinstance(v, Literal) else values[v]


def _convert_literal(number: Any, variable: Any) -> Any:
    """Return a literal of JAX's program in the type that the program has for it.

    In single precision a literal may be a number of Python, which would count as a double.
    """
    return np.asarray(number, np.float32) if variable.aval.dtype == np.float32 else number


def estimate_size(lowering: Lowering, jaxpr: Any) -> int:
    """Return an estimate of how many numbers a traced program computes; `lowering.sizes` keeps the answers.

    The body of a scan counts once for each iteration, and that of a while loop counts once.
    """
    if jaxpr in lowering.sizes:
        return lowering.sizes[jaxpr]
    total = 0
    for equation in jaxpr.eqns:
        inner = [estimate_size(lowering, getattr(p, "jaxpr", p)) for p in _list_inner_programs(equation.params)]
        length = equation.params["length"] if equation.primitive.name == "scan" else 1
        total += length * sum(inner) + sum(math.prod(v.aval.shape) for v in equation.outvars)
    lowering.sizes[jaxpr] = total
    return total


def _list_inner_programs(params: dict[str, Any]) -> list[Any]:
    """Return the traced programs among the parameters of an operation of JAX, such as a loop's body."""
    values = [x for p in params.values() for x in (p if isinstance(p, tuple) else (p,))]
    return [x for x in values if hasattr(x, "eqns") or hasattr(x, "jaxpr")]


def make_refusal(operation: str, error: Exception, where: str) -> Unsupported:
    """Return the refusal (Unsupported) of a program whose native code failed with an error; warn once for each text.

    Such an error is a defect of this package or of LLVM; XLA then computes the program. `where` is the line of code
    that the operation comes from, "" if it is not known.
    """
    refused = Unsupported(f"{operation}, whose native code failed ({type(error).__name__}: {error})", where)
    warn_once(f"no native code: {refused}")
    return refused


@contextmanager
def turn_failures_into_refusals(what: str) -> Iterator[None]:
    """Turn any error within the `with` block, which makes native code of `what`, into the refusal Unsupported."""
    try:
        yield
    except Unsupported:
        raise
    except Exception as error:
        raise make_refusal(what, error, "") from error


@cache
def warn_once(text: str) -> None:
    """Give a warning with this text, once in a process."""
    warnings.warn(text, RuntimeWarning, stacklevel=2)


def arrange_nodes(nodes: Iterable[Any], shape: tuple[int, ...]) -> np.ndarray:
    """Return nodes (or random keys), given in row-major order, as a NumPy array of objects of this shape."""
    flat = list(nodes)
    # NumPy must not look into the nodes, as np.array(flat) would.
    array = np.empty(len(flat), dtype=object)
    array[:] = flat
    return array.reshape(shape)


def make_keys(words: np.ndarray) -> np.ndarray:
    """Return an array (...) of random keys from the nodes of their two words, an array (..., 2)."""
    flat = words.reshape(-1, 2)
    return arrange_nodes((RandomKey(*pair) for pair in flat), words.shape[:-1])


def list_nodes(value: np.ndarray) -> list[Node]:
    """Return the nodes of an array in row-major order, a key as its two words."""
    flat: list[Any] = value.ravel().tolist()
    return [n for x in flat for n in ((x.first, x.second) if isinstance(x, RandomKey) else (x,))]


def type_of(value: Any) -> Type:
    """Return the type of a number, or of an array's numbers; raise Unsupported if native code has no such type."""
    dtype = value.dtype
    # NAMES keeps the names of dtypes, which NumPy takes long to spell.
    if dtype not in NAMES:
        NAMES[dtype] = np.dtype(dtype).name
    name = NAMES[dtype]
    if name not in TYPES:
        raise Unsupported(f"numbers of type {name}")
    return TYPES[name]


def result_type(equation: JaxprEqn, index: int = 0) -> Type:
    """Return the type of the numbers of an operation's result; one with several results has them at `index`."""
    return type_of(equation.outvars[index].aval)


def result_shape(equation: JaxprEqn, index: int = 0) -> tuple[int, ...]:
    """Return the shape of an operation's result; one with several results has them at `index`."""
    aval: Any = equation.outvars[index].aval
    return tuple(aval.shape)


def make_placeholder(shape: Sequence[int], dtype: Any) -> Any:
    """Return a placeholder from which JAX traces an array of this shape and type."""
    return jax.ShapeDtypeStruct(tuple(shape), dtype)  # type: ignore[no-untyped-call]


def known_integers(value: np.ndarray) -> np.ndarray | None:
    """Return an array of nodes as integers, or None if one of the nodes is no constant, so that data decide it."""
    flat: list[Node] = value.ravel().tolist()
    if any(x.op != "constant" for x in flat):
        return None
    # A larger unsigned number would not fit an int64.
    return np.array([min(int(x.value), sys.maxsize) for x in flat], dtype=np.int64).reshape(value.shape)


def code_line(equation: JaxprEqn) -> str:
    """Return the line of code, as file:number, that an operation comes from; "" if it is not known.

    It is the innermost line that is not in JAX, in equinox or in this package (HERE).
    """
    traceback = equation.source_info.traceback
    frames: list[Any] = [] if traceback is None else traceback.frames
    inside = ("/jax/", "/equinox/", HERE)
    outside = [f for f in frames if not any(folder in f.file_name for folder in inside)]
    return f"{outside[0].file_name}:{outside[0].line_num}" if outside else ""


class _NonArrayPart(NamedTuple):
    """A part of a result that is no array, such as a function: kept as it is, where JAX would trace an array."""

    value: Any


jax.tree_util.register_pytree_node(_NonArrayPart, lambda held: ((), held.value), lambda value, _: value)
ARRAYS = (jax.Array, np.ndarray, np.generic, bool, int, float, complex)


HALVED = {np.dtype(x): np.dtype(y) for x, y in (("f8", "f4"), ("i8", "i4"), ("u8", "u4"))}


def _halve_precision(example: Any) -> Any:
    """Return an example of an argument as JAX takes it in single precision: with types of half as many bits.

    A number of Python, whose type JAX chooses, stays as it is.
    """
    kind = getattr(example, "dtype", None)
    return make_placeholder(example.shape, HALVED[kind]) if kind in HALVED else example


def trace_function(function: Callable[..., PyTree], *examples: PyTree, single: bool = False) -> tuple[ClosedJaxpr, Any]:
    """Trace a function of one run, in double precision or in single; return its program and its result's structure.

    What a result has beside arrays, as a filter its model's functions, is part of the structure.
    """
    structure: list[Any] = []

    def call(*leaves: Any) -> list[Any]:
        """Return the leaves of the function's results from the leaves of its arguments; note the results' `structure`.

        Parts that are not arrays become _NonArrayPart, which has no leaves and so stays in the structure.
        """
        returned = function(*jax.tree.unflatten(tree, leaves))
        arrays, form = jax.tree.flatten(
            jax.tree.map(lambda x: x if isinstance(x, ARRAYS) else _NonArrayPart(x), returned)
        )
        structure[:] = [form]
        return arrays

    with jax.enable_x64(not single):
        flat, tree = jax.tree.flatten(examples)
        program = jax.make_jaxpr(call)(*(map(_halve_precision, flat) if single else flat))
    return program, structure[0]


def _list_used_equations(jaxpr: Jaxpr) -> list[JaxprEqn]:
    """Return the operations of JAX's program that its results need, and those with effects, such as printing."""
    # Go backward, since all uses of an operation's results come after it.
    needed = {v for v in jaxpr.outvars if isinstance(v, Var)}
    used: list[JaxprEqn] = []
    for equation in reversed(jaxpr.eqns):
        if equation.effects or not needed.isdisjoint(equation.outvars):
            needed |= {v for v in equation.invars if isinstance(v, Var)}
            used.append(equation)
    return used[::-1]
