"""Who sends in a channel, and how its transmitters are called.

Every map z = g A y + n with a random gain or a noise is a hop, and its transmitter sends A y; what is known and without
noise is a wire. Transmitters are called by their place: "hop1", "hop2" along a chain, "part1.", "part2." in a stack,
"choice1." where a mixture chooses among several.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import equinox as eqx
import numpy as np

from heliograph.numerics.check import fail
from heliograph.numerics.traced import is_traced, is_zero
from heliograph.random_affine.atoms import GainAndNoise
from heliograph.random_affine.base import AbstractRandomAffine
from heliograph.random_affine.combine import Mixture, Series, Stack
from heliograph.random_affine.delay import Delayed, OfLine
from heliograph.random_affine.erasure import Erasure
from heliograph.random_affine.law import Constant
from heliograph.random_affine.modes import Faded, Modes, OneStepLate, Revealed

Hop = GainAndNoise | Faded
Act = Callable[[str, Hop], AbstractRandomAffine]


def transmits(atom: Hop) -> bool:
    """Whether anything is sent over the air."""
    if isinstance(atom, Faded):
        return True
    return not (_is_one(atom) and is_zero(atom.noise.covariance))


def _is_one(atom: GainAndNoise) -> bool:
    return isinstance(atom.law, Constant) and not is_traced(atom.law.value) and float(atom.law.value) == 1.0


def is_silent(channel: AbstractRandomAffine) -> bool:
    """Whether nothing comes through but noise: what a loss, or a mode in which nothing is heard, is made of."""
    return isinstance(channel, GainAndNoise) and is_zero(channel.matrix) and _is_one(channel)


class Place(NamedTuple):
    """Where in a channel: the prefix of names, and how many hops are before along the chain."""

    prefix: str
    hops: int


BEGINNING = Place("", 0)


def walked(channel: AbstractRandomAffine, act: Act, place: Place = BEGINNING) -> tuple[AbstractRandomAffine, Place]:
    """The channel with every hop replaced by act(name, hop), and the place behind it.

    Raises:
        ValueError: a map of a kind whose transmitters are not known.
    """
    match channel:
        case GainAndNoise() | Faded():
            if not transmits(channel):
                return channel, place
            after = place._replace(hops=place.hops + 1)
            return act(f"{place.prefix}hop{after.hops}", channel), after
        case Series():
            parts = []
            for part in channel.maps:
                part, place = walked(part, act, place)
                parts.append(part)
        case Stack():
            places = [Place(f"{place.prefix}part{i}.", 0) for i in range(1, len(channel.maps) + 1)]
            parts = [walked(part, act, own)[0] for part, own in zip(channel.maps, places, strict=True)]
        case Mixture() | Modes():
            parts, place = _chosen(channel, act, place)
        case Revealed():
            return channel, place
        case Erasure() | OneStepLate() | Delayed() | OfLine():
            name = {Erasure: "base", OneStepLate: "base", Delayed: "link", OfLine: "plain"}[type(channel)]
            inner, place = walked(getattr(channel, name), act, place)
            return eqx.tree_at(lambda c: getattr(c, name), channel, inner), place
        case _:
            raise unknown(channel)
    return eqx.tree_at(lambda c: c.maps, channel, tuple(parts)), place


def _chosen(channel: Mixture | Modes, act: Act, place: Place) -> tuple[list[AbstractRandomAffine], Place]:
    """The maps of which one is in force: modes of one link have the same transmitters, those of a mixture their own."""
    own = [not is_silent(part) for part in channel.maps]
    several = isinstance(channel, Mixture) and sum(own) > 1
    places = [Place(f"{place.prefix}choice{i}.", 0) if several else place for i in range(1, len(own) + 1)]
    pairs = [walked(part, act, at) for part, at in zip(channel.maps, places, strict=True)]
    return [part for part, _ in pairs], place if several else max((at for _, at in pairs), key=lambda at: at.hops)


def names_of(channel: AbstractRandomAffine) -> list[str]:
    """Names of the transmitters, in order of appearance."""
    found: dict[str, None] = {}

    def note(name: str, hop: Hop) -> Hop:
        found.setdefault(name)
        return hop

    walked(channel, note)
    return list(found)


def selected(names: Sequence[str], wanted: Sequence[str], what: str) -> np.ndarray:
    """Which of the names are wanted, by name or by what stands before a dot.

    Raises:
        ValueError: one that is there under no name.
    """
    chosen = np.zeros(len(names), dtype=bool)
    for one in wanted:
        hit = np.array([name == one or name.startswith(f"{one}.") for name in names])
        if not np.any(hit):
            raise fail(what, f"names of transmitters {list(names)}", repr(one))
        chosen |= hit
    return chosen


def unknown(channel: AbstractRandomAffine) -> ValueError:
    """The error for a map of a kind whose transmitters are not known."""
    expected = "hops in series, stacks, mixtures, modes, losses and delays"
    return fail("transmitters of a channel", expected, type(channel).__name__)
