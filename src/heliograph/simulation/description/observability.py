"""Which outputs within n steps depend on which state: the observability matrix of a network at one state."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.model.over_time import first
from heliograph.model.plant import AbstractPlant
from heliograph.model.sensor import AbstractSensor
from heliograph.numerics.float64 import compile_in_float64
from heliograph.numerics.types import Array, Float, Int
from heliograph.simulation.network import Network
from heliograph.simulation.node import Node


def list_sensors(network: Network) -> list[AbstractSensor]:
    """Return every sensor of the network, at its first step: of the nodes, common to all nodes, or behind relays."""
    sensors = [node.sensor for node in network.nodes.values() if isinstance(node, Node)]
    if network.common is not None:
        sensors.append(network.common.sensor)
    if network.relays is not None:
        sensors.append(network.relays.sensor)
    return [first(sensor) for sensor in sensors]


def make_observability_matrix(
    plant: AbstractPlant, sensors: Sequence[AbstractSensor], state: Float[np.ndarray, " n"], steps: int
) -> Float[np.ndarray, "rows n"]:
    """Return the observability matrix d(y_1, ..., y_steps)/dx_0 at a state, with all sensors stacked.

    All inputs are 1.
    """
    return np.asarray(_differentiate_outputs(plant, tuple(sensors), state, np.arange(steps)))


def simulate_outputs(
    plant: AbstractPlant, sensors: Sequence[AbstractSensor], states: Float[np.ndarray, "states n"], steps: int
) -> Float[np.ndarray, "states rows"]:
    """Return y_1, ..., y_steps of all sensors from each initial state, one row each, without noise.

    All inputs are 1.
    """
    return np.asarray(_measure_from_states(plant, tuple(sensors), states, np.arange(steps)))


@compile_in_float64
def _differentiate_outputs(
    plant: AbstractPlant, sensors: tuple[AbstractSensor, ...], state: Float[Array, " n"], rows: Int[Array, " steps"]
) -> jax.Array:
    """Return d(y_1, ..., y_steps)/dx_0 at `state` for the outputs of all sensors: (outputs of all steps, n)."""
    jacobian: jax.Array = jax.jacfwd(lambda x: _measure_rows(plant, sensors, x, rows))(state)
    return jacobian


@compile_in_float64
def _measure_from_states(
    plant: AbstractPlant,
    sensors: tuple[AbstractSensor, ...],
    states: Float[Array, "states n"],
    rows: Int[Array, " steps"],
) -> jax.Array:
    """Return the outputs y_1, ..., y_steps of all sensors, one after another, from each state: (states, rows)."""
    return jax.vmap(lambda x: _measure_rows(plant, sensors, x, rows))(states)


def _measure_rows(
    plant: AbstractPlant, sensors: tuple[AbstractSensor, ...], x: jax.Array, rows: Int[Array, " steps"]
) -> jax.Array:
    """Return y_1, ..., y_steps of all sensors from the state x in one row, one step for each entry of `rows`.

    There is no noise, and all inputs are 1. The result is flat: all outputs of the first step, then of the second, and
    so on.
    """
    u = jnp.ones(len(plant.inputs))

    def step(x: jax.Array, _: object) -> tuple[jax.Array, jax.Array]:
        """Return the state after a step without noise, with inputs u, and what all sensors measure there."""
        x = plant.transition(x, u)
        return x, jnp.concatenate([sensor.under(plant.inputs, u).measure(x) for sensor in sensors])

    _, outputs = jax.lax.scan(step, x, rows)
    return outputs.reshape(-1)
