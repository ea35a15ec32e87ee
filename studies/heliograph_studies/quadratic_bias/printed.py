"""The quadratic filter as printed: Theorems 1 and 2 take V_t as white, which random powers deny."""

from typing import NamedTuple

import numpy as np

from heliograph.linear.lift import lifted_system
from heliograph.linear.recursion import lmmse, true_covariance
from heliograph.linear.system import LinearSystem, Schedule, state_moments
from heliograph.model.channel import Channel
from heliograph.model.plant import AnyPlant
from heliograph.model.sensor import AnySensor
from heliograph.random_affine.combine import known


class Printed(NamedTuple):
    """The printed filter: its gains with what it claims, and the covariance (time, n, n) that it has."""

    schedule: Schedule
    true_covariance: np.ndarray


def printed_quadratic(plant: AnyPlant, sensor: AnySensor, channel: Channel, horizon: int) -> Printed:
    """Gains, claimed covariance (36) and true covariance of (14) with (30), (31) and (35), Lemma 4 corrected."""
    square = lifted_system(plant, sensor, channel, 2, horizon)
    schedule = lmmse(believed(square, lifted_system(plant, sensor, channel, 1, horizon)), "nominal")
    return Printed(schedule, true_covariance(square, schedule))


def believed(square: LinearSystem, linear: LinearSystem) -> LinearSystem:
    """The system that the paper believes in, from the true one of degree 2 and that of degree 1.

    E[z z' | x] is taken as (mean gain)^2 x x' plus a constant (printed: theta^2 mu^2, true: theta^2 E[l m]). What is
    left over, D Y + V with D = C - C_printed, has the right covariance D Cov(Y) D' + Cov(V), but it is no longer
    uncorrelated with Y.
    """
    before, s = state_moments(square), linear.steps
    output = np.array([known(c, o).moments(2).matrix[:-1, :-1] for c, o in zip(s.output, s.offset, strict=True)])
    gap = square.steps.output - output
    offset = square.steps.offset + np.einsum("tij,tj->ti", gap, before.mean[1:])
    noise = square.steps.noise + gap @ before.covariance[1:] @ np.swapaxes(gap, 1, 2)
    steps = square.steps._replace(output=output, offset=offset, noise=noise)
    return LinearSystem(steps, square.mean, square.covariance, square.projection, square.rounding)
