"""A JAX function of small arrays as one function of C99: no heap, no global variable, no library but libm."""

import inspect
from collections.abc import Callable, Collection, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr
from jaxtyping import PyTree

from straightline.c_lowering import lower_for_c
from straightline.c_source import CSource, EntryText, Real, c_type
from straightline.lowering import code_line, list_nodes, trace_function, type_of
from straightline.nodes import Buffer, Node, Type, Unsupported

RANDOM = ("random_", "threefry")
RESERVED = frozenset((
    "auto", "break", "case", "char", "const", "continue", "default", "do", "double", "else", "enum", "extern", "float",
    "for", "goto", "if", "inline", "int", "long", "register", "restrict", "return", "short", "signed", "sizeof",
    "static", "struct", "switch", "typedef", "union", "unsigned", "void", "volatile", "while",
))  # fmt: skip


class CArray(NamedTuple):
    """An argument or a result in C: name, type of a number, how many, and whether C passes it as an array.

    `used`: of an argument, whether a result depends on it. `same`: of a result, the number of the first one that has
    the same numbers. `symmetric`: of a result, whether entries across the diagonal are the same number.
    """

    name: str
    type: str
    size: int
    is_array: bool
    used: bool = True
    same: int = 0
    symmetric: bool = False

    @property
    def argument_declaration(self) -> str:
        """Return the C declaration of the array, or number, as an argument that a function reads."""
        return f"const {self.type} {self.name}[{max(self.size, 1)}]" if self.is_array else f"{self.type} {self.name}"

    @property
    def result_declaration(self) -> str:
        """Return the C declaration of the array as a result that a function writes."""
        return f"{self.type} {self.name}[{max(self.size, 1)}]"


class CFunction(NamedTuple):
    """Text of a function in C99, what it reads and writes, and the number of each operation in it.

    `header` declares it, and `source` is a file with it; `definition` is the function and the tables that it reads,
    without the lines of a file around it.
    """

    name: str
    header: str
    source: str
    definition: str
    arguments: list[CArray]
    results: list[CArray]
    operations: dict[str, int]


def to_c(
    function: Callable[..., PyTree],
    *examples: PyTree,
    name: str,
    single: bool = False,
    names: tuple[Sequence[str], Sequence[str]] = ((), ()),
    finite: Collection[int] = (),
    symmetric: Collection[int] = (),
    short: bool = False,
) -> CFunction:
    """Return a JAX function of small arrays as a function of C99, for a device.

    The arrays of the arguments come first, then those of the results, each row by row; a result may be written over an
    argument, since all are written at the end. The same numbers as native code's but for libm's rounding, and for fused
    products where the compiler makes them.

    Args:
        function: of trees of arrays; any that JAX traces.
        examples: arguments, of which shapes and types count alone.
        name: name of the function in C, and beginning of the names of its tables.
        single: whether numbers are float; double unless so.
        names: of the arguments' arrays and of the results'; by default from the parameters and fields.
        finite: indices, among the arguments' arrays in order, of those that never hold NaN, so that zero times an entry
            is zero; none by default.
        symmetric: indices of those that are symmetric, so that one triangle is read; none by default.
        short: whether each loop stays a loop, so that the text is short; by default short loops are written out.

    Raises:
        Unsupported: random numbers, or an operation that C does not have, with the line that it comes from.
        ValueError: a name that C does not take; numbers beyond single precision.
    """
    _check_name(name)
    program, tree = trace_function(function, *examples)
    equations = list(_yield_equations(program.jaxpr))
    _refuse_random_numbers(equations)
    graph, buffers, outputs = lower_for_c(program, finite, symmetric, short)
    real: Real = "float" if single else "double"
    argument_names, result_names = _name_arrays(function, examples, tree, names)
    arguments = _describe_arguments(argument_names, buffers, real)
    # The body: statements in the order of the graph, of what the nodes of the results need.
    result_nodes = [list_nodes(x) for x in outputs]
    entry_texts = {b: _make_entry_expression(x) for b, x in zip(buffers, arguments, strict=True)}
    source = CSource([node for nodes in result_nodes for node in nodes], entry_texts, real, name)
    try:
        body = source.write_statements(graph.top)
    except Unsupported as error:
        raise Unsupported(error.operation, error.where or _find_code_line(error.operation, equations)) from None
    # The end: every result is written, after all arguments are read.
    arguments = [x._replace(used=b in source.needed) for x, b in zip(arguments, buffers, strict=True)]
    results = _describe_results(result_names, program, outputs, result_nodes, real)
    assignments = _write_assignments(source, results, result_nodes)
    # What is not used is said to be so, for compilers that warn of it: "(void)x;".
    unused = [f"    (void){x.name};" for x in (*arguments, *results) if not x.used or not x.size]
    head = _declare_function(name, arguments, results)
    lines = [f"{head}\n{{", *unused, *source.declarations(), *body, *assignments, "}"]
    definition = "\n\n".join([*source.table_definitions(), "\n".join(lines)])
    return CFunction(
        name=name,
        header=_HEADER.format(guard=f"{name.upper()}_H", head=head),
        source=_SOURCE.format(name=name, definition=definition),
        definition=definition,
        arguments=arguments,
        results=results,
        operations=source.operations,
    )


def _refuse_random_numbers(equations: Sequence[Any]) -> None:
    """Raise Unsupported if an operation draws random numbers; the error names its line of code.

    RANDOM holds the beginnings of such operations' names in JAX.
    """
    for equation in equations:
        if equation.primitive.name.startswith(RANDOM):
            raise Unsupported(equation.primitive.name, code_line(equation))


def _describe_arguments(names: Sequence[str], buffers: Sequence[Buffer], real: Real) -> list[CArray]:
    """Describe the arguments of a C function, one for each input; a number without axes is passed by value.

    `real` is the C type of real numbers, double or float.
    """
    return [
        CArray(name=name, type=_name_stored_type(b.type, real), size=b.size, is_array=bool(b.shape))
        for name, b in zip(names, buffers, strict=True)
    ]


def _check_name(name: str) -> None:
    """Raise ValueError for a name that C does not take for a function: RESERVED has C's words, "_" begins its own."""
    if not (name.isascii() and name.isidentifier()) or name in RESERVED or name.startswith("_"):
        raise ValueError(f"name: expected one that C takes for a function, got {name!r}")


def _name_stored_type(type: Type, real: Real) -> str:
    """Return the C type in which arguments and results store a number: a flag is a byte, an int when computed with."""
    return "unsigned char" if type == "bool" else c_type(type, real)


def _make_entry_expression(array: CArray) -> EntryText:
    """Return the function that writes an argument's entry in C: "x[3]" of an index, or "x" where it is one number."""
    return (lambda index: f"{array.name}[{index}]") if array.is_array else (lambda index: array.name)


def _write_assignments(source: CSource, results: Sequence[CArray], flat: Sequence[Sequence[Node]]) -> list[str]:
    """Return the lines of C that write every result, entry by entry; a flag is written as a byte.

    `flat` has for each result the nodes (scalar operations) of its entries, whose C variables `source` names.
    """
    return [
        f"    {x.name}[{i}] = {'(unsigned char)' if node.type == 'bool' else ''}{source.name_node(node)};"
        for x, nodes in zip(results, flat, strict=True)
        for i, node in enumerate(nodes)
    ]


def _declare_function(name: str, arguments: Sequence[CArray], results: Sequence[CArray]) -> str:
    """Return the head of a C function, with its arguments and then its results.

    A head of more than 100 characters has one argument a line.
    """
    every = [*(x.argument_declaration for x in arguments), *(x.result_declaration for x in results)]
    line = f"void {name}({', '.join(every)})"
    return line if len(line) <= 100 else f"void {name}(\n    " + ",\n    ".join(every) + ")"


def _describe_results(
    names: Sequence[str], program: ClosedJaxpr, outputs: Sequence[np.ndarray], flat: Sequence[list[Node]], real: Real
) -> list[CArray]:
    """Return the description of each array that a C function writes, its results.

    Args:
        names: their names in C.
        program: the traced function, which has their types.
        outputs: arrays of nodes, the scalar operations that compute them.
        flat: the nodes of each as a list; results of the same nodes are always equal, which `same` says.
        real: C type of real numbers.
    """
    results = []
    for n, (name, variable, value, nodes) in enumerate(zip(names, program.jaxpr.outvars, outputs, flat, strict=True)):
        aval: Any = variable.aval
        results.append(
            CArray(
                name=name,
                type=_name_stored_type(type_of(aval), real),
                size=len(nodes),
                is_array=True,
                same=next(k for k in range(n + 1) if flat[k] == nodes),
                symmetric=_is_symmetric(value),
            )
        )
    return results


def _is_symmetric(value: np.ndarray) -> bool:
    """Return whether a square matrix of nodes is symmetric: entries (i, j) and (j, i) are the same node.

    A node is a scalar operation. A matrix of one row does not count.
    """
    if value.ndim != 2 or value.shape[0] != value.shape[1] or len(value) < 2:
        return False
    return all(value[i, j] is value[j, i] for i in range(len(value)) for j in range(i))


def _name_arrays(
    function: Callable[..., PyTree], examples: Sequence[PyTree], tree: Any, names: tuple[Sequence[str], Sequence[str]]
) -> tuple[list[str], list[str]]:
    """Return the names in C of the arguments' arrays and of the results' arrays, no two the same.

    A name that is a word of C, or that is taken, gets underscores.

    Args:
        function: the function of JAX, whose parameters name the arguments.
        examples: its arguments, trees of arrays, whose fields name the arrays within.
        tree: the structure of its results.
        names: names that the caller chose, of the arguments' arrays and of the results'; an empty sequence for those
            that are to be made of parameters and fields.
    """
    argument_names, result_names = map(list, names)
    if not argument_names:
        parameters = [p.name for p in inspect.signature(function).parameters.values() if p.kind != p.VAR_POSITIONAL]
        # Arguments that a parameter such as `*rest` takes have no name of their own: they are numbered.
        labels = [parameters[n] if n < len(parameters) else f"argument_{n}" for n in range(len(examples))]
        argument_names = [n for label, x in zip(labels, examples, strict=True) for n in _name_leaves(label, x)]
    if not result_names:
        result_names = _name_leaves("result", jax.tree.unflatten(tree, range(tree.num_leaves)))
    taken = set[str]()
    for array_names in (argument_names, result_names):
        for n in range(len(array_names)):
            while array_names[n] in RESERVED or array_names[n] in taken:
                array_names[n] += "_"
            taken.add(array_names[n])
    return argument_names, result_names


def _name_leaves(label: str, tree: PyTree) -> list[str]:
    """Return a name in C for each array of a tree: `label` and the array's path, as in state_speed_0.

    Characters that C does not allow in a name become _.
    """
    names = []
    for path, _ in jax.tree_util.tree_flatten_with_path(tree)[0]:
        # An entry of the path is an attribute's name, a dictionary's key, or an index.
        entries = [str(getattr(k, "name", getattr(k, "key", getattr(k, "idx", "")))) for k in path]
        text = "_".join([label, *entries])
        names.append("".join(c if c.isalnum() and c.isascii() else "_" for c in text))
    return names


def _find_code_line(operation: str, equations: Sequence[Any]) -> str:
    """Return the line of code, as file:number, of the first of JAX's operations (`equations`) with this name."""
    same = (e for e in equations if e.primitive.name.removesuffix("_convert_type") == operation)
    return next((code_line(e) for e in same), "an unknown line")


def _yield_equations(jaxpr: Any) -> Iterator[Any]:
    """Yield all operations of a traced program, and those of the programs inside it (loops, branches, calls)."""
    for equation in jaxpr.eqns:
        yield equation
        for param in equation.params.values():
            for inner in param if isinstance(param, tuple | list) else (param,):
                # A Jaxpr has `eqns`; a ClosedJaxpr holds one as `jaxpr`.
                if hasattr(inner, "eqns") or hasattr(inner, "jaxpr"):
                    yield from _yield_equations(getattr(inner, "jaxpr", inner))


_HEADER = """#ifndef {guard}
#define {guard}

#include <stdint.h>

#ifdef __cplusplus
extern "C" {{
#endif

{head};

#ifdef __cplusplus
}}
#endif

#endif
"""

_SOURCE = """#include "{name}.h"

#include <math.h>

#ifdef __FAST_MATH__
#error "NaN has a meaning here, which this mode of the compiler does not know"
#endif

{definition}
"""
