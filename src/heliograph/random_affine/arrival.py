"""What may arrive of a map that loses data: each set of components, its probability, and the map when it is so."""

from itertools import product
from typing import NamedTuple

import numpy as np

from heliograph.numerics.check import fail
from heliograph.random_affine.base import AbstractRandomAffine
from heliograph.random_affine.combine import Mixture, Series, Stack
from heliograph.random_affine.erasure import Erasure

PATTERNS = 256  # sets of components that are listed


class Pattern(NamedTuple):
    """`present` components arrive, with probability `chance`; then they are those of `channel`, which loses nothing."""

    present: tuple[bool, ...]
    chance: float
    channel: AbstractRandomAffine


def patterns(channel: AbstractRandomAffine) -> list[Pattern]:
    """All sets of components that may arrive, each once.

    Raises:
        ValueError: losses of some components before another map, or within a map of unknown kind; more than PATTERNS.
    """
    if not channel.erases:
        return [Pattern((True,) * channel.outputs, 1.0, channel)]
    match channel:
        case Erasure():
            p, none = float(channel.arrival), (False,) * channel.outputs
            kept = [part._replace(chance=part.chance * p) for part in patterns(channel.base)]
            found = [*kept, Pattern(none, 1 - p, kept[0].channel)]
        case Series():
            found = patterns(channel.maps[0])
            for part in channel.maps[1:]:
                found = [_after(a, b, part.outputs) for a, b in product(found, patterns(part))]
        case Stack():
            found = [_beside(parts) for parts in product(*(patterns(m) for m in channel.maps))]
        case Mixture():
            weighted = zip(np.asarray(channel.choice.probabilities), channel.maps, strict=True)
            found = [part._replace(chance=part.chance * float(p)) for p, m in weighted for part in patterns(m)]
        case _:
            raise fail("channel that loses data", "hops, series, stacks and mixtures", type(channel).__name__)
    return _merged(found)


def _after(first: Pattern, second: Pattern, outputs: int) -> Pattern:
    """What is lost before a map is lost behind it."""
    chance, channel = first.chance * second.chance, Series([first.channel, second.channel])
    if all(first.present):
        return Pattern(second.present, chance, channel)
    if any(first.present):
        raise fail("losses before another hop", "of all components together", "of some")
    return Pattern((False,) * outputs, chance, channel)


def _beside(parts: tuple[Pattern, ...]) -> Pattern:
    present = tuple(there for part in parts for there in part.present)
    chance = float(np.prod([part.chance for part in parts]))
    return Pattern(present, chance, Stack([part.channel for part in parts]))


def _merged(found: list[Pattern]) -> list[Pattern]:
    """Patterns of one kind as one, their maps mixed."""
    kinds: dict[tuple[bool, ...], list[Pattern]] = {}
    for part in found:
        if part.chance > 0:
            kinds.setdefault(part.present, []).append(part)
    if len(kinds) > PATTERNS:
        raise fail("channel that loses data", f"at most {PATTERNS} sets of components", len(kinds))
    return [_mixed(parts) for parts in kinds.values()]


def _mixed(parts: list[Pattern]) -> Pattern:
    chance = sum(part.chance for part in parts)
    if len(parts) == 1 or not any(parts[0].present):  # of what is lost no moment matters
        return parts[0]._replace(chance=chance)
    weights = [part.chance / chance for part in parts]
    return Pattern(parts[0].present, chance, Mixture([part.channel for part in parts], weights))
