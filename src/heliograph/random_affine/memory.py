"""Memories of several maps told apart, or made one and the same."""

from collections.abc import Mapping, Sequence
from typing import TypeVar

import equinox as eqx
import jax

from heliograph.numerics.types import PyTree
from heliograph.random_affine.base import is_modal, memories
from heliograph.random_affine.chain import AbstractMemory

T = TypeVar("T")


def drop_names(channel: T) -> T:
    """The map with its memories called 0, 1, ... in order of appearance: maps that share no others then look alike."""
    held = memories(channel)
    return replace_memories(channel, {key: memory.labelled(str(i)) for i, (key, memory) in enumerate(held.items())})


def separate_memories(maps: Sequence[T]) -> list[T]:
    """Return maps that share no unnamed memory: one that stands in several of them becomes one of each."""
    apart, taken = [], set[str]()
    for index, affine in enumerate(maps):
        held = memories(affine)
        again = {key: m.labelled(f"{key} of {index}") for key, m in held.items() if m.name is None and key in taken}
        apart.append(replace_memories(affine, again))
        taken |= set(held)
    return apart


def align_memories_over_time(maps: Sequence[T]) -> list[T]:
    """Return the maps of later steps with the unnamed memories of the first step, in order of appearance."""
    by_map = [memories(affine) for affine in maps]
    if not by_map[0] or len({len(held) for held in by_map}) > 1:
        return list(maps)
    labels = [
        {key: m.labelled(label) for (key, m), label in zip(held.items(), by_map[0], strict=True) if m.name is None}
        for held in by_map
    ]
    return [replace_memories(affine, twins) for affine, twins in zip(maps, labels, strict=True)]


def replace_memories(channel: T, twins: Mapping[str, AbstractMemory]) -> T:
    """The map with other memories in place of those of these identities."""

    def replaced(leaf: PyTree) -> PyTree:
        if not is_modal(leaf) or leaf.memory.identity not in twins:
            return leaf
        return eqx.tree_at(lambda m: m.memory, leaf, twins[leaf.memory.identity])

    exchanged: T = jax.tree.map(replaced, channel, is_leaf=is_modal) if twins else channel
    return exchanged
