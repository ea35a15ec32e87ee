"""A loss that the receiver knows of: the channel of complete packets, and every set of losses with its probability."""

from collections.abc import Callable
from functools import reduce
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.numerics.check import fail, scalar
from heliograph.numerics.traced import is_traced, plain
from heliograph.numerics.types import ArrayLike, Bool, Float, PyTree
from heliograph.random_affine.base import AbstractRandomAffine, check_forgets, check_maps
from heliograph.random_affine.combine import Series, Stack
from heliograph.random_affine.composite import AbstractWrapper
from heliograph.random_affine.hop import known
from heliograph.random_affine.moments.monomials import Moments
from heliograph.random_affine.moments.tensors import second_moment_tensor


class Erasure(AbstractWrapper):
    """A map whose outputs are all lost with probability 1 - arrival, and the receiver knows: it reads NaN."""

    base: AbstractRandomAffine
    arrival: Float[jax.Array | np.ndarray, ""]

    def __init__(self, base: AbstractRandomAffine, arrival: ArrayLike):
        (self.base,) = check_maps("erasure", [base])
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
        """Refuse: a filter skips lost packets, and asks for the moments of the channel inside."""
        raise fail("moments of a channel", "one without erasures (give the filter what is inside)", "an erasure")


def condition_on_arrival(channel: AbstractRandomAffine) -> AbstractRandomAffine:
    """Return the channel given that everything arrives, where losses are independent of gains."""
    if not channel.erases:
        return channel
    match channel:
        case Erasure():
            return condition_on_arrival(channel.base)
        case Series() | Stack():
            return channel.rebuilt(*map(condition_on_arrival, channel.maps))
    raise fail("channel", "erasures of channels, not mixtures of them", type(channel).__name__)


OUTCOME_LIMIT = 1024  # sets of losses that are listed


class Outcome(NamedTuple):
    """Set of losses that the receiver can observe: with `probability` the outputs in `arrived` come through `map`."""

    probability: float | jax.Array
    map: AbstractRandomAffine
    arrived: Bool[np.ndarray, " outputs"]


def outcomes(channel: AbstractRandomAffine) -> list[Outcome]:
    """List every set of losses of a channel without memory; outcomes of probability 0 are left out."""
    check_forgets("channel with erasures", channel)
    if not channel.erases:
        return [Outcome(1.0, channel, np.ones(channel.outputs, dtype=bool))]
    match channel:
        case Erasure():
            # Either what the base delivers, or nothing.
            arrival, lost = plain(channel.arrival), np.zeros(channel.outputs, dtype=bool)
            listed = [o._replace(probability=arrival * o.probability) for o in outcomes(channel.base)]
            listed.append(Outcome(1 - arrival, known(np.zeros((channel.outputs, channel.inputs))), lost))
        # Losses of independent parts: probabilities multiply.
        case Series() | Stack():
            join = _join_series if isinstance(channel, Series) else _join_parallel
            listed = reduce(lambda done, more: _join_outcomes(done, more, join), map(outcomes, channel.maps))
        case _:
            raise fail("channel with erasures", "erasures in series and stacks", type(channel).__name__)
    return [o for o in listed if is_traced(o.probability) or o.probability > 0]


def _join_outcomes(
    a: list[Outcome], b: list[Outcome], join: Callable[[Outcome, Outcome], tuple[AbstractRandomAffine, np.ndarray]]
) -> list[Outcome]:
    if len(a) * len(b) > OUTCOME_LIMIT:
        raise fail("channel with erasures", f"at most {OUTCOME_LIMIT} sets of losses", f"{len(a) * len(b):,}")
    return [Outcome(x.probability * y.probability, *join(x, y)) for x in a for y in b]


def _join_series(x: Outcome, y: Outcome) -> tuple[AbstractRandomAffine, np.ndarray]:
    """Join outcomes in series: an output is lost where y loses it or has a gain on what x lost."""
    received = known(np.diag(x.arrived.astype(float)))
    power = second_moments(y.map)[1][..., :-1, :-1]  # E[G_ia G_jb]
    uses = np.einsum("iiaa->ia", power) > 0
    return Series([x.map, received, y.map]), y.arrived & ~uses[:, ~x.arrived].any(axis=1)


def _join_parallel(x: Outcome, y: Outcome) -> tuple[AbstractRandomAffine, np.ndarray]:
    """Join outcomes in parallel: the outputs of both, one after another."""
    return Stack([x.map, y.map]), np.concatenate([x.arrived, y.arrived])


def second_moments(
    channel: AbstractRandomAffine,
) -> tuple[Float[np.ndarray, "m p+1"], Float[np.ndarray, "m m p+1 p+1"]]:
    """Return E[(G, n)] and the tensor of E[z z' | y] on (y, 1)(y, 1)', under the nominal law."""
    moments = channel.moments(2)
    tensor = second_moment_tensor(moments.matrix, moments.outputs, moments.inputs)
    return np.asarray(moments.mean[:-1]), np.asarray(tensor)
