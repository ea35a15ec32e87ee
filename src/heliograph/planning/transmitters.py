"""Transmitters of a channel: how they are named, and how to change what they do.

Every map z = g A y + n with a random gain or a noise is a hop, and its transmitter sends A y; what is known and without
noise is a wire. Transmitters are named by their place: "hop1", "hop2" along a chain, "part1.", "part2." in a stack,
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
HopChange = Callable[[str, Hop], AbstractRandomAffine]


def transmits(hop: Hop) -> bool:
    """Whether anything is transmitted, rather than passed on by a wire."""
    return isinstance(hop, Faded) or not (_gain_is_one(hop) and is_zero(hop.noise.covariance))


def _gain_is_one(hop: GainAndNoise) -> bool:
    return isinstance(hop.law, Constant) and not is_traced(hop.law.value) and float(hop.law.value) == 1.0


def is_silent(channel: AbstractRandomAffine) -> bool:
    """Whether nothing comes through but noise: what a loss, or a mode without reception, is made of."""
    return isinstance(channel, GainAndNoise) and is_zero(channel.matrix) and _gain_is_one(channel)


class Place(NamedTuple):
    """Place in a channel: the prefix of names, and the number of hops before along the chain."""

    prefix: str
    hops: int


BEGINNING = Place("", 0)


def replace_hops(
    channel: AbstractRandomAffine, change: HopChange, place: Place = BEGINNING
) -> tuple[AbstractRandomAffine, Place]:
    """Channel with every hop replaced by change(name, hop), and the place behind it.

    Raises:
        ValueError: a map of a kind whose transmitters are not known.
    """
    match channel:
        case GainAndNoise() | Faded():
            if not transmits(channel):
                return channel, place
            after = place._replace(hops=place.hops + 1)
            return change(f"{place.prefix}hop{after.hops}", channel), after
        case Series():
            parts = []
            for part in channel.maps:
                part, place = replace_hops(part, change, place)
                parts.append(part)
        case Stack():
            places = [Place(f"{place.prefix}part{i}.", 0) for i in range(1, len(channel.maps) + 1)]
            parts = [replace_hops(part, change, at)[0] for part, at in zip(channel.maps, places, strict=True)]
        case Mixture() | Modes():
            parts, place = _replace_in_choices(channel, change, place)
        case Revealed():
            return channel, place
        case Erasure() | OneStepLate() | Delayed() | OfLine():
            name = {Erasure: "base", OneStepLate: "base", Delayed: "link", OfLine: "plain"}[type(channel)]
            inner, place = replace_hops(getattr(channel, name), change, place)
            return eqx.tree_at(lambda c: getattr(c, name), channel, inner), place
        case _:
            raise unknown(channel)
    return eqx.tree_at(lambda c: c.maps, channel, tuple(parts)), place


def _replace_in_choices(
    channel: Mixture | Modes, change: HopChange, place: Place
) -> tuple[list[AbstractRandomAffine], Place]:
    """Maps of which one is in force: modes of one link have the same transmitters, those of a mixture each theirs."""
    sending = [not is_silent(part) for part in channel.maps]
    several = isinstance(channel, Mixture) and sum(sending) > 1
    places = [Place(f"{place.prefix}choice{i}.", 0) if several else place for i in range(1, len(sending) + 1)]
    pairs = [replace_hops(part, change, at) for part, at in zip(channel.maps, places, strict=True)]
    return [part for part, _ in pairs], place if several else max((at for _, at in pairs), key=lambda at: at.hops)


def transmitter_names(channel: AbstractRandomAffine) -> list[str]:
    """Names of the transmitters, in order of appearance."""
    names: dict[str, None] = {}

    def note(name: str, hop: Hop) -> Hop:
        names.setdefault(name)
        return hop

    replace_hops(channel, note)
    return list(names)


def selected(names: Sequence[str], chosen: Sequence[str], what: str) -> np.ndarray:
    """Which of the names are chosen, by name or by what stands before a dot.

    Raises:
        ValueError: a choice that is there under no name.
    """
    result = np.zeros(len(names), dtype=bool)
    for choice in chosen:
        hit = np.array([name == choice or name.startswith(f"{choice}.") for name in names])
        if not np.any(hit):
            raise fail(what, f"names of transmitters {list(names)}", repr(choice))
        result |= hit
    return result


def unknown(channel: AbstractRandomAffine) -> ValueError:
    """Error for a map of a kind whose transmitters are not known."""
    expected = "hops in series, stacks, mixtures, modes, losses and delays"
    return fail("transmitters of a channel", expected, type(channel).__name__)
