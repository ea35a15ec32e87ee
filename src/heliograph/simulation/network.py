"""Network: one plant, and nodes that receive measurements of it, with their filters."""

import warnings
from collections.abc import Iterable, Mapping
from copy import copy
from functools import cached_property
from typing import ClassVar
from zlib import crc32

import equinox as eqx
import numpy as np

from heliograph.filters.base import AbstractFilter
from heliograph.filters.linear.scheduled_gains import ScheduledFilter
from heliograph.fusion.network_fusion import Fusion
from heliograph.linear.system import Schedule
from heliograph.model.channel import Channel, check_link, find_received_angles
from heliograph.model.estimate import Claim
from heliograph.model.over_time import first, steps_covered
from heliograph.model.plant import AbstractPlant, AnyPlant
from heliograph.model.readings.repeated_readings import Repeats
from heliograph.model.relays import RECEIVER, RelayNetwork
from heliograph.model.sensor import AnySensor, without_output_names
from heliograph.numerics.angles.angle import Angles
from heliograph.numerics.check import check_horizon, fail, table
from heliograph.numerics.frozen_mapping import FrozenMapping
from heliograph.numerics.module import Module, readable
from heliograph.random_affine.base import check_forgets
from heliograph.random_affine.memories_of_channels import memories
from heliograph.simulation.covariance_claims import (
    MistakenBelief,
    find_claims,
    lower_claim,
    lower_claims_of_central_filters,
    lower_claims_of_nodes,
    make_fusions_nominal,
    make_nodes_nominal,
    pad_filters_alike,
    yield_mistaken_beliefs,
)
from heliograph.simulation.description.diagram import write_diagram, write_html_table, write_short_diagram
from heliograph.simulation.filter_flag_check import check_filter_flags
from heliograph.simulation.mesh.check import check_mesh
from heliograph.simulation.network_index import (
    EstimateIndex,
    StackIndex,
    find_estimate_indices,
    find_rows_of_nodes,
    group_by_structure,
    list_mesh_stacks,
    list_stacks,
)
from heliograph.simulation.node import FUSED as FUSED
from heliograph.simulation.node import (
    CommonReception,
    Node,
    ReceivingNode,
    check_angles,
    check_filters,
    check_received,
    check_states,
    get_parts_of_reception,
)
from heliograph.simulation.recordings.screened_recording import ScreenedRecording, screen_recording
from heliograph.simulation.sender_checks import check_type, refuse_words_and_feedback

Claims = dict[str, dict[str, Claim]]  # by node and filter

LOCAL = "local"  # a relay's one filter
SENSORLESS = ReceivingNode({}, 0, (), True)  # a node that estimates from its neighbours alone


class Network(Module):
    """A plant observed by named nodes: the description that simulation, filters and reports are made from.

    `Network.of_relays` makes the network of relays that filter and forward, `Network.sharing` that of nodes which share
    a sensor's noise, a hop or fading. Nodes of one structure form a group, filters of one structure in it a stack: each
    is one array axis from here to the results, which have names again.

    Args:
        plant: the plant.
        nodes: nodes by name; None for a node without a sensor, which estimates from its neighbours.
        fused: fusions by name: a `Fusion` of the estimates of one of the nodes' filters, or a central filter that
            receives all measurements, joined in the order of the nodes. In results they stand under the node name
            "fused", and fusions between neighbours under each of their nodes. None by default.
        relays: network of relays, set by `Network.of_relays`.
        common: common sensor and channel, set by `Network.sharing`.

    Raises:
        ValueError: no nodes, a node that does not fit the plant, or a fusion of a filter that no node has; between
            neighbours a node that cannot know the plant's state from those upstream.
    """

    FUSED: ClassVar[str] = FUSED  # the name under which results of several nodes stand
    LOCAL: ClassVar[str] = LOCAL  # of the one filter of a relay
    plant: AnyPlant
    nodes: dict[str, Node | ReceivingNode]
    fused: dict[str, Fusion | AbstractFilter]
    meshes: dict[str, Fusion]
    relays: RelayNetwork | None
    common: CommonReception | None
    # The index: names in the given order (compiled code sorts dictionaries), and where each stands.
    names: tuple[str, ...] = eqx.field(static=True)
    states: tuple[str, ...] = eqx.field(static=True)
    inputs: tuple[str, ...] = eqx.field(static=True)
    groups: tuple[tuple[str, ...], ...] = eqx.field(static=True)
    stacks: tuple[StackIndex, ...] = eqx.field(static=True)
    mesh_stacks: tuple[StackIndex, ...] = eqx.field(static=True)  # of meshes, sorted as in compiled code
    estimate_indices: FrozenMapping[tuple[str, str], EstimateIndex] = eqx.field(static=True)  # by node and filter
    rows: FrozenMapping[str, range] = eqx.field(static=True)  # among all measurements, joined in the order of the nodes
    claimed: FrozenMapping[tuple[str, str], Claim] = eqx.field(static=True)  # by node and filter, fused ones last

    def __init__(
        self,
        plant: AnyPlant,
        nodes: "Mapping[str, Node | ReceivingNode | None]",
        fused: "Mapping[str, Fusion | AbstractFilter] | None" = None,
        relays: "RelayNetwork | None" = None,
        common: "CommonReception | None" = None,
    ):
        """Check that all parts fit, lower claims (what covariances are said to be) that are wrong here, and index."""
        self.plant, self.relays, self.common = plant, relays, common
        # Nodes, and fusions between neighbours apart from those at a centre.
        self.nodes = {
            name: SENSORLESS if node is None else node for name, node in table("nodes", nodes, "nodes").items()
        }
        fusions = {} if fused is None else table("fused", fused, "fusions and central filters")
        self.meshes = {
            name: fusion for name, fusion in fusions.items() if isinstance(fusion, Fusion) and fusion.neighbours
        }
        self.fused = {name: fusion for name, fusion in fusions.items() if name not in self.meshes}
        self.names = tuple(self.nodes)
        check_type("plant", first(plant), AbstractPlant)
        if not self.nodes:
            raise fail("network", "at least one node", "none")
        self.states, self.inputs = first(plant).states, first(plant).inputs
        self._check_nodes()
        self.rows = FrozenMapping(find_rows_of_nodes({name: node.received for name, node in self.nodes.items()}))
        # A filter made for other models than its node's claims less. Arrays get one length, so that they stack.
        self.nodes = pad_filters_alike(lower_claims_of_nodes(self))
        # Groups of nodes and stacks of filters, by structure. `meshes`: each node's fusions between neighbours.
        meshes = {name: tuple(m for m in self.meshes if name in self.mesh_nodes(m)) for name in self.names}
        self.groups = group_by_structure(
            (name, without_output_names((get_parts_of_reception(n), n.filters, meshes[name])))
            for name, n in self.nodes.items()
        )
        self.stacks = list_stacks(self.groups, {name: node.filters for name, node in self.nodes.items()})
        self.mesh_stacks = list_mesh_stacks(self.groups, meshes)
        self.estimate_indices = FrozenMapping(find_estimate_indices(self.groups, self.stacks))
        # Links and fusions, which are checked by group.
        self._check_links()
        self._check_fused()
        self.fused = lower_claims_of_central_filters(self)
        for name, mesh in self.meshes.items():
            check_mesh(name, mesh, self)
        self.claimed = FrozenMapping(find_claims(self))

    def _check_nodes(self) -> None:
        """Raise ValueError unless nodes and filters fit the plant, and names' checksums, which seed draws, differ."""
        node_type = Node if self.relays is None and self.common is None else ReceivingNode
        for name, node in self.nodes.items():
            may_stand_anywhere = isinstance(node, ReceivingNode) and not node.filters
            if not may_stand_anywhere:
                check_type(f"node {name!r}", node, node_type)
            for label, filter in node.filters.items():
                check_states(f"filter {label!r} of node {name!r}", filter, self)
        if len({crc32(name.encode()) for name in self.nodes}) != len(self.nodes):
            raise fail("node names", "names with distinct checksums", list(self.nodes))
        if self.fused and FUSED in self.nodes:
            raise fail("node names", f"no node called {FUSED!r}, which stands for fused results", list(self.nodes))

    def _check_links(self) -> None:
        """Raise ValueError unless sensors and channels fit each other.

        One node of each group is checked, since all nodes of a group have models of one structure.
        """
        for names in self.groups:
            node = self.nodes[names[0]]
            if isinstance(node, Node):
                check_link(first(node.sensor).typical(self.inputs), first(node.channel), len(self.states), late=True)
                find_received_angles(self.plant, node.sensor, node.channel)

    def _check_fused(self) -> None:
        """Raise ValueError unless each fusion fits its nodes, and each central filter receives what all nodes do."""
        for name, fusion in self.fused.items():
            check_states(f"fused {name!r}", fusion, self)
            if isinstance(fusion, Fusion):
                fusion.check(self.nodes_with(fusion.filter), len(self.states))
            else:
                check_type(f"fused {name!r}", fusion, AbstractFilter)
                check_received(f"fused {name!r}", fusion, sum(node.received for node in self.nodes.values()))
                links = [first(node.channel) for node in self.nodes.values() if isinstance(node, Node)]
                check_filter_flags(f"fused {name!r}", fusion, links)
                check_angles(f"fused {name!r}", fusion, self)

    @staticmethod
    def of_relays(
        relays: RelayNetwork, schedules: Mapping[str, Schedule], receivers: Mapping[str, AbstractFilter]
    ) -> "Network":
        """Return the network of relays that run their schedules in the world, and a receiver with its filters.

        Relay r sends C s_r at each step, s_r its estimate of the step before, through hops (links to one listener) with
        independent draws; each filter receives the sum of its hops, NaN where nobody transmits to it by plan. The nodes
        are the relays, each with one filter "local", and "receiver". A recording may leave out what a relay received.

        Args:
            relays: the relays' hops in each slot (turn of a schedule that says who transmits).
            schedules: fixed gains of each relay's filter, by name.
            receivers: the receiver's filters, by name.

        Raises:
            ValueError: relays without a schedule, schedules of the wrong shape.
        """
        # A schedule for each relay, of gains (n, received): n states, `received` numbers that it receives.
        check_type("relays", relays, RelayNetwork)
        schedules = table("relay schedules", schedules, "schedules")
        if set(schedules) != set(relays.relays):
            raise fail("relay schedules", f"those of {list(relays.relays)}", list(schedules))
        filters: dict[str, dict[str, AbstractFilter]] = {}
        n = len(relays.states)
        for name, size in zip(relays.relays, relays.received, strict=False):  # the receiver stands last
            check_type(f"schedule of {name!r}", schedules[name], Schedule)
            shape = schedules[name].gains.direct.shape[1:]
            if shape != (n, size):
                raise fail(f"schedule of {name!r}", f"gains of shape {(n, size)}", f"shape {shape}")
            filters[name] = {LOCAL: ScheduledFilter(schedules[name])}
        filters[RECEIVER] = table("receiver's filters", receivers, "filters")
        check_filters(filters[RECEIVER], relays.received[-1])
        # All places, the receiver last, receive sums of hops.
        outputs = tuple(first(relays.sensor).outputs)
        nodes = {
            name: ReceivingNode(filters[name], size, outputs, relays.always_receives(name))
            for name, size in zip(relays.filters, relays.received, strict=True)
        }
        return Network(relays.plant, nodes, relays=relays)

    @staticmethod
    def sharing(
        plant: AnyPlant,
        sensor: AnySensor,
        channel: Channel,
        filters: Mapping[str, Mapping[str, AbstractFilter]],
        fused: Mapping[str, Fusion | AbstractFilter] | None = None,
    ) -> "Network":
        """Return the network of nodes that receive parts of one channel: they share its sensor noise, hops and fading.

        Args:
            plant: the plant.
            sensor: the common sensor.
            channel: the common channel, without memory.
            filters: filters by name of each node, all with the same number of outputs: the first node receives the
                first ones, and so on.
            fused: fusions by name; None by default.

        Raises:
            ValueError: filters that do not use all outputs once, a channel with memory, parts that do not fit.
        """
        # Sensor and channel fit.
        check_link(first(sensor), first(channel), len(first(plant).states), late=True)
        find_received_angles(plant, sensor, channel)
        check_forgets("channel of nodes that share it", first(channel))
        # Each output goes to one node; a node has as many as its filters receive.
        received = {
            name: max((filter.received for filter in by_name.values()), default=0) for name, by_name in filters.items()
        }
        if sum(received.values()) != first(channel).outputs:
            expected = f"to receive its {first(channel).outputs} outputs, each once"
            raise fail("nodes that share a channel", expected, received)
        for name, by_name in filters.items():
            check_filters(by_name, received[name])
        names, complete = tuple(first(sensor).outputs), not first(channel).erases
        nodes = {name: ReceivingNode(dict(own), received[name], names, complete) for name, own in filters.items()}
        return Network(plant, nodes, fused, common=CommonReception(sensor, channel))

    def restricted_to(self, names: Iterable[str]) -> "Network":
        """Return the network with only the nodes of these names; only relays may be left out.

        Raises:
            ValueError: a node that is not a relay is missing, or a name is no node's.
        """
        measured_nodes = set(names)
        optional = set() if self.relays is None else set(self.relays.relays)
        # Names without a node, and nodes without a name; only relays may be missing.
        mismatched = sorted((measured_nodes ^ set(self.nodes)) - (optional - measured_nodes))
        if mismatched:
            raise fail("measurements", f"arrays for the nodes {sorted(self.nodes)}", f"a mismatch in {mismatched}")
        if len(measured_nodes) == len(self.nodes):
            return self
        nodes = {name: node for name, node in self.nodes.items() if name in measured_nodes}
        return Network(self.plant, nodes, relays=self.relays)

    def nodes_with(self, name: str) -> list[str]:
        """Return the names of the nodes that have the filter `name`, in the order of the network.

        Raises:
            ValueError: none has it.
        """
        nodes_with_filter = [node for node in self.names if name in self.nodes[node].filters]
        if not nodes_with_filter:
            known_filters = sorted({filter for node in self.nodes.values() for filter in node.filters})
            raise fail("fusion", f"a filter that some node has {known_filters}", repr(name))
        return nodes_with_filter

    def mesh_nodes(self, name: str) -> tuple[str, ...]:
        """Return the names of the nodes of a fusion between neighbours, in the order of the network."""
        neighbours = self.meshes[name].neighbours or {}
        return tuple(node for node in self.names if node in neighbours)

    @property
    def shared(self) -> dict[str, tuple[str, ...]]:
        """Names of the nodes that share something, by its name: fading (`hg.shared`), or one channel for all nodes."""
        nodes_by_memory: dict[str, list[str]] = {}
        for name, node in self.nodes.items():
            for memory in memories(node.channel).values() if isinstance(node, Node) else ():
                if memory.name is not None:
                    nodes_by_memory.setdefault(memory.name, []).append(name)
        shared = {name: tuple(nodes) for name, nodes in nodes_by_memory.items() if len(nodes) > 1}
        return shared if self.common is None else {"sensor and channel": self.names}

    @cached_property
    def angles(self) -> dict[str, Angles]:
        """Indices of the angles among the numbers that each node receives, by node."""
        if self.common is not None:  # each node receives some rows of one channel
            angles = find_received_angles(self.plant, self.common.sensor, self.common.channel)
            return {name: tuple(i - rows.start for i in angles if i in rows) for name, rows in self.rows.items()}
        angles_by_node: dict[str, Angles] = dict.fromkeys(self.nodes, ())
        for name, node in self.nodes.items():
            if isinstance(node, Node):
                angles_by_node[name] = find_received_angles(self.plant, node.sensor, node.channel)
        return angles_by_node

    def diagram(self) -> str:
        """Return all of the network as lines of text, of which `repr` shows the first."""
        return write_diagram(self)

    def claims(self) -> Claims:
        """Return what each estimate claims of its covariance, by node and filter; fused ones come last, under FUSED."""
        claims: Claims = {name: {} for name in (*self.names, *([FUSED] if self.fused else []))}
        for (node, name), claim in self.claimed.items():
            claims[node][name] = claim
        return claims

    def beliefs(self) -> tuple[MistakenBelief, ...]:
        """Return filters that believe another world than their place's, node after node, fused ones last."""
        return tuple(yield_mistaken_beliefs(self))

    def with_nominal_claims(self) -> "Network":
        """Return the network whose covariances claim "nominal" at most, as where rounding may spoil any digit."""
        lowered = copy(self)  # without the constructor, which would check all again; fields are frozen
        claimed = FrozenMapping({place: lower_claim(claim) for place, claim in self.claimed.items()})
        object.__setattr__(lowered, "nodes", make_nodes_nominal(self))
        object.__setattr__(lowered, "fused", make_fusions_nominal(self))
        object.__setattr__(lowered, "claimed", claimed)
        return lowered

    def parts_of(self, name: str) -> dict[str, tuple[AnySensor, Channel, AbstractFilter]]:
        """Return the sensor, channel and filter `name` of each node that has this filter and receives over a channel.

        Sensor and channel are the node's own, or common to all nodes. A node behind relays has neither and is left out.
        """
        parts = {}
        for label in self.nodes_with(name):
            node = self.nodes[label]
            owner = node if isinstance(node, Node) else self.common  # of sensor and channel; None behind relays
            if owner is not None:
                parts[label] = owner.sensor, owner.channel, node.filters[name]
        return parts

    def check_horizon(self, horizon: int) -> None:
        """Raise ValueError if a plant, sensor, channel or filter that varies over time ends before `horizon` steps."""
        one_of_each = [self.nodes[names[0]] for names in self.groups]  # a group's nodes cover the same steps
        check_horizon(horizon, steps_covered((self.plant, one_of_each, self.common, self.relays, self.fused)))

    def screen_readings(
        self, measurements: dict[str, np.ndarray], inputs: np.ndarray, before: Mapping[str, Repeats]
    ) -> ScreenedRecording:
        """Return measurements without readings that limits refuse; `before`: equal readings at the end before these."""
        return screen_recording(self.nodes, self.inputs, measurements, inputs, before)

    def drop_refused_readings(self, measurements: dict[str, np.ndarray], inputs: np.ndarray) -> dict[str, np.ndarray]:
        """Return the measurements by node (steps, received), without readings that nodes refuse, and warn of these."""
        screened = self.screen_readings(measurements, inputs, {})
        for line in screened.said:
            warnings.warn(line, stacklevel=3)
        return screened.measurements

    def check_sends_numbers(self, what: str) -> None:
        """Raise ValueError if a node sends words (`encoder`) or differences (feedback), not the numbers themselves."""
        refuse_words_and_feedback(what, self.nodes)

    def check_sends_each_step(self, what: str) -> None:
        """Raise ValueError if a node has a trigger, since `what` needs senders that transmit at each step."""
        deciding = [name for name, node in self.nodes.items() if isinstance(node, Node) and node.trigger is not None]
        if deciding:
            raise fail(what, "senders that transmit at each step", f"triggers of {deciding}")


readable(Network)
Network.__repr__ = write_short_diagram  # type: ignore[method-assign, assignment]
Network._repr_html_ = write_html_table  # type: ignore[attr-defined]
