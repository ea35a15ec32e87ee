"""The way of a signal through a channel: the names of the hops that it meets, and its second moment at each."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeVar

import jax
import numpy as np

from heliograph.numerics.check import fail
from heliograph.numerics.numpy_or_jax import library
from heliograph.numerics.types import Array, Float, Scalar
from heliograph.random_affine.moments.monomials import JointMoments

T = TypeVar("T")
Second = Float[Array, "p p"]  # second moment E (y, 1)(y, 1)' of a signal y and the constant 1


class SignalMoment(NamedTuple):
    """Second moment E (y, 1)(y, 1)' of what a map receives, and the probability that it arrives."""

    second: Second
    arrives: Scalar


# Function of a hop's name, the hop, and the second moment of what it receives; it returns a hop to put in its place.
Visit = Callable[[str, Any, SignalMoment | None], Any]


class ChannelPosition(NamedTuple):
    """Position in a channel: prefix of names, number of hops before it along the chain, and the signal there."""

    prefix: str
    hops: int
    signal: SignalMoment | None

    def number_maps(self, maps: Sequence[T], word: str) -> "list[tuple[T, ChannelPosition]]":
        """Return each of the maps that stand side by side here, with the position at its beginning.

        The names of the hops in map i begin with `word` and i, such as "part2.hop1": each map counts its own hops. The
        signal there is the same for all maps.
        """
        positions = [self._replace(prefix=f"{self.prefix}{word}{i}.", hops=0) for i in range(1, len(maps) + 1)]
        return list(zip(maps, positions, strict=True))

    def select_components(self, indices: Sequence[int]) -> "ChannelPosition":
        """Return the position at a map that takes only the components of y at these indices.

        The signal then has the rows and columns of E (y, 1)(y, 1)' of these components and of the constant.
        """
        if self.signal is None:
            return self
        chosen = np.array([*indices, -1])
        second = self.signal.second[chosen[:, None], chosen]
        return self._replace(signal=self.signal._replace(second=second))

    def on_delay_line(self, times: int) -> "ChannelPosition":
        """Return the position at a map of the line (y_k, y_{k-1}, ...) of so many signals.

        Each signal has the moments of the present one. The moments between two signals are set to zero: a delay selects
        one signal, so that they are never used.
        """
        if self.signal is None:
            return self
        second, xp = self.signal.second, library(self.signal.second)
        mean = xp.tile(second[:-1, -1], times)
        blocks = xp.kron(np.eye(times), second[:-1, :-1])  # on the diagonal
        second_of_line = xp.block([[blocks, mean[:, None]], [mean[None], np.ones((1, 1))]])
        return self._replace(signal=self.signal._replace(second=second_of_line))


def carry_by_moments(signal: SignalMoment, moments: JointMoments) -> SignalMoment:
    """Return E (z, 1)(z, 1)' behind a random map, by its mean and second moments, from E (y, 1)(y, 1)' before it."""
    second, tensor = signal.second, moments.second
    mean = moments.mean[:-1] @ second[:, -1]
    xp = library(tensor, second)
    of_z = xp.einsum("ijab,ab->ij", tensor, second)
    second_behind = xp.block([[of_z, mean[:, None]], [mean[None], np.ones((1, 1))]])
    return signal._replace(second=second_behind)


def refuse_gain_on_angles(got: str) -> ValueError:
    """Return the error that an angle is multiplied by a gain other than 1, so that the product is no angle.

    `got` says in the message which gain or map it is.
    """
    expected = "gain 1 on circular outputs (behind any other, send sine and cosine, which are no angles)"
    return fail("channel", expected, got)


def apply(h: jax.Array, y: jax.Array) -> jax.Array:
    """Return z = G y + n for a drawn H = [[G, n], [0, 1]] of shape (outputs + 1, inputs + 1)."""
    gain, noise = h[:-1, :-1], h[:-1, -1]
    return gain @ y + noise
