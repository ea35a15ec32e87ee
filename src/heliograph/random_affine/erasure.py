"""A loss that the receiver knows of."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PyTree

from heliograph.numerics.check import fail, scalar
from heliograph.numerics.types import ArrayLike
from heliograph.random_affine.base import AbstractRandomAffine, as_maps
from heliograph.random_affine.moments.moments import Moments


class Erasure(AbstractRandomAffine):
    """A map whose outputs are all lost with probability 1 - arrival, and the receiver knows: it reads NaN."""

    base: AbstractRandomAffine
    arrival: Float[jax.Array | np.ndarray, ""]

    def __init__(self, base: AbstractRandomAffine, arrival: ArrayLike):
        (self.base,) = as_maps("erasure", [base])
        self.arrival = scalar("arrival probability", arrival, 0.0, 1.0)

    @property
    def outputs(self) -> int:
        """Outputs of the map."""
        return self.base.outputs

    @property
    def inputs(self) -> int:
        """Inputs of the map."""
        return self.base.inputs

    @property
    def erases(self) -> bool:
        """Always True."""
        return True

    def _init(self, key: jax.Array) -> PyTree[jax.Array]:
        """State of the map."""
        return self.base.init(key)

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

    def extremes(self) -> tuple[AbstractRandomAffine, ...]:
        """Erasures of the map's extremes."""
        return tuple(Erasure(m, self.arrival) for m in self.base.extremes())

    def corner_count(self) -> int:
        """Count of the map."""
        return self.base.corner_count()

    def mean_gain(self) -> AbstractRandomAffine:
        """The map with its mean gain, lost as often."""
        return Erasure(self.base.mean_gain(), self.arrival)
