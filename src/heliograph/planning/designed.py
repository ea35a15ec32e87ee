"""A network with the powers of a design, and the best linear filters of it: one that runs."""

from collections.abc import Mapping, Sequence
from typing import TypeVar

import numpy as np
from scipy.linalg import block_diag

from heliograph.filters.linear import linear_filter
from heliograph.model.channel import parallel
from heliograph.model.over_time import OverTime, at, over_time
from heliograph.model.sensor import LinearSensor
from heliograph.numerics.check import instance
from heliograph.numerics.types import Float
from heliograph.planning.criterion import Error
from heliograph.planning.reallocation import allocated
from heliograph.planning.repeated import repeated
from heliograph.planning.state_power import of_sensor, seconds_over, steady_second
from heliograph.simulation.network import Network
from heliograph.simulation.node import Node

BEST = "best"
T = TypeVar("T")


def designed_network(network: Network, powers: Mapping[str, Float[np.ndarray, "steps"]], error: Error) -> Network:
    """Every node with the filter "best" behind its channel, and with several nodes "best" of all that they receive."""
    instance("network", network, Network, "a Network")
    instance("error", error, Error, "an Error")
    nodes = {name: node for name, node in network.nodes.items() if isinstance(node, Node)}
    if error.horizon is None:
        seconds = np.tile(steady_second(network.plant), (error.period, 1, 1))
    else:
        seconds = seconds_over(network.plant, error.horizon)
    each = [
        {
            name: allocated(at(node.channel, k), of_sensor(node.sensor, second, k), _of_node(name, powers, k), k)
            for name, node in nodes.items()
        }
        for k, second in enumerate(seconds)
    ]
    channels = {name: _over_time([one[name] for one in each]) for name in nodes}
    plant = network.plant
    own = {
        name: Node(node.sensor, channels[name], {BEST: linear_filter(plant, node.sensor, channels[name])})
        for name, node in nodes.items()
    }
    if len(own) == 1:
        return _for_ever(Network(plant, own), error)
    sensors = {name: node.sensor for name, node in nodes.items()}
    varying = [sensor.steps for sensor in sensors.values() if isinstance(sensor, OverTime)]
    steps = min(varying) if varying else 1
    joint = _over_time([_joined({name: at(sensor, k) for name, sensor in sensors.items()}) for k in range(steps)])
    whole = _over_time([parallel(list(one.values())) for one in each])
    return _for_ever(Network(plant, own, {BEST: linear_filter(plant, joint, whole)}), error)


def _for_ever(network: Network, error: Error) -> Network:
    """What repeats with the error's period, over as many steps as a run may have."""
    return repeated(network) if error.period > 1 else network


def _of_node(name: str, powers: Mapping[str, Float[np.ndarray, "steps"]], k: int) -> dict[str, float]:
    start = f"{name}."
    return {key.removeprefix(start): float(power[k]) for key, power in powers.items() if key.startswith(start)}


def _over_time(items: Sequence[T]) -> T | OverTime:
    """One object for ever, or one for each step."""
    return items[0] if len(items) == 1 else over_time(items)


def _joined(sensors: Mapping[str, LinearSensor]) -> LinearSensor:
    """All sensors as one, each output called by its node."""
    return LinearSensor(
        np.concatenate([np.asarray(s.matrix) for s in sensors.values()]),
        block_diag(*(np.asarray(s.noise.covariance) for s in sensors.values())),
        [f"{name} {output}" for name, s in sensors.items() for output in s.outputs],
    )
