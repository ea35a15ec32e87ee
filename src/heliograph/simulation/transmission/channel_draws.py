"""Channels in a run: their draws, and those of memories that several of them may share.

Draws depend on the run's key, the step and a number: a checksum of the channel's name, or of its memory's. Memories
with one number have the same draws, so that they are one memory. `shared` in arguments: these numbers of a model's
memories.
"""

from collections.abc import Mapping
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.model.channel import Channel
from heliograph.model.over_time import at, stack, structure_key
from heliograph.numerics.module import Module
from heliograph.numerics.types import PyTree
from heliograph.random_affine.base import AbstractRandomAffine
from heliograph.random_affine.delay import signal_size
from heliograph.random_affine.markov_chain_and_autoregression import AbstractMemory, unique_memories
from heliograph.random_affine.memories_of_channels import (
    draw_with_shared_memories,
    drop_names,
    init_with_shared_memories,
    memories,
)
from heliograph.random_affine.moments.signal_path import apply
from heliograph.simulation.random_keys import (
    CHANNEL,
    CHANNEL_START,
    MEMORY,
    MEMORY_START,
    Number,
    checksum,
    draw_key,
)

MemoryNumbers = jax.Array | np.ndarray | tuple[()]  # uint32, one for each memory of a channel

PLANT = "plant"  # whose memories others may share, with a name or without


def number_memory_seeds(channels: Mapping[str, PyTree], plant: PyTree = ()) -> dict[str, np.ndarray]:
    """Return for each channel the numbers that seed the draws of its memories, such as fading.

    Shared memories have equal numbers. A number comes from the memory's name, or from the channel's if it has none.

    Args:
        channels: channels by name; each may be any tree of models, such as a sensor and its channel.
        plant: the plant; a memory that it has too is seeded as the plant's.

    Raises:
        ValueError: memories that differ have one name.
    """
    of_plant = {identity: i for i, identity in enumerate(memories(plant))}
    # One object under many names is looked at once.
    channel_by_id = {id(channel): channel for channel in channels.values()}
    memories((plant, tuple(channel_by_id.values())))  # raises if memories that differ have one name
    memories_of = {key: memories(channel) for key, channel in channel_by_id.items()}
    unique_memories(memory for by_identity in memories_of.values() for memory in by_identity.values())  # raises too
    numbers = {}
    for name, channel in channels.items():
        of_channel = memories_of[id(channel)].values()
        sources = [_name_source(memory, i, name, of_plant) for i, memory in enumerate(of_channel)]
        numbers[name] = np.array([checksum(source) for source in sources], dtype=np.uint32)
    return numbers


def _name_source(memory: AbstractMemory, i: int, name: str, of_plant: Mapping[str, int]) -> str:
    """Return the name that seeds a memory's draws: the memory's own, or one by the plant, or one by the channel.

    `i`: number of the memory in the channel `name`. `of_plant`: numbers of the plant's memories, by identity.
    """
    if memory.name is not None:
        return memory.identity
    if memory.identity in of_plant:
        return f"{PLANT}\tmemory {of_plant[memory.identity]}"
    return f"memory {i} of {name}"


class ChannelGroup(Module):
    """Channels of one structure, stacked.

    Args:
        channel: the stack, with a leading axis of channels.
        checksums: of their names (channel,), which seed their draws.
        memories: numbers that seed the draws of their memories (channel, memory).
        indices: of each among all channels (channel,).
    """

    channel: Channel
    checksums: np.ndarray
    memories: np.ndarray
    indices: np.ndarray


def group_channels(channels: Mapping[str, Channel]) -> tuple[ChannelGroup, ...]:
    """Return the channels by structure: those of one are stacked, with a row for each name.

    Channels of one structure differ in numbers alone, so that one vectorised program draws what they deliver. Names of
    memories (which links share what they remember) do not matter to the structure. `channels`: channels by the name
    that seeds their draws.
    """
    # Of each channel: the numbers that seed its memories, and the checksum of its name, which seeds its draws.
    listed, memories = list(channels.values()), list(number_memory_seeds(channels).values())
    checksums = np.array([checksum(name) for name in channels], dtype=np.uint32)
    # Rows of each structure's channels, by the objects' identities: one object under many names is stacked once.
    unnamed = {identity: drop_names(channel) for identity, channel in {id(c): c for c in listed}.items()}
    rows_by_structure: dict[object, dict[int, int]] = {}
    for identity, channel in unnamed.items():
        row_of = rows_by_structure.setdefault(structure_key(channel), {})
        row_of[identity] = len(row_of)
    # A group for each structure: its channels stacked, then one row for each name that has one of them.
    groups = []
    for row_of in rows_by_structure.values():
        indices = np.array([i for i, channel in enumerate(listed) if id(channel) in row_of])
        rows = np.array([row_of[id(listed[i])] for i in indices])
        stacked = stack([unnamed[identity] for identity in row_of])
        channel = jax.tree.map(lambda leaf, rows=rows: leaf[rows] if eqx.is_array(leaf) else leaf, stacked)
        groups.append(
            ChannelGroup(
                channel=channel,
                checksums=checksums[indices],
                memories=np.stack([memories[i] for i in indices]),
                indices=indices,
            )
        )
    return tuple(groups)


class LateChannelState(NamedTuple):
    """State of a late channel: of the `channel` itself, and the `line` of signals sent before, the last first."""

    channel: PyTree
    line: jax.Array


def start_channel(channel: Channel, key: jax.Array, source: Number, shared: MemoryNumbers) -> PyTree:
    """Return a channel's state before the first step of the run with this key.

    The state has that of the channel's memories, such as fading or a Markov chain of losses. A channel that delivers
    late also keeps the signals of its last `past` steps, which are zeros here.

    Args:
        channel: a link, or one for each step.
        key: key of the run.
        source: number that seeds the link's own draws.
        shared: numbers that seed the draws of its memories, one for each: links with a memory of one number share it.
    """
    link, link_key = at(channel, k=0), draw_key(key, k=0, source=source, purpose=CHANNEL_START)
    keys = [draw_key(key, k=0, source=memory, purpose=MEMORY_START) for memory in shared]
    state = init_with_shared_memories(link, link_key, keys) if len(shared) else link.init(link_key)
    past_signals = jnp.zeros(link.past * signal_size(link))
    return LateChannelState(state, past_signals) if link.past else state


def start_modes(models: PyTree, key: jax.Array, shared: MemoryNumbers) -> tuple[jax.Array, ...]:
    """Return the states (modes) of the memories of a plant or sensor at the first step of the run with this key.

    A memory is a state that is random over time, such as a Markov chain of modes. `shared`: the numbers that seed their
    draws; memories of one number begin alike.
    """
    states = []
    for memory, number in zip(memories(models).values(), shared, strict=True):
        states.append(memory.begin(draw_key(key, k=0, source=number, purpose=MEMORY_START)))
    return tuple(states)


def move_modes(
    models: PyTree, states: tuple[jax.Array, ...], key: jax.Array, k: jax.Array, shared: MemoryNumbers
) -> tuple[jax.Array, ...]:
    """Return the states of the memories (modes) of a plant or sensor at the step after k, drawn with the run's key.

    `shared`: the numbers that seed their draws. Memories with one number move alike.
    """
    after = []
    for memory, state, number in zip(memories(models).values(), states, shared, strict=True):
        after.append(memory.move(state, draw_key(key, k, number, MEMORY)))
    return tuple(after)


def deliver_signal(
    channel: Channel, state: PyTree, y: jax.Array, key: jax.Array, k: jax.Array, source: Number, shared: MemoryNumbers
) -> tuple[PyTree, jax.Array]:
    """Draw a channel z = G y + n at step k: return its next state, and what it delivers of y.

    Args:
        channel: a link, or one for each step.
        state: of its memories (states that are random over time, such as fading); of a late link also past signals.
        y: signal of this step.
        key: of the run.
        k: number of the step.
        source: number that seeds the link's own draws.
        shared: numbers that seed the draws of its memories, which other links may share.
    """
    link, link_key = at(channel, k), draw_key(key, k, source, CHANNEL)
    # `matrix` is the drawn [G n; 0 1].
    if link.past:
        # A late link has G for y and the signals before it, the latest first; `line` holds these signals.
        signals = jnp.concatenate([y, state.line])
        memory, matrix = _draw_link(link, state.channel, key, k, link_key, shared)
        return LateChannelState(memory, signals[: -len(y)]), apply(matrix, signals)
    memory, matrix = _draw_link(link, state, key, k, link_key, shared)
    return memory, apply(matrix, y)


def _draw_link(
    link: AbstractRandomAffine, state: PyTree, key: jax.Array, k: jax.Array, link_key: jax.Array, shared: MemoryNumbers
) -> tuple[PyTree, jax.Array]:
    """Return a link's next state, and its matrix [G n; 0 1] drawn at step k.

    `shared`: the numbers that seed the draws of its memories, each with a key of its own. `link_key`: the key of all
    other draws.
    """
    if not len(shared):
        return link.draw(state, link_key)
    memory_keys = [draw_key(key, k, number, MEMORY) for number in shared]
    return draw_with_shared_memories(link, state, link_key, memory_keys)
