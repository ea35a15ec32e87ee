"""Which outputs within n steps depend on which state: the observability matrix of a network at one state."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.model.over_time import first
from heliograph.model.plant import AbstractPlant
from heliograph.model.sensor import AbstractSensor
from heliograph.numerics.types import Float
from heliograph.simulation.network import Network
from heliograph.simulation.node import Node


def list_sensors(network: Network) -> list[AbstractSensor]:
    """Return every sensor of the network, at its first step."""
    sensors = [node.sensor for node in network.nodes.values() if isinstance(node, Node)]
    sensors += [] if network.common is None else [network.common.sensor]
    sensors += [] if network.relays is None else [network.relays.sensor]
    return [first(sensor) for sensor in sensors]


def make_observability_matrix(
    plant: AbstractPlant, sensors: Sequence[AbstractSensor], state: Float[np.ndarray, " n"], steps: int
) -> Float[np.ndarray, "rows n"]:
    """Return d(y_1, ..., y_steps)/dx_0 at a state, all sensors stacked, with inputs of 1."""
    with jax.enable_x64(True):
        return np.asarray(jax.jacfwd(lambda x: _measure_steps(plant, sensors, x, steps))(jnp.asarray(state)))


def measure_from(
    plant: AbstractPlant, sensors: Sequence[AbstractSensor], states: Float[np.ndarray, "states n"], steps: int
) -> Float[np.ndarray, "states rows"]:
    """Return y_1, ..., y_steps of all sensors from each of some states, without noise, with inputs of 1."""
    with jax.enable_x64(True):
        return np.asarray(jax.vmap(lambda x: _measure_steps(plant, sensors, x, steps))(jnp.asarray(states)))


def _measure_steps(plant: AbstractPlant, sensors: Sequence[AbstractSensor], x: jax.Array, steps: int) -> jax.Array:
    """Return y_1, ..., y_steps of all sensors from the state x, stacked."""
    u, results = jnp.ones(len(plant.inputs)), list[jax.Array]()
    for _ in range(steps):
        x = plant.transition(x, u)
        results += [sensor.under(plant.inputs, u).measure(x) for sensor in sensors]
    return jnp.concatenate(results)
