"""Lowered programs: inputs, outputs, what these need, what differs between runs, fused products, and sums over runs.

Run r of a sum over runs belongs to batch r mod BATCHES. A row of sums is W - 1 longer than the number of batches, so
that W consecutive runs of a block never wrap around; what is beyond the end is added to the beginning (`folded`).
"""

from collections.abc import Callable, Iterable
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
    results: set[Any] = set(inputs)
    items = sorted(needed(roots), key=_order)
    count = -1
    while count != len(results):
        count = len(results)
        results.update(node for node in items if node not in results and _varies(node, results))
    return results


def _order(node: Any) -> int:
    return node.serial if isinstance(node, Node) else 0


def _varies(node: Any, results: set[Any]) -> bool:
    if isinstance(node, Node) and not results.isdisjoint(node.args):
        return True
    if isinstance(node, Buffer):
        owner = node.owner[0]
        if owner is not node:
            return owner in results
        return any(store.node in results or _is_apart(store.block, results) for store in node.stores)
    # Statements: a loop differs by its condition, a store makes its buffer differ.
    if isinstance(node, Loop):
        return node.length is None and (node.condition in results or any(p in results for p in node.parameters))
    if isinstance(node, Guard):
        return node.condition in results
    if isinstance(node, Store):
        if node.node in results or _is_apart(node.block, results):
            results.add(node.buffer.owner[0])
            return True
        return False
    # Nodes: by their block, by memory, by the carry, else by their arguments.
    if node.op in ("constant", "counter"):
        return False
    if _is_apart(node.block, results):
        return True
    if node.op == "load":
        return node.value[0].owner[0] in results
    if node.op in ("parameter", "result"):
        loop, index = node.value
        return loop in results or loop.initial[index] in results or loop.following[index] in results
    if node.op == "guarded":
        guard, index = node.value
        return guard in results or guard.values[index] in results
    return False


def _is_apart(block: Block, results: set[Any]) -> bool:
    """Return whether a block lies in a loop or guard that differs between runs."""
    return any(b.owner in results for b in block.inwards() if b.owner is not None)


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
