"""Fusion of products with the sums that use them, in one rounding."""

from collections.abc import Iterable
from typing import Any

from heliograph.codegen.graph import Guard, Loop, Node, Store


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
