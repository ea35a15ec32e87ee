"""Descriptions of sources: which field of a message is which output, of which node and plant, and when."""

from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, get_args

import numpy as np
from typing_extensions import TypeAliasType

from heliograph.files.device_availability import Available
from heliograph.files.sources.derived_values import Computed, Covariance, PlaneCovariance, ZeroIfAbsent
from heliograph.files.sources.message_fields import TimeUnit, convert_name, convert_time, field_at, parse_start
from heliograph.files.sources.message_reading import is_allowed, read_texts
from heliograph.model.checks.refusal_reasons import RefusedError
from heliograph.numerics.check import TINY, fail, flag, scalar, show_value
from heliograph.numerics.module import readable
from heliograph.numerics.times.dates import looks_like_date
from heliograph.numerics.types import ArrayLike


@readable
@dataclass(frozen=True)
class Level:
    """Level of a topic that names a plant or a node: of "zigbee2mqtt/garden" level 0 is "zigbee2mqtt".

    Args:
        index: number of the level, from 0; negative from the end.
        names: name that a level's word stands for; a word that is not there is the name itself. None for no such names.
    """

    index: int
    names: Mapping[str, str] | None = None

    def of(self, topic: str, message: object, where: str) -> str:
        """Return the topic's level number `self.index`, or its name in `self.names`. `where`: place for errors."""
        levels = topic.split("/")
        if not -len(levels) <= self.index < len(levels):
            raise fail(where, f"a topic with a level {self.index}", repr(topic))
        return (self.names or {}).get(levels[self.index], levels[self.index])


@readable
@dataclass(frozen=True)
class Field:
    """Field of a message that names a plant or a node, such as the identifier of an anchor.

    Args:
        path: dotted path of a text or of a whole number.
        names: name that a value, as text, stands for; a value that is not there is the name itself. None for no such
            names.
    """

    path: str
    names: Mapping[str, str] | None = None

    def of(self, topic: str, message: object, where: str) -> str:
        """Return a message's field at `self.path`, or its name in `self.names`. `where`: place for errors."""
        name = convert_name(field_at(message, self.path, where), f"{where}, field {self.path!r}")
        return (self.names or {}).get(name, name)


@readable
@dataclass(frozen=True)
class Stamp:
    """Time of a measurement in a message.

    A clock that counts from its own start, such as the boot of a device, has the date of that moment as `start`; then
    its times can be joined with those of other clocks.

    Args:
        path: dotted path of the time.
        offset: seconds added to it: negative for a stamp that is set late (default 0).
        start: date with its zone from which numbers count; None for 1970, and for times that are dates.

    Raises:
        ValueError: a start that is no date with its zone, an offset that is no number.
    """

    path: str
    offset: float = 0.0
    start: str | None = None

    def __post_init__(self) -> None:
        """Raise ValueError unless the offset (seconds) is a number, and the clock's start is a date or None."""
        scalar("Stamp, offset", self.offset)
        if self.start is not None:
            parse_start("Stamp, start", self.start)

    @cached_property
    def shift(self) -> int:
        """Return the nanoseconds that are added to the time in a message."""
        start = 0 if self.start is None else parse_start("Stamp, start", self.start)
        return start + round(self.offset * 10**9)

    def of(self, message: object, unit: TimeUnit, where: str, quoted: bool = False) -> int:
        """Return the time in a message, in nanoseconds since 1970 or as a step.

        `unit`: of a numeric time. `where`: the message's place, for errors. `quoted`: whether the time may be a text.
        """
        value = field_at(message, self.path, where)
        name = f"{where}, field {self.path!r}"
        if self.start is not None and isinstance(value, str) and looks_like_date(value):
            raise fail(name, f"a number, which counts from start={self.start!r}", show_value(value))
        return convert_time(value, unit, name, quoted) + self.shift


@readable
@dataclass(frozen=True)
class Count:
    """Running count of a node in a message; gaps in it are lost messages.

    Args:
        path: dotted path of the count.
        bits: its bits, if it begins at 0 again after 2^bits - 1: 4 of a count modulo 16, 8 of one modulo 256, 16 of one
            modulo 65,536; None if it does not. A message with a larger count is refused.
    """

    path: str
    bits: int | None = None

    @property
    def period(self) -> int:
        """Return after how many messages the count begins at 0 again; 0 if it does not."""
        return 0 if self.bits is None else 1 << self.bits

    def check(self, number: int, name: str) -> int:
        """Return the running count `number`; raise ValueError, which calls it `name`, unless it is below the period.

        The count begins again at 0 after `self.period` = 2^bits messages. A period of 0 means that it never does.
        """
        if self.period and number >= self.period:
            got = f"{number}: of another modulus than bits={self.bits}"
            raise RefusedError("counter", fail(name, f"a count below {self.period}", got))
        return number


Real = TypeAliasType("Real", ArrayLike)
Unit = TypeAliasType("Unit", TimeUnit)
Step = TypeAliasType("Step", float | None)
Name = TypeAliasType("Name", str | Level | Field)
Path = TypeAliasType("Path", str | Computed)
Paths = TypeAliasType("Paths", str | Computed | Sequence[str | Computed])
Texts = TypeAliasType("Texts", str | Sequence[str] | None)
Time = TypeAliasType("Time", str | Stamp | None)
Counted = TypeAliasType("Counted", str | Count | None)
Plant = TypeAliasType("Plant", str | Level | Field | None)
Condition = TypeAliasType("Condition", Mapping[str, object] | Available)
Where = TypeAliasType("Where", Condition | Sequence[Condition] | None)
Valid = TypeAliasType("Valid", str | Mapping[str, object] | None)
Devices = TypeAliasType("Devices", tuple[Available, ...])
Allowed = TypeAliasType("Allowed", dict[str, Container[object]])
Flags = TypeAliasType("Flags", Allowed | None)
Numbers = TypeAliasType("Numbers", tuple[float, ...])


@readable
@dataclass(frozen=True)
class Source:
    """One event of a node in each message of a topic, as `json_field` describes it.

    Attributes:
        paths: dotted path of each value in the message, or what is computed of several, such as the `Yaw` of a
            quaternion.
        node: name of the node, or "inputs"; or the `Level` or `Field` that names it.
        outputs: name of each value among the node's outputs or the plant's inputs; empty for all of them.
        scale: factor of each value.
        offset: what is added to each value after that.
        time: the time; None for the moment of arrival.
        time_unit: unit of a time that is a number.
        sequence: the node's running count; None if there is none.
        plant: the `Level` or `Field` that names the plant; None for a single plant.
        step: seconds of a step where times are counted in steps; None where they are not.
        where: the values, or a container of them, that the field at each dotted path may have.
        available: conditions on what the device says of itself on another topic.
        valid: the values that the field at each dotted path has where the message can be trusted; None for no flags
            but those that types of ROS have, {} for none at all.
        quoted: whether numbers may be texts.
    """

    paths: "tuple[Path, ...]"
    node: "Name"
    outputs: "tuple[str, ...]"
    scale: "Numbers"
    offset: "Numbers"
    time: "Stamp | None"
    time_unit: "Unit"
    sequence: "Count | None"
    plant: "Level | Field | None"
    step: "Step"
    where: "Allowed"
    available: "Devices"
    valid: "Flags"
    quoted: bool

    @property
    def fields(self) -> list[str]:
        """Return the dotted paths of all fields that are read: values, names, time, count and conditions."""
        values = [field for path in self.paths for field in ((path,) if isinstance(path, str) else path.parts)]
        options = (self.node, self.plant, self.time, self.sequence)
        fields_of_options = [option.path for option in options if isinstance(option, Field | Stamp | Count)]
        return [*values, *fields_of_options, *self.where, *(self.valid or ())]

    def check_valid(self, message: object, where: str) -> None:
        """Raise ValueError unless all flags of a message say that it can be trusted.

        `self.valid` maps the path of a flag to its values in such a message.

        Raises:
            ValueError: a flag has another value, or it is missing.
        """
        for field, allowed in (self.valid or {}).items():
            if not is_allowed(value := field_at(message, field, where), allowed):
                expected = "true or 1" if allowed == (True, 1) else f"one of {show_value(allowed)}"
                said = f"{expected}, of a message that can be trusted"
                raise RefusedError("flag", fail(f"{where}, field {field!r}", said, show_value(value)))


def json_field(
    path: "Paths",
    node: "Name",
    output: "Texts" = None,
    *,
    scale: "Real" = 1.0,
    offset: "Real" = 0.0,
    time: "Time" = None,
    time_unit: "Unit" = "s",
    sequence: "Counted" = None,
    plant: "Plant" = None,
    step: "Step" = None,
    where: "Where" = None,
    valid: "Valid" = None,
    quoted: bool = False,
) -> "Source":
    """Map a field of a topic's messages, or several, to a node's outputs or to inputs of the plant.

    A network's file maps topics by a dictionary `sources`; a topic that feeds several nodes has a list of fields:

        sources = {"zigbee2mqtt/garden": hg.files.json_field("temp", node="garden", output="temperature")}

    The result only describes what to read: JSON from MQTT, NATS, a pipe or a file, messages of a bag, or rows of a
    table, whose columns are the fields. A topic may have the wildcards of MQTT, where `plant` or `node` says which
    sensor a message is of. A path is dotted, with positions in lists as numbers ("pose.pose.position.x", "ranges.3"); a
    field of that very name, dots included, comes first; "" is the message itself.

    A value becomes `scale` value + `offset`; true is 1, false 0; null and numbers that are not finite did not arrive.

    A time is a date of ISO 8601 with its zone, a stamp of ROS, or a number in `time_unit` since 1970, or since the
    `start` of its `Stamp`; in the unit "step" it is a step of a network that counts steps. Without `time` a measurement
    is of the moment of its arrival. With `step`, times are counted in steps of so many seconds: each is of the nearest
    step, the first of step 0. A count that is absent is 0, as JSON of protobuf has it; a message that has its count and
    no value measured nothing.

    Args:
        path: dotted path of the value, or the `Yaw` of a quaternion or a coordinate of a `Geodetic` position, or
            several, which are then one measurement. What is told of values (`hg.model.told`) stands after these, such
            as a `Covariance`.
        node: name of a node of the network, or "inputs"; or the `Level` of the topic or the `Field` that names it.
        output: name of the output or input, one for each path; None for all of the node's, in their order.
        scale: factor, of all values but covariances, or of each. Shape () or (values,) (default 1).
        offset: added after scaling, to all values or to each. Shape () or (values,) (default 0).
        time: dotted path of the time, or its `Stamp`; None for the moment of arrival.
        time_unit: unit of a time that is a number (default "s").
        sequence: dotted path of the node's running count, or the `Count`; None if there is none.
        plant: dotted path of the plant's name, or the `Level` or `Field` that has it; None if there is one plant.
        step: seconds of a step of a network that counts steps, where times are dates; None for any other.
        where: for each dotted path the value that the field must have, or several (a list, a set, a range), for the
            message to be used, such as {"status": ["Good", "Uncertain"]}; or `Available`, for a topic on which the
            device says whether it is online; or a list of these. None for all messages.
        valid: dotted path of a flag by which a message says that it can be trusted, such as that its checksum is
            right: true or 1; or for each path the values that say so, as in `where`. Any other message is refused, by
            its reason, and counts as none that was lost. None for no such flag; {} for none either of those that ROS
            has (-1 in the covariance of an `Imu`, no fix, out of range), by which values count as not arrived.
        quoted: whether numbers in quotes are numbers too (default False: they are refused).

    Raises:
        ValueError: no path, as many outputs as paths expected and others given, numbers that are not finite, another
            unit of time, a step that is not positive.
    """
    # Paths and the outputs that they are.
    paths = read_paths(path)
    outputs = () if output is None else read_texts("output", output)
    if not paths or (outputs and len(outputs) != len(paths)):
        raise fail("json_field, output", f"{max(len(paths), 1)} names, one for each path", show_value(output))
    # Time and count.
    stamp, seconds = _read_time_options(time, time_unit, step)
    count = Count(sequence) if isinstance(sequence, str) else sequence
    if not isinstance(count, Count | None):
        raise fail("json_field, sequence", "a text or hg.files.Count", show_value(sequence))
    # A text as the plant's name is the path of a field, one as the node's is the name itself.
    plant_name = Field(plant) if isinstance(plant, str) else plant
    # Factor and offset of each value; what messages have to say of themselves.
    factors, shifts = (
        _broadcast_to_paths(name, value, paths, neutral)
        for name, value, neutral in (("scale", scale, 1.0), ("offset", offset, 0.0))
    )
    conditions, available = _split_conditions(where)
    return Source(
        paths=paths,
        node=_parse_name_option("node", node),
        outputs=outputs,
        scale=factors,
        offset=shifts,
        time=stamp,
        time_unit=time_unit,
        sequence=count,
        plant=None if plant_name is None else _parse_name_option("plant", plant_name),
        step=seconds,
        where=conditions,
        available=available,
        valid=_read_valid_flags(valid),
        quoted=flag("json_field, quoted", quoted),
    )


def _read_time_options(time: "Time", time_unit: "Unit", step: "Step") -> "tuple[Stamp | None, float | None]":
    """Return a source's stamp and its seconds of a step, each None if not given; raise if they contradict."""
    if not isinstance(time_unit, str) or time_unit not in get_args(TimeUnit):
        raise fail("json_field, time_unit", f"one of {', '.join(get_args(TimeUnit))}", show_value(time_unit))
    stamp = Stamp(time) if isinstance(time, str) else time
    if not isinstance(stamp, Stamp | None):
        raise fail("json_field, time", "a text or hg.files.Stamp", show_value(time))
    seconds = None if step is None else float(scalar("json_field, step", step, TINY))
    if time_unit == "step" and (seconds is not None or (stamp is not None and stamp.shift)):
        raise fail("json_field, step", "none where the time is in steps already, and no offset", step)
    return stamp, seconds


def read_paths(value: object) -> tuple[str | Computed, ...]:
    """Return paths as a tuple; the value is one path, one number computed from several, or a sequence of these."""
    items = [value] if isinstance(value, str | Computed) else value
    if not isinstance(items, Sequence) or not all(isinstance(path, str | Computed) for path in items):
        expected = "a dotted path, hg.files.Yaw, Covariance or east of a Geodetic, or a list of these"
        raise fail("json_field, path", expected, show_value(value))
    return tuple(items)


def _parse_name_option(name: str, value: object) -> Any:
    """Return a text, Level or Field that names a node or a plant (`name` says which), or raise ValueError."""
    if not isinstance(value, str | Level | Field):
        raise fail(f"json_field, {name}", "a text, hg.files.Level or hg.files.Field", show_value(value))
    return value


def _split_conditions(where: object) -> tuple[Allowed, tuple[Available, ...]]:
    """Return the allowed values by path of a field, and the conditions on what devices say of themselves.

    `where`: one condition or several in a list, or None: {path: allowed value or values}, or `Available` (a device's
    word).
    """
    conditions = list(where) if isinstance(where, list | tuple) else [] if where is None else [where]
    available = tuple(condition for condition in conditions if isinstance(condition, Available))
    pairs = list[tuple[str, object]]()
    for condition in conditions:
        if isinstance(condition, Available):
            continue
        if not isinstance(condition, Mapping) or not all(isinstance(path, str) for path in condition):
            raise fail("json_field, where", "a dictionary of paths with their values, or Available", show_value(where))
        pairs += condition.items()
    allowed_by_path = dict[str, Container[object]]()
    for path, value in pairs:
        if path in allowed_by_path:
            raise fail("json_field, where", "each path once", show_value(path))
        # A single value, a text too, is the only one that is allowed.
        allowed = (value,) if isinstance(value, str | int | float | bool | None) else value
        if not isinstance(allowed, Container):
            raise fail(f"json_field, where, {path!r}", "a value, or a list, set or range of them", show_value(allowed))
        allowed_by_path[path] = allowed
    return allowed_by_path, available


def _read_valid_flags(valid: object) -> Flags:
    """Return {path of a flag: its values in a message that can be trusted}; `valid`: such, or a path (true or 1)."""
    if valid is None or isinstance(valid, str):
        return None if valid is None else {valid: (True, 1)}
    if not isinstance(valid, Mapping):
        raise fail("json_field, valid", "a dotted path, or a dictionary of paths with their values", show_value(valid))
    allowed_by_path, _available = _split_conditions(valid)
    return allowed_by_path


def _broadcast_to_paths(name: str, value: ArrayLike, paths: tuple[Path, ...], neutral: float) -> tuple[float, ...]:
    """Return one number (a scale or an offset) for each path in a message, from as many numbers or from a single one.

    A single number applies to measured values; paths of covariances get the `neutral` number instead.
    """
    count = len(paths)
    try:
        values = np.atleast_1d(np.asarray(value, dtype=object))
    except (TypeError, ValueError):  # a set of arrays, a key
        raise fail(f"json_field, {name}", f"1 number, or {count}", show_value(value)) from None
    if values.ndim != 1 or len(values) not in (1, count):
        raise fail(f"json_field, {name}", f"1 number, or {count}", show_value(value))
    numbers = [float(scalar(f"json_field, {name}", single)) for single in values]
    if len(numbers) == count:
        return tuple(numbers)
    return tuple(
        neutral if isinstance(path, Covariance | PlaneCovariance | ZeroIfAbsent) else numbers[0] for path in paths
    )
