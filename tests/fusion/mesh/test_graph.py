"""Graphs of neighbours: tables, graphs of networkx, positions, and who is upstream of whom."""

import numpy as np
import pytest

import heliograph as hg
from heliograph.fusion.mesh import find_upstream_nodes, graph_of


def neighbours_of(table):
    """Names by name, as a fusion has them."""
    return hg.Fusion("f", hg.CovarianceIntersection(), neighbours=table).neighbours


class Drawn:
    """A graph with the methods of networkx that are used."""

    def __init__(self, edges, directed, nodes="abc"):
        self.pairs, self.directed, self.names = edges, directed, nodes

    def edges(self):
        return self.pairs

    def nodes(self):
        return list(self.names)

    def is_directed(self):
        return self.directed


def test_a_table_names_every_node_and_one_that_is_only_received_receives_nobody():
    assert neighbours_of({"a": ["b", "c"]}) == {"a": ("b", "c"), "b": (), "c": ()}


def test_an_edge_of_a_graph_is_both_ways_unless_it_is_directed():
    assert neighbours_of(Drawn([("a", "b")], False)) == {"a": ("b",), "b": ("a",), "c": ()}
    assert neighbours_of(Drawn([("a", "b", {})], True)) == {"a": (), "b": ("a",), "c": ()}


def test_graphs_of_networkx():
    networkx = pytest.importorskip("networkx")
    assert neighbours_of(networkx.path_graph(["a", "b", "c"]))["b"] == ("a", "c")
    assert neighbours_of(networkx.DiGraph([("a", "b")])) == {"a": (), "b": ("a",)}


def test_neighbours_by_position_are_within_the_radius_and_never_the_node_itself():
    near = hg.fusion.neighbours_within({"a": [0.0, 0.0], "b": [3.0, 4.0], "c": [0.0, 6.0]}, 5.0)
    assert near == {"a": ("b",), "b": ("a", "c"), "c": ("b",)}


def test_rows_of_a_graph_are_padded_with_the_node_itself():
    graph = graph_of({"a": ["b", "c"], "b": ["c"], "c": []}, ["a", "b", "c"])
    assert graph.senders.tolist() == [[0, 1, 2], [1, 2, 1], [2, 2, 2]]
    assert graph.present.sum(axis=1).tolist() == [3, 2, 1]
    assert graph.edges.tolist() == [[1, 0], [2, 0], [2, 1]]


def test_upstream_follows_directed_paths():
    graph = graph_of({"a": ["b"], "b": ["a"], "c": ["b"], "d": []}, list("abcd"))
    places = find_upstream_nodes(graph)
    assert [mine.tolist() for mine in places] == [[0, 1], [0, 1], [0, 1, 2], [3]]
    assert places[0] is places[1]


@pytest.mark.parametrize(
    ("value", "line"),
    [
        ({"a": ["a"]}, "neighbours of 'a': expected other nodes"),
        ({"a": ["b", "b"]}, "neighbours of 'a': expected each once"),
        ({"a": [1]}, "neighbours of 'a': expected names"),
        ({"a": "bc"}, "neighbours of 'a': expected a list of names"),
        ({1: ["b"]}, "neighbours: expected a dictionary"),
        ({}, "neighbours: expected at least one node"),
        (3, "neighbours: expected a dictionary"),
    ],
)
def test_bad_neighbours_are_refused_in_a_line(value, line):
    with pytest.raises(ValueError, match=line) as error:
        neighbours_of(value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("positions", "radius", "line"),
    [
        ({}, 1.0, "positions: expected those of some nodes"),
        ({"a": [0.0], "b": [0.0, 1.0]}, 1.0, "positions: expected as many numbers"),
        ({"a": [0.0]}, 0.0, "radius: expected a positive number"),
        ({"a": [np.inf]}, 1.0, "position of 'a': expected finite numbers"),
    ],
)
def test_bad_positions_are_refused_in_a_line(positions, radius, line):
    with pytest.raises(ValueError, match=line):
        hg.fusion.neighbours_within(positions, radius)
