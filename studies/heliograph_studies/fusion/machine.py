"""An induction machine heard by four nodes through relays of strong signals; filters that are not linear."""

from collections.abc import Mapping
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np

import heliograph as hg
from heliograph.filters.gaussian.gaussian import GaussianFilter

B1, B2, B3, B4, B5 = -0.186, -1.778, 6.125, -6.234, 0.081  # stator, rotor, torque
STEP, FREQUENCY, VOLTAGE = 0.1, 2.0, 2.0
OUTPUTS = ((-4.448, 1.11), (-4.428, 1.21), (-4.435, 1.05), (-4.441, 1.14))
START = (0.25, -0.55, -0.4, 0.2, 0.15)
NOISE, SPREAD = 1e-3, 0.02  # variance of sensors and hops, and of the start
HORIZON = 100


def transition(x: jax.Array, _: object) -> jax.Array:
    """Fluxes x1 to x4 and angular velocity x5, one Euler step without load."""
    rates = [
        B1 * x[0] + FREQUENCY * x[1] + B2 * x[2] + VOLTAGE,
        -FREQUENCY * x[0] + B1 * x[1] + B2 * x[3],
        B3 * x[0] + B4 * x[2] + (FREQUENCY - x[4]) * x[3],
        B3 * x[1] - (FREQUENCY - x[4]) * x[2] + B4 * x[3],
        B5 * (x[0] * x[3] - x[1] * x[2]),
    ]
    return x + STEP * jnp.stack(rates)


@cache
def plant() -> hg.Plant:
    """The machine."""
    return hg.Plant(transition, 1e-5 * np.eye(5), START, SPREAD * np.eye(5), ["x1", "x2", "x3", "x4", "x5"])


def sensor(node: int) -> hg.LinearSensor:
    """Two currents, as a node measures them."""
    p, q = OUTPUTS[node]
    return hg.LinearSensor([[p, 0, q, 0, 0], [0, p, 0, q, 0]], NOISE * np.eye(2))


def channel() -> hg.random_affine.AbstractRandomAffine:
    """Two hops whose probabilities are known to 0.02."""
    first = hg.Discrete([0.7, 0.85, 1.0], [0.3, 0.3, 0.4], 0.02)
    second = hg.Discrete([0.8, 0.9, 1.0], [0.2, 0.3, 0.5], 0.02)
    noise = NOISE * np.eye(2)
    return hg.amplify_and_forward([hg.hop(first, noise), hg.hop(second, noise, amplification=2.0)])


def cubature(node: int) -> GaussianFilter:
    """A node's cubature filter; its update trusts that its errors have mean zero."""
    start = START, SPREAD * np.eye(5)
    return hg.cubature_filter(plant(), sensor(node), channel(), hg.filters.ZeroMean(), *start)


def network(local: str, fused: Mapping[str, hg.Fusion | hg.filters.AbstractFilter], count: int) -> hg.Network:
    """Nodes with one filter each, the given fusions of it, and the filter "central" that hears all nodes."""
    filters = [cubature(i) for i in range(count)]
    nodes = {f"node {i + 1}": hg.Node(sensor(i), channel(), {local: item}) for i, item in enumerate(filters)}
    return hg.Network(plant(), nodes, {**fused, "central": hg.filters.sequential_filter(filters)})
