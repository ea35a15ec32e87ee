"""One step of a filter as a graph of scalar operations: from state, measurement and inputs to state and estimate.

Inputs of devices are finite, so that zero times them is zero; known arrays become tables.
"""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import JaxprEqn

from heliograph.filters.base import AbstractFilter, step_with_judgement
from heliograph.filters.plausibility import LIMIT
from heliograph.model.inputs import inputs_spoil
from heliograph.numerics.check import InputError, fail
from heliograph.numerics.types import PyTree
from straightline.c_source import Real
from straightline.folding import is_finite
from straightline.graph import Graph
from straightline.lowering import RULES, Lowering, Value, array_of, code_line, scalars, traced, type_of
from straightline.memory import LARGE, InMemory
from straightline.nodes import Buffer, Node, Type, Unsupported

# Finite where the arguments are, but for overflow and divisions by zero, which the finished step is checked for.
PRESERVING = frozenset((
    "add", "sub", "mul", "div", "neg", "abs", "sqrt", "exp", "log", "log1p", "expm1", "sin", "cos", "tan", "tanh",
    "asin", "acos", "atan", "atan2", "floor", "ceil", "sign", "max", "min", "round_even", "pow", "rem",
))  # fmt: skip


# Of an array in memory these make a view; all others take its numbers.
VIEWS = frozenset(
    ("dynamic_slice", "gather", "slice", "squeeze", "expand_dims", "reshape", "transpose", "broadcast_in_dim")
)


class FiniteGraph(Graph):
    """A graph that also simplifies products of zero with numbers that depend on finite `buffers` only.

    A measurement, whose components may be NaN, is no such buffer: a number that depends on it counts as finite only
    after a selection that replaces NaN.
    """

    def __init__(self) -> None:
        super().__init__()
        self.buffers: set[Buffer] = set()
        self.finite: set[Node] = set()

    def node(self, op: str, type: Type, *args: Node, value: Any = None) -> Node:
        """Make a node, with products of zero and a finite number simplified."""
        if op == "mul" and type == "f64":
            for a, b in (args, args[::-1]):
                if a.op == "constant" and a.value == 0 and self._is_finite(b):
                    return self.constant(0.0, "f64")
        made = super().node(op, type, *args, value=value)
        numbers = args[1:] if op == "select" else args
        if type == "f64" and (op in PRESERVING or op == "select") and all(map(self._is_finite, numbers)):
            self.finite.add(made)
        return made

    def load(self, buffer: Buffer, offset: int, strides: Sequence[int] = (), indices: Sequence[Node] = ()) -> Node:
        """Load a number; those of tables are finite too."""
        made = super().load(buffer, offset, strides, indices)
        if buffer in self.buffers:
            self.finite.add(made)
        return made

    def _is_finite(self, node: Node) -> bool:
        return node in self.finite or is_finite(node)


class DeviceLowering(Lowering):
    """Lowering into a `FiniteGraph`: written out, with known arrays as tables that a step can index."""

    def __init__(self) -> None:
        super().__init__()
        self.graph: FiniteGraph = FiniteGraph()

    def equation(self, equation: JaxprEqn, inputs: list[Value]) -> Sequence[Value]:
        """Lower one operation; arithmetic is written out unless its arrays are too long."""
        if equation.primitive.name in RULES and equation.primitive.name not in VIEWS:
            inputs = [self.nodes(x) if isinstance(x, InMemory) and x.size <= LARGE else x for x in inputs]
        return super().equation(equation, inputs)

    def known(self, number: Any) -> Value:
        """Place an array of known numbers in memory; an entry at a known place is a constant."""
        if not isinstance(number, np.ndarray | np.generic | jax.Array) or not np.shape(number) or not np.size(number):
            return super().known(number)
        if isinstance(number, np.ndarray) and number.dtype == object:
            return number
        array = np.asarray(number)
        return InMemory.whole(Buffer("table", type_of(array), array.shape, self.graph.top, array))


ROUNDING: dict[Real, float] = {"double": 1e-9, "float": 1e-4}  # of an expectation after many steps
RANDOM = ("random_", "threefry")
RESERVED = frozenset((
    "auto", "break", "case", "char", "const", "continue", "default", "do", "double", "else", "enum", "extern", "float",
    "for", "goto", "if", "inline", "int", "long", "register", "restrict", "return", "short", "signed", "sizeof",
    "static", "struct", "switch", "typedef", "union", "unsigned", "void", "volatile", "while",
))  # fmt: skip
ADDED = frozenset(("step", "estimate_mean", "estimate_covariance"))  # members beside the arrays of the filter's state


class Leaf(NamedTuple):
    """An array of the state: its name, its buffer, its initial numbers and the nodes after a step."""

    name: str
    buffer: Buffer
    start: np.ndarray
    after: list[Node]


class StepProgram(NamedTuple):
    """A step: its inputs and outputs; `start_mean` and `start_covariance` are those before the first step.

    `implausible`: whether the estimate would lose its digits, so that the step must not be used; `spoilt`: whether
    the inputs are none.
    """

    filter: AbstractFilter
    graph: FiniteGraph
    leaves: list[Leaf]
    z: Buffer
    u: Buffer
    k: Buffer
    mean: list[Node]
    covariance: list[Node]
    implausible: Node
    spoilt: Node
    start_mean: np.ndarray
    start_covariance: np.ndarray
    equations: list[Any]


def step_program(filter: AbstractFilter, real: Real) -> StepProgram:
    """Lower `step` of a filter to a graph of scalar operations, for numbers of this type.

    A measurement that differs from what was expected by less than `ROUNDING` of itself is used, however small its
    deviations are: after many steps its expectation is rounded by as much (and below 1e-33 has few digits).

    An array of the state that is symmetric at the start, and after every step from a symmetric one, is always
    symmetric: then only one of its triangles is read, and the other is only written.

    Raises:
        ValueError: random numbers, or operations that are not supported; with the operation and its place.
    """
    state = filter.init()
    leaves, tree = jax.tree.flatten(state)
    z, u, k = np.zeros(filter.received), np.zeros(len(filter.inputs)), np.asarray(0)
    rounding, precision = ROUNDING[real], np.float64 if real == "double" else np.float32

    def step(leaves: list[jax.Array], z: jax.Array, u: jax.Array, k: jax.Array) -> PyTree:
        after, estimate, judgement, innovation = step_with_judgement(filter, jax.tree.unflatten(tree, leaves), z, u, k)
        # Each component by itself, which is cheap: larger than expected, and beyond the bound of its own deviations.
        differs, variances = jnp.abs(innovation.value), jnp.diagonal(jnp.asarray(innovation.covariance))
        far = differs > LIMIT * jnp.sqrt(jnp.maximum(variances, 0.0))
        far &= (jnp.abs(z) > jnp.abs(z - innovation.value)) & (differs > rounding * jnp.maximum(jnp.abs(z), 1e-33))
        implausible = jnp.any(far) | (judgement.input > 0)
        spoilt = inputs_spoil(filter, filter.inputs, u, k, precision)
        return jax.tree.leaves(after), estimate.mean, estimate.covariance, implausible, spoilt

    # Trace the step, and refuse random numbers: a device has none.
    program, _ = traced(step, leaves, z, u, k)
    equations = list(_equations(program.jaxpr))
    for equation in equations:
        if equation.primitive.name.startswith(RANDOM):
            raise no_c(equation.primitive.name, code_line(equation))
    estimate, names = filter.estimate(state), names_of(state)
    graph, inputs, outputs = _with_symmetry(program, leaves)
    # Inputs are (state, z, u, k), outputs (state, mean, covariance, whether it is implausible, and the inputs spoilt).
    *buffers, of_z, of_u, of_k = inputs
    *after, mean, covariance, (implausible,), (spoilt,) = map(scalars, outputs)
    parts = zip(names, buffers, map(np.asarray, leaves), after, strict=True)
    return StepProgram(
        filter=filter,
        graph=graph,
        leaves=[Leaf(*fields) for fields in parts],
        z=of_z,
        u=of_u,
        k=of_k,
        mean=mean,
        covariance=covariance,
        implausible=implausible,
        spoilt=spoilt,
        start_mean=np.asarray(estimate.mean),
        start_covariance=np.asarray(estimate.covariance),
        equations=equations,
    )


def _with_symmetry(program: Any, leaves: list[Any]) -> tuple[FiniteGraph, list[Buffer], list[Any]]:
    """Lower a step by induction: assume all arrays symmetric, drop those that it does not keep symmetric, repeat."""
    symmetric = {i for i, leaf in enumerate(leaves) if _is_symmetric(np.asarray(leaf))}
    while True:
        graph, inputs, outputs = _lowered(program, len(leaves), symmetric)
        lost = {i for i in symmetric if not _is_symmetric(np.asarray(outputs[i]))}
        if not lost:
            return graph, inputs, outputs
        symmetric -= lost


def _lowered(program: Any, leaves: int, symmetric: set[int]) -> tuple[FiniteGraph, list[Buffer], list[Any]]:
    """Return graph, input buffers and output values; the last inputs are z, u and k."""
    lowering, inputs, values = DeviceLowering(), [], []
    graph = lowering.graph
    try:
        for number, variable in enumerate(program.jaxpr.invars):
            aval = variable.aval
            # A symmetric array is read from its upper triangle.
            buffer = Buffer("input", type_of(aval), tuple(aval.shape), graph.top)
            inputs.append(buffer)
            if number != leaves:  # all but the measurement, of which components may be missing
                graph.buffers.add(buffer)
            value: Any = InMemory.whole(buffer)
            if number in symmetric:
                nodes, n = value.nodes(graph), aval.shape[0]
                value = array_of([nodes[min(i, j), max(i, j)] for i in range(n) for j in range(n)], aval.shape)
            values.append(value)
        with jax.enable_x64(True):
            outputs = [lowering.nodes(x) for x in lowering.inline(program, values)]
    except Unsupported as error:
        raise no_c(error.operation, error.where) from None
    return graph, inputs, outputs


def no_c(operation: str, where: str) -> InputError:
    """Return an error, in one line, about an operation that cannot be exported."""
    return fail("export", "operations that C has", f"{operation} at {where}")


def place_of(operation: str, equations: list[Any]) -> str:
    """Return the source line of an operation of the graph."""
    same = (e for e in equations if e.primitive.name.removesuffix("_convert_type") == operation)
    return next((code_line(e) for e in same), "an unknown line")


def names_of(state: PyTree) -> list[str]:
    """Return names in C for the arrays of a state, from their field names."""
    names: list[str] = []
    for path, _ in jax.tree_util.tree_flatten_with_path(state)[0]:
        parts = (str(getattr(k, "name", getattr(k, "key", getattr(k, "idx", "")))) for k in path)
        text = "_".join("".join(c if c.isalnum() and c.isascii() else "_" for c in p) for p in parts)
        text = f"state_{text}".rstrip("_") if not text or not text[0].isalpha() else text
        while text in RESERVED | ADDED or text in names:
            text += "_"
        names.append(text)
    return names


def _is_symmetric(value: np.ndarray) -> bool:
    if value.ndim != 2 or value.shape[0] != value.shape[1] or len(value) < 2:
        return False
    return all(value[i, j] == value[j, i] for i in range(len(value)) for j in range(i))


def _equations(jaxpr: Any) -> Iterator[Any]:
    """Yield all operations, also those of inner programs."""
    for equation in jaxpr.eqns:
        yield equation
        for param in equation.params.values():
            for inner in param if isinstance(param, tuple | list) else (param,):
                if hasattr(inner, "eqns") or hasattr(inner, "jaxpr"):
                    yield from _equations(getattr(inner, "jaxpr", inner))
