"""Lowered programs: inputs, outputs, what these need, what differs between runs, fused products, and sums over runs.

Run r of a sum over runs belongs to batch r mod BATCHES. A row of sums is W - 1 longer than the number of batches, so
that W consecutive runs of a block never wrap around; what is beyond the end is added to the beginning (`folded`).
"""

from collections.abc import Callable, Iterable
from functools import cache
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr

from heliograph.codegen.graph import MOST, Graph
from heliograph.codegen.lowering import Lowering, Value, keys_of, traced, type_of
from heliograph.codegen.memory import InMemory
from heliograph.codegen.nodes import Block, Buffer, Guard, Loop, Node, Store
from heliograph.codegen.rules import (  # noqa: F401  (they fill the rules)
    arrived,
    calls,
    decompositions,
    elementwise,
    indexing,
    loops,
    matrices,
    random_bits,
    rows,
    shapes,
    special,
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


def lower(function: Callable[..., PyTree], *examples: PyTree, most: int = MOST) -> Program:
    """Lower a function of one run, for arguments of these shapes, to at most so many operations."""
    return lower_traced(*traced(function, *examples), most)


def lower_traced(traced: ClosedJaxpr, tree: Any, most: int = MOST) -> Program:
    """Lower a program that is traced already."""
    lowering = Lowering(most)
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


def needed(roots: Iterable[Node | Buffer], among: Callable[[Any], bool] = lambda node: True) -> dict[Any, None]:
    """Nodes, loops, guards, buffers and stores that these numbers need, in an order without chance; `among` some."""
    results: dict[Any, None] = {}
    waiting: list[Any] = list(roots)
    while waiting:
        node = waiting.pop()
        if node not in results and among(node):
            results[node] = None
            waiting += _needs(node)
    return results


def _needs(node: Any) -> list[Any]:
    if isinstance(node, Buffer):
        within = [] if node.inside is None else [node.inside[0]]
        return [*node.stores, *node.parts, *within]
    owner = node.block.owner
    arguments = node.args if isinstance(node, Node) and node.op not in REFERRING else _arguments(node)
    return [*arguments] if owner is None else [owner, *arguments]


REFERRING = frozenset(("load", "parameter", "result", "counter", "guarded"))  # nodes that need more than arguments


def _arguments(node: Any) -> list[Any]:
    if isinstance(node, Store):
        return [node.node, *node.indices]
    if isinstance(node, Guard):
        return [node.condition]
    if isinstance(node, Loop):
        return [] if node.condition is None else [node.condition]
    # Nodes: a load needs its buffer, a result of a loop the loop and the carry.
    if node.op == "load":
        return [*node.args, node.value[0]]
    if node.op in ("parameter", "result"):
        loop, index = node.value
        return [loop, loop.initial[index], loop.following[index]]
    if node.op == "counter":
        return [node.value]
    if node.op == "guarded":
        guard, index = node.value
        return [guard, guard.values[index]]
    return list(node.args)


def fusable(node: Node, products: set[Node]) -> Node | None:
    """Return the product that is computed with a sum or difference as one operation."""
    if node.op not in ("add", "sub") or node.type != "f64":
        return None
    results = [a for a in node.args if a in products and a.value is node]
    return results[0] if results else None


def products_of(items: Iterable[Any]) -> set[Node]:
    """Find products used once, by a sum or difference; mark each with its user, of two the later one."""
    users: dict[Node, list[Any]] = {}
    for statement in items:
        for used in uses(statement):
            users.setdefault(used, []).append(statement)
    results: set[Node] = set()
    taken: set[Node] = set()
    for node in sorted((n for n in users if n.op == "mul" and n.type == "f64"), key=lambda n: -n.serial):
        user = users[node][0]
        single = len(users[node]) == 1 and isinstance(user, Node) and user.op in ("add", "sub")
        if single and user.args[0] is not user.args[1] and user.block is node.block and user not in taken:
            node.value = user
            results.add(node)
            taken.add(user)
    return results


def uses(node: Any) -> list[Node]:
    """Return the nodes that an item of a program uses directly."""
    if isinstance(node, Node):
        return list(node.args)
    if isinstance(node, Store):
        return [node.node, *node.indices]
    if isinstance(node, Guard):
        return [node.condition, *node.values]
    if isinstance(node, Loop):
        return [*node.initial, *node.following, *([] if node.condition is None else [node.condition])]
    return []


def varying(roots: Iterable[Node | Buffer], inputs: Iterable[Buffer]) -> set[Any]:
    """Return nodes, buffers, loops and guards that differ between runs if these input buffers do."""
    following: dict[Any, list[Any]] = {}

    @cache
    def around(block: Block) -> list[Any]:
        return [b.owner for b in block.inwards() if b.owner is not None]

    for node in needed(roots):
        for source in _sources(node, around):
            following.setdefault(source, []).append(node)
        if isinstance(node, Store):  # a store makes its buffer differ
            following.setdefault(node, []).append(node.buffer.owner[0])
    results: set[Any] = set(inputs)
    left = list(results)
    while left:
        for node in following.get(left.pop(), ()):
            if node not in results:
                results.add(node)
                left.append(node)
    return results


def _sources(node: Any, around: Callable[[Block], list[Any]]) -> list[Any]:
    """Return all of which any makes a number or a statement differ: arguments, memory, what is around it."""
    if isinstance(node, Buffer):
        owner = node.owner[0]
        return [owner] if owner is not node else [x for store in node.stores for x in _sources(store, around)]
    # Statements: a loop differs by its condition.
    if isinstance(node, Loop):
        return [node.condition, *node.parameters] if node.length is None else []
    if isinstance(node, Guard):
        return [node.condition]
    if isinstance(node, Store):
        return [node.node, *around(node.block)]
    # Nodes: by their block, by memory, by the carry, else by their arguments.
    if node.op in ("constant", "counter"):
        return list(node.args)
    if node.op == "load":
        return [*node.args, *around(node.block), node.value[0].owner[0]]
    if node.op in ("parameter", "result"):
        loop, index = node.value
        return [*node.args, *around(node.block), loop, loop.initial[index], loop.following[index]]
    if node.op == "guarded":
        guard, index = node.value
        return [*node.args, *around(node.block), guard, guard.values[index]]
    return [*node.args, *around(node.block)]


class Summed(NamedTuple):
    """Outputs that are summed, leaf by leaf; into how many batches; which input is the run's number (u32)."""

    outputs: tuple[bool, ...]
    batches: int
    number: int


def row_length(width: int, batches: int) -> int:
    """Return the length of a row of sums."""
    return batches + width - 1


def folded(sums: np.ndarray, batches: int) -> np.ndarray:
    """Return sums (..., batch) from rows (..., `row_length`)."""
    totals = sums[..., :batches].copy()
    beyond = sums[..., batches:]
    totals[..., : beyond.shape[-1]] += beyond
    return totals
