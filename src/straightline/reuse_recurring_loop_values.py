"""Values of a loop that repeat bit for bit with a period: computed once, then read from a ring of stored rows.

The covariance of a Kalman filter converges until it stands still, or goes round among a few roundings, and with it
gains, variances and logarithms; from then on means are all that an iteration has to compute, a tenth of it.

Let S be the set of numbers of a loop's body that follow from a set C of carried numbers, from tests of the data of the
iteration (did a measurement arrive?), and from what the loop does not change. C is the largest set of carried numbers
whose next values are in S. S is moved to a guarded block, which an iteration skips if it knows the numbers already. The
numbers of S that others need, and the outcomes of the tests, are stored as a row of a ring of RING rows. If after rows
0 ... p - 1 the numbers C have the bits that they had before row 0, a cycle of period p is found: as long as the tests
have the outcomes of the cycle's next row, that row has the numbers of the iteration. If they have not, or if the ring
is full without a cycle, S is computed again and stored from row 0 on.

All results have the bits that they had. An iteration of a filter of four states and two outputs, 1,400 operations,
takes 120 ns in a program of one run, 22 in a cycle, and a tenth more than 120 where one is sought in vain. Of 35
filters of levels, trends, oscillations, positions and seasons 22 stand still after some hundreds of rows; 11 go round
in 2 to 8. A sensor that is read every tenth row makes a cycle too.
"""

from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from functools import partial, reduce
from typing import Any, NamedTuple

from straightline.graph import Graph
from straightline.nodes import REAL, Block, Buffer, Guard, Loop, Node, Store, Type
from straightline.program import REFERRING, list_needed_items, list_used_nodes
from straightline.rules.elementwise import select
from straightline.size_limits import DEAR

RING = 32  # rows: of a longer cycle every iteration is computed
INTEGERS: dict[Type, Type] = {"f64": "i64", "f32": "i32"}  # that have the bits of a real number


class RecurringNodes(NamedTuple):
    """Numbers of a loop's body whose values may repeat, iteration by iteration.

    nodes: the set S of numbers that may repeat, in order. carried: the set C of carried numbers from which S follows,
    by number in the carry. tests: flags of the iteration's data on which S depends, such as whether a measurement
    arrived. test_nodes: all nodes that compute the tests, in order, and the tests.
    """

    nodes: dict[Node, None]
    carried: list[int]
    tests: list[Node]
    test_nodes: dict[Node, None]


def reuse_recurring_values(graph: Graph, outputs: Sequence[Buffer]) -> dict[Any, None]:
    """Rewrite each counted loop of one run in which many values may repeat; return what the outputs then need.

    A rewritten loop reads repeated values from memory. A loop is rewritten if this saves more than DEAR operations,
    not counting the operations whose results must be stored because others need them.
    """
    items = list_needed_items(outputs)
    for loop in [x for x in items if isinstance(x, Loop) and x.length is not None]:
        recurring = _find_recurring(loop, items)
        if recurring is None:
            continue
        stored = _list_needed_elsewhere(items, recurring)
        if len(recurring.nodes) > DEAR + len(stored):
            _rewrite_loop(graph, items, loop, recurring, stored)
            items = list_needed_items(outputs)
    return items


def _find_recurring(loop: Loop, needed: Collection[Any]) -> RecurringNodes | None:
    """Return the numbers S of a loop's body that may repeat, with C and the tests on which they depend.

    Some numbers that a loop carries, such as a filter's covariance, settle to a value or a cycle; all that follows from
    them then repeats, and need not be computed again. S is all that follows from a set C of carried numbers, from tests
    of the iteration's data (such as whether a measurement arrived), and from what the loop does not change. C is the
    largest set of carried numbers whose next values are in S. Return None if S has no more than DEAR (100) nodes, which
    is not worth it. Sets of nodes are the keys of a dict, which keeps an order. `needed` are the items that the outputs
    need.
    """
    body = loop.body
    nodes = [x for x in body.items if isinstance(x, Node) and x in needed]
    data_nodes = _find_nodes_of_data(loop, nodes)
    # Tests: flags that are computed from numbers of the data, rather than from other flags.
    tests = {n for n in data_nodes if n.type == "bool" and all(a.type != "bool" for a in n.args)}
    # The largest set C: begin with all carried numbers, and drop those whose next value does not follow from C.
    carried = [k for k, parameter in enumerate(loop.parameters) if parameter in needed]
    # Each pass of `while`: S (`computed`) by one walk through the body, in order, from the tests and C.
    operations = [(n, _list_nodes_of_body(n.args, body)) for n in nodes if n.op not in REFERRING and n not in tests]
    while True:
        known, computed = tests | {loop.parameters[k] for k in carried}, dict[Node, None]()
        for n, arguments in operations:
            if known.issuperset(arguments):
                known.add(n)
                computed[n] = None
        still_carried = [k for k in carried if known.issuperset(_list_nodes_of_body([loop.following[k]], body))]
        if still_carried == carried:
            break
        carried = still_carried
    if not carried or len(computed) <= DEAR:
        return None
    _remove_products_fused_outside(computed, needed)
    # Only the tests that S or C's next values use. The nodes that compute them are not in S, even if they follow from
    # other tests, since the tests are computed in each iteration.
    used = {a for n in computed for a in n.args} | {loop.following[k] for k in carried}
    used_tests = [n for n in data_nodes if n in tests and n in used]
    test_nodes = _list_sources(data_nodes, used_tests)
    recurring = {n: None for n in computed if n not in test_nodes}
    return RecurringNodes(nodes=recurring, carried=carried, tests=used_tests, test_nodes=test_nodes)


def _list_nodes_of_body(nodes: Sequence[Node], body: Block) -> list[Node]:
    """Return those of the nodes (numbers) that a loop's body computes; all others are known before the loop."""
    return [n for n in nodes if n.block is body]


def _find_nodes_of_data(loop: Loop, nodes: Sequence[Node]) -> dict[Node, None]:
    """Return the numbers of a loop's body that follow from the data of the iteration alone, and from no carried number.

    The data are memory that was filled before the loop, such as the rows of an array of which an iteration reads one,
    and the number of the iteration, `loop.counter`. `nodes` are the body's, in order.
    """
    data_nodes, known = dict[Node, None](), {loop.counter}
    for node in nodes:
        if node.op == "load":
            buffer = node.value[0]
            # Memory that the loop carries, or that its body fills, is no data.
            is_allowed = buffer.owner[0].kind != "carried" and buffer.block is not loop.body
        else:
            is_allowed = node.op not in REFERRING  # a carried number of a loop, or a result of a loop or guard
        if is_allowed and known.issuperset(_list_nodes_of_body(node.args, loop.body)):
            known.add(node)
            data_nodes[node] = None
    return data_nodes


def _list_sources(nodes: Iterable[Node], tests: Iterable[Node]) -> dict[Node, None]:
    """Return those of the `nodes` from which the tests are computed, and the tests themselves, in order."""
    wanted = set(tests)
    # Go backward, since a node comes after its arguments.
    for n in reversed(list(nodes)):
        if n in wanted:
            wanted.update(n.args)
    return {n: None for n in nodes if n in wanted}


def _remove_products_fused_outside(recurring: dict[Node, None], needed: Iterable[Any]) -> None:
    """Remove from `recurring` the products that will be fused with a sum that is not in `recurring`.

    A fused product and sum, a b + c, are rounded once. If the product were stored for later iterations, it would be
    rounded itself, which changes the bits of the sum. So such a product is computed in each iteration. `needed` are all
    items that the outputs need, among which the one sum is that uses the product.
    """
    users: defaultdict[Node, list[Any]] = defaultdict(list)
    for item in needed:
        for node in list_used_nodes(item):
            users[node].append(item)
    for product in [n for n in recurring if n.op == "mul" and n.type in REAL and len(users[n]) == 1]:
        user = users[product][0]
        if isinstance(user, Node) and user.op in ("add", "sub") and user not in recurring:
            del recurring[product]


def _list_needed_elsewhere(items: Iterable[Any], recurring: RecurringNodes) -> list[Node]:
    """Return the recurring numbers that an item outside of them uses, in order: they must be stored.

    `items` are all that the outputs need.
    """
    used = {a for x in items if x not in recurring.nodes for a in list_used_nodes(x)}
    return [n for n in recurring.nodes if n in used]


class RingBuffer:
    """Memory of some rows of numbers, filled in the iterations of a loop; a row has one number of each given type.

    There is one buffer for each type. The loop fills row after row and, behind the last row, row 0 again.
    """

    def __init__(self, graph: Graph, types: Sequence[Type], loop: Loop, rows: int = RING):
        """Allocate memory, in the block around a loop, for the newest `rows` rows of numbers.

        Number k of a row has the type types[k]. There is one buffer (rows, numbers) for each type.
        """
        count_by_type = Counter(types)
        buffers = {type: Buffer("scratch", type, (rows, n), loop.block) for type, n in count_by_type.items()}
        self._graph = graph
        # For each number of a row: its buffer, and its column there, the count of earlier numbers of the same type.
        self._columns = [(buffers[type], types[:k].count(type)) for k, type in enumerate(types)]

    def store(self, nodes: Iterable[Node], row: Node) -> None:
        """Add to the open block of the program the stores of these numbers as a row of the ring.

        There is one number of each of the ring's types, in their order; `row` is the node of the row's number.
        """
        for n, (buffer, column) in zip(nodes, self._columns, strict=True):
            self._graph.store(buffer, n, column, buffer.shape[1:], (row,))

    def load(self, row: Node) -> list[Node]:
        """Return the nodes that load a row, in the order of the types."""
        return [self._graph.load(buffer, column, buffer.shape[1:], (row,)) for buffer, column in self._columns]


class RingRow(NamedTuple):
    """What an iteration does with the ring of stored rows.

    row: the row that it fills or reads. computes: whether it computes the recurring numbers and fills the row, since no
    stored row is known to have them. restarts: whether it would fill row 0, from which a cycle is then sought.
    """

    row: Node
    computes: Node
    restarts: Node


def _rewrite_loop(
    graph: Graph, items: Iterable[Any], loop: Loop, recurring: RecurringNodes, stored: Sequence[Node]
) -> None:
    """Rewrite a loop so that an iteration computes the recurring numbers only if no stored row is known to have them.

    Recurring numbers are numbers of the body that may have the same values in later iterations. The ring is a memory of
    their values in RING earlier iterations, one row each. The body becomes: the tests of the data; the choice of the
    iteration's row of the ring; a guarded block (which runs under a condition) that computes the recurring numbers and
    stores them in that row; and the rest, which loads them from it. The loop carries in addition the row of the last
    iteration, and the period of the cycle in which rows repeat, 0 if none is known.

    Args:
        graph: the program.
        items: all that its outputs need.
        loop: the loop.
        recurring: the recurring numbers, the carried numbers from which they follow, and the tests.
        stored: the recurring numbers that the rest of the program needs.
    """
    body, enclosing = loop.body, graph.current
    # Nodes made here are not the program's own, and do not count: at most some for each number that a ring has.
    graph.max_nodes += 8 * (len(recurring.nodes) + len(recurring.tests))
    # The body begins anew with the tests alone; `rest` is put at its end.
    rest = [x for x in body.items if x not in recurring.nodes and x not in recurring.test_nodes]
    body.items, body.seen, graph.current = [*recurring.test_nodes], {}, body
    test_ring, value_ring = (RingBuffer(graph, [n.type for n in nodes], loop) for nodes in (recurring.tests, stored))
    # The last row before the first iteration is RING - 1, so that row 0 is next.
    last_row, period = _carry_integer(graph, loop, RING - 1), _carry_integer(graph, loop, 0)
    ring_row = _choose_ring_row(graph, recurring.tests, test_ring, last_row, period)
    closes_cycle = _move_to_guarded_block(graph, loop, recurring, stored, ring_row, (test_ring, value_ring))
    # A cycle that closes with row p - 1 has the period p.
    zero, one = graph.constant(0, "i64"), graph.constant(1, "i64")
    new_period = select(graph, closes_cycle, graph.node("add", "i64", ring_row.row, one), zero)
    # The rest of the program loads the recurring numbers from the iteration's row.
    loaded = dict(zip(stored, value_ring.load(ring_row.row), strict=True))
    for x in items:
        if x not in recurring.nodes:
            _replace_uses(x, loaded)
    loop.following += [ring_row.row, select(graph, ring_row.computes, new_period, period)]
    body.items += rest
    graph.current = enclosing


def _move_to_guarded_block(
    graph: Graph,
    loop: Loop,
    recurring: RecurringNodes,
    stored: Sequence[Node],
    ring_row: RingRow,
    rings: tuple[RingBuffer, RingBuffer],
) -> Node:
    """Move the recurring numbers to a guarded block of the loop's body; return whether a cycle closes there.

    Numbers of a loop's iterations, such as covariances of a filter, may recur in a cycle; rings store the rows of
    recent iterations, so that later ones read them. An iteration skips the block unless it has to compute the numbers
    (`ring_row.computes`). The block also stores the iteration's row in the two `rings`: the outcomes of the tests, and
    the numbers that the rest of the program needs (`stored`). A cycle closes if the next values of the carried numbers,
    from which the recurring ones follow, have the bits that they had before row 0. In iterations that skip the block
    the result is False.
    """
    # Make a conditional block in the loop's body, and move the recurring nodes there.
    guard = Guard(Block(loop.body, pinned=True), ring_row.computes)
    graph.current, guard.body.items = guard.body, [*recurring.nodes]
    for n in recurring.nodes:
        n.block = guard.body
    # Store the row, and compare the carried numbers with those before row 0.
    test_ring, value_ring = rings
    test_ring.store(recurring.tests, ring_row.row)
    value_ring.store(stored, ring_row.row)
    guard.values = [_compare_with_start(graph, loop, recurring.carried, ring_row.restarts)]
    # Back in the loop's body: the block's result is a node there.
    graph.current = loop.body
    guard.results = [graph.make_fresh_node("guarded", "bool", (), loop.body, (guard, 0))]
    loop.body.items.append(guard)
    return guard.results[0]


def _choose_ring_row(
    graph: Graph, outcomes: Sequence[Node], test_ring: RingBuffer, last_row: Node, period: Node
) -> RingRow:
    """Choose the row of the ring that an iteration reads, or fills with numbers that it computes.

    A loop, such as a Kalman filter over rows of data, often comes to compute the same covariances again and again in a
    cycle. So its recurring numbers are stored in a ring of RING rows, with the outcomes of the tests on which they
    depend (did a measurement arrive?). If a cycle is known, the next row of the cycle is read, provided that the tests
    had the same outcomes there. Else the numbers are computed and fill the next row of the ring, or row 0 if a cycle
    was just left or the ring is full.

    Args:
        graph: the program, to which operations (nodes) are added.
        outcomes: outcomes of the tests in this iteration.
        test_ring: the ring of earlier outcomes.
        last_row: row of the last iteration.
        period: number of rows of the known cycle, 0 if none is known.
    """
    node, zero, one = graph.node, graph.constant(0, "i64"), graph.constant(1, "i64")
    # The next row, which after the last row of the cycle is row 0.
    next_row = node("add", "i64", last_row, one)
    next_in_cycle = select(graph, node("eq", "bool", next_row, period), zero, next_row)
    # Compute if no cycle is known or some test differs. Then fill row 0 if a cycle is left or the ring is full.
    knows_no_cycle = node("eq", "bool", period, zero)
    differing_tests = [node("xor", "bool", *pair) for pair in zip(outcomes, test_ring.load(next_in_cycle), strict=True)]
    computes = reduce(partial(node, "or", "bool"), differing_tests, knows_no_cycle)
    is_full = node("eq", "bool", last_row, graph.constant(RING - 1, "i64"))
    restarts = node("or", "bool", node("not", "bool", knows_no_cycle), is_full)
    row_to_fill = select(graph, restarts, zero, next_row)
    return RingRow(row=select(graph, computes, row_to_fill, next_in_cycle), computes=computes, restarts=restarts)


def _compare_with_start(graph: Graph, loop: Loop, carried: Sequence[int], restarts: Node) -> Node:
    """Return whether the next values of carried numbers have the bits that these numbers had before row 0 of the ring.

    The ring buffer holds one row of computed values for each of the last iterations. If the carried numbers are again
    what they were before row 0, the loop is in a cycle, and later values can be read from the ring. Bits are compared
    rather than numbers, so that NaN equals itself.

    Args:
        graph: the program; its open block is executed when the recurring numbers are computed.
        loop: the loop.
        carried: which of the numbers that it carries, by number in the carry.
        restarts: whether this iteration fills row 0, so that its carried numbers must be stored.

    Returns:
        A node of the graph: a flag that the program computes in each iteration.
    """
    block, zero = graph.current, graph.constant(0, "i64")
    # The bits before row 0: a ring of one row, which is filled in a guarded block, run only where `restarts` is true.
    types = [INTEGERS.get(loop.parameters[k].type, loop.parameters[k].type) for k in carried]
    start_bits = RingBuffer(graph, types, loop, rows=1)
    guard = Guard(Block(block, pinned=True), restarts)
    block.items.append(guard)
    graph.current = guard.body
    start_bits.store([_read_bits(graph, loop.parameters[k]) for k in carried], zero)
    graph.current = block
    # For each type, the bits in which any of its numbers differs.
    differing = dict[Type, Node]()
    for k, start in zip(carried, start_bits.load(zero), strict=True):
        bits = graph.node("xor", start.type, start, _read_bits(graph, loop.following[k]))
        joined = graph.node("or", start.type, differing[start.type], bits) if start.type in differing else bits
        differing[start.type] = joined
    are_equal = [graph.node("eq", "bool", n, graph.constant(0, type)) for type, n in differing.items()]
    return reduce(partial(graph.node, "and", "bool"), are_equal)


def _carry_integer(graph: Graph, loop: Loop, start: int) -> Node:
    """Let the loop carry one more integer, which is `start` before the first iteration.

    Return its parameter: the node that stands for the integer within an iteration.
    """
    key = loop, len(loop.parameters)
    loop.initial.append(graph.constant(start, "i64"))
    loop.parameters.append(graph.make_fresh_node("parameter", "i64", (), loop.body, key))
    loop.results.append(graph.make_fresh_node("result", "i64", (), loop.block, key))
    return loop.parameters[-1]


def _read_bits(graph: Graph, node: Node) -> Node:
    """Return the node of a number whose bits can be compared: a real one is read as an integer of as many bits."""
    return graph.node("bitcast", INTEGERS[node.type], node) if node.type in REAL else node


def _replace_uses(x: Any, replaced: Mapping[Node, Node]) -> None:
    """Change a node or a statement, in place, so that it uses the nodes replaced[n] in the place of the nodes n."""

    def replace_all(nodes: Sequence[Node]) -> list[Node]:
        """Return the nodes with those replaced that have a replacement."""
        return [replaced.get(n, n) for n in nodes]

    if isinstance(x, Node):
        x.args = tuple(replace_all(x.args))
    elif isinstance(x, Store):
        x.node, x.indices = replaced.get(x.node, x.node), tuple(replace_all(x.indices))
    elif isinstance(x, Guard):
        x.condition, x.values = replaced.get(x.condition, x.condition), replace_all(x.values)
    elif isinstance(x, Loop):
        x.initial, x.following = replace_all(x.initial), replace_all(x.following)
        x.condition = None if x.condition is None else replaced.get(x.condition, x.condition)
