"""Nodes of a network: a sensor, the channel of its signal, and the filters that receive it."""

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
    """A sensor, the channel of its signal, and named filters; the true channel need not be that of the filters' models.

    With a `fed_back_filter` among them the sensor sends the difference from that filter's prediction.

    Args:
        sensor: the sensor.
        channel: the true channel from the sensor to the filters.
        filters: filters by name.
        limits: range of an honest received number, (low, high) for all of them or a pair for each, None where there
            is no limit. Recorded and live data outside count as not arrived, are counted and named. Claims stand as far
            as no honest number is among them.
        invalid: a code, or several, by which the sensor says that it has no value (-999); none by default.

    Raises:
        ValueError: a sensor and a channel that do not fit; a filter with another number of values than arrive,
            or flags of another step than those that do; another filter of the measurement next to one that is fed back;
            limits that are none.
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
        # Sensor, channel and filters fit.
        check_type("sensor", first(sensor), AbstractSensor)
        check_type("channel", first(channel), AbstractRandomAffine)
        check_sent(first(sensor), first(channel))
        check_filters(self.filters, self.received)
        self.limits = limits_of(self.received, limits, invalid)
        # Side information of the right step; feedback to one filter alone.
        for name, item in self.filters.items():
            check_flags(f"filter {name!r}", item, [first(channel)])
        observation = [name for name, item in self.filters.items() if item.received]
        if self.informed_by is not None and observation != [self.informed_by]:
            raise fail(
                "node whose sensor has feedback",
                f"no filter with measurements besides {self.informed_by!r}",
                observation,
            )

    @property
    def received(self) -> int:
        """Length of the measurement that reaches the filters."""
        return int(first(self.channel).outputs)

    @property
    def informed_by(self) -> str | None:
        """Name of the filter whose estimates are fed back to the sensor; None without."""
        return next((name for name, item in self.filters.items() if isinstance(item, FedBackFilter)), None)

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of the sensor's outputs."""
        return tuple(first(self.sensor).outputs)

    @property
    def received_names(self) -> tuple[str, ...]:
        """Names of the components of the measurement."""
        return received_names(self.outputs, self.received)

    @property
    def complete(self) -> bool:
        """True if everything arrives, always."""
        return not first(self.channel).erases


@readable
class Listener(Module):
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
        return received_names(self.outputs, self.received)

    @property
    def limits(self) -> None:
        """None: a network of relays has no limits."""


@readable
class Common(Module):
    """Common sensor and channel of all nodes: each receives the outputs that follow those of the nodes before it."""

    sensor: AnySensor
    channel: Channel


def received_names(outputs: tuple[str, ...], received: int) -> tuple[str, ...]:
    """Names of the received components: the sensor's outputs where these are as many, else z0, z1, ..."""
    return outputs if len(outputs) == received else tuple(f"z{i}" for i in range(received))


def check_received(name: str, item: AbstractFilter, received: int) -> None:
    """Refuse a filter of another number of components than arrive, unless it uses no measurements."""
    if item.received not in (0, received):  # 0: it uses no measurements
        raise fail(name, f"one that receives the {received} numbers that arrive", f"one that receives {item.received}")


def check_sizes(name: str, item: AbstractFilter, states: tuple[str, ...], inputs: tuple[str, ...]) -> None:
    """Refuse a filter of other numbers of states and inputs than the plant has."""
    for what, single, theirs in (("states", states, item.states), ("inputs", inputs, item.inputs)):
        if len(single) != len(theirs):
            raise fail(name, f"the plant's {len(single)} {what} {list(single)}", f"{len(theirs)} {list(theirs)}")


def check_filters(filters: Mapping[str, object], received: int) -> None:
    """Refuse filters that do not fit the measurement of their node."""
    for name, item in filters.items():
        check_type(f"filter {name!r}", item, AbstractFilter)
        if isinstance(item, AbstractFilter):
            check_received(f"filter {name!r}", item, received)


def check_type(name: str, value: object, expected: type) -> None:
    """Refuse an object of another class, in one line."""
    if not isinstance(value, expected):
        raise fail(name, f"a {expected.__name__}", shown(value))
