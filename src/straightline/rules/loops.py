"""Rules of loops: short ones are written out; long ones stay loops with stacked results in memory, as does `while`."""

from collections.abc import Callable, Sequence
from functools import reduce
from typing import Any, NamedTuple

import numpy as np
from jax.extend.core import ClosedJaxpr, JaxprEqn

from straightline.graph import Graph
from straightline.lowering import IN_MEMORY, Lowering, Value, arrange_nodes, estimate_size, list_nodes
from straightline.nodes import Block, Buffer, Loop, LoopExit, Node, RandomKey, Type, Unsupported
from straightline.rules.elementwise import select
from straightline.size_limits import WRITTEN_OUT
from straightline.strided_arrays import StridedArray

# (row, carry before an iteration) -> (carry after it, arrays that are stacked), as arrays of nodes
LoopBody = Callable[[Node, list[np.ndarray]], tuple[Sequence[np.ndarray], Sequence[np.ndarray]]]


def make_counted_loop(
    lowering: Lowering, length: int, carry: Sequence[np.ndarray], body: LoopBody, backwards: bool = False
) -> tuple[list[np.ndarray], list[StridedArray]]:
    """Make a loop of `length` iterations of `body`; return the carry after it, and the stacked results in memory.

    body(row, carry) lowers one iteration, and returns the next carry and what is stored in this row of the stacked
    results. Rows run from 0 up, or `backwards` down to 0. `carry` has the arrays of nodes before the first iteration.
    """
    graph, outer = lowering.graph, lowering.graph.current

    def lower_body(loop: Loop, carry: list[np.ndarray]) -> tuple[Sequence[np.ndarray], list[StridedArray]]:
        """Lower the body of a loop by `body`; return the next carry and the stacked arrays.

        A stacked array (length, ...) lies in memory of the block `outer` around the loop. Each iteration stores one
        row; if `backwards`, the first one stores the last row.
        """
        loop.counter = counter = graph.make_fresh_node("counter", "i64", (), loop.body, loop)
        row = graph.node("sub", "i64", graph.constant(length - 1, "i64"), counter) if backwards else counter
        following, stacked = body(row, carry)
        return following, [_store_row(lowering, length, x, counter, backwards, outer) for x in stacked]

    return _lower_loop(lowering, length, carry, lower_body)


def _lower_loop(
    lowering: Lowering, length: int | None, carry: Sequence[np.ndarray], body: Callable[[Loop, list[np.ndarray]], Any]
) -> tuple[list[np.ndarray], Any]:
    """Lower a loop; return the carry after it, and what the body returns in addition to its carry.

    To lower is to write an operation of JAX as nodes, one for each number. A matrix that is symmetric before the loop
    is taken for symmetric within it: the loop carries its upper triangle. Where the body does not keep a matrix
    symmetric, the body is lowered once more, with all its entries carried.

    Args:
        lowering: the program that is being written: its `graph` holds the nodes and the open block.
        length: how many iterations; None of a loop that ends by its condition.
        carry: the arrays of nodes before the first iteration, which each iteration replaces by new ones.
        body: function of the loop and of the carry before an iteration. It lowers the iteration into the open block,
            and returns the carry after it, and something else.
    """
    graph, outer = lowering.graph, lowering.graph.current
    by_triangle = [is_symmetric(x) for x in carry]  # which carried arrays are carried as their upper triangle
    while True:
        nodes_before = graph.serial
        loop = Loop(Block(outer), length, _flatten_carry(carry, by_triangle))
        # In the body the carry is a parameter; the body is traced once for all iterations.
        loop.parameters = _make_carried_nodes(graph, "parameter", loop, loop.body)
        graph.current = loop.body
        following, beside = body(loop, _restore_arrays(carry, loop.parameters, by_triangle))
        graph.current = outer
        still_symmetric = [was and is_symmetric(x) for was, x in zip(by_triangle, following, strict=True)]
        if still_symmetric == by_triangle:
            break
        # Once more; the nodes of this try do not count.
        by_triangle = still_symmetric
        graph.max_nodes += graph.serial - nodes_before
    loop.following = _flatten_carry(following, by_triangle)
    outer.items.append(loop)
    # After the loop the carry is a result.
    loop.results = _make_carried_nodes(graph, "result", loop, outer)
    return _restore_arrays(carry, loop.results, by_triangle), beside


def _make_carried_nodes(graph: Graph, op: str, loop: Loop, block: Block) -> list[Node]:
    """Make a node for each number that a loop carries: it stands for the number in the body, or after the loop.

    `op` is "parameter" or "result" accordingly, and `block` the body or the block around the loop.
    """
    return [graph.make_fresh_node(op, n.type, (), block, (loop, index)) for index, n in enumerate(loop.initial)]


def is_symmetric(x: np.ndarray) -> bool:
    """Return whether matrices of nodes (..., n, n), n > 1, are symmetric: entries (i, j) and (j, i) are one node."""
    if x.ndim < 2 or x.shape[-1] != x.shape[-2] or not x.size or x.shape[-1] == 1:
        return False
    return all(a is b for a, b in zip(x.ravel().tolist(), np.swapaxes(x, -1, -2).ravel().tolist(), strict=True))


def _flatten_carry(arrays: Sequence[np.ndarray], halves: Sequence[bool]) -> list[Node]:
    """Return the nodes of arrays as one list; of a symmetric matrix, marked in `halves`, only the upper triangle's."""
    nodes: list[Node] = []
    for x, is_halved in zip(arrays, halves, strict=True):
        nodes += list_nodes(x[..., *np.triu_indices(x.shape[-1])] if is_halved else x)
    return nodes


def _store_row(
    lowering: Lowering, length: int, value: np.ndarray, counter: Node, backwards: bool, outer: Block
) -> StridedArray:
    """Store one iteration's array as a row of new memory; return the array (length, ...) of all iterations.

    The memory belongs to the block `outer`. The row's number is that of the iteration, `counter`. If `backwards`,
    iteration 0 has the last row.
    """
    nodes = _list_nodes_of_numbers(value)
    type: Type = nodes[0].type if nodes else "f64"
    buffer = Buffer("scratch", type, (length, *value.shape), outer)
    # The first index of each node in a row. Indices are noted from the last to the first, so that the first one stays.
    size, first_indices = len(nodes), {node: index for index, node in reversed(list(enumerate(nodes)))}
    buffer.first = [first_indices[node] for node in nodes] if len(first_indices) < size else []
    first_row, stride = ((length - 1) * size, -size) if backwards else (0, size)
    for index, node in enumerate(nodes):
        lowering.graph.store(buffer, node, offset=first_row + index, strides=(stride,), indices=(counter,))
    return StridedArray.of_whole_buffer(buffer)


def _list_nodes_of_numbers(value: np.ndarray) -> list[Node]:
    """Return the nodes of an array in row-major order; raise Unsupported if they are keys of random numbers."""
    flat: list[Node] = value.ravel().tolist()
    if any(isinstance(x, RandomKey) for x in flat):
        raise Unsupported("keys of random numbers in memory")
    return flat


def _restore_arrays(
    arrays: Sequence[np.ndarray], nodes: Sequence[Node], by_triangle: Sequence[bool]
) -> list[np.ndarray]:
    """Return arrays of the shapes of `arrays`, made of `nodes`, a flat list: the inverse of `_flatten_carry`.

    An entry takes one node, or two where `arrays` has a key of random numbers, which consists of two words. An array
    marked in `by_triangle` is a symmetric matrix, of which the list has only the upper triangle.
    """
    remaining = iter(nodes)
    results = []
    for array, has_triangle in zip(arrays, by_triangle, strict=True):
        n = array.shape[-1] if has_triangle else 0
        listed_entries = array[..., *np.triu_indices(n)] if has_triangle else array
        new_entries = [
            RandomKey(next(remaining), next(remaining)) if isinstance(x, RandomKey) else next(remaining)
            for x in listed_entries.ravel().tolist()
        ]
        restored = arrange_nodes(new_entries, listed_entries.shape)
        results.append(_mirror_triangles(restored, n) if has_triangle else restored)
    return results


def _mirror_triangles(upper: np.ndarray, n: int) -> np.ndarray:
    """Return symmetric matrices (..., n, n) from their upper triangles, row by row (..., n (n + 1) / 2)."""
    # The index of each entry in the flat triangle. Below the diagonal it is 0; the maximum takes the mirror image's.
    index_in_triangle = np.zeros((n, n), dtype=int)
    index_in_triangle[np.triu_indices(n)] = np.arange(upper.shape[-1])
    return upper[..., np.maximum(index_in_triangle, index_in_triangle.T)]


def _lower_scan(lowering: Lowering, equation: JaxprEqn, inputs: list[Value]) -> list[Value]:
    """Return the results of JAX's `scan`, its last carry and then what it stacks, as operations of the program.

    If all iterations together compute at most `written_out` numbers, they are written out one after another. Else the
    scan becomes a loop. The arguments are in this order what is the same in all iterations, the carry, and arrays of
    which each iteration gets a row.
    """
    params = equation.params
    fixed_count, carry_count = _count_scan_arguments(params)
    fixed, others = inputs[:fixed_count], inputs[fixed_count:]
    carry, rows = others[:carry_count], others[carry_count:]
    length = params["length"]
    computed_numbers = length * estimate_size(lowering, params["jaxpr"].jaxpr)
    if computed_numbers <= lowering.written_out or length <= 1:  # a loop of one iteration would be no shorter
        return _write_out_scan(lowering, equation, fixed, [lowering.nodes(x) for x in carry], rows)
    return _lower_long_scan(lowering, equation, fixed, carry, rows)


def _lower_long_scan(
    lowering: Lowering, equation: JaxprEqn, fixed: list[Value], carry: list[Value], rows: list[Value]
) -> list[Value]:
    """Lower a scan as a loop, whose long arrays stay in memory; return its carry, then what it stacks.

    `fixed` are arguments that are the same in each iteration, `rows` arrays of which an iteration has one row. A
    carried array that the body returns unchanged is a constant of the loop. A long one is carried in memory
    (`in_memory`). All others are carried as numbers, a node for each entry (`as_numbers`).
    """
    params, program = equation.params, equation.params["jaxpr"]
    carried_in, carried_out = program.jaxpr.invars[len(fixed) :], program.jaxpr.outvars
    changed = [k for k in range(len(carry)) if carried_out[k] is not carried_in[k]]
    in_memory = {k: CarriedMemory(lowering, carry[k]) for k in changed if carry[k].size > WRITTEN_OUT}
    as_numbers = [k for k in changed if k not in in_memory]
    body = _ScanBody(
        lowering, program, fixed, carry, as_numbers, in_memory, rows=[put_in_memory(lowering, x) for x in rows]
    )
    start = [lowering.nodes(carry[k]) for k in as_numbers]
    finals, stacked = make_counted_loop(
        lowering, params["length"], start, body.lower_iteration, backwards=params["reverse"]
    )
    after: dict[int, Value] = dict(zip(as_numbers, finals, strict=True))
    after |= {k: x.view_from_here() for k, x in in_memory.items()}
    return [*(after.get(k, initial) for k, initial in enumerate(carry)), *stacked]


class _ScanBody(NamedTuple):
    """The body of a scan that stays a loop, and how its arguments are held.

    program: the body, of the fixed arguments (the same in each iteration), all carried arrays, and a row of each
    stacked array. carry: all carried arrays as they begin; one that is in neither of the next two stays as it is.
    as_numbers: which of them are carried as nodes, one for each number. in_memory: the memory of the others, by their
    index in the carry. rows: arrays in memory, of which an iteration has one row.
    """

    lowering: Lowering
    program: ClosedJaxpr
    fixed: list[Value]
    carry: list[Value]
    as_numbers: list[int]
    in_memory: "dict[int, CarriedMemory]"
    rows: list[StridedArray]

    def lower_iteration(self, row: Node, numbers: list[np.ndarray]) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """Lower one iteration of the loop; return the carried nodes after it, and the results to stack, as nodes.

        `row` is the row of the stacked arguments that it reads. `numbers` are the arrays that the loop carries as nodes
        (`self.as_numbers`), before the iteration. Long arrays are carried in memory, which it reads and fills anew.
        """
        carried: dict[int, Value] = dict(zip(self.as_numbers, numbers, strict=True))
        carried |= {k: memory.view_in_iteration() for k, memory in self.in_memory.items()}
        whole_carry = [carried.get(k, initial) for k, initial in enumerate(self.carry)]
        inputs = [*self.fixed, *whole_carry, *(array.row(row) for array in self.rows)]
        results = self.lowering.inline_program(self.program, inputs)  # the whole carry, then what is stacked
        results = [x if k in self.in_memory else self.lowering.nodes(x) for k, x in enumerate(results)]
        fill_carried_memory(self.lowering, [(memory, results[k]) for k, memory in self.in_memory.items()])
        return [results[k] for k in self.as_numbers], results[len(self.carry) :]


class CarriedMemory:
    """Memory of an array that a loop carries and that is too long to be carried as single numbers.

    An iteration reads it, and fills it anew at its end; each run has its own, whatever it is computed from.
    """

    def __init__(self, lowering: Lowering, start: Value):
        """Make memory for an array that a loop carries, and add a copy of `start` into it before the loop.

        `lowering` holds the program that is being written, whose open block is that around the loop.
        """
        self._graph = lowering.graph
        copied = copy_in_memory(lowering, put_in_memory(lowering, start))
        self.memory = copied.buffer
        self.memory.kind = "carried"  # memory that each iteration of a loop overwrites, unlike "scratch" memory

    def view_in_iteration(self) -> StridedArray:
        """Return the array as an iteration of the loop reads it; the loop's body must be the graph's open block."""
        self.memory.parts = []  # a body may be lowered twice: forget what filled the memory in the first try
        return self.view_from_here()

    def view_from_here(self) -> StridedArray:
        """Return the array as the graph's open block reads it: in a loop's body before the end, or after the loop."""
        return self._view_part(Buffer("scratch", self.memory.type, self.memory.shape, self._graph.current))

    def fill(self, lowering: Lowering, x: StridedArray) -> None:
        """Add a copy of `x`, an array in other memory, into this memory; the open block is the loop's body."""
        self._view_part(copy_in_memory(lowering, x).buffer)  # the copy's buffer lies inside this memory

    def _view_part(self, buffer: Buffer) -> StridedArray:
        """Make a buffer of the same size a part of this memory, from its first number on; return the view of it."""
        self.memory.place_buffer_inside(buffer, 0)
        return StridedArray.of_whole_buffer(buffer)


def fill_carried_memory(lowering: Lowering, filled: Sequence[tuple[CarriedMemory, Value]]) -> None:
    """Fill the memory of carried arrays at the end of an iteration; `filled` pairs each with its next array.

    An array that lies in carried memory itself is copied first, since filling could overwrite it. This happens if two
    carried arrays are exchanged.
    """
    carried_memory = {target.memory for target, _ in filled}
    pairs = []
    for target, value in filled:
        array = put_in_memory(lowering, value)
        is_carried = array.buffer.owner[0] in carried_memory
        pairs.append((target, array, is_carried))
    arrays = [copy_in_memory(lowering, array) if is_carried else array for _, array, is_carried in pairs]
    for (target, _, _), array in zip(pairs, arrays, strict=True):
        target.fill(lowering, array)


def _count_scan_arguments(params: dict[str, Any]) -> tuple[int, int]:
    """Return how many arguments of a scan are constants, and how many are carried.

    JAX 0.10 has these counts among the parameters; later ones have trees, whose entries are counted.
    """
    if "num_consts" in params:
        return params["num_consts"], params["num_carry"]
    consts, carried, _ = params["ft_in"].unpack()
    return len(list(consts)), len(list(carried))


def _write_out_scan(
    lowering: Lowering, equation: JaxprEqn, fixed: list[Value], carry: list[Value], rows: list[Value]
) -> list[Value]:
    """Return the results of a short `scan`, its carry, then what it stacks, from its iterations one after another.

    Args:
        lowering: the program to which the operations of each iteration are added.
        equation: the scan.
        fixed: arguments that are the same in all iterations.
        carry: the carry before the first iteration.
        rows: arrays of which each iteration gets a row.
    """
    params = equation.params
    stacked: list[list[Value]] = []
    numbers = range(params["length"])
    for i in reversed(numbers) if params["reverse"] else numbers:
        items = [x.row(i) if isinstance(x, StridedArray) else _take_row(x, i) for x in rows]
        results = lowering.inline_program(params["jaxpr"], [*fixed, *carry, *items])
        carry = results[: len(carry)]
        stacked.append([lowering.nodes(x) for x in results[len(carry) :]])
    if not stacked:  # of no iterations the results that are stacked have no rows
        avals: list[Any] = [v.aval for v in equation.outvars[len(carry) :]]
        return [*carry, *(np.empty(a.shape, dtype=object) for a in avals)]
    if params["reverse"]:
        stacked.reverse()
    return [*carry, *(np.stack(leaves) for leaves in zip(*stacked, strict=True))]


def _take_row(x: np.ndarray, i: int) -> np.ndarray:
    """Return x[i] as an array; of an array with one axis too, where NumPy's x[i] would be an entry itself."""
    return x[i : i + 1].reshape(x.shape[1:])


def put_in_memory(lowering: Lowering, value: Value) -> StridedArray:
    """Return an array in memory, so that data can choose among its entries.

    An array of nodes is stored: constants become a table of the program, others a buffer that the open block fills.
    """
    if isinstance(value, StridedArray):
        return value
    flat = _list_nodes_of_numbers(value)
    graph = lowering.graph
    type: Type = flat[0].type if flat else "f64"
    if all(n.op == "constant" for n in flat):
        table = np.array([n.value for n in flat]).reshape(value.shape)
        return StridedArray.of_whole_buffer(Buffer("table", type, value.shape, graph.top, table))
    buffer = Buffer("scratch", type, value.shape, graph.current)
    for index, node in enumerate(flat):
        graph.store(buffer, node, index, (), ())
    return StridedArray.of_whole_buffer(buffer)


def copy_in_memory(lowering: Lowering, x: StridedArray) -> StridedArray:
    """Copy a long array to new memory, row by row in a loop that is added to the program; return the copy."""
    _carry, stacked = make_counted_loop(lowering, x.shape[0], [], lambda row, _: ([], [lowering.nodes(x.row(row))]))
    return stacked[0]


def _lower_while(lowering: Lowering, equation: JaxprEqn, inputs: list[Value]) -> list[Value]:
    """Lower a loop that ends when no run's condition holds; a run whose condition is false keeps its carry.

    Under `vmap` the condition has axes, the leading ones of the carry, and each entry keeps its carry likewise.
    """
    params, graph = equation.params, lowering.graph
    conditional, fixed = params["cond_nconsts"], params["body_nconsts"]
    of_condition, of_body = inputs[:conditional], inputs[conditional : conditional + fixed]

    def lower_body(loop: Loop, carry: list[np.ndarray]) -> tuple[list[np.ndarray], None]:
        """Lower the check of the condition and then one iteration; return the next carry. Nothing is stacked.

        The loop goes on while any run's condition holds. A run whose condition does not hold keeps its carry.
        """
        active = lowering.nodes(lowering.inline_program(params["cond_jaxpr"], [*of_condition, *carry])[0])
        loop.condition = reduce(lambda a, b: graph.node("or", "bool", a, b), list_nodes(active))
        loop.body.items.append(LoopExit(loop))
        moved = [lowering.nodes(x) for x in lowering.inline_program(params["body_jaxpr"], [*of_body, *carry])]
        return [_select_where_active(graph, active, new, old) for new, old in zip(moved, carry, strict=True)], None

    start = [lowering.nodes(x) for x in inputs[conditional + fixed :]]
    return _lower_loop(lowering, None, start, lower_body)[0]


def _select_where_active(graph: Graph, active: np.ndarray, new: np.ndarray, old: np.ndarray) -> np.ndarray:
    """Return the nodes that select the new entries where a loop goes on (`active`), and the old ones elsewhere.

    A node is a scalar operation of the program (`graph`). `active` holds a flag for each item of a batch, along the
    leading axes of `new` and `old`, and is repeated for all entries of the item.
    """
    conditions = np.repeat(active.ravel(), new.size // active.size).tolist()
    entries = zip(conditions, new.ravel().tolist(), old.ravel().tolist(), strict=True)
    return arrange_nodes([select(graph, condition, x, y) for condition, x, y in entries], old.shape)


IN_MEMORY |= {"scan": _lower_scan, "while": _lower_while}
