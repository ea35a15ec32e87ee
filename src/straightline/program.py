"""Lowered programs: inputs, outputs, what these need, what differs between runs, fused products, and sums over runs."""

from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache
from types import MappingProxyType
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr
from jaxtyping import PyTree

from straightline.constant_folding import DTYPES
from straightline.graph import Graph
from straightline.lowering import Lowering, Value, arrange_nodes, make_keys, trace_function, type_of
from straightline.nodes import REAL, Block, Buffer, Guard, Loop, Node, Store
from straightline.rules import (  # noqa: F401  (they fill the rules)
    calls_and_branches,
    custom_operations,
    decompositions,
    elementwise,
    gather,
    long_arrays,
    loops,
    matrices,
    never_nan_marks,
    random_bits,
    scatter,
    shapes,
    sorting,
    special_functions,
    views,
)
from straightline.size_limits import LONGEST, TABLE
from straightline.strided_arrays import StridedArray


class Program(NamedTuple):
    """Program of one run: its graph, a buffer for each argument and the value of each result, leaf by leaf.

    `tree`: the structure of the results. The words of a key of random numbers are the last axis, (2,), of its buffer.
    """

    graph: Graph
    inputs: list[Buffer]
    outputs: list[Value]
    tree: Any


Known = Mapping[int, tuple[np.ndarray, np.ndarray]]  # number of a leaf -> which entries are known, and these numbers


def lower_function(
    function: Callable[..., PyTree],
    *examples: PyTree,
    most: int = 2 * LONGEST,
    known: Known = MappingProxyType({}),
    single: bool = False,
) -> Program:
    """Return a function of one run (one evaluation) as a program of at most `most` scalar operations.

    `examples` give the arguments' shapes and types. `known` maps the number of a leaf of the arguments to the entries
    that are the same in every call. `single`: whether numbers are float32.
    """
    return lower_traced(*trace_function(function, *examples, single=single), most, known, single)


def lower_traced(
    traced: ClosedJaxpr,
    tree: Any,
    most: int = 2 * LONGEST,
    known: Known = MappingProxyType({}),
    single: bool = False,
) -> Program:
    """Lower a program that JAX traced: return it as a graph of scalar operations, with a buffer for each argument.

    Args:
        traced: the program, in single precision or in double.
        tree: the structure of its results.
        most: number of operations above which it is refused; LONGEST is that of the longest program.
        known: by number of an argument, a mask of the entries that are the same in every call, and these numbers.
        single: whether numbers are float32.
    """
    lowering = Lowering(most)
    # Of each argument its memory, and its value: a view of the memory, or an array of nodes (scalar operations).
    inputs: list[Buffer] = []
    values: list[Value] = []
    for number, variable in enumerate(traced.jaxpr.invars):
        aval: Any = variable.aval  # its shape and type
        is_key = jax.numpy.issubdtype(aval.dtype, jax.dtypes.prng_key)
        shape = (*aval.shape, 2) if is_key else aval.shape  # a random key is two numbers of 32 bits
        buffer = Buffer("input", "u32" if is_key else type_of(aval), shape, lowering.graph.top)
        value: Value = StridedArray.of_whole_buffer(buffer)
        if number in known:
            mask, numbers = known[number]
            value = _insert_known_entries(lowering, value, mask, numbers)
        elif is_key:
            value = make_keys(value.nodes(lowering.graph))
        inputs.append(buffer)
        values.append(value)
    with jax.enable_x64(not single):
        outputs = lowering.lower_whole_program(traced, values)
    return Program(graph=lowering.graph, inputs=inputs, outputs=outputs, tree=tree)


def _insert_known_entries(lowering: Lowering, view: StridedArray, mask: np.ndarray, numbers: np.ndarray) -> Value:
    """Return an argument with constants for the entries that `mask` marks as known; `numbers` holds their values.

    If all entries are known, it is a known array. Else each entry becomes a constant or a load. An argument of more
    than TABLE entries that are not all known stays in memory as it is.
    """
    if mask.all():
        return lowering.make_known_array(numbers.astype(DTYPES[view.type]))
    if view.size > TABLE:
        return view
    graph, kind = lowering.graph, view.type
    entries = zip(mask.ravel().tolist(), numbers.ravel().tolist(), range(view.size), strict=True)
    nodes = [graph.constant(x, kind) if is_known else graph.load(view.buffer, index) for is_known, x, index in entries]
    return arrange_nodes(nodes, view.shape)


def list_needed_items(roots: Iterable[Node | Buffer]) -> dict[Any, None]:
    """Return the nodes, loops, guards, buffers and stores that `roots` need, as the keys of a dictionary.

    A dictionary keeps their order; that of a set, and with it the program's text, would change between processes.
    """
    needed: dict[Any, None] = {}
    to_visit: list[Any] = list(roots)
    while to_visit:
        item = to_visit.pop()
        if item not in needed:
            needed[item] = None
            to_visit += item.args if needs_arguments_alone(item) else _list_needs(item)
    return needed


REFERRING = frozenset(("load", "parameter", "result", "counter", "guarded"))  # nodes that need more than arguments


def needs_arguments_alone(node: Any) -> bool:
    """Return whether all that an item of a program needs is its arguments: an operation outside of loops and guards."""
    return type(node) is Node and node.block.parent is None and node.op not in REFERRING


def _list_needs(node: Any) -> list[Any]:
    """Return what an item of a program needs, directly: its arguments, memory, and the loop or guard around it.

    A buffer needs the statements that fill it, its parts, and the buffer that it lies in.
    """
    if isinstance(node, Buffer):
        within = [] if node.inside is None else [node.inside[0]]
        return [*node.stores, *node.parts, *within]
    owner = node.block.owner
    arguments = node.args if isinstance(node, Node) and node.op not in REFERRING else _list_dependencies(node)
    return [*arguments] if owner is None else [owner, *arguments]


def _list_dependencies(node: Any) -> list[Any]:
    """Return what a node, store, guard or loop needs before it can be computed.

    A store writes to memory, a guard is a conditional block. A "parameter" is a number that a loop carries, as its body
    reads it, and a "result" the same after the loop. A "counter" is the number of a loop's iteration, and "guarded" a
    number that a guarded block computes. The attribute `value` of these, and of a load, is the statement or buffer.
    """
    if isinstance(node, Store):
        return [node.node, *node.indices]
    if isinstance(node, Guard):
        return [node.condition]
    if isinstance(node, Loop):
        return [] if node.condition is None else [node.condition]
    if node.op == "load":
        buffer, _offset, _strides = node.value
        return [*node.args, buffer]
    if node.op in ("parameter", "result"):
        loop, index = node.value
        return [loop, loop.initial[index], loop.following[index]]
    if node.op == "counter":
        loop = node.value
        return [loop]
    if node.op == "guarded":
        guard, index = node.value
        return [guard, guard.values[index]]
    return list(node.args)


def find_fused_product(node: Node, products: set[Node]) -> Node | None:
    """Return the argument of a sum or difference that is a product fused with it, or None if there is none.

    `products` comes from `find_fusable_products`, which sets the `value` of a product to the sum that it is fused with.
    """
    for a in node.args:
        if a.value is node and a in products:
            return a
    return None


def find_fusable_products(items: Iterable[Any]) -> set[Node]:
    """Return the products that are fused with the one sum or difference that uses them: a b + c, rounded once.

    A product is fused if nothing else uses it and both are in one block; of two products in a sum only the later one
    is. Its attribute `value`, otherwise not used for products, is set to its sum: so the writer of the sum finds it.
    """
    users: dict[Node, Any] = {}  # for each product the one item that uses it, or None if several do
    for item in items:
        for used in list_used_nodes(item):
            if used.op == "mul" and used.type in REAL:
                users[used] = None if used in users else item
    fused: set[Node] = set()
    sums_with_product: set[Node] = set()
    for product in sorted(users, key=lambda n: -n.serial):  # later products first
        user = users[product]
        is_sum = isinstance(user, Node) and user.op in ("add", "sub")
        if is_sum and user.block is product.block and user not in sums_with_product:
            product.value = user
            fused.add(product)
            sums_with_product.add(user)
    return fused


def list_used_nodes(node: Any) -> Sequence[Node]:
    """Return the nodes that an item of a program (node, store, guard or loop) uses directly; a buffer uses none."""
    if isinstance(node, Node):
        return node.args
    if isinstance(node, Store):
        return [node.node, *node.indices]
    if isinstance(node, Guard):
        return [node.condition, *node.values]
    if isinstance(node, Loop):
        return [*node.initial, *node.following, *([] if node.condition is None else [node.condition])]
    return []


def sort_items_by_dependence(items: Iterable[Any]) -> list[Any]:
    """Return items sorted so that each comes after those that it is computed from; buffers come first.

    Nodes are numbered (`serial`) as they are made, so a node has a higher number than its arguments. Only a number that
    a loop carries to its next iteration may come after its use.
    """

    def position(x: Any) -> int:
        """Return the serial by which an item is sorted: its own, or that of the node that it stores or depends on.

        A buffer, and a loop or guard without a condition, has -1 and comes first.
        """
        if isinstance(x, Store):
            return x.node.serial
        if isinstance(x, Loop | Guard):
            return -1 if x.condition is None else x.condition.serial
        return -1 if isinstance(x, Buffer) else x.serial

    return sorted(items, key=position)


def find_varying_items(items: Iterable[Any], inputs: Iterable[Buffer]) -> set[Any]:
    """Return which items (nodes, buffers, loops, guards) differ between runs if these input buffers do, with these.

    A node is a number that is computed, a buffer is memory, a guard a conditional block; a run is one evaluation.
    """

    @cache
    def list_owners(block: Block) -> list[Any]:
        """Return the guards, and the loops that end by a condition, around a block.

        These may make runs differ within the block. A loop of known length cannot: all runs make the same iterations.
        """
        return [
            b.owner
            for b in block.list_enclosing_blocks()
            if b.owner is not None and getattr(b.owner, "length", None) is None
        ]

    # followers[a]: the items that differ if a does, since they are computed from it.
    followers: defaultdict[Any, list[Any]] = defaultdict(list)
    for item in items:
        for source in item.args if needs_arguments_alone(item) else _list_sources(item, list_owners):
            followers[source].append(item)
        if isinstance(item, Store):  # a number that differs makes the memory differ that it is stored in
            followers[item].append(item.buffer.owner[0])
    # Walk from the inputs to all followers; each item is visited once, as its list is popped.
    differing: set[Any] = set(inputs)
    to_visit = list(differing)
    while to_visit:
        for follower in followers.pop(to_visit.pop(), ()):
            if follower not in differing:
                differing.add(follower)
                to_visit.append(follower)
    return differing


def find_differing_items(items: list[Any], inputs: Iterable[Buffer]) -> set[Any]:
    """Return which of the sorted `items` have a number for each run: those that vary with `inputs`, and some memory.

    All other items are computed once, before the runs. A loop overwrites an array that it carries in memory ("carried")
    in each iteration, so that only the last iteration's numbers would be left when the runs are computed. If the runs'
    own code reads the array within the loop, it needs those of every iteration. Then each run gets its own array.
    """
    differing = find_varying_items(items, inputs)
    carried = {x for x in items if isinstance(x, Buffer) and x.kind == "carried"}
    # An array that gets a copy for each run makes more items differ, which may read more carried arrays.
    while carried:
        read_in_loops = _find_memory_read_in_parts(find_crossing_items(items, differing))
        newly_differing = read_in_loops & carried - differing
        if not newly_differing:
            break
        differing = find_varying_items(items, [*inputs, *newly_differing, *(carried & differing)])
    return differing


def _find_memory_read_in_parts(items: Iterable[Any]) -> set[Buffer]:
    """Return the whole buffers of which `items` load from a part that is filled in another block than the whole.

    An array that a loop carries in memory is such a buffer: each iteration of the loop's body fills a part anew.
    """
    users = [x for x in items if not isinstance(x, Buffer)]
    nodes = (node for x in users for node in (x, *_list_dependencies(x)) if isinstance(node, Node))
    loaded_buffers = {node.value[0] for node in nodes if node.op == "load"}
    return {buffer.owner[0] for buffer in loaded_buffers if buffer.block is not buffer.owner[0].block}


def find_crossing_items(items: Iterable[Any], differing: set[Any]) -> set[Any]:
    """Return the items of the code that computes what differs between runs, for a block of runs at once.

    They are the items that differ (`differing`), the stores into memory that differs, and the loops and guards around
    them: a loop is also executed there if only a part of its body differs.
    """
    found = {x for x in items if x in differing or (isinstance(x, Store) and x.buffer.owner[0] in differing)}
    to_visit = list(found)
    while to_visit:
        item = to_visit.pop()
        # The loop or guard around the item, and the one whose carried or guarded number it is.
        statements = [] if isinstance(item, Buffer) else [item.block.owner]
        if isinstance(item, Node) and item.op in ("parameter", "result", "guarded"):
            loop_or_guard, _index = item.value
            statements.append(loop_or_guard)
        to_visit += [statement for statement in statements if statement is not None and statement not in found]
        found.update(statements)
    return found - {None}


def _list_sources(item: Any, list_owners: Callable[[Block], list[Any]]) -> list[Any]:
    """Return the items on which a node, buffer or statement depends: it differs between runs if one of them does.

    Statements are stores, guards (conditional blocks) and loops. `list_owners` returns those around a block on whose
    conditions its contents depend.
    """
    # Memory inside other memory differs with it.
    if isinstance(item, Buffer):
        whole, _ = item.owner
        return [whole]
    # Runs differ in the iterations of a loop only if it ends by a condition, which carried numbers decide.
    if isinstance(item, Loop):
        return [item.condition, *item.parameters] if item.length is None else []
    if isinstance(item, Guard):
        return [item.condition]
    if isinstance(item, Store):
        return [item.node, *list_owners(item.block)]
    # All others are nodes. A constant and a counter are the same in all runs.
    if item.op in ("constant", "counter"):
        return []
    sources = [*item.args, *list_owners(item.block)]
    if item.op == "load":
        buffer, _offset, _strides = item.value
        sources.append(buffer.owner[0])
    elif item.op in ("parameter", "result"):
        loop, index = item.value
        sources += [loop, loop.initial[index], loop.following[index]]
    elif item.op == "guarded":
        guard, index = item.value
        sources += [guard, guard.values[index]]
    return sources


class SummedOutputs(NamedTuple):
    """Outputs that are summed, leaf by leaf; into how many batches; which input is the run's number (u32)."""

    outputs: tuple[bool, ...]
    batches: int
    number: int


def row_length_of_sums(width: int, batches: int) -> int:
    """Return how many partial sums an output that is summed over runs has in memory.

    Run r belongs to batch r mod `batches`. A block of `width` runs adds to as many neighbouring sums, from the batch
    of its first run on: up to width - 1 of them lie beyond the last batch, so that the row does not wrap around.
    """
    return batches + width - 1


def fold_rows_into_batches(sums: np.ndarray, batches: int) -> np.ndarray:
    """Return the sum of each batch, (..., batches), from rows of partial sums (..., row).

    Place k of a row is a partial sum of batch k mod `batches`. `row_length_of_sums` gives the length of a row.
    """
    totals = sums[..., :batches].copy()
    for start in range(batches, sums.shape[-1], batches):
        beyond = sums[..., start : start + batches]
        totals[..., : beyond.shape[-1]] += beyond
    return totals
