"""A network: one plant, and nodes that each have a sensor, a channel and the filters that listen to it."""

from collections.abc import Mapping
from typing import Any
from zlib import crc32

import equinox as eqx

from heliograph.filters.base import AbstractFilter
from heliograph.fusion.rules import Fusion
from heliograph.model.channel import Channel, check_link
from heliograph.model.estimate import Claim
from heliograph.model.over_time import first, steps_covered
from heliograph.model.plant import AbstractPlant, AnyPlant
from heliograph.model.sensor import AbstractSensor, AnySensor
from heliograph.numerics.check import check_horizon, fail
from heliograph.random_affine.base import AbstractRandomAffine

FUSED = "fused"  # the name under which results of several nodes stand


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

    `fused` names what is made of several nodes: a `Fusion` of the estimates that one of their filters gives, or a
    central filter that receives all measurements, joined in the order of the nodes. In results these stand under the
    node name "fused".

    Raises:
        ValueError: no nodes, a node that does not fit the plant, or a fusion of a filter that no node has.
    """

    plant: AnyPlant
    nodes: dict[str, Node]
    fused: dict[str, Fusion | AbstractFilter]
    names: tuple[str, ...] = eqx.field(static=True)  # in the given order: compiled code sorts dictionaries

    def __init__(
        self, plant: AnyPlant, nodes: Mapping[str, Node], fused: Mapping[str, Fusion | AbstractFilter] | None = None
    ):
        self.plant, self.nodes, self.fused = plant, dict(nodes), dict(fused or {})
        self.names = tuple(self.nodes)
        _check_type("plant", first(plant), AbstractPlant)
        if not self.nodes:
            raise fail("network", "at least one node", "none")
        for name, node in self.nodes.items():
            _check_type(f"node {name!r}", node, Node)
            check_link(first(node.sensor), first(node.channel), len(self.states))
        if len({crc32(name.encode()) for name in self.nodes}) != len(self.nodes):
            raise fail("node names", "names with distinct checksums", list(self.nodes))
        if self.fused and FUSED in self.nodes:
            raise fail("node names", f"no node called {FUSED!r}, which stands for fused results", list(self.nodes))
        for name, item in self.fused.items():
            if isinstance(item, Fusion):
                item.check(self.nodes_with(item.filter), len(self.states))
                self._fused_claim(item)
            else:
                _check_type(f"fused {name!r}", item, AbstractFilter)

    def nodes_with(self, name: str) -> list[str]:
        """Names of the nodes that have the filter `name`, in the given order.

        Raises:
            ValueError: none has it.
        """
        found = [node for node in self.names if name in self.nodes[node].filters]
        if not found:
            known = sorted({f for node in self.nodes.values() for f in node.filters})
            raise fail("fusion", f"a filter that some node has {known}", repr(name))
        return found

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

    def claims(self) -> dict[str, dict[str, Claim]]:
        """What every estimate claims, by node and filter; fused ones last, under "fused"."""
        claims = {name: {f: item.claim for f, item in node.filters.items()} for name, node in self.nodes.items()}
        if self.fused:
            claims[FUSED] = {name: self._fused_claim(item) for name, item in self.fused.items()}
        return claims

    def _fused_claim(self, item: Fusion | AbstractFilter) -> Claim:
        if isinstance(item, AbstractFilter):
            return item.claim
        return item.claim([self.nodes[n].filters[item.filter].claim for n in self.nodes_with(item.filter)])

    def check_horizon(self, horizon: int) -> None:
        """Raise ValueError if something that varies over time ends before `horizon` steps."""
        check_horizon(horizon, steps_covered(self))


def _check_type(name: str, value: Any, expected: type) -> None:
    if not isinstance(value, expected):
        raise fail(name, f"a {expected.__name__}", type(value).__name__)
