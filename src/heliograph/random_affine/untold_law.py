"""Law of links with channel side information before a message arrives, so that no number is reported yet."""

from collections import Counter
from typing import TypeVar

import jax
import jax.numpy as jnp

from heliograph.random_affine.base import AbstractRandomAffine
from heliograph.random_affine.channel_state_information import (
    AbstractToldMap,
    PilotedHop,
    ToldGainHop,
    ToldMap,
    list_told_maps,
)
from heliograph.random_affine.hop import GainAndNoise
from heliograph.random_affine.laws.law import AbstractLaw, Discrete
from heliograph.random_affine.mixture import Mixture
from heliograph.random_affine.reported_numbers import FreshNumbers

T = TypeVar("T")


def believe_untold(channel: T) -> T:
    """Return the channel as it is for a receiver that has not got the message yet: reported numbers count as random.

    A link may report numbers with each message, such as its gain ("told" numbers). A filter conditions on them, but a
    prediction of z before the message cannot. So each part z = G y + n of the channel with such numbers is replaced by
    its law averaged over them. Where their law is not known, the part gets example numbers (`typical`) instead.
    """

    def average(leaf: object) -> object:
        """Return a map with reported numbers as its averaged law, or with example numbers; all else unchanged."""
        if not isinstance(leaf, AbstractToldMap):
            return leaf
        law_before_message = _find_law_before_message(leaf)
        return leaf.believed(leaf.typical) if law_before_message is None else law_before_message

    averaged: T = jax.tree.map(average, channel, is_leaf=_is_told_map)
    return averaged


def has_untold_law(channel: AbstractRandomAffine) -> bool:
    """Return whether `believe_untold` returns the exact law of the channel before a message reports numbers.

    It is not exact if example numbers stand for a law that is not known, or if two maps have the same reported numbers:
    these maps are dependent, but would be replaced by independent ones.
    """
    told_maps = [leaf for leaf in jax.tree.leaves(channel, is_leaf=_is_told_map) if isinstance(leaf, AbstractToldMap)]
    maps_by_memory = Counter(affine.memory.identity for affine in told_maps)
    have_laws = all(_find_law_before_message(affine) is not None for affine in told_maps)
    are_independent = max(maps_by_memory.values(), default=0) <= 1
    return have_laws and are_independent


def draw_told(channel: AbstractRandomAffine, key: jax.Array) -> jax.Array:
    """Draw the numbers that one message reports of all maps of a channel (told,), in the order of `list_told_maps`.

    Each map has a memory, whose first state is drawn, `memory.begin`. `memory.announce` returns the part of the state
    that the message reports, such as the reading of a gain without the gain itself.

    Raises:
        ValueError: numbers whose law nobody knows.
    """
    memories = [affine.memory for affine in list_told_maps(channel)]
    keys = jax.random.split(key, len(memories))
    states = [memory.begin(memory_key) for memory, memory_key in zip(memories, keys, strict=True)]
    numbers_by_map = [memory.announce(state) for memory, state in zip(memories, states, strict=True)]
    return jnp.concatenate([jnp.ravel(jnp.asarray(numbers, dtype=float)) for numbers in numbers_by_map])


def _find_law_before_message(affine: AbstractToldMap) -> AbstractRandomAffine | None:
    """Return the law of a map not conditioned on the numbers that a message will report, or None if it is not known.

    A reported gain, or a gain of which a reading is reported (`PilotedHop`), may have any law: the map is then a hop
    with this law. Other numbers (`ToldMap`) must have finitely many values: the map is a mixture of one map for each.
    """
    if isinstance(affine, PilotedHop):
        return GainAndNoise(affine.memory.law, affine.matrix, affine.noise)
    if not isinstance(affine, ToldMap) or not isinstance(affine.memory, FreshNumbers):
        return None
    law = affine.memory.law
    if isinstance(affine.make, ToldGainHop):
        return GainAndNoise(law, affine.make.matrix, affine.make.noise) if isinstance(law, AbstractLaw) else None
    if not isinstance(law, Discrete):
        return None
    maps = [affine.believed(law.values[i : i + 1]) for i in range(len(law.values))]
    return Mixture(maps, law.probabilities)


def _is_told_map(leaf: object) -> bool:
    """Return whether an object is a map of which messages report numbers."""
    return isinstance(leaf, AbstractToldMap)
