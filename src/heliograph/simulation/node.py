"""Nodes of a network: a sensor, the channel of its signal, and the filters that receive it."""

from collections.abc import Mapping
from typing import Protocol

import equinox as eqx

from heliograph.filters.base import AbstractFilter
from heliograph.filters.modes.arrival_patterns import losses_tell_of_gains
from heliograph.filters.wrappers.fed_back import FedBackFilter
from heliograph.fusion.network_fusion import Fusion
from heliograph.model.channel import Channel, check_sent
from heliograph.model.channel_side_information import name_received_values
from heliograph.model.estimate import Claim
from heliograph.model.over_time import first
from heliograph.model.plant import AnyPlant
from heliograph.model.readings.reading_limits import LimitsLike, ReadingLimits, make_limits
from heliograph.model.readings.repeated_readings import StuckLike
from heliograph.model.relays import RelayNetwork
from heliograph.model.sensor import AbstractSensor, AnySensor
from heliograph.model.trigger import AbstractTrigger, Periodic
from heliograph.model.words.encoder import Words
from heliograph.model.words.word_channel import FLAG, find_carried_components
from heliograph.numerics.angles.angle import Angles
from heliograph.numerics.check import TINY, fail, scalar, table
from heliograph.numerics.frozen_mapping import FrozenMapping
from heliograph.numerics.module import Module, readable
from heliograph.numerics.types import ArrayLike
from heliograph.random_affine.base import AbstractRandomAffine
from heliograph.random_affine.memories_of_channels import drop_names
from heliograph.simulation.filter_flag_check import check_filter_flags
from heliograph.simulation.sender_checks import (
    check_encoder,
    check_trigger,
    check_type,
    compares_with_prediction,
    count_subtracted_dithers,
)

FUSED = "fused"  # the name under which results of several nodes stand


@readable
class Node(Module):
    """A sensor, the channel of its signal, and named filters; the true channel need not be that of the filters' models.

    With a `fed_back_filter` among them the sensor sends the difference from that filter's prediction.

    Args:
        sensor: the sensor.
        channel: the true channel from the sensor to the filters.
        filters: filters by name.
        limits: range of an honest measured value, (low, high) for all of them or a pair for each received number, None
            where there is no limit; or another node's `limits`, which hold its codes too. What is outside counts as not
            arrived, is counted and named. What is refused then depends on the state, so that claims are nominal.
        invalid: a code, or several, by which the sensor says that it has no value (-999); none by default.
        stuck: after how many equal readings in a row one counts as not arrived, a number or one for each; True for
            what the sensor's noise and resolution make less than once in 10^9 readings; None (default) where readings
            may repeat. Counted and named, and claims are nominal, as with limits.
        timeout: for how long nothing need come of a sensor that works, in steps, or in the unit of continuous time;
            None (default) for any time. What is silent for longer is named and counted; no estimate depends on it.
        trigger: when the sender transmits, such as `SendOnDelta(0.5)`; at each step by default. The filter for it is
            `event_filter`; all others take what was not sent for missing.
        encoder: `Words` as which the sender sends what it measures; the channel is then one of words, and behind what
            it delivers stand the dithers that are to be taken off, if any. Numbers of unlimited length by default.

    Raises:
        ValueError: a sensor and a channel that do not fit; a filter with another number of values than arrive,
            or flags of another step than those that do; another filter of the measurement next to one that is fed back;
            limits that are none; `stuck` of True without a resolution; a timeout that is not positive; a trigger that
            does not fit, or next to feedback
            or a channel that is late; words that are amplified, or compared by a trigger with what a flipped bit or a
            dither lets the ends not share.
    """

    sensor: AnySensor
    channel: Channel
    filters: dict[str, AbstractFilter]
    limits: ReadingLimits | None
    timeout: float | None = eqx.field(static=True)
    trigger: AbstractTrigger | None
    encoder: Words | None
    received: int = eqx.field(static=True, init=False, repr=False)  # length of the measurement that reaches the filters
    complete: bool = eqx.field(static=True, init=False, repr=False)  # whether everything arrives, always

    def __init__(
        self,
        sensor: AnySensor,
        channel: Channel,
        filters: "Mapping[str, AbstractFilter]",
        limits: LimitsLike = None,
        invalid: ArrayLike = (),
        trigger: "AbstractTrigger | None" = None,
        encoder: "Words | None" = None,
        stuck: "StuckLike" = None,
        timeout: float | None = None,
    ):
        """Check that sensor, channel, trigger, encoder and filters fit, and find what the filters receive.

        A node is a sensor, the channel from it, and filters of what arrives. A trigger decides at the sensor whether a
        measurement is sent; an encoder quantises it to codewords. `limits`, `invalid` (error codes) and `stuck` say
        which readings are refused, and after `timeout` without one the node counts as silent.
        """
        self.timeout = None if timeout is None else float(scalar("timeout", timeout, low=TINY))
        self.trigger, self.encoder = trigger, encoder
        self.sensor, self.channel, self.filters = sensor, channel, table("filters of a node", filters, "filters")
        # Sensor and channel fit.
        check_type("sensor", first(sensor), AbstractSensor)
        check_type("channel", first(channel), AbstractRandomAffine)
        check_sent(first(sensor), first(channel))
        # Numbers that arrive beside the values: a trigger's side information, and the dithers of codewords that the
        # receiver subtracts.
        if trigger is not None:
            check_trigger(trigger, first(sensor), first(channel), self.filters)
        side_information = 0 if trigger is None else trigger.side_information(len(self.outputs))
        if encoder is not None:
            check_encoder(encoder, first(sensor), channel, trigger, self.filters)
            side_information += count_subtracted_dithers(encoder, channel)
        # What the filters receive, and whether it is always all of it.
        self.received = int(first(channel).outputs) + side_information
        self.complete = not first(channel).erases and trigger is None
        check_filters(self.filters, self.received)
        self.limits = make_limits(self.received, limits, invalid, stuck, self.sensor, self.channel)
        # A channel may deliver a flag of its mode beside the measurement: refused unless the filter's model has it too.
        for name, filter in self.filters.items():
            check_filter_flags(f"filter {name!r}", filter, [first(channel)])
        # A sensor with feedback sends its measurement less one filter's prediction: no other filter could use that.
        receiving = [name for name, filter in self.filters.items() if filter.received]
        if self.informed_by is not None and receiving != [self.informed_by]:
            expected = f"no filter with measurements besides {self.informed_by!r}"
            raise fail("node whose sensor has feedback", expected, receiving)

    @property
    def counts_all(self) -> bool:
        """Whether all that is sent arrives, always, and none of it is refused for a value beyond limits."""
        has_range = self.limits is not None and self.limits.has_range
        return self.complete and not has_range

    @property
    def chosen_by_value(self) -> bool:
        """Whether values decide which measurements a filter uses: by a sender's rule, or by limits of the readings.

        Limits are bounds of plausible readings, or the number of equal readings after which a sensor counts as stuck.
        """
        return self.trigger is not None or (self.limits is not None and self.limits.bounded)

    @property
    def absence_tells(self) -> bool:
        """Whether it says something that no value came: of the sender's signal, by its rule, or of the link's mode.

        A reading that is refused is absent too. Behind such a node a filter takes that for silence, or for a loss.
        """
        decides = self.trigger is not None and not isinstance(self.trigger, Periodic)
        return decides or losses_tell_of_gains(self.channel)

    @property
    def disturbs_what_is_sent(self) -> bool:
        """Whether a filter gets something else than sensor and channel say: data choose it, or words stand for it."""
        return self.chosen_by_value or self.encoder is not None

    @property
    def predictor(self) -> str | None:
        """Name of the filter whose prediction the sender compares with its measurement, to decide whether to send.

        It is None if the sender compares with no prediction.
        """
        if self.trigger is None or self.trigger.reference != "prediction":
            return None
        return next(name for name, filter in self.filters.items() if compares_with_prediction(filter))

    @property
    def informed_by(self) -> str | None:
        """Name of the filter whose estimates are fed back to the sensor; None without."""
        return next((name for name, filter in self.filters.items() if isinstance(filter, FedBackFilter)), None)

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of the sensor's outputs."""
        return tuple(first(self.sensor).outputs)

    @property
    def received_names(self) -> tuple[str, ...]:
        """Names of the components of the measurement: values, side information, then dithers "dither_OUTPUT".

        A dither is noise that an encoder adds before rounding and the receiver subtracts: it is received for each
        output that the channel carries, but not for a flag, which tells the channel's mode.
        """
        channel = first(self.channel)
        if self.encoder is None or not self.encoder.subtracts:  # no dithers arrive
            side_information = self.received - channel.outputs
            return name_received_values(self.outputs, channel, side_information)
        carried_outputs = [output for output in find_carried_components(channel) if output != FLAG]
        dithers = [f"dither_{self.outputs[output]}" for output in carried_outputs]
        side_information = self.received - channel.outputs - len(dithers)
        values = name_received_values(self.outputs, channel, side_information)
        # Dithers of an output that arrives several times, such as over two links, are numbered from 1.
        repeated = {name for name in dithers if dithers.count(name) > 1}
        numbers = [dithers[: i + 1].count(name) for i, name in enumerate(dithers)]
        return values + tuple(
            f"{name}_{number}" if name in repeated else name for name, number in zip(dithers, numbers, strict=True)
        )


@readable
class ReceivingNode(Module):
    """A place in a network of relays, which receives from relays or the sensor, and its filters.

    `received` numbers named after `outputs` arrive, always all of them if it is `complete`.
    """

    filters: dict[str, AbstractFilter]
    received: int = eqx.field(static=True)
    outputs: tuple[str, ...] = eqx.field(static=True)
    complete: bool = eqx.field(static=True)

    @property
    def received_names(self) -> tuple[str, ...]:
        """Names of the components of the measurement."""
        return name_values(self.outputs, self.received)

    @property
    def counts_all(self) -> bool:
        """Whether all that is sent arrives, always: nothing is refused here."""
        return self.complete

    @property
    def limits(self) -> None:
        """None: a network of relays has no limits."""

    @property
    def timeout(self) -> None:
        """None: what comes from relays may be silent for any time."""


@readable
class CommonReception(Module):
    """Common sensor and channel of all nodes: each receives the outputs that follow those of the nodes before it."""

    sensor: AnySensor
    channel: Channel


class HasNodes(Protocol):
    """A network as its checks and its diagram read it."""

    @property
    def plant(self) -> AnyPlant:
        """Plant that all nodes of the network observe."""

    @property
    def nodes(self) -> dict[str, Node | ReceivingNode]:
        """Nodes of the network by name."""

    @property
    def fused(self) -> dict[str, Fusion | AbstractFilter]:
        """Fusions of the nodes' estimates, and filters of all measurements, by name."""

    @property
    def meshes(self) -> dict[str, Fusion]:
        """Fusions between neighbours, by name."""

    @property
    def relays(self) -> RelayNetwork | None:
        """Relays that filter and forward."""

    @property
    def common(self) -> CommonReception | None:
        """Sensor and channel of all nodes together."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the nodes, in the given order."""

    @property
    def states(self) -> tuple[str, ...]:
        """Names of the states."""

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the inputs."""

    @property
    def rows(self) -> FrozenMapping[str, range]:
        """Places of each node among all measurements, joined in the order of the nodes."""

    @property
    def angles(self) -> dict[str, Angles]:
        """Places of the angles among what each node receives."""

    def claims(self) -> dict[str, dict[str, Claim]]:
        """Return the claims by node and filter."""

    def nodes_with(self, name: str) -> list[str]:
        """Return the nodes that have a filter of this name."""

    def mesh_nodes(self, name: str) -> tuple[str, ...]:
        """Return the nodes of a fusion between neighbours."""

    def parts_of(self, name: str) -> dict[str, tuple[AnySensor, Channel, AbstractFilter]]:
        """Return sensor, channel and the filter `name` of each node that has it and receives over a channel."""


def name_values(outputs: tuple[str, ...], received: int) -> tuple[str, ...]:
    """Return the names of the received components: the sensor's outputs where these are as many, else z0, z1, ..."""
    return outputs if len(outputs) == received else tuple(f"z{i}" for i in range(received))


def check_received(name: str, filter: AbstractFilter, received: int) -> None:
    """Raise ValueError if a filter receives another number of components than arrive, unless it uses no measurements.

    `name`: of the filter, for errors. `received`: how many components arrive.
    """
    if filter.received not in (0, received):  # 0: it uses no measurements
        expected = f"one that receives the {received} numbers that arrive"
        raise fail(name, expected, f"one that receives {filter.received}")


def check_states(name: str, filter: object, network: HasNodes) -> None:
    """Raise ValueError unless a filter has as many states and inputs as the plant, and the plant's attitudes.

    An attitude is three states that are the vector of a rotation. A filter corrects an attitude by composing rotations,
    and other states by adding, so filter and plant must agree which states are attitudes.

    Args:
        name: name of the filter or fusion, for errors.
        filter: a filter, or a fusion, which has no states of its own: only its attitudes are compared.
        network: the network with the plant.
    """
    plant = first(network.plant)
    if isinstance(filter, AbstractFilter):
        for kind, of_plant_names, of_filter_names in (
            ("states", plant.states, filter.states),
            ("inputs", plant.inputs, filter.inputs),
        ):
            if len(of_plant_names) != len(of_filter_names):
                raise fail(
                    name,
                    f"the plant's {len(of_plant_names)} {kind} {list(of_plant_names)}",
                    f"{len(of_filter_names)} {list(of_filter_names)}",
                )
    # Indices of the states that are attitudes, of the plant and of the filter.
    of_plant, of_filter = plant.manifold.rotations, getattr(filter, "attitude", ())
    if of_plant != of_filter:
        expected, got = [network.states[i] for i in of_plant], [network.states[i] for i in of_filter]
        raise fail(name, f"a filter of all that is received, whose attitudes are the plant's, {expected}", got)


def check_angles(name: str, filter: AbstractFilter, network: HasNodes) -> None:
    """Raise ValueError unless a filter of all measurements takes as angles what are angles, and nothing else.

    An error of an angle is wrapped to -pi ... pi, so a filter that took another number for an angle would be wrong.

    Args:
        name: name of the filter, for errors.
        filter: the filter, which receives the measurements of all nodes, or none.
        network: the network, whose plant and sensors say which states and received numbers are angles.
    """
    used, angles = filter.angles_used(), first(network.plant).angles
    if used is None:  # a filter of a user's own class, which does not say
        return
    if used.states != angles:
        expected, got = [network.states[i] for i in angles], [network.states[i] for i in used.states]
        raise fail(name, f"a filter whose angles are the plant's, {expected}", got)
    if not filter.received:
        return
    # A filter of all measurements receives z = (z_1, z_2, ...), node after node: names of its components, and the
    # indices of those that are angles.
    names = [f"{node}.{part}" for node in network.names for part in network.nodes[node].received_names]
    received_angles = [network.rows[node][i] for node in network.names for i in network.angles[node]]
    expected, got = [names[i] for i in received_angles], [names[i] for i in used.received]
    if expected != got:
        raise fail(name, f"a filter that receives the nodes' angles, {expected}", got)


def check_filters(filters: Mapping[str, object], received: int) -> None:
    """Raise ValueError for an object that is no filter, or that does not receive as many components as its node."""
    for name, filter in filters.items():
        check_type(f"filter {name!r}", filter, AbstractFilter)
        if isinstance(filter, AbstractFilter):
            check_received(f"filter {name!r}", filter, received)


def get_parts_of_reception(node: Node | ReceivingNode) -> object:
    """Return the parts of a node that determine its measurements.

    Nodes whose parts have one structure and differ only in numbers are simulated as a group. Filters count only where
    the sender needs their predictions: as feedback (`informed_by`), or to decide when to send (`predictor`).
    """
    if isinstance(node, Node):
        carried = None if node.encoder is None else find_carried_components(node.channel)
        link = drop_names(node.channel)
        return node.sensor, link, node.informed_by, node.trigger, node.encoder, carried, node.predictor
    return node.received, node.complete
