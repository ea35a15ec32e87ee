"""Who receives the stator currents: two nodes behind relays, one by wire, and the filters at each."""

from zlib import crc32

import jax
import jax.numpy as jnp
import numpy as np

import heliograph as hg
from heliograph.numerics.float64 import compiled
from heliograph.random_affine.base import apply
from heliograph.simulation.draws import CHANNEL, SENSOR, draw_key
from heliograph_studies.motor_drive.machine import CURRENT

SENSOR_VARIANCE = 0.05**2  # A^2
HOP_VARIANCE = 0.05**2  # A^2, at the relay and at the receiver
# Probabilities known to 0.02, as the publication's are; the simulated channel has the nominal ones.
STEADY = hg.Discrete([0.8, 0.9, 1.0], [0.2, 0.3, 0.5], 0.02)
FADING = hg.Discrete([0.7, 0.85, 1.0], [0.3, 0.3, 0.4], 0.02)
DEEP_FADING = hg.Discrete([0.4, 0.7, 1.0], [0.2, 0.3, 0.5], 0.02)
CHANNELS: dict[str, hg.random_affine.AbstractRandomAffine] = {
    "relay_1": hg.amplify_and_forward(
        [hg.hop(FADING, HOP_VARIANCE, dimension=2), hg.hop(STEADY, HOP_VARIANCE, dimension=2)]
    ),
    "relay_2": hg.amplify_and_forward(
        [hg.hop(DEEP_FADING, HOP_VARIANCE, dimension=2), hg.hop(STEADY, HOP_VARIANCE, dimension=2)]
    ),
    "wired": hg.perfect(2),
}


def currents(states: int) -> hg.LinearSensor:
    """Both currents in A, of a state per unit."""
    return hg.LinearSensor(CURRENT * np.eye(2, states), SENSOR_VARIANCE, ("i_alpha", "i_beta"))


def network(plant: hg.Plant) -> hg.Network:
    """The three nodes with their filters on one model of the machine, and what is fused of the two behind relays."""
    sensor = currents(len(plant.states))
    nodes = {}
    for name, channel in CHANNELS.items():
        filters: dict[str, hg.filters.AbstractFilter] = {
            "zero_mean": hg.cubature_filter(plant, sensor, channel, hg.filters.ZeroMean()),
            "polytope": hg.cubature_filter(plant, sensor, channel, hg.filters.Polytope()),
            "mean_gain": hg.mean_gain_filter(plant, sensor, channel),
        }
        wired = {"perfect": hg.cubature_filter(plant, sensor, channel), "open_loop": hg.filters.open_loop_filter(plant)}
        nodes[name] = hg.Node(sensor, channel, wired if name == "wired" else filters)
    optimal, equal = hg.CovarianceIntersection(), hg.fusion.EqualIntersection()
    fusions = {name: hg.Fusion(name, optimal) for name in ("zero_mean", "polytope")}
    return hg.Network(plant, nodes, fusions | {"equal_weights": hg.Fusion("zero_mean", equal)})


def received(truth: np.ndarray, seed: int) -> dict[str, np.ndarray]:
    """What reaches each node (steps, 2) in A; the three receive one machine, each with its own sensor and channel."""
    sensor = currents(truth.shape[1])
    return {
        name: np.asarray(_send(sensor, channel, truth, seed, crc32(name.encode())))
        for name, channel in CHANNELS.items()
    }


@compiled
def _send(
    sensor: hg.LinearSensor, channel: hg.random_affine.AbstractRandomAffine, truth: np.ndarray, seed: int, place: int
) -> jax.Array:
    key = jax.random.key(seed)

    def single(k: jax.Array, x: jax.Array) -> jax.Array:
        y = sensor.measure(x) + sensor.noise.sample(draw_key(key, k, place, SENSOR))
        z: jax.Array = apply(channel.sample(draw_key(key, k, place, CHANNEL)), y)
        return z

    return jax.vmap(single)(jnp.arange(len(truth)), jnp.asarray(truth))
