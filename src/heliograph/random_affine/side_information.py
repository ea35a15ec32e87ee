"""Outcomes of a channel with erasures: every set of losses, its probability, and the map that remains."""

from collections.abc import Callable
from functools import reduce
from typing import NamedTuple

import jax
import numpy as np

from heliograph.numerics.check import fail
from heliograph.numerics.traced import is_traced, plain
from heliograph.numerics.types import Bool, Float
from heliograph.random_affine.atoms import known
from heliograph.random_affine.base import AbstractRandomAffine, check_forgets
from heliograph.random_affine.combine import Series, Stack
from heliograph.random_affine.erasure import Erasure
from heliograph.random_affine.moments.second_moments import second_moment_tensor

OUTCOME_LIMIT = 1024  # sets of losses that are listed


class Outcome(NamedTuple):
    """Set of losses that the receiver can observe: with `probability` the outputs in `arrived` come through `map`."""

    probability: float | jax.Array
    map: AbstractRandomAffine
    arrived: Bool[np.ndarray, " outputs"]


def outcomes(channel: AbstractRandomAffine) -> list[Outcome]:
    """List every set of losses of a channel without memory; outcomes of probability 0 are left out.

    Raises:
        ValueError: a channel that remembers, erasures inside a map that is no series or stack, more than OUTCOME_LIMIT
            outcomes.
    """
    check_forgets("channel with erasures", channel)
    if not channel.erases:
        return [Outcome(1.0, channel, np.ones(channel.outputs, dtype=bool))]
    match channel:
        case Erasure():
            # Either what the base delivers, or nothing.
            arrival, lost = plain(channel.arrival), np.zeros(channel.outputs, dtype=bool)
            results = [o._replace(probability=arrival * o.probability) for o in outcomes(channel.base)]
            results.append(Outcome(1 - arrival, known(np.zeros((channel.outputs, channel.inputs))), lost))
        # Losses of independent parts: probabilities multiply.
        case Series():
            results = reduce(lambda done, part: _joint(done, outcomes(part), _after), channel.maps[1:],
                           outcomes(channel.maps[0]))  # fmt: skip
        case Stack():
            results = reduce(lambda done, part: _joint(done, outcomes(part), _others), channel.maps[1:],
                           outcomes(channel.maps[0]))  # fmt: skip
        case _:
            raise fail("channel with erasures", "erasures in series and stacks", type(channel).__name__)
    return [o for o in results if is_traced(o.probability) or o.probability > 0]


def _joint(
    a: list[Outcome], b: list[Outcome], join: Callable[[Outcome, Outcome], tuple[AbstractRandomAffine, np.ndarray]]
) -> list[Outcome]:
    if len(a) * len(b) > OUTCOME_LIMIT:
        raise fail("channel with erasures", f"at most {OUTCOME_LIMIT} sets of losses", f"{len(a) * len(b):,}")
    return [Outcome(x.probability * y.probability, *join(x, y)) for x in a for y in b]


def _after(x: Outcome, y: Outcome) -> tuple[AbstractRandomAffine, np.ndarray]:
    """Join outcomes in series: an output is lost where y loses it or has a gain on what x lost."""
    received = known(np.diag(x.arrived.astype(float)))
    power = second_moments(y.map)[1][..., :-1, :-1]  # E[G_ia G_jb]
    uses = np.einsum("iiaa->ia", power) > 0
    return Series([x.map, received, y.map]), y.arrived & ~uses[:, ~x.arrived].any(axis=1)


def _others(x: Outcome, y: Outcome) -> tuple[AbstractRandomAffine, np.ndarray]:
    """Join outcomes of parallel maps, stacked."""
    return Stack([x.map, y.map]), np.concatenate([x.arrived, y.arrived])


def second_moments(
    channel: AbstractRandomAffine,
) -> tuple[Float[np.ndarray, "m p+1"], Float[np.ndarray, "m m p+1 p+1"]]:
    """Return E[(G, n)] and the tensor of E[z z' | y] on (y, 1)(y, 1)', under the nominal law."""
    moments = channel.moments(2)
    tensor = second_moment_tensor(moments.matrix, moments.outputs, moments.inputs)
    return np.asarray(moments.mean[:-1]), np.asarray(tensor)
