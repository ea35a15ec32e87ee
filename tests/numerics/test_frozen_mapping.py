"""Mappings that never change: equal and hashed by their items, whatever their order."""

import pytest

import heliograph as hg

PLANT, SENSOR = hg.LinearPlant([[0.9]], 0.1, [0.0], 1.0), hg.LinearSensor([[1.0]], 0.1)
NODE = hg.Node(SENSOR, hg.perfect(), {"f": hg.kalman_filter(PLANT, SENSOR)})


def claimed(nodes):
    """Claims by node and filter, which a network holds in such a mapping."""
    return hg.Network(PLANT, nodes).claimed


def test_equal_items_are_equal_mappings_with_one_hash():
    one, other = claimed({"a": NODE, "b": NODE}), claimed({"b": NODE, "a": NODE})
    assert one == other == {("a", "f"): "exact", ("b", "f"): "exact"} and hash(one) == hash(other)
    assert one != claimed({"a": NODE}) and list(one) == [("a", "f"), ("b", "f")]


def test_nothing_is_changed_through_it_or_from_outside():
    nodes = {"a": NODE}
    frozen = claimed(nodes)
    nodes["b"] = NODE
    assert dict(frozen) == {("a", "f"): "exact"}
    with pytest.raises(TypeError):
        frozen["a", "f"] = "upper"
