"""Lowered programs: inputs and outputs, and the nodes and statements that these need."""

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import jax
from jax.extend.core import ClosedJaxpr

from heliograph.codegen.graph import Buffer, Graph, Guard, Key, Loop, Node, Store
from heliograph.codegen.lowering import Lowering, Value, keys_of, traced, type_of
from heliograph.codegen.memory import InMemory
from heliograph.codegen.rules import (  # noqa: F401  (they fill the rules)
    arrived,
    branches,
    calls,
    eigen,
    elementwise,
    indexing,
    loops,
    lu,
    matrices,
    random_bits,
    rows,
    shapes,
    views,
)
from heliograph.numerics.types import PyTree


class Program(NamedTuple):
    """A graph, a buffer for each argument of the function and the value of each result, leaf by leaf; `tree` of these.

    The words of a key of random numbers are the last axis, (2,), of its buffer.
    """

    graph: Graph
    inputs: list[Buffer]
    outputs: list[Value]
    tree: Any


def lower(function: Callable[..., PyTree], *examples: PyTree) -> Program:
    """Lower a function of one run, for arguments of these shapes."""
    return lower_traced(*traced(function, *examples))


def lower_traced(traced: ClosedJaxpr, tree: Any) -> Program:
    """Lower a program that is traced already."""
    lowering = Lowering()
    avals: list[Any] = [v.aval for v in traced.jaxpr.invars]
    inputs, values = [], []
    for aval in avals:
        is_key = jax.numpy.issubdtype(aval.dtype, jax.dtypes.prng_key)
        shape = (*aval.shape, 2) if is_key else aval.shape
        buffer = Buffer("input", "u32" if is_key else type_of(aval), shape, lowering.graph.top)
        view = InMemory.whole(buffer)
        inputs.append(buffer)
        values.append(keys_of(view.nodes(lowering.graph)) if is_key else view)
    with jax.enable_x64(True):
        outputs = lowering.inline(traced, values)
    return Program(lowering.graph, inputs, outputs, tree)


def scalars(value: Value) -> list[Node]:
    """Return the nodes of an array, in row-major order, a key as its two words."""
    flat: list[Any] = value.ravel().tolist()
    return [n for x in flat for n in ((x.first, x.second) if isinstance(x, Key) else (x,))]


def needed(roots: Iterable[Node | Buffer], among: Callable[[Any], bool] = lambda item: True) -> set[Any]:
    """Nodes, loops, guards, buffers and stores that these numbers need; only `among` some."""
    results: set[Any] = set()
    waiting: list[Any] = list(roots)
    while waiting:
        item = waiting.pop()
        if item not in results and among(item):
            results.add(item)
            waiting += _needs(item)
    return results


def _needs(item: Any) -> list[Any]:
    if isinstance(item, Buffer):
        within = [] if item.inside is None else [item.inside[0]]
        return [*item.stores, *item.parts, *within]
    around = [] if item.block.owner is None else [item.block.owner]
    return around + _arguments(item)


def _arguments(item: Any) -> list[Any]:
    if isinstance(item, Store):
        return [item.node, *item.indices]
    if isinstance(item, Guard):
        return [item.condition]
    if isinstance(item, Loop):
        return [] if item.condition is None else [item.condition]
    # Nodes: a load needs its buffer, a result of a loop the loop and the carry.
    if item.op == "load":
        return [*item.args, item.value[0]]
    if item.op in ("parameter", "result"):
        loop, place = item.value
        return [loop, loop.initial[place], loop.following[place]]
    if item.op == "counter":
        return [item.value]
    if item.op == "guarded":
        guard, place = item.value
        return [guard, guard.values[place]]
    return list(item.args)
