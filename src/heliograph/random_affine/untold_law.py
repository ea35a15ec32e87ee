"""Links whose messages tell numbers of their law, as they are known before a message, when nothing is told yet."""

from collections import Counter
from typing import TypeVar

import jax
import jax.numpy as jnp

from heliograph.random_affine.base import AbstractRandomAffine
from heliograph.random_affine.channel_state_information import (
    AbstractToldMap,
    FreshNumbers,
    PilotedHop,
    ToldGainHop,
    ToldMap,
    list_told_maps,
)
from heliograph.random_affine.hop import GainAndNoise
from heliograph.random_affine.laws.law import AbstractLaw, Discrete
from heliograph.random_affine.mixture import Mixture

T = TypeVar("T")


def believe_untold(channel: T) -> T:
    """Return the channel as a receiver knows it before a message: each told map by the law of its numbers.

    A told map has numbers that a message tells, such as a gain. If the law of its numbers is not known, or gives no map
    that can be written, the map of typical numbers is taken.
    """

    def believe(leaf: object) -> object:
        """Return a told map by the law of its numbers, or by typical numbers; return anything else unchanged."""
        if not isinstance(leaf, AbstractToldMap):
            return leaf
        map_of_law = _find_untold(leaf)
        return leaf.believed(leaf.typical) if map_of_law is None else map_of_law

    believed: T = jax.tree.map(believe, channel, is_leaf=_is_told_map)
    return believed


def has_untold_law(channel: AbstractRandomAffine) -> bool:
    """Return whether `believe_untold` gives the exact law of all that arrives, before a message tells numbers.

    It does not if it takes typical numbers for a map, or if two maps have the same told numbers and so are dependent.
    """
    maps = [leaf for leaf in jax.tree.leaves(channel, is_leaf=_is_told_map) if isinstance(leaf, AbstractToldMap)]
    counts = Counter(affine.memory.identity for affine in maps)
    have_laws = all(_find_untold(affine) is not None for affine in maps)
    return have_laws and max(counts.values(), default=0) <= 1


def draw_told(channel: AbstractRandomAffine, key: jax.Array) -> jax.Array:
    """Draw the numbers that a message tells of all maps of a channel, in the order of `list_told_maps`.

    Raises:
        ValueError: numbers whose law nobody knows.
    """
    memories = [affine.memory for affine in list_told_maps(channel)]
    keys = jax.random.split(key, len(memories))
    numbers_by_map = [memory.announce(memory.begin(key)) for memory, key in zip(memories, keys, strict=True)]
    return jnp.concatenate([jnp.ravel(jnp.asarray(numbers, dtype=float)) for numbers in numbers_by_map])


def _find_untold(affine: AbstractToldMap) -> AbstractRandomAffine | None:
    """Return a map by the law of the numbers that a message would tell, or None if that law gives no known map.

    A gain may have any law. Other numbers must have finitely many values, each of which gives a map of a mixture.
    """
    if isinstance(affine, PilotedHop):  # before the reading only the law of its gain is known
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
    """Return whether an object is a map of which numbers are told."""
    return isinstance(leaf, AbstractToldMap)
