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
    """A model whose law at each step depends on the state of its `memory`: a Markov chain's mode, a drifting gain."""

    memory: eqx.AbstractVar[AbstractMemory]

    def given(self, state: int | float | jax.Array | np.ndarray) -> Any:
        """Return the model that this one is while its memory has this state; it has no memory itself."""
        raise unwritten(self, "given")


def select_model_of_equal_structure(models: Sequence[T], state: jax.Array) -> T | None:
    """Return the model of mode `state` out of `models`, one for each mode, or None if they differ in structure.

    `state` is traced by JAX, so that it cannot choose an object. It chooses each number among those of all models.
    """
    leaves, trees = zip(*(jax.tree.flatten(model) for model in models), strict=True)
    if any(not eqx.is_array_like(leaf) for of_mode in leaves for leaf in of_mode):
        return None
    shapes = {tuple(np.shape(leaf) for leaf in of_mode) for of_mode in leaves}
    if len(set(trees)) > 1 or len(shapes) > 1:
        return None
    leaves_by_place = [jnp.stack([jnp.asarray(leaf) for leaf in of_modes]) for of_modes in zip(*leaves, strict=True)]
    present: T = jax.tree.unflatten(trees[0], [of_modes[state] for of_modes in leaves_by_place])
    return present


class ChannelState(NamedTuple):
    """State of a channel that remembers.

    memories: state of each of its memories, in the order of `memories(channel)`. rest: state of the map that the
    channel is given these states; () if that map is independent over time.
    """

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

    The state holds the states of all memories in the channel, and in `rest` the channel's own state given these.
    """
    rest_of_channel, matrix = condition_on_memories(channel, state.memories).draw(state.rest, key)
    triples = zip(memories(channel).values(), state.memories, keys, strict=True)
    next_memories = tuple(memory.move(memory_state, memory_key) for memory, memory_state, memory_key in triples)
    return ChannelState(next_memories, rest_of_channel), matrix


def memories(channel: PyTree) -> dict[str, AbstractMemory]:
    """Return the memories on which the maps in a channel (or in any tree of models) depend, in order of appearance.

    The key is the memory's identity, a text. Maps whose memories have one identity share one state, so that such a
    memory is listed once.
    """
    parts = jax.tree.leaves(channel, is_leaf=is_memory_dependent)
    return unique_memories(leaf.memory for leaf in parts if is_memory_dependent(leaf))


def condition_on_memories(channel: T, states: Sequence[int | float | jax.Array | np.ndarray]) -> T:
    """Return the map given the `states` of its `memories`, in their order: a map without memory of modes."""
    return condition_on_states(channel, dict(zip(memories(channel), states, strict=True)))


def condition_on_states(channel: T, by_identity: Mapping[str, int | float | jax.Array | np.ndarray]) -> T:
    """Return the map, or tree of maps, given the states of its memories: a map without memory of modes.

    `by_identity` holds the state of each memory by its identity, and may hold states of other memories too.
    """

    def condition(leaf: PyTree) -> PyTree:
        """Return a map with a memory given the memory's state; return anything else unchanged."""
        return leaf.given(by_identity[leaf.memory.identity]) if is_memory_dependent(leaf) else leaf

    memoryless: T = jax.tree.map(condition, channel, is_leaf=is_memory_dependent)
    return memoryless


def is_memory_dependent(leaf: object) -> bool:
    """Return True for a map whose law depends on the state of a memory."""
    return isinstance(leaf, AbstractWithMemory)


def drop_names(channel: T) -> T:
    """Return a map whose memories are called 0, 1, ... in order, so that maps that differ in names alone look alike."""
    by_identity = memories(channel)
    renamed = {identity: memory.labelled(str(i)) for i, (identity, memory) in enumerate(by_identity.items())}
    return replace_memories(channel, renamed)


def number_unnamed_memories(model: T) -> T:
    """Return the model with its unnamed memories identified by numbers instead of random texts.

    The identity of a memory is the text by which maps share it; without a name it is random. So models that differ only
    in these texts become equal.
    """
    numbered = enumerate(memories(model).items())
    labelled = {key: memory.labelled(f"unnamed {i}") for i, (key, memory) in numbered if memory.name is None}
    return replace_memories(model, labelled)


def separate_memories(maps: Sequence[T]) -> list[T]:
    """Return maps that share no unnamed memory: a memory that is in several maps is copied for each.

    Named memories stay shared. The first map keeps its memories. Later maps get copies, labelled by the map's index.
    """
    separated, used_identities = [], set[str]()
    for index, affine in enumerate(maps):
        memories_of_map = memories(affine)
        shared = {
            key: memory for key, memory in memories_of_map.items() if memory.name is None and key in used_identities
        }
        labelled = {key: memory.labelled(f"{key} of {index}") for key, memory in shared.items()}
        separated.append(replace_memories(affine, labelled))
        used_identities |= set(memories_of_map)
    return separated


def align_memories_over_time(maps: Sequence[T]) -> list[T]:
    """Return the maps of all steps such that the state of each memory goes on from step to step.

    Memories share a state if they have the same identity, a text. So each memory without a name gets the identity of
    its counterpart in the first step, in order of appearance. If the first map has no memory, or if steps have
    different numbers of memories, the maps are returned unchanged.
    """
    memories_by_map = [memories(affine) for affine in maps]
    if not memories_by_map[0] or len({len(memories_of_map) for memories_of_map in memories_by_map}) > 1:
        return list(maps)
    aligned = []
    for affine, memories_of_map in zip(maps, memories_by_map, strict=True):
        labelled = {
            key: memory.labelled(label)
            for (key, memory), label in zip(memories_of_map.items(), memories_by_map[0], strict=True)
            if memory.name is None
        }
        aligned.append(replace_memories(affine, labelled))
    return aligned


def replace_memories(channel: T, replacements: Mapping[str, AbstractMemory]) -> T:
    """Return the map with some memories replaced: `replacements` has the new memory by the identity of the old one."""

    def replace(leaf: PyTree) -> PyTree:
        """Return a model with its memory replaced, if a new one is given; return anything else unchanged."""
        if not is_memory_dependent(leaf) or leaf.memory.identity not in replacements:
            return leaf
        return eqx.tree_at(lambda m: m.memory, leaf, replacements[leaf.memory.identity])

    replaced: T = jax.tree.map(replace, channel, is_leaf=is_memory_dependent) if replacements else channel
    return replaced
