"""Analysis of which numbers of a program differ between runs; all others are computed once."""

from collections.abc import Iterable
from typing import Any

from heliograph.codegen.graph import Block, Buffer, Guard, Loop, Node, Store
from heliograph.codegen.program import needed


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
        return any(store.node in result or _is_apart(store.block, result) for store in _stores(item))
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


def _stores(buffer: Buffer) -> list[Store]:
    return buffer.stores


def _is_apart(block: Block, result: set[Any]) -> bool:
    """Return whether a block lies in a loop or guard that differs between runs."""
    return any(b.owner in result for b in block.inwards() if b.owner is not None)
