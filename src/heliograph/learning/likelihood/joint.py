"""Sensor and channel of all nodes of a network together."""

from heliograph.model.channel import Channel, parallel
from heliograph.model.clock import joint_sensor
from heliograph.model.over_time import OverTime, first, over_time, unstack
from heliograph.model.plant import AnyPlant
from heliograph.model.sensor import AbstractSensor, AnySensor, LinearSensor
from heliograph.numerics.check import fail
from heliograph.numerics.traced import library
from heliograph.random_affine.arrived import arrived
from heliograph.random_affine.noise import Independent
from heliograph.simulation.network import Network
from heliograph.simulation.node import Node


def joint_world(network: Network) -> tuple[AnyPlant, AnySensor, Channel]:
    """Plant, sensor and channel of all nodes together, in their order, as if no observed loss ever happened.

    Raises:
        ValueError: relays that filter and forward, several nodes of which one varies over time.
    """
    if network.relays is not None:
        raise fail("network to be learned", "nodes that hear sensors through channels", "relays that filter")
    if network.common is not None:
        return network.plant, network.common.sensor, _joint_channel(network.common.channel)
    nodes = [node for name in network.names if isinstance(node := network.nodes[name], Node)]
    if len(nodes) == 1:
        return network.plant, nodes[0].sensor, _joint_channel(nodes[0].channel)
    if any(isinstance(part, OverTime) for node in nodes for part in (node.sensor, node.channel)):
        raise fail("network to be learned", "one node, where its sensor or channel varies over time", len(nodes))
    sensors = {name: first(node.sensor) for name, node in zip(network.names, nodes, strict=True)}
    return network.plant, _joined(sensors), parallel([first(_joint_channel(node.channel)) for node in nodes])


def _joined(sensors: dict[str, AbstractSensor]) -> AbstractSensor:
    parts = [sensor for sensor in sensors.values() if isinstance(sensor, LinearSensor)]
    if len(parts) < len(sensors):
        return joint_sensor(sensors)
    matrices = [part.matrix for part in parts]
    outputs = [f"{name}_{output}" for name, part in zip(sensors, parts, strict=True) for output in part.outputs]
    return LinearSensor(library(matrices).concatenate(matrices), Independent([part.noise for part in parts]), outputs)


def _joint_channel(channel: Channel) -> Channel:
    """Channel without observed losses, which leave rows out; with memory losses tell the modes, and stay."""
    if first(channel).remembers or not first(channel).erases:
        return channel
    if isinstance(channel, OverTime):
        return over_time([arrived(item) for item in unstack(channel)])
    return arrived(channel)
