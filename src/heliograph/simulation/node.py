"""What stands at a place of a network: a sensor, the channel its signal takes, and the filters that listen there."""

from collections.abc import Mapping

import equinox as eqx

from heliograph.filters.base import AbstractFilter
from heliograph.filters.wrappers.fed_back import FedBackFilter
from heliograph.model.channel import Channel, check_sent
from heliograph.model.limits import Limits, LimitsLike, limits_of
from heliograph.model.over_time import first
from heliograph.model.sensor import AbstractSensor, AnySensor
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

    Raises:
        ValueError: a sensor and a channel that do not fit; a filter that takes another number of values than arrive,
            or flags of another step than those that do; a filter that hears beside one that is fed back; limits that
            are none.
    """

    sensor: AnySensor
    channel: Channel
    filters: dict[str, AbstractFilter]
    limits: Limits | None

    def __init__(
        self,
        sensor: AnySensor,
        channel: Channel,
        filters: Mapping[str, AbstractFilter],
        limits: LimitsLike = None,
        invalid: ArrayLike = (),
    ):
        self.sensor, self.channel, self.filters = sensor, channel, table("filters of a node", filters, "filters")
        check_type("sensor", first(sensor), AbstractSensor)
        check_type("channel", first(channel), AbstractRandomAffine)
        check_sent(first(sensor), first(channel))
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
        return int(first(self.channel).outputs)

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
        return not first(self.channel).erases


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
