"""Graphs of nodes that estimate from their neighbours' messages: who receives whom, and whom through others."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np

from heliograph.numerics.check import array, fail, items, scalar, show_value, table
from heliograph.numerics.types import ArrayLike, Bool, Float, Int


@runtime_checkable
class GraphLike(Protocol):
    """A graph as networkx has it: `edges()` yields pairs of names, sender first where it `is_directed()`."""

    def edges(self) -> Iterable[Any]:
        """Return the edges as pairs of node names, sender first if the graph is directed."""

    def nodes(self) -> Iterable[Any]:
        """Return the names of the nodes."""

    def is_directed(self) -> bool:
        """Return whether an edge leads one way only, from its first node to its second."""


FEW = 64  # up to so many nodes the rows are not divided
PARTS = (0.4, 0.75, 0.95, 1.0)  # quantiles of the numbers of neighbours at which the rows are divided
Neighbours = Mapping[str, Sequence[str]] | GraphLike


class Graph(NamedTuple):
    """Neighbours by place, in rows of one length: each node itself, those it receives, then itself again as padding.

    There is a row for each of the nodes, or for some of them.

    Shapes: senders (node, degree), present (node, degree): False for padding.
    """

    nodes: tuple[str, ...]
    senders: Int[np.ndarray, "node degree"]
    present: Bool[np.ndarray, "node degree"]

    @property
    def edges(self) -> Int[np.ndarray, "edge 2"]:
        """Indices (sender, receiver) of every edge, sorted by receiver; a node's own entry is no edge."""
        receiver, column = np.nonzero(self.present[:, 1:])  # column 0 is the node itself
        sender = self.senders[receiver, column + 1]
        return np.stack([sender, receiver], axis=1)

    def buckets(self) -> "list[Graph]":
        """Return the rows divided by their numbers of neighbours, those with few first, with less padding.

        Arithmetic on a row costs up to the cube of its padded length, and a graph has few long rows. The longest row of
        each part is at one of the quantiles PARTS. A graph of up to FEW nodes stays as it is.
        """
        counts = self.present.sum(axis=1)  # of neighbours, the node itself included
        widths = {counts.max()}  # padded lengths of the parts' rows
        if len(counts) > FEW:
            widths = {int(width) for width in np.quantile(counts, PARTS, method="higher")}
        parts, width_before = [], 0
        for width in sorted(widths):
            rows = np.flatnonzero((counts > width_before) & (counts <= width))
            parts.append(Graph(self.nodes, self.senders[rows, :width], self.present[rows, :width]))
            width_before = width
        return parts


def neighbours_of(value: object) -> dict[str, tuple[str, ...]]:
    """Return for each node the checked names of the nodes whose messages it receives.

    Args:
        value: a table {node: names of its senders}, or a networkx graph, whose edges go from sender to receiver, or
            both ways without direction.

    Raises:
        ValueError: neither of them, names that are no texts, a node as its own neighbour, or a neighbour twice.
    """
    senders_by_node = _list_senders(value) if isinstance(value, GraphLike) else value
    expected = "names of those whom a node receives (or a networkx graph of names)"
    unchecked = table("neighbours", senders_by_node, expected)
    results = {name: _check_senders(name, senders) for name, senders in unchecked.items()}
    # A sender without an entry of its own receives nobody.
    for senders in list(results.values()):
        for sender in senders:
            results.setdefault(sender, ())
    if not results:
        raise fail("neighbours", "at least one node", "none")
    return results


def _list_senders(graph: GraphLike) -> dict[Any, list[Any]]:
    """Return for each node of a networkx graph the nodes from which an edge leads to it.

    An edge is a pair (sender, receiver); without direction, it leads both ways.
    """
    pairs = [tuple(pair[:2]) for pair in graph.edges()]
    if not graph.is_directed():
        pairs += [pair[::-1] for pair in pairs]
    senders: dict[Any, list[Any]] = {name: [] for name in graph.nodes()}
    for sender, receiver in pairs:
        senders[receiver].append(sender)
    return senders


def _check_senders(name: str, value: object) -> tuple[str, ...]:
    """Return the names of a node's senders; raise ValueError unless they are texts, distinct and not its own."""
    what = f"neighbours of {name!r}"
    senders = tuple(items(what, value, "names"))
    no_names = [sender for sender in senders if not isinstance(sender, str)]
    if no_names:
        raise fail(what, "names", show_value(no_names[0]))
    if name in senders:
        raise fail(what, "other nodes (a node has its own message anyway)", repr(name))
    if len(set(senders)) < len(senders):
        repeated = sorted({sender for sender in senders if senders.count(sender) > 1})
        raise fail(what, "each once", f"{repeated} more than once")
    return senders


def neighbours_within(
    positions: Mapping[str, Float[ArrayLike, " axes"]], radius: Float[ArrayLike, ""]
) -> dict[str, tuple[str, ...]]:
    """Return the neighbours of nodes at these positions: every other node at most `radius` away.

    Args:
        positions: by node (axes,), in the unit of the radius.
        radius: reach of a message, positive.

    Returns:
        Names of the neighbours by node, in the order of the positions: for `Fusion(..., neighbours=...)`.

    Raises:
        ValueError: no positions, positions of several lengths, a radius that is not positive.
    """
    # Positions (nodes, axes), all of one length.
    given = table("positions", positions, "positions of nodes")
    reach = float(scalar("radius", radius, np.finfo(float).tiny))
    if not given:
        raise fail("positions", "those of some nodes", "none")
    rows = [array(f"position of {name!r}", position, ("axes",)) for name, position in given.items()]
    if len({len(row) for row in rows}) > 1:
        raise fail("positions", "as many numbers for each node", sorted({len(row) for row in rows}))
    names = list(given)
    from scipy.spatial import cKDTree  # imported here, since it takes 40 ms

    # The unit is a power of two, which changes no digit, and in which no square leaves the range of numbers: the
    # largest coordinate is between 1 and 2. No two points are 4 (1 + axes) apart then: a longer reach is cut to that.
    points = np.array(rows)
    largest = np.abs(points).max(initial=0.0)
    _mantissa, exponent = np.frexp(largest)
    unit = 2.0 ** (int(exponent) - 1) if largest else 1.0
    reach_in_units = min(reach / unit, 4.0 * (1 + points.shape[1]))
    near = cKDTree(points / unit).query_ball_point(points / unit, reach_in_units)  # numbers of nodes, by node
    return {
        name: tuple(names[j] for j in sorted(numbers) if j != i)
        for i, (name, numbers) in enumerate(zip(names, near, strict=True))
    }


def graph_of(neighbours: Mapping[str, Sequence[str]], nodes: Sequence[str]) -> Graph:
    """Return the graph of these nodes with names replaced by indices; all neighbours are among the nodes.

    A row (degree,) has the index of the node itself, those of the nodes it receives, and then its own as padding, which
    `present` marks False.
    """
    index = {name: i for i, name in enumerate(nodes)}
    rows = [[i, *(index[sender] for sender in neighbours[name])] for i, name in enumerate(nodes)]
    lengths = np.array([len(row) for row in rows])
    degree = max(map(len, rows))
    senders = np.array([row + [row[0]] * (degree - len(row)) for row in rows])
    present = np.arange(degree) < lengths[:, None]
    return Graph(tuple(nodes), senders, present)


def find_upstream_nodes(graph: Graph) -> list[Int[np.ndarray, " senders"]]:
    """Return, for each node, the indices of the nodes from which a directed path leads to it, itself included.

    Nodes that are reached from the same ones, as those of one strongly connected component, share one array.
    """
    count = len(graph.nodes)
    senders = [row[present].tolist() for row, present in zip(graph.senders, graph.present, strict=True)]
    # Bit j of sources[i]: a path leads from j to i. Each takes its senders' bits, until nothing is added.
    sources, before = [1 << i for i in range(count)], list[int]()
    while sources != before:
        before = list(sources)
        for i in (*range(count), *reversed(range(count))):
            for sender in senders[i]:
                sources[i] |= sources[sender]
    # The indices of the bits that are set, once for each set of them.
    as_bytes = {bits: np.frombuffer(bits.to_bytes(count // 8 + 1, "little"), np.uint8) for bits in set(sources)}
    indices = {bits: np.flatnonzero(np.unpackbits(row, bitorder="little")) for bits, row in as_bytes.items()}
    return [indices[bits] for bits in sources]
