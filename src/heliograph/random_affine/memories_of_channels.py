"""Memories (modes, drifting gains) of channels: list them, condition a channel on their states, replace them."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.numerics.module import Module, unwritten
from heliograph.numerics.types import PyTree
from heliograph.random_affine.markov_chain_and_autoregression import AbstractMemory, unique_memories

T = TypeVar("T")


class AbstractWithMemory(Module):
    """Whatever has a law at each step that depends on the state of a memory."""

    memory: eqx.AbstractVar[AbstractMemory]

    def given(self, state: int | float | jax.Array | np.ndarray) -> Any:
        """Return the same without memory, for this state of the memory."""
        raise unwritten(self, "given")


def select_model_of_equal_structure(models: Sequence[T], state: jax.Array) -> T | None:
    """Return the model of a mode, with its numbers, of models (one a mode) that differ in numbers alone; else None.

    `state`: the number of the mode, which is traced by JAX, so that no model can be chosen by it: its numbers are.
    """
    leaves, trees = zip(*(jax.tree.flatten(model) for model in models), strict=True)
    if any(not eqx.is_array_like(leaf) for of_mode in leaves for leaf in of_mode):
        return None
    shapes = {tuple(np.shape(leaf) for leaf in of_mode) for of_mode in leaves}
    if len(set(trees)) > 1 or len(shapes) > 1:
        return None
    numbers = [jnp.stack([jnp.asarray(leaf) for leaf in same])[state] for same in zip(*leaves, strict=True)]
    present: T = jax.tree.unflatten(trees[0], numbers)
    return present


class ChannelState(NamedTuple):
    """State of a channel: of its memories, in order of appearance, and of the map given them."""

    memories: tuple[jax.Array, ...]
    rest: PyTree[jax.Array]


def init_with_shared_memories(channel: Any, key: jax.Array, keys: Sequence[jax.Array]) -> ChannelState:
    """Draw a channel's state before the first draw: each of its memories by one of `keys`, then the rest by `key`."""
    states = tuple(m.begin(k) for m, k in zip(memories(channel).values(), keys, strict=True))
    return ChannelState(states, condition_on_memories(channel, states).init(key))


def draw_with_shared_memories(
    channel: Any, state: ChannelState, key: jax.Array, keys: Sequence[jax.Array]
) -> tuple[ChannelState, jax.Array]:
    """Draw H by `key` given the memories' states, and move each memory by one of `keys`; return the new state and H.

    The state: those of all memories in a channel, and the `rest`, that of the channel given these.
    """
    rest, h = condition_on_memories(channel, state.memories).draw(state.rest, key)
    held = memories(channel).values()
    return ChannelState(tuple(m.move(s, k) for m, s, k in zip(held, state.memories, keys, strict=True)), rest), h


def memories(channel: PyTree) -> dict[str, AbstractMemory]:
    """Return the memories on which the modes of a map (or of all maps in a tree) depend, by identity, in order."""
    parts = jax.tree.leaves(channel, is_leaf=is_memory_dependent)
    return unique_memories(leaf.memory for leaf in parts if is_memory_dependent(leaf))


def condition_on_memories(channel: T, states: Sequence[int | float | jax.Array | np.ndarray]) -> T:
    """Return the map without memory that a map is for these states of its `memories`, put together in the same way."""
    return condition_on_states(channel, dict(zip(memories(channel), states, strict=True)))


def condition_on_states(channel: T, by_identity: Mapping[str, int | float | jax.Array | np.ndarray]) -> T:
    """Return the map, or tree of maps, without memory that it is for these states of its memories.

    `by_identity`: the state of each memory by its identity; states of other memories may be among them.
    """

    def condition(leaf: PyTree) -> PyTree:
        """Return a map with a memory as that of the memory's state (`by_identity`), anything else as it is."""
        return leaf.given(by_identity[leaf.memory.identity]) if is_memory_dependent(leaf) else leaf

    memoryless: T = jax.tree.map(condition, channel, is_leaf=is_memory_dependent)
    return memoryless


def is_memory_dependent(leaf: object) -> bool:
    """Return True for a map whose law depends on the state of a memory."""
    return isinstance(leaf, AbstractWithMemory)


def drop_names(channel: T) -> T:
    """Return a map whose memories are called 0, 1, ... in order, so that maps that differ in names alone look alike."""
    held = memories(channel)
    return replace_memories(channel, {key: memory.labelled(str(i)) for i, (key, memory) in enumerate(held.items())})


def number_unnamed_memories(model: T) -> T:
    """Return the model with its unnamed memories identified by their number, in place of random texts.

    So models that differ in these texts alone look alike.
    """
    held = enumerate(memories(model).items())
    twins = {key: memory.labelled(f"unnamed {i}") for i, (key, memory) in held if memory.name is None}
    return replace_memories(model, twins)


def separate_memories(maps: Sequence[T]) -> list[T]:
    """Return maps that share no unnamed memory: one that stands in several of them becomes one of each.

    Named memories stay shared. The first map keeps its memories; later ones get copies, labelled by their index.
    """
    separate, taken = [], set[str]()
    for index, affine in enumerate(maps):
        held = memories(affine)
        twins = {key: m.labelled(f"{key} of {index}") for key, m in held.items() if m.name is None and key in taken}
        separate.append(replace_memories(affine, twins))
        taken |= set(held)
    return separate


def align_memories_over_time(maps: Sequence[T]) -> list[T]:
    """Return the maps of all steps, with unnamed memories identified as the first step's, by order of appearance.

    So they go on from step to step. Maps as they are where the first has no memory, or steps have different counts.
    """
    by_map = [memories(affine) for affine in maps]
    if not by_map[0] or len({len(held) for held in by_map}) > 1:
        return list(maps)
    labels = [
        {key: m.labelled(label) for (key, m), label in zip(held.items(), by_map[0], strict=True) if m.name is None}
        for held in by_map
    ]
    return [replace_memories(affine, twins) for affine, twins in zip(maps, labels, strict=True)]


def replace_memories(channel: T, twins: Mapping[str, AbstractMemory]) -> T:
    """Return the map with other memories in place of its own; `twins`: the other memory by the identity of its own."""

    def replace(leaf: PyTree) -> PyTree:
        """Return a map with the other memory (`twins`, by identity) in place of its own, anything else as it is."""
        if not is_memory_dependent(leaf) or leaf.memory.identity not in twins:
            return leaf
        return eqx.tree_at(lambda m: m.memory, leaf, twins[leaf.memory.identity])

    exchanged: T = jax.tree.map(replace, channel, is_leaf=is_memory_dependent) if twins else channel
    return exchanged
