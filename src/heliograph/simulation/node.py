"""What stands at a place of a network: a sensor, the channel its signal takes, and the filters that listen there."""

from collections.abc import Mapping

import equinox as eqx

from heliograph.filters.base import AbstractFilter
from heliograph.filters.event_stochastic import StochasticEventFilter
from heliograph.filters.gaussian.event import EventFilter
from heliograph.filters.wrappers.fed_back import FedBackFilter
from heliograph.model.channel import Channel, check_sent
from heliograph.model.estimate import Claim
from heliograph.model.limits import Limits, LimitsLike, limits_of
from heliograph.model.over_time import alike, first
from heliograph.model.sensor import AbstractSensor, AnySensor
from heliograph.model.trigger import AbstractTrigger, Periodic
from heliograph.numerics.check import fail, shown, table
from heliograph.numerics.module import Module
from heliograph.numerics.readable import readable
from heliograph.numerics.types import ArrayLike
from heliograph.random_affine.base import AbstractRandomAffine
from heliograph.simulation.flags import check_flags


@readable
class Node(Module):
    """A sensor, the channel its signal takes, and named filters; the world's channel need not be what they believe.

    With a `fed_back_filter` among them the sensor sends what that filter does not expect.

    `limits`: what an honest received number is within, (low, high) for all of them or a pair for each, None where there
    is no limit. `invalid`: a code, or several, by which the sensor says that it has no value (-999). Recorded and live
    data beyond that count as not arrived, are counted and named. Claims stand as far as no honest number is among them.

    `trigger`: when the sender transmits, such as `SendOnDelta(0.5)`; at each step unless given. An estimator that knows
    it is `event_filter`; all others take what was not sent for missing, and then claim "nominal" at most.

    Raises:
        ValueError: a sensor and a channel that do not fit; a filter that takes another number of values than arrive,
            or flags of another step than those that do; a filter that hears beside one that is fed back; limits that
            are none; a trigger that does not fit, or beside a filter that is fed back or a channel that is late.
    """

    sensor: AnySensor
    channel: Channel
    filters: dict[str, AbstractFilter]
    limits: Limits | None
    trigger: AbstractTrigger | None

    def __init__(
        self,
        sensor: AnySensor,
        channel: Channel,
        filters: Mapping[str, AbstractFilter],
        limits: LimitsLike = None,
        invalid: ArrayLike = (),
        trigger: AbstractTrigger | None = None,
    ):
        self.trigger = trigger
        self.sensor, self.channel, self.filters = sensor, channel, table("filters of a node", filters, "filters")
        check_type("sensor", first(sensor), AbstractSensor)
        check_type("channel", first(channel), AbstractRandomAffine)
        check_sent(first(sensor), first(channel))
        if trigger is not None:
            check_trigger(trigger, first(sensor), first(channel), self.filters)
        check_filters(self.filters, self.received)
        self.limits = limits_of(self.received, limits, invalid)
        for name, item in self.filters.items():
            check_flags(f"filter {name!r}", item, [first(channel)])
        observation = [name for name, item in self.filters.items() if item.received]
        if self.informed_by is not None and observation != [self.informed_by]:
            raise fail("node whose sensor hears back", f"no filter that hears beside {self.informed_by!r}", observation)

    @property
    def received(self) -> int:
        """Length of the measurement that reaches the filters."""
        known = 0 if self.trigger is None else self.trigger.side_information(len(self.outputs))
        return int(first(self.channel).outputs) + known

    @property
    def predictor(self) -> str | None:
        """Name of the filter whose prediction the sender compares with; None where it compares with none."""
        if self.trigger is None or self.trigger.reference != "prediction":
            return None
        return next(name for name, item in self.filters.items() if _predicts(item, self.trigger))

    def claim_of(self, item: AbstractFilter) -> Claim:
        """What a filter claims here: without the trigger it does not know why something is missing."""
        if self.trigger is None or isinstance(self.trigger, Periodic) or not item.received:
            return item.claim
        rule = getattr(item, "trigger", None)
        knows = alike(rule, self.trigger) and bool(eqx.tree_equal(rule, self.trigger))
        return item.claim if knows else lowered_claim(item.claim)

    @property
    def informed_by(self) -> str | None:
        """Name of the filter whose estimates the sensor hears back; None where it hears none."""
        return next((name for name, item in self.filters.items() if isinstance(item, FedBackFilter)), None)

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of what is sent to the node."""
        return tuple(first(self.sensor).outputs)

    @property
    def received_names(self) -> tuple[str, ...]:
        """Names of what reaches the filters."""
        return received_names(self.outputs, self.received)

    @property
    def complete(self) -> bool:
        """Whether everything arrives, always."""
        return not first(self.channel).erases and self.trigger is None


@readable
class Listener(Module):
    """A place in a network of relays, which hears one of them or the sensor, and the filters there.

    `received` numbers named after `outputs` are heard, always all of them if it is `complete`.
    """

    filters: dict[str, AbstractFilter]
    received: int = eqx.field(static=True)
    outputs: tuple[str, ...] = eqx.field(static=True)
    complete: bool = eqx.field(static=True)

    @property
    def received_names(self) -> tuple[str, ...]:
        """Names of what reaches the filters."""
        return received_names(self.outputs, self.received)

    @property
    def limits(self) -> None:
        """None: a network of relays has no limits of its own."""


@readable
class Common(Module):
    """One sensor and one channel for all nodes: of what arrives each hears the rows that follow those before it."""

    sensor: AnySensor
    channel: Channel


def _predicts(item: AbstractFilter, trigger: AbstractTrigger) -> bool:
    return isinstance(item, EventFilter | StochasticEventFilter) and item.trigger.reference == "prediction"


def lowered_claim(claim: Claim) -> Claim:
    """Nominal, whatever is claimed more."""
    return "none" if claim == "none" else "nominal"


def check_trigger(
    trigger: AbstractTrigger, sensor: AbstractSensor, channel: AbstractRandomAffine, filters: Mapping[str, object]
) -> None:
    """A trigger that fits the sensor, the channel and the filters of a node.

    Raises:
        ValueError: numbers for another count of components; a channel that is late, or that does not carry each
            component for itself where each is sent alone; no filter whose prediction the sender could know.
    """
    check_type("trigger", trigger, AbstractTrigger)
    trigger.check_outputs(len(sensor.outputs))
    if sensor.circular:
        raise fail("trigger", "a sensor without angles", list(sensor.circular))
    if channel.past:
        raise fail(
            "channel of a node with a trigger", "one that is not late", f"one late by up to {channel.past} steps"
        )
    if trigger.region == "each" and channel.outputs != len(sensor.outputs):
        raise fail("channel of components that are each sent alone", f"{len(sensor.outputs)} outputs", channel.outputs)
    if any(isinstance(item, FedBackFilter) for item in filters.values()):
        raise fail("trigger", "no filter that is fed back", "one")
    if trigger.reference == "prediction" and not any(
        isinstance(item, AbstractFilter) and _predicts(item, trigger) for item in filters.values()
    ):
        raise fail("node whose sender compares with a prediction", "an event_filter with this trigger", list(filters))


def received_names(outputs: tuple[str, ...], received: int) -> tuple[str, ...]:
    """Names of what is received: the sensor's outputs where these are as many, else z0, z1, ..."""
    return outputs if len(outputs) == received else tuple(f"z{i}" for i in range(received))


def check_received(name: str, item: AbstractFilter, received: int) -> None:
    """A filter that hears as much as arrives, or does not listen."""
    if item.received not in (0, received):  # 0: it does not listen
        raise fail(name, f"one that hears the {received} numbers that arrive", f"one that hears {item.received}")


def check_sizes(name: str, item: AbstractFilter, states: tuple[str, ...], inputs: tuple[str, ...]) -> None:
    """A filter of as many states and inputs as the plant has."""
    for what, single, theirs in (("states", states, item.states), ("inputs", inputs, item.inputs)):
        if len(single) != len(theirs):
            raise fail(name, f"the plant's {len(single)} {what} {list(single)}", f"{len(theirs)} {list(theirs)}")


def check_filters(filters: Mapping[str, object], received: int) -> None:
    """Filters that hear what arrives at their node."""
    for name, item in filters.items():
        check_type(f"filter {name!r}", item, AbstractFilter)
        if isinstance(item, AbstractFilter):
            check_received(f"filter {name!r}", item, received)


def check_type(name: str, value: object, expected: type) -> None:
    """An object of a class, named in one line if it is none."""
    if not isinstance(value, expected):
        raise fail(name, f"a {expected.__name__}", shown(value))
