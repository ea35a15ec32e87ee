"""A network: one plant, and nodes that each have a sensor, a channel and the filters that listen to it."""

from collections.abc import Mapping
from typing import Any
from zlib import crc32

import equinox as eqx

from heliograph.channel import Channel, check_link
from heliograph.check import fail
from heliograph.filter.base import AbstractFilter
from heliograph.over_time import first, steps_covered
from heliograph.plant import AbstractPlant, AnyPlant
from heliograph.random_affine.base import AbstractRandomAffine
from heliograph.sensor import AbstractSensor, AnySensor


class Node(eqx.Module):
    """A sensor, the channel its signal takes, and named filters; the world's channel need not be what they believe.

    Raises:
        ValueError: a sensor and a channel that do not fit.
    """

    sensor: AnySensor
    channel: Channel
    filters: dict[str, AbstractFilter]

    def __init__(self, sensor: AnySensor, channel: Channel, filters: Mapping[str, AbstractFilter]):
        self.sensor, self.channel, self.filters = sensor, channel, dict(filters)
        _check_type("sensor", first(sensor), AbstractSensor)
        _check_type("channel", first(channel), AbstractRandomAffine)
        for name, item in self.filters.items():
            _check_type(f"filter {name!r}", item, AbstractFilter)

    @property
    def received(self) -> int:
        """Length of the measurement that reaches the filters."""
        return int(first(self.channel).outputs)


class Network(eqx.Module):
    """A plant observed by named nodes. Everything downstream (simulation, filters, reports) reads this one description.

    Raises:
        ValueError: no nodes, or a node that does not fit the plant.
    """

    plant: AnyPlant
    nodes: dict[str, Node]

    def __init__(self, plant: AnyPlant, nodes: Mapping[str, Node]):
        self.plant, self.nodes = plant, dict(nodes)
        _check_type("plant", first(plant), AbstractPlant)
        if not self.nodes:
            raise fail("network", "at least one node", "none")
        for name, node in self.nodes.items():
            _check_type(f"node {name!r}", node, Node)
            check_link(first(node.sensor), first(node.channel), len(self.states))
        if len({crc32(name.encode()) for name in self.nodes}) != len(self.nodes):
            raise fail("node names", "names with distinct checksums", list(self.nodes))

    @property
    def states(self) -> tuple[str, ...]:
        """Names of the plant's states."""
        names: tuple[str, ...] = first(self.plant).states
        return names

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the plant's inputs."""
        names: tuple[str, ...] = first(self.plant).inputs
        return names

    def check_horizon(self, horizon: int) -> None:
        """Raise ValueError if something that varies over time ends before `horizon` steps."""
        covered = steps_covered(self)
        if covered is not None and horizon > covered:
            raise fail("horizon", f"at most {covered} steps, which what varies over time covers", horizon)


def _check_type(name: str, value: Any, expected: type) -> None:
    if not isinstance(value, expected):
        raise fail(name, f"a {expected.__name__}", type(value).__name__)
