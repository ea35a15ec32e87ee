"""Mappings that never change: equal and hashed by their items, whatever their order."""

import pytest

from heliograph.numerics.frozen import FrozenMapping


def test_equal_items_are_equal_mappings_with_one_hash():
    one, other = FrozenMapping({"a": 1, "b": 2}), FrozenMapping({"b": 2, "a": 1})
    assert one == other == {"a": 1, "b": 2} and hash(one) == hash(other)
    assert one != FrozenMapping({"a": 1}) and list(one) == ["a", "b"]


def test_nothing_is_changed_through_it_or_from_outside():
    items = {"a": 1}
    frozen = FrozenMapping(items)
    items["a"] = 2
    assert frozen["a"] == 1
    with pytest.raises(TypeError):
        frozen["a"] = 3
