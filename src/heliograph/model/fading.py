"""Links that remember: fading in bursts, loss in bursts, gains that drift, and shadows that several links share."""

from collections.abc import Sequence
from typing import cast

import numpy as np
from numpy.typing import ArrayLike

from heliograph.model.channel import hop
from heliograph.numerics.check import array, check_count, fail, scalar
from heliograph.numerics.traced import library
from heliograph.random_affine.base import AbstractRandomAffine
from heliograph.random_affine.chain import Autoregression, MarkovChain
from heliograph.random_affine.modes import Faded, Modes
from heliograph.random_affine.noise import AbstractNoise, as_noise, components


def gilbert_elliott(
    good: AbstractRandomAffine,
    bad: AbstractRandomAffine,
    fail: ArrayLike,
    recover: ArrayLike,
    name: str | None = None,
) -> Modes:
    """A link that is `good` or `bad` for a while: it fails with probability `fail` at each step and then recovers.

    `good` and `bad` are any channels, with losses too: `erasure(link, arrival)` in each makes losses in bursts. It
    starts in its stationary law. Links of one `name` are good and bad together.

    Raises:
        ValueError: probabilities outside [0, 1], both zero, or channels of different shapes.
    Source: Gilbert (1960), Elliott (1963).
    """
    p, q = scalar("fail", fail, 0.0, 1.0), scalar("recover", recover, 0.0, 1.0)
    xp = library(p, q)
    return Modes(MarkovChain(xp.stack([xp.stack([1 - p, p]), xp.stack([q, 1 - q])]), name=name), [good, bad])


def markov_fading(
    gains: Sequence[AbstractRandomAffine] | ArrayLike,
    transition: MarkovChain | ArrayLike,
    noise: AbstractNoise | ArrayLike | None = None,
    name: str | None = None,
) -> Modes:
    """A link whose gain moves as a Markov chain: `gains` are numbers, with one `noise`, or a channel for each mode.

    `transition` is P(next j | now i), started in its stationary law, or a chain. Links of one chain, or of one `name`,
    move together.

    Raises:
        ValueError: gains without a noise or channels with one, not one for each mode, rows that are no probabilities.
    """
    if isinstance(transition, MarkovChain) and name is not None:
        raise fail("name", "none beside a chain, which has its own", repr(name))
    chain = transition if isinstance(transition, MarkovChain) else MarkovChain(transition, name=name)
    channels = [item for item in gains if isinstance(item, AbstractRandomAffine)] if isinstance(gains, Sequence) else []
    if channels:
        if noise is not None:
            raise fail("noise", "none beside channels, which have their own", "one")
        return Modes(chain, channels)
    if noise is None:
        raise fail("noise", "one for gains that are numbers", "none")
    return Modes(chain, [hop(g, noise) for g in array("gains of the modes", cast(ArrayLike, gains), (None,))])


def autoregressive_fading(
    mean: ArrayLike,
    deviation: ArrayLike,
    correlation: ArrayLike,
    noise: AbstractNoise | ArrayLike,
    dimension: int = 1,
    name: str | None = None,
) -> Faded:
    """A link z = g y + n whose gain drifts: Gaussian, stationary, with `correlation` from one step to the next.

    `noise` is as for a hop. Links of one `name` drift together, each with its own mean and deviation.

    Raises:
        ValueError: a negative deviation, a correlation outside [-1, 1], a noise that is no covariance.
    """
    count = components(noise) or check_count("dimension of a hop", dimension)
    return Faded(Autoregression(correlation, name), mean, deviation, np.eye(count), as_noise("hop noise", noise, count))
