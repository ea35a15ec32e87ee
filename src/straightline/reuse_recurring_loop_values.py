"""Values of a loop that repeat bit for bit with a period: computed once, then read from a ring of stored rows.

The covariance of a Kalman filter converges until it stands still, or goes round among a few roundings, and with it
gains, variances and logarithms; from then on means are all that a turn has to compute, a tenth of it. Of a loop's body
let S be the numbers that follow from carried numbers C, from tests of a turn's rows (did it arrive?) and from what the
loop does not change, where C is the largest set of carried numbers whose next values are in S. S becomes a guarded
block; what other numbers need of it goes to a row of a ring, and so do the tests. If after rows 0 ... p - 1 of the ring
C has the bits that it had before row 0, these rows are those of all further turns, in turn, as long as the tests are
theirs: S is not computed. Where these are other ones, and where the ring is full, row 0 is next.

All results have the bits that they had. A turn of a filter of four states and two outputs, 1,400 operations, takes 120
ns in a program of one run, 22 in a cycle, and a tenth more than 120 where one is sought in vain. Of 35 filters of
levels, trends, oscillations, positions and seasons 22 stand still after some hundreds of rows; 11 go round in 2 to 8.
A sensor that is read every tenth row makes a cycle too.
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

RING = 32  # rows: of a longer cycle every turn is computed
INTEGERS: dict[Type, Type] = {"f64": "i64", "f32": "i32"}  # that have the bits of a real number


class RecurringNodes(NamedTuple):
    """Numbers of a loop's body whose values may repeat from turn to turn: S and C of this file's beginning.

    nodes: S, in order; carried: C, by number; tests: of a turn's rows, of which S needs the outcome; rows: what these
    are computed of, in order, and they themselves.
    """

    nodes: dict[Node, None]
    carried: list[int]
    tests: list[Node]
    rows: dict[Node, None]


def reuse_recurring_values(graph: Graph, outputs: Sequence[Buffer]) -> dict[Any, None]:
    """Rewrite each counted loop of one run in which many values may repeat; return what the outputs then need.

    A rewritten loop reads repeated values from memory. A loop is rewritten if this saves more than DEAR operations,
    not counting the operations whose results must be stored because others need them.
    """
    items = list_needed_items(outputs)
    for loop in [x for x in items if isinstance(x, Loop) and x.length is not None]:
        found = _find_recurring(loop, items)
        if found is None:
            continue
        kept = _list_needed_elsewhere(items, found)
        if len(found.nodes) > DEAR + len(kept):
            _rewrite_loop(graph, items, loop, found, kept)
            items = list_needed_items(outputs)
    return items


def _find_recurring(loop: Loop, needed: Collection[Any]) -> RecurringNodes | None:
    """Return S and C of a loop's body, and the tests of rows that S needs; None where S is no more than DEAR nodes.

    S, C, tests and rows are those of this file's beginning. Sets of nodes are the keys of a dict, which keeps an order.

    `needed`: items that the outputs need, gone through for a large S only: some programs have hundreds of small loops.
    """
    body = loop.body
    nodes = [x for x in body.items if isinstance(x, Node) and x in needed]
    of_rows = _find_nodes_of_rows(loop, nodes)
    # Tests: flags of rows that are computed of numbers, rather than of other flags.
    tests = {n for n in of_rows if n.type == "bool" and all(a.type != "bool" for a in n.args)}
    # The largest set C: begin with all carried numbers, and drop those whose next value does not follow from C.
    carried = [k for k, parameter in enumerate(loop.parameters) if parameter in needed]
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
    _leave_fused_products_in_turn(needed, computed)
    # Only the tests that S or C's next values use; what these are computed of is no part of S, even where it follows
    # from other tests, since the tests are computed in each turn.
    used = {a for n in computed for a in n.args} | {loop.following[k] for k in carried}
    used_tests = [n for n in of_rows if n in tests and n in used]
    sources = _list_sources(of_rows, used_tests)
    recurring = {n: None for n in computed if n not in sources}
    return RecurringNodes(nodes=recurring, carried=carried, tests=used_tests, rows=sources)


def _list_nodes_of_body(nodes: Sequence[Node], body: Block) -> list[Node]:
    """Return those of the numbers that are computed in a loop's body: all others are there before it."""
    return [n for n in nodes if n.block is body]


def _find_nodes_of_rows(loop: Loop, nodes: Sequence[Node]) -> dict[Node, None]:
    """Return the numbers of a loop's body that follow only from the turn's number and from memory filled before.

    They are computed from the rows that a turn reads, and from no carried number. `nodes` are the body's, in order.
    """
    results, known = dict[Node, None](), {loop.counter}
    for node in nodes:
        is_load = node.op == "load"
        reads_older_memory = not is_load or (
            node.value[0].owner[0].kind != "carried" and node.value[0].block is not loop.body
        )
        refers_to_loop = not is_load and node.op in REFERRING  # a number that a loop or a guard carries
        follows = known.issuperset(_list_nodes_of_body(node.args, loop.body))
        if reads_older_memory and not refers_to_loop and follows:
            known.add(node)
            results[node] = None
    return results


def _list_sources(rows: Iterable[Node], tests: Iterable[Node]) -> dict[Node, None]:
    """Return those of the nodes `rows` that the tests are computed from, and the tests themselves, in order."""
    wanted = set(tests)
    # Go backward, since a node comes after its arguments.
    for n in reversed(list(rows)):
        if n in wanted:
            wanted.update(n.args)
    return {n: None for n in rows if n in wanted}


def _leave_fused_products_in_turn(needed: Iterable[Any], found: dict[Node, None]) -> None:
    """Remove from `found` the products that will be fused with a sum that is not in `found`.

    A fused product and sum are rounded once. A product that is stored apart would be rounded itself, which changes
    the bits of the result.
    """
    users: defaultdict[Node, list[Any]] = defaultdict(list)
    for item in needed:
        for node in list_used_nodes(item):
            users[node].append(item)
    for product in [n for n in found if n.op == "mul" and n.type in REAL and len(users[n]) == 1]:
        user = users[product][0]
        if isinstance(user, Node) and user.op in ("add", "sub") and user not in found:
            del found[product]


def _list_needed_elsewhere(items: Iterable[Any], found: RecurringNodes) -> list[Node]:
    """Return the numbers of S that something else needs, in order."""
    used = {a for x in items if x not in found.nodes for a in list_used_nodes(x)}
    return [n for n in found.nodes if n in used]


class RingBuffer:
    """Memory for rows of some numbers of these types, one buffer for each type; filled in the turns of a loop."""

    def __init__(self, graph: Graph, types: Sequence[Type], loop: Loop, rows: int = RING):
        """Allocate memory, in the block around a loop, for the newest `rows` rows of numbers.

        Number k of a row has the type types[k]. There is one buffer (rows, numbers) for each type.
        """
        count_by_type = Counter(types)
        buffers = {type: Buffer("scratch", type, (rows, n), loop.block) for type, n in count_by_type.items()}
        self._graph = graph
        # For each number of a row: its buffer, and its column there, the count of earlier numbers of the same type.
        self._places = [(buffers[type], types[:k].count(type)) for k, type in enumerate(types)]

    def store(self, nodes: Iterable[Node], row: Node) -> None:
        """Store these numbers, in the order of the types, as a row of the ring."""
        for n, (buffer, place) in zip(nodes, self._places, strict=True):
            self._graph.store(buffer, n, place, buffer.shape[1:], (row,))

    def load(self, row: Node) -> list[Node]:
        """Return the nodes that load a row, in the order of the types."""
        return [self._graph.load(buffer, place, buffer.shape[1:], (row,)) for buffer, place in self._places]


class RingTurn(NamedTuple):
    """The turn's row of the ring; whether the turn computes S for it, seeking a cycle, and whether one begins there."""

    now: Node
    seeks: Node
    begins: Node


def _rewrite_loop(graph: Graph, items: Iterable[Any], loop: Loop, found: RecurringNodes, kept: Sequence[Node]) -> None:
    """Rewrite a loop so that S is computed only in turns that seek a cycle; all other turns read it from a ring.

    S are the numbers that may come back, C the carried ones that they follow from (this file's beginning). The ring is
    memory of RING rows, each with the numbers of one turn. The body becomes: the tests of rows; the choice of the
    turn's row of the ring; a guarded block with S, which stores that row; the rest, which loads from it. The loop
    carries in addition the last turn's row of the ring, and the period of the cycle, 0 where none is known.

    Args:
        graph: the program.
        items: all that its outputs need.
        loop: the loop.
        found: S, C and the tests.
        kept: the numbers of S that something outside of S needs.
    """
    body, enclosing = loop.body, graph.current
    # Nodes made here are not the program's own, and do not count: at most some for each number that a ring has.
    graph.max_nodes += 8 * (len(found.nodes) + len(found.tests))
    # The body begins anew with the tests alone; `rest` is put at its end.
    rest = [x for x in body.items if x not in found.nodes and x not in found.rows]
    body.items, body.seen, graph.current = [*found.rows], {}, body
    test_ring, value_ring = (RingBuffer(graph, [n.type for n in nodes], loop) for nodes in (found.tests, kept))
    # Before the first turn it is as if the ring were full, so that row 0 is next.
    last_row, period = _carry_integer(graph, loop, RING - 1), _carry_integer(graph, loop, 0)
    turn = _choose_ring_row(graph, found.tests, test_ring, last_row, period)
    # S, the stores of its row, and whether it closes a cycle.
    closes = _move_to_guarded_block(graph, loop, found, kept, turn, (test_ring, value_ring))
    # A cycle that closes with row p - 1 has the period p.
    zero, one = graph.constant(0, "i64"), graph.constant(1, "i64")
    found_period = select(graph, closes, graph.node("add", "i64", turn.now, one), zero)
    # The rest of the program has the numbers of S from the turn's row.
    from_ring = dict(zip(kept, value_ring.load(turn.now), strict=True))
    for x in items:
        if x not in found.nodes:
            _replace_uses(x, from_ring)
    loop.following += [turn.now, select(graph, turn.seeks, found_period, period)]
    body.items += rest
    graph.current = enclosing


def _move_to_guarded_block(
    graph: Graph,
    loop: Loop,
    found: RecurringNodes,
    kept: Sequence[Node],
    turn: RingTurn,
    rings: tuple[RingBuffer, RingBuffer],
) -> Node:
    """Move S to a guarded block, for turns that seek a cycle; return whether C has the bits with which it began.

    The block also stores the turn's row of the two rings, of tests and of the numbers that others need. The result is
    False in turns that do not seek.
    """
    guard = Guard(Block(loop.body, pinned=True), turn.seeks)
    graph.current, guard.body.items = guard.body, [*found.nodes]
    for n in found.nodes:
        n.block = guard.body
    for ring, nodes in zip(rings, (found.tests, kept), strict=True):
        ring.store(nodes, turn.now)
    guard.values = [_compare_with_start(graph, loop, found.carried, turn.begins)]
    graph.current = loop.body
    guard.results = [graph.make_fresh_node("guarded", "bool", (), loop.body, (guard, 0))]
    loop.body.items.append(guard)
    return guard.results[0]


def _choose_ring_row(graph: Graph, now: Sequence[Node], tests: RingBuffer, row: Node, period: Node) -> RingTurn:
    """Choose a turn's row of the ring, which holds the last turns' values in RING rows.

    It is the next row of the cycle if the tests had the same outcomes there. Else the turn computes its values anew.

    `now`: outcomes of this turn's tests. `tests`: the ring of earlier outcomes, by row. `row`: the last turn's row.
    `period`: how many rows the cycle has, 0 where no cycle is known.
    """
    node, zero, one = graph.node, graph.constant(0, "i64"), graph.constant(1, "i64")
    following = node("add", "i64", row, one)
    of_cycle = select(graph, node("eq", "bool", following, period), zero, following)
    unknown = node("eq", "bool", period, zero)
    differing_tests = [node("xor", "bool", *pair) for pair in zip(now, tests.load(of_cycle), strict=True)]
    seeks = reduce(partial(node, "or", "bool"), differing_tests, unknown)
    # The ring begins anew at row 0 if a cycle was left or if the ring is full.
    full = node("eq", "bool", row, graph.constant(RING - 1, "i64"))
    begins = node("or", "bool", node("not", "bool", unknown), full)
    sought = select(graph, begins, zero, following)
    return RingTurn(now=select(graph, seeks, sought, of_cycle), seeks=seeks, begins=begins)


def _compare_with_start(graph: Graph, loop: Loop, carried: Sequence[int], begins: Node) -> Node:
    """Return whether the next values of carried numbers have the bits that these had when the cycle began."""
    block, zero = graph.current, graph.constant(0, "i64")
    # Their bits before row 0, stored in the turns in which a cycle begins.
    reference = RingBuffer(
        graph, [INTEGERS.get(loop.parameters[k].type, loop.parameters[k].type) for k in carried], loop, 1
    )
    guard = Guard(Block(block, pinned=True), begins)
    block.items.append(guard)
    graph.current = guard.body
    reference.store([_read_bits(graph, loop.parameters[k]) for k in carried], zero)
    graph.current = block
    # The bits in which any number differs, of each type together.
    differing = dict[Type, Node]()
    for k, old in zip(carried, reference.load(zero), strict=True):
        bits = graph.node("xor", old.type, old, _read_bits(graph, loop.following[k]))
        differing[old.type] = graph.node("or", old.type, differing[old.type], bits) if old.type in differing else bits
    equal = [graph.node("eq", "bool", n, graph.constant(0, type)) for type, n in differing.items()]
    return reduce(partial(graph.node, "and", "bool"), equal)


def _carry_integer(graph: Graph, loop: Loop, start: int) -> Node:
    """Let the loop carry one more integer, which is `start` before the first turn.

    Returns its parameter: the node that stands for the integer within a turn.
    """
    place = loop, len(loop.parameters)
    loop.initial.append(graph.constant(start, "i64"))
    loop.parameters.append(graph.make_fresh_node("parameter", "i64", (), loop.body, place))
    loop.results.append(graph.make_fresh_node("result", "i64", (), loop.block, place))
    return loop.parameters[-1]


def _read_bits(graph: Graph, node: Node) -> Node:
    """Return the bits of a number, a real one as an integer."""
    return graph.node("bitcast", INTEGERS[node.type], node) if node.type in REAL else node


def _replace_uses(x: Any, replaced: Mapping[Node, Node]) -> None:
    """Let a node or a statement use the values of `replaced` in the place of its keys."""

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
