"""Nodes that measure states which nothing couples: plants of their own, written as one."""

import jax
import jax.numpy as jnp
import numpy as np
from scipy.sparse.csgraph import connected_components

from heliograph.model.plant import LinearPlant
from heliograph.model.sensor import LinearSensor
from heliograph.numerics.types import Bool
from heliograph.simulation.network import Network
from heliograph.simulation.node import Node


def separate_nodes(network: Network) -> list[list[str]]:
    """Return the nodes by the states that they measure, where no state of one list is coupled with one of another.

    States are coupled by A, by the covariances of w and of x_0, and by a sensor that measures both. Known of linear
    plants and sensors that do not vary over time; otherwise all nodes are in one list.
    """
    nodes = {name: node.sensor for name, node in network.nodes.items() if isinstance(node, Node)}
    linear = isinstance(network.plant, LinearPlant) and all(isinstance(s, LinearSensor) for s in nodes.values())
    if not linear or len(nodes) < len(network.nodes):
        return [list(network.nodes)]
    # A graph of the states: edges between those that the plant couples, or that one sensor measures.
    measured = {name: _mask_measured(sensor) for name, sensor in nodes.items()}
    coupled = _mask_coupled(network.plant)
    for states in measured.values():
        coupled |= states[:, None] & states
    # Its connected components: `component` (states,) is the number of each state's.
    _, component = connected_components(coupled, directed=False)
    nodes_by_component: dict[int, list[str]] = {}
    for name, states in measured.items():
        first_measured = int(np.argmax(states))  # all states that a node measures are in one component
        nodes_by_component.setdefault(int(component[first_measured]), []).append(name)
    return list(nodes_by_component.values())


def _mask_measured(sensor: object) -> Bool[np.ndarray, " states"]:
    """Return which states a linear sensor measures."""
    assert isinstance(sensor, LinearSensor)
    return np.asarray(np.any(np.asarray(sensor.matrix) != 0, axis=0))


def _mask_coupled(plant: object) -> Bool[np.ndarray, "states states"]:
    """Return which pairs of states a linear plant couples by its motion, noise or initial covariance.

    All inputs are 1.
    """
    assert isinstance(plant, LinearPlant)
    u = jnp.ones(len(plant.inputs))
    with jax.enable_x64(True):
        matrices = plant.transition_matrix(u), plant.noise_covariance(u), plant.initial_covariance
    are_nonzero = [np.asarray(matrix) != 0 for matrix in matrices]
    return np.asarray(sum(are_nonzero) > 0)
