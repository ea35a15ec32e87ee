"""Centring for polynomial filters: the mean of the state, and of what is received, before any data.

Powers of numbers far from zero are nearly collinear: of x near 10,000 with a spread of 1, the squares and x itself
agree to nine digits, and what the squares would add is in the digits that are lost. Behind a known gain, the
measurement can be centred: z - G C E[x_k] depends on x_k - E[x_k] alone, and all moments are about the mean.
"""

from typing import TypeVar

import numpy as np

from heliograph.model.channel import Channel
from heliograph.model.over_time import OverTime, first, over_time, unstack
from heliograph.model.plant import AbstractPlant, AnyPlant, LinearPlant
from heliograph.model.sensor import AbstractSensor, AnySensor, LinearSensor
from heliograph.numerics.module import Module
from heliograph.numerics.types import Array, Float
from heliograph.random_affine.base import AbstractRandomAffine
from heliograph.random_affine.moments.moment_noise import about_mean
from heliograph.random_affine.moments.second_moments import has_known_gain
from heliograph.random_affine.noise import AbstractNoise, Gaussian

Part = TypeVar("Part", AbstractPlant, AbstractSensor, AbstractRandomAffine)
T = TypeVar("T")


class Centre(Module):
    """Mean of the state before any data, E[x_0] and E[x+] = A E[x] + b, and the matrix G C with which it is received.

    Shapes: start (n,), transition A (n, n), drift b (n,), received G C (m, n); each at every step, or constant.
    """

    start: Float[Array, " n"]
    transition: Array | OverTime
    drift: Array | OverTime
    received: Array | OverTime


def centre_of(plant: AnyPlant, sensor: AnySensor, channel: Channel) -> Centre | None:
    """Return the mean of a linear model's state; None where it is zero throughout or a gain is random."""
    plants, sensors, channels = _over_steps(plant), _over_steps(sensor), _over_steps(channel)
    if not all(has_known_gain(c) for c in channels):
        return None
    drifts = [np.asarray(p.noise_mean()) for p in plants]
    start = np.asarray(first(plant).initial_mean)
    if not np.any(start) and not np.any(drifts):
        return None
    count = max(len(sensors), len(channels))
    pairs = zip(_repeated(sensors, count), _repeated(channels, count), strict=False)
    received = [np.asarray(c.moments(1).mean[:-1, :-1]) @ _matrix(s) for s, c in pairs]
    return Centre(start, _series([_matrix(p) for p in plants]), _series(drifts), _series(received))


def without_mean(plant: AnyPlant) -> AnyPlant:
    """Return the plant of the centred state x_k - E[x_k]."""
    if isinstance(plant, OverTime):
        return over_time([without_mean(item) for item in unstack(plant)])
    assert isinstance(plant, LinearPlant) and isinstance(plant.noise, AbstractNoise)
    law = about_mean(plant.deviation) if plant.deviation is not None else Gaussian(plant.initial_covariance)
    n = len(plant.states)
    return LinearPlant(plant.matrix, about_mean(plant.noise), np.zeros(n), law, plant.input_matrix, plant.states)


def _over_steps(item: Part | OverTime) -> list[Part]:
    return unstack(item) if isinstance(item, OverTime) else [item]


def _matrix(item: AbstractPlant | AbstractSensor) -> np.ndarray:
    assert isinstance(item, LinearPlant | LinearSensor)  # checked before
    return np.asarray(item.matrix)


def _repeated(items: list[T], count: int) -> list[T]:
    return items * count if len(items) == 1 else items


def _series(values: list[np.ndarray]) -> Array | OverTime:
    return values[0] if len(values) == 1 else OverTime(np.array(values))
