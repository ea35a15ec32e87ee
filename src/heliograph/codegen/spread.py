"""Which numbers of a program differ between runs: the others are computed once for all."""

from collections.abc import Iterable
from typing import Any

from heliograph.codegen.graph import Block, Buffer, Guard, Loop, Node, Store
from heliograph.codegen.program import needed


def varying(roots: Iterable[Node | Buffer], inputs: Iterable[Buffer]) -> set[Any]:
    """Nodes, buffers, loops and guards that differ between runs where these input buffers do.

    A loop that ends for each run at its own turn, and a block computed for runs that need it, differ in all they do.
    """
    found: set[Any] = set(inputs)
    items = sorted(needed(roots), key=_order)
    count = -1
    while count != len(found):
        count = len(found)
        found.update(item for item in items if item not in found and _varies(item, found))
    return found


def _order(item: Any) -> int:
    return item.serial if isinstance(item, Node) else 0


def _varies(item: Any, found: set[Any]) -> bool:
    if isinstance(item, Buffer):
        owner = item.owner[0]
        if owner is not item:
            return owner in found
        return any(store.node in found or _is_apart(store.block, found) for store in _stores(item))
    if isinstance(item, Loop):
        return item.length is None and (item.condition in found or any(p in found for p in item.parameters))
    if isinstance(item, Guard):
        return item.condition in found
    if isinstance(item, Store):
        if item.node in found or _is_apart(item.block, found):
            found.add(item.buffer.owner[0])
            return True
        return False
    if item.op in ("constant", "counter"):
        return False
    if _is_apart(item.block, found):
        return True
    if item.op == "load":
        return item.value[0].owner[0] in found or any(i in found for i in item.args)
    if item.op in ("parameter", "result"):
        loop, place = item.value
        return loop in found or loop.initial[place] in found or loop.following[place] in found
    if item.op == "guarded":
        guard, place = item.value
        return guard in found or guard.values[place] in found
    return any(a in found for a in item.args)


def _stores(buffer: Buffer) -> list[Store]:
    return buffer.stores


def _is_apart(block: Block, found: set[Any]) -> bool:
    """Whether a block lies in a loop or guard that differs between runs."""
    return any(b.owner in found for b in block.inwards() if b.owner is not None)
