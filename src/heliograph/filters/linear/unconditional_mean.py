"""Mean of the state of a linear model before any data, and the plant of the state less that mean."""

from typing import TypeVar

import numpy as np

from heliograph.model.channel import Channel
from heliograph.model.over_time import OverTime, at_each_step, first, unstack
from heliograph.model.plant import AbstractPlant, AnyPlant, LinearPlant
from heliograph.model.sensor import AbstractSensor, AnySensor, LinearSensor
from heliograph.numerics.float64 import in_float64
from heliograph.numerics.module import Module
from heliograph.numerics.types import Array, Float
from heliograph.random_affine.noises.noise import AbstractNoise, Gaussian
from heliograph.random_affine.noises.noise_from_moments import about_mean

T = TypeVar("T")


class UnconditionalMean(Module):
    """Mean of the state before any data, E[x_0] and E[x+] = A E[x] + b, and the matrix G C with which it is received.

    Shapes: start (n,), transition A (n, n), drift b (n,), received G C (m, n); each at every step, or constant.
    """

    start: Float[Array, " n"]
    transition: Array | OverTime
    drift: Array | OverTime
    received: Array | OverTime


@in_float64
def find_unconditional_mean(plant: AnyPlant, sensor: AnySensor, channel: Channel) -> UnconditionalMean | None:
    """Return E[x_0], A_k, b_k and G_k C_k of a linear model, from which E x_k and E z_k follow before any data.

    A filter of powers of x subtracts these means, so that its moments lose no digits to a large mean. None where E x is
    zero throughout, so that there is nothing to subtract, or a gain is random.
    """
    plants, sensors, channels = unstack(plant), unstack(sensor), unstack(channel)
    if not all(c.has_known_gain for c in channels):
        return None
    drifts = [np.asarray(p.noise_mean()) for p in plants]
    start = np.asarray(first(plant).initial_mean)
    if not np.any(start) and not np.any(drifts):
        return None
    count = max(len(sensors), len(channels))
    pairs = zip(_repeat(sensors, count), _repeat(channels, count), strict=False)
    # E z = E[G] C E x. `moments(1).mean` is E[[G, n], [0, 1]] (m + 1, p + 1), of which [:-1, :-1] is E[G].
    received = [np.asarray(c.moments(1).mean[:-1, :-1]) @ _matrix_of(s) for s, c in pairs]
    return UnconditionalMean(
        start=start,
        transition=_stack_over_time([_matrix_of(p) for p in plants]),
        drift=_stack_over_time(drifts),
        received=_stack_over_time(received),
    )


def centre_plant(plant: AnyPlant) -> AnyPlant:
    """Return the plant of the centred state x_k - E[x_k]."""
    centred: AnyPlant = at_each_step(_centre_plant, plant)
    return centred


def _centre_plant(plant: AbstractPlant) -> LinearPlant:
    """Return the plant of x - E x: the same matrices, but noise and first state with the mean 0.

    A law that simulations draw the first state from (`deviation`) is kept, about its mean; else it is Gaussian.
    """
    assert isinstance(plant, LinearPlant) and isinstance(plant.noise, AbstractNoise)
    law = about_mean(plant.deviation) if plant.deviation is not None else Gaussian(plant.initial_covariance)
    return LinearPlant(
        matrix=plant.matrix,
        noise=about_mean(plant.noise),
        initial_mean=np.zeros(len(plant.states)),
        initial_covariance=law,
        input_matrix=plant.input_matrix,
        states=plant.states,
        inputs=plant.inputs,
    )


def _matrix_of(model: AbstractPlant | AbstractSensor) -> np.ndarray:
    """Return the matrix A or C of a linear plant or sensor."""
    assert isinstance(model, LinearPlant | LinearSensor)  # checked before
    return np.asarray(model.matrix)


def _repeat(items: list[T], count: int) -> list[T]:
    """Return the items of `count` steps: a single item, of a model that does not vary over time, is repeated."""
    return items * count if len(items) == 1 else items


def _stack_over_time(values: list[np.ndarray]) -> Array | OverTime:
    """Return the values of all steps as one model of them; a single value is constant."""
    return values[0] if len(values) == 1 else OverTime(np.array(values))
