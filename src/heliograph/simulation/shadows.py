"""Channels in a run: their draws, and those of the memories that several of them may share."""

from collections.abc import Mapping

import jax
import numpy as np
from jaxtyping import PyTree

from heliograph.model.channel import Channel
from heliograph.model.over_time import at
from heliograph.random_affine.base import advance, apply, begin, memories
from heliograph.simulation.draws import (
    CHANNEL,
    CHANNEL_START,
    MEMORY,
    MEMORY_START,
    Number,
    checksum,
    draw_key,
)

Places = jax.Array | np.ndarray | tuple[()]  # uint32, one for each memory of a channel


def memory_places(channels: Mapping[str, Channel]) -> dict[str, np.ndarray]:
    """The places of each channel's memories among all keys: by their names, or by the first channel that holds them.

    Raises:
        ValueError: one name for memories that differ.
    """
    memories(tuple(channels.values()))
    found: dict[str, int] = {}
    for name, channel in channels.items():
        for i, (identity, memory) in enumerate(memories(channel).items()):
            found.setdefault(identity, checksum(f"memory {i} of {name}" if memory.name is None else identity))
    return {
        name: np.array([found[identity] for identity in memories(channel)], dtype=np.uint32)
        for name, channel in channels.items()
    }


def start(channel: Channel, key: jax.Array, place: Number, shared: Places) -> PyTree:
    """A channel's state before the first step."""
    now, own = at(channel, 0), draw_key(key, 0, place, CHANNEL_START)
    if not len(shared):
        return now.init(own)
    return begin(now, own, [draw_key(key, 0, memory, MEMORY_START) for memory in shared])


def deliver(
    channel: Channel, state: PyTree, y: jax.Array, key: jax.Array, k: jax.Array, place: Number, shared: Places
) -> tuple[PyTree, jax.Array]:
    """The state that follows, and what the channel makes of y at step k."""
    now, own = at(channel, k), draw_key(key, k, place, CHANNEL)
    if not len(shared):
        state, h = now.draw(state, own)
    else:
        state, h = advance(now, state, own, [draw_key(key, k, memory, MEMORY) for memory in shared])
    return state, apply(h, y)
