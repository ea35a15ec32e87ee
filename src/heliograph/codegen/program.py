"""Lowered programs: inputs, outputs, what these need, what differs between runs, fused products, and sums over runs.

Run r of a sum over runs belongs to batch r mod BATCHES. A row of sums is W - 1 longer than the number of batches, so
that W consecutive runs of a block never wrap around; what is beyond the end is added to the beginning (`folded`).
"""

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr

from heliograph.codegen.graph import Block, Buffer, Graph, Guard, Loop, Node, Store
from heliograph.codegen.lowering import Lowering, Value, keys_of, traced, type_of
from heliograph.codegen.memory import InMemory
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


def fusable(node: Node, products: set[Node]) -> Node | None:
    """Return the product that is computed with a sum or difference as one operation."""
    if node.op not in ("add", "sub") or node.type != "f64":
        return None
    results = [a for a in node.args if a in products and a.value is node]
    return results[0] if results else None


def products_of(items: Iterable[Any]) -> set[Node]:
    """Find products used once, by a sum or difference; mark each with its user, of two the later one."""
    users: dict[Node, list[Any]] = {}
    for item in items:
        for used in uses(item):
            users.setdefault(used, []).append(item)
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


def uses(item: Any) -> list[Node]:
    """Return the nodes that an item of a program uses directly."""
    if isinstance(item, Node):
        return list(item.args)
    if isinstance(item, Store):
        return [item.node, *item.indices]
    if isinstance(item, Guard):
        return [item.condition, *item.values]
    if isinstance(item, Loop):
        return [*item.initial, *item.following, *([] if item.condition is None else [item.condition])]
    return []


def varying(roots: Iterable[Node | Buffer], inputs: Iterable[Buffer]) -> set[Any]:
    """Return nodes, buffers, loops and guards that differ between runs if these input buffers do."""
    results: set[Any] = set(inputs)
    items = sorted(needed(roots), key=_order)
    count = -1
    while count != len(results):
        count = len(results)
        results.update(item for item in items if item not in results and _varies(item, results))
    return results


def _order(item: Any) -> int:
    return item.serial if isinstance(item, Node) else 0


def _varies(item: Any, result: set[Any]) -> bool:
    if isinstance(item, Buffer):
        owner = item.owner[0]
        if owner is not item:
            return owner in result
        return any(store.node in result or _is_apart(store.block, result) for store in item.stores)
    # Statements: a loop differs by its condition, a store makes its buffer differ.
    if isinstance(item, Loop):
        return item.length is None and (item.condition in result or any(p in result for p in item.parameters))
    if isinstance(item, Guard):
        return item.condition in result
    if isinstance(item, Store):
        if item.node in result or _is_apart(item.block, result):
            result.add(item.buffer.owner[0])
            return True
        return False
    # Nodes: by their block, by memory, by the carry, else by their arguments.
    if item.op in ("constant", "counter"):
        return False
    if _is_apart(item.block, result):
        return True
    if item.op == "load":
        return item.value[0].owner[0] in result or any(i in result for i in item.args)
    if item.op in ("parameter", "result"):
        loop, place = item.value
        return loop in result or loop.initial[place] in result or loop.following[place] in result
    if item.op == "guarded":
        guard, place = item.value
        return guard in result or guard.values[place] in result
    return any(a in result for a in item.args)


def _is_apart(block: Block, result: set[Any]) -> bool:
    """Return whether a block lies in a loop or guard that differs between runs."""
    return any(b.owner in result for b in block.inwards() if b.owner is not None)


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
    result = sums[..., :batches].copy()
    beyond = sums[..., batches:]
    result[..., : beyond.shape[-1]] += beyond
    return result
