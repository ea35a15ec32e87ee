"""Channels whose transmitters send more or less than they do."""

from collections.abc import Mapping

import equinox as eqx
import numpy as np

from heliograph.numerics.check import fail
from heliograph.planning.channel_power import Second, sent_powers
from heliograph.planning.transmitters import Hop, names_of, walked
from heliograph.random_affine.base import AbstractRandomAffine


def scaled(channel: AbstractRandomAffine, factors: Mapping[str, float]) -> AbstractRandomAffine:
    """The channel in which each named transmitter's signal is so many times larger."""

    def act(name: str, hop: Hop) -> Hop:
        result: Hop = eqx.tree_at(lambda h: h.matrix, hop, np.asarray(hop.matrix) * factors.get(name, 1.0))
        return result

    return walked(channel, act)[0]


def allocated(
    channel: AbstractRandomAffine, second: Second, powers: Mapping[str, float], step: int = 0
) -> AbstractRandomAffine:
    """The channel whose named transmitters send these powers: each amplifies what it hears to its own.

    Raises:
        ValueError: a transmitter that hears nothing which it could amplify.
    """
    for name in names_of(channel):  # a relay hears what those before it send
        if name in powers:
            now = sent_powers(channel, second, step)[name]
            if now <= 0 < powers[name]:
                channel = _woken(channel, name)
                now = sent_powers(channel, second, step)[name]
            if now <= 0 < powers[name]:
                raise fail(f"transmitter {name!r}", "a signal that can be amplified", "none")
            channel = scaled(channel, {name: np.sqrt(powers[name] / now) if now > 0 else 0.0})
    return channel


def _woken(channel: AbstractRandomAffine, silent: str) -> AbstractRandomAffine:
    """The channel in which a transmitter whose matrix is zero sends what it hears."""

    def act(name: str, hop: Hop) -> Hop:
        if name != silent:
            return hop
        result: Hop = eqx.tree_at(lambda h: h.matrix, hop, np.eye(*np.shape(hop.matrix)))
        return result

    return walked(channel, act)[0]
