"""The channel of complete packets: erasures removed."""

from heliograph.numerics.check import fail
from heliograph.random_affine.base import AbstractRandomAffine
from heliograph.random_affine.combine import Series, Stack
from heliograph.random_affine.erasure import Erasure


def arrived(channel: AbstractRandomAffine) -> AbstractRandomAffine:
    """Return the channel given that everything arrives, where losses are independent of gains.

    Raises:
        ValueError: losses that depend on which of several channels was drawn.
    """
    if not channel.erases:
        return channel
    match channel:
        case Erasure():
            return arrived(channel.base)
        case Series():
            return Series([arrived(part) for part in channel.maps])
        case Stack():
            return Stack([arrived(part) for part in channel.maps])
    raise fail("channel", "erasures of channels, not mixtures of them", type(channel).__name__)
