"""Plants whose past outputs are states, so that what arrives late is a measurement of the present."""

from functools import partial
from typing import Any

import numpy as np

from heliograph.model.channel import Channel, check_link
from heliograph.model.over_time import at_each_step, first
from heliograph.model.plant import AnyPlant, LinearPlant
from heliograph.model.sensor import AnySensor, LinearSensor, check_linear
from heliograph.numerics.check import fail
from heliograph.numerics.numpy_or_jax import library
from heliograph.numerics.types import rename
from heliograph.random_affine.delay import place_on_delay_line
from heliograph.random_affine.noises.noise import AbstractNoise, Gaussian, Independent
from heliograph.random_affine.noises.shaped_noise import Shaped


def with_past(plant: AnyPlant, sensor: AnySensor, channel: Channel) -> tuple[AnyPlant, LinearSensor, Channel]:
    """Return plant, sensor and channel of the state (x_k, y_k, y_{k-1}, ..., y_{k-D}), and so without a delay.

    A channel that delivers late, by up to D steps, needs the past outputs y of the sensor, so they become states. The
    new sensor reads all these outputs without noise, and the new channel takes them and delivers one by the law of the
    delay. So any filter of linear plants can be made for the three. Before the first step zeros were sent.

    The state y_{k+1} = C x_{k+1} + v_{k+1} contains the sensor's noise. So if one y is received twice, it brings the
    same noise twice, and is used as one measurement. With past x as states instead, its noise would count as two
    independent ones, and the claimed covariance would be too small.

    Args:
        plant: a linear plant, n states.
        sensor: a linear sensor.
        channel: a channel that delivers late, by up to D steps.

    Raises:
        ValueError: a plant or sensor that is not linear or has angles, parts that do not fit, process noise that
            depends on inputs.
    """
    check_linear("plant and sensor behind a random delay", plant, sensor)
    check_link(first(sensor), first(channel), len(first(plant).states), late=True)
    augmented: AnyPlant = at_each_step(partial(_append_delay_line, past=first(channel).past), plant, sensor)
    n, states = len(first(plant).states), first(augmented).states
    # The new sensor has the matrix (0, I) for the state (x, y_k, ..., y_{k-D}), and no noise.
    outputs = len(states) - n
    read_outputs = LinearSensor(np.eye(len(states))[n:], np.zeros((outputs, outputs)), states[n:])
    return augmented, read_outputs, place_on_delay_line(channel)


def _append_delay_line(plant: Any, sensor: Any, past: int) -> LinearPlant:
    """Return the plant of (x, y_k, ..., y_{k-past}): x+ = A x + B u + w, y+ = C x+ + v, and older outputs move on.

    A message that is late by d steps carries y_{k-d}. With past outputs in the state it is a linear measurement.

    Args:
        plant: the linear plant of x.
        sensor: the linear sensor, C and v.
        past: number of past outputs that are kept beside the present one.
    """
    if not isinstance(plant.noise, AbstractNoise):
        raise fail("noise of a plant behind a random delay", "a covariance or a noise law", "a function of the inputs")
    c = sensor.matrix
    xp = library(plant.matrix, plant.input_matrix, c)
    m, n = c.shape
    length = past * m  # of the older outputs together
    # Blocks of rows: x+ (n), y+ (m), older outputs (past m). Columns: x, and all outputs. The rows of the older outputs
    # take y_k, ..., y_{k-past+1}.
    from_state = xp.concatenate([plant.matrix, c @ plant.matrix, np.zeros((length, n))])
    from_line = np.concatenate([np.zeros((n + m, length + m)), np.eye(length, length + m)])
    input_matrix = xp.concatenate([plant.input_matrix, c @ plant.input_matrix, np.zeros((length, len(plant.inputs)))])
    # (w, v) enters x+ and y+ = C w + v.
    noise_matrix = xp.block([[np.eye(n), np.zeros((n, m))], [c, np.eye(m)], [np.zeros((length, n + m))]])
    # Nothing was sent before the start: all outputs are zero there. x_0 = initial_mean - law.mean + (a draw of `law`):
    # the draw brings the law's own mean, which is therefore subtracted first.
    law = Gaussian(plant.initial_covariance) if plant.deviation is None else plant.deviation
    output_names = [
        rename(name, f"{name}_{d}_ago" if d else f"{name}_sent") for d in range(past + 1) for name in sensor.outputs
    ]
    return LinearPlant(
        matrix=xp.concatenate([from_state, from_line], axis=1),
        noise=Shaped(noise_matrix, Independent([plant.noise, sensor.noise])),
        initial_mean=xp.concatenate([plant.initial_mean - law.mean, np.zeros(length + m)]),
        initial_covariance=Independent([law, Gaussian(np.zeros((length + m, length + m)))]),
        input_matrix=input_matrix,
        states=(*plant.states, *output_names),
        inputs=plant.inputs,
        limits=plant.limits,
    )
