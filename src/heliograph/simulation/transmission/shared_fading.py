"""Channels in a run: their draws, and those of memories that several of them may share."""

from collections.abc import Mapping
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.model.channel import Channel
from heliograph.model.over_time import at, stack, structure
from heliograph.numerics.module import Module
from heliograph.numerics.types import PyTree
from heliograph.random_affine.base import AbstractRandomAffine
from heliograph.random_affine.chain import AbstractMemory, unique_memories
from heliograph.random_affine.delay import signal_size
from heliograph.random_affine.memory import draw_with_shared_memories, drop_names, init_with_shared_memories, memories
from heliograph.random_affine.moments.route import apply
from heliograph.simulation.random_keys import (
    CHANNEL,
    CHANNEL_START,
    MEMORY,
    MEMORY_START,
    Number,
    checksum,
    draw_key,
)

Places = jax.Array | np.ndarray | tuple[()]  # uint32, one for each memory of a channel


PLANT = "plant"  # whose memories others may share, with a name or without


def memory_places(channels: Mapping[str, PyTree], plant: PyTree = ()) -> dict[str, np.ndarray]:
    """Places of each channel's memories among all keys: by their names, or by the channel where they have none.

    A channel may be any tree of models, such as a sensor and its channel; what is a memory of the plant's too is that.

    Raises:
        ValueError: one name for memories that differ.
    """
    of_plant = {identity: i for i, identity in enumerate(memories(plant))}
    _ = memories((plant, tuple({id(c): c for c in channels.values()}.values())))
    held = {id(channel): memories(channel) for channel in {id(c): c for c in channels.values()}.values()}
    unique_memories(memory for by_identity in held.values() for memory in by_identity.values())
    return {
        name: np.array(
            [
                checksum(_place_of(memory, i, name, of_plant))
                for i, (identity, memory) in enumerate(by_identity.items())
            ],
            dtype=np.uint32,
        )
        for name, by_identity in ((name, held[id(channel)]) for name, channel in channels.items())
    }


def _place_of(memory: AbstractMemory, i: int, name: str, of_plant: Mapping[str, int]) -> str:
    """Return what a memory's draws are seeded by: its name, the plant's number of it, or the channel's."""
    if memory.name is not None:
        return memory.identity
    if memory.identity in of_plant:
        return f"{PLANT}\tmemory {of_plant[memory.identity]}"
    return f"memory {i} of {name}"


class ChannelGroup(Module):
    """Channels of one structure, stacked; checksums of their names and of their memories, and their places among all.

    Shapes: checksums (channel,), memories (channel, memories of each), places (channel,).
    """

    channel: Channel
    checksums: np.ndarray
    memories: np.ndarray
    places: np.ndarray


def channel_groups(channels: Mapping[str, Channel]) -> tuple[ChannelGroup, ...]:
    """Stack channels by structure, names of memories aside; a group has one copy of each channel, and rows by name."""
    listed, memories = list(channels.values()), list(memory_places(channels).values())
    checksums = np.array([checksum(name) for name in channels], dtype=np.uint32)
    # Of each structure its channels, by identity: one object under many names is looked at once.
    kinds = {id(channel): drop_names(channel) for channel in {id(c): c for c in listed}.values()}
    alike: dict[object, dict[int, int]] = {}
    for which, kind in kinds.items():
        same = alike.setdefault(structure(kind), {})
        same[which] = len(same)
    # A group for each structure: its channels stacked, then one row for each name that has one of them.
    groups = []
    for same in alike.values():
        places = np.array([e for e, channel in enumerate(listed) if id(channel) in same])
        rows = np.array([same[id(listed[e])] for e in places])
        kind = stack([kinds[which] for which in same])
        channel = jax.tree.map(lambda leaf, rows=rows: leaf[rows] if eqx.is_array(leaf) else leaf, kind)
        groups.append(ChannelGroup(channel, checksums[places], np.stack([memories[e] for e in places]), places))
    return tuple(groups)


class Late(NamedTuple):
    """State of a late channel, and the signals sent before, the last first."""

    channel: PyTree
    line: jax.Array


def start(channel: Channel, key: jax.Array, source: Number, shared: Places) -> PyTree:
    """Return a channel's state before the first step."""
    now, link_key = at(channel, 0), draw_key(key, 0, source, CHANNEL_START)
    keys = [draw_key(key, 0, memory, MEMORY_START) for memory in shared]
    state = init_with_shared_memories(now, link_key, keys) if len(shared) else now.init(link_key)
    return Late(state, jnp.zeros(now.past * signal_size(now))) if now.past else state


def start_modes(models: PyTree, key: jax.Array, shared: Places) -> tuple[jax.Array, ...]:
    """Return the states of the memories of a plant or sensor at the first step."""
    held = memories(models).values()
    return tuple(m.begin(draw_key(key, 0, place, MEMORY_START)) for m, place in zip(held, shared, strict=True))


def move_modes(
    models: PyTree, states: tuple[jax.Array, ...], key: jax.Array, k: jax.Array, shared: Places
) -> tuple[jax.Array, ...]:
    """Return the states of the memories of a plant or sensor at the step after k; of one place, they move alike."""
    held = memories(models).values()
    moves = zip(held, states, shared, strict=True)
    return tuple(m.move(state, draw_key(key, k, place, MEMORY)) for m, state, place in moves)


def deliver(
    channel: Channel, state: PyTree, y: jax.Array, key: jax.Array, k: jax.Array, source: Number, shared: Places
) -> tuple[PyTree, jax.Array]:
    """Draw the channel at step k and apply it to y, a late one to past signals too: next state and output."""
    now, link_key = at(channel, k), draw_key(key, k, source, CHANNEL)
    if now.past:
        line = jnp.concatenate([y, state.line])
        after, h = _advance_memory(now, state.channel, key, k, link_key, shared)
        return Late(after, line[: -len(y)]), apply(h, line)
    state, h = _advance_memory(now, state, key, k, link_key, shared)
    return state, apply(h, y)


def _advance_memory(
    now: AbstractRandomAffine, state: PyTree, key: jax.Array, k: jax.Array, link_key: jax.Array, shared: Places
) -> tuple[PyTree, jax.Array]:
    if not len(shared):
        return now.draw(state, link_key)
    return draw_with_shared_memories(now, state, link_key, [draw_key(key, k, memory, MEMORY) for memory in shared])
