"""A loss that the receiver knows of, and the channel of complete packets, erasures removed."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PyTree

from heliograph.numerics.check import fail, scalar
from heliograph.numerics.types import ArrayLike
from heliograph.random_affine.base import AbstractRandomAffine, AbstractWithBase, as_maps
from heliograph.random_affine.combine import Series, Stack
from heliograph.random_affine.moments.moments import Moments


class Erasure(AbstractWithBase):
    """A map whose outputs are all lost with probability 1 - arrival, and the receiver knows: it reads NaN."""

    base: AbstractRandomAffine
    arrival: Float[jax.Array | np.ndarray, ""]

    def __init__(self, base: AbstractRandomAffine, arrival: ArrayLike):
        (self.base,) = as_maps("erasure", [base])
        self.arrival = scalar("arrival probability", arrival, 0.0, 1.0)

    @property
    def erases(self) -> bool:
        """Always True."""
        return True

    def _draw(self, state: PyTree[jax.Array], key: jax.Array) -> tuple[PyTree[jax.Array], jax.Array]:
        """Draw whether it arrives, and the map, whose state moves in any case."""
        arrives, drawn = jax.random.split(key)
        state, h = self.base.draw(state, drawn)
        lost = ~jax.random.bernoulli(arrives, self.arrival)
        return state, h.at[:-1].set(jnp.where(lost, jnp.nan, h[:-1]))

    def moments(self, order: int) -> Moments:
        """Refuse: a filter skips lost packets, and asks for the moments of the channel inside.

        Raises:
            ValueError: always.
        """
        raise fail("moments of a channel", "one without erasures (give the filter what is inside)", "an erasure")


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
