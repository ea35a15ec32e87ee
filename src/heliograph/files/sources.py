"""Sources of data: which field of which topic's messages is which output or input of a network."""

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from difflib import get_close_matches
from functools import lru_cache
from math import isfinite
from operator import attrgetter
from typing import Any, Literal, NamedTuple, get_args

import numpy as np

from heliograph.live.event import INPUTS, whole
from heliograph.model.plant import TIME_STEP
from heliograph.numerics.check import TINY, fail, scalar, shown, text
from heliograph.numerics.dates import UNITS, dates, instant
from heliograph.numerics.module import readable
from heliograph.numerics.types import ArrayLike, Float
from heliograph.simulation.network import Network

TimeUnit = Literal["s", "ms", "us", "ns", "step"]
STAMPS = (("sec", "nanosec"), ("secs", "nsecs"), ("seconds", "nanos"))  # ROS 2, ROS 1, protobuf
PLAIN = (Mapping, list, tuple, str, int, float, np.ndarray, type(None))
NUMBER = "a number, true or false, or null for what did not arrive"


@readable
@dataclass(frozen=True)
class Source:
    """One event of a node in each message of a topic, as `json_field` describes it.

    Attributes:
        paths: dotted path of each value in the message.
        node: name of the node, or "inputs".
        outputs: name of each value among the node's outputs or the plant's inputs; empty for all of them.
        scale: factor of each value.
        offset: what is added to each value after that.
        time: dotted path of the time; None for the moment of arrival.
        time_unit: unit of a time that is a number.
        sequence: dotted path of the node's running count; None if there is none.
        plant: dotted path of the plant's name; None for a single plant.
        step: seconds of a step where times are counted in steps; None where they are not.
    """

    paths: tuple[str, ...]
    node: str
    outputs: tuple[str, ...]
    scale: tuple[float, ...]
    offset: tuple[float, ...]
    time: str | None
    time_unit: TimeUnit
    sequence: str | None
    plant: str | None
    step: float | None


def json_field(
    path: "str | Sequence[str]",
    node: str,
    output: "str | Sequence[str] | None" = None,
    *,
    scale: "ArrayLike" = 1.0,
    offset: "ArrayLike" = 0.0,
    time: str | None = None,
    time_unit: "TimeUnit" = "s",
    sequence: str | None = None,
    plant: str | None = None,
    step: float | None = None,
) -> "Source":
    """Map a field of a topic's messages, or several, to a node's outputs or to inputs of the plant.

    A network's file maps topics by a dictionary `sources`; a topic that feeds several nodes has a list of fields:

        sources = {"zigbee2mqtt/garden": hg.files.json_field("temp", node="garden", output="temperature")}

    The same object reads JSON from MQTT, NATS or a pipe, messages of a bag, and rows of a CSV file, whose columns are
    the fields. A path is dotted, with positions in lists as numbers ("pose.pose.position.x", "ranges.3"); a field of
    that very name, dots included, comes first; "" is the message itself. A topic may have the wildcards of MQTT.

    A value becomes `scale` value + `offset`; true is 1, false 0; null and numbers that are not finite did not arrive. A
    time is a date of ISO 8601 with its zone, a stamp of ROS, or a number since 1970 in `time_unit`; with the unit
    "step" it is a step of a network that counts steps. Without `time` a measurement is of the moment of its arrival.
    With `step` the moments are counted in steps of so many seconds: each is of the nearest step, the first of step 0.

    Args:
        path: dotted path of the value, or of several, which are then one measurement.
        node: name of a node of the network, or "inputs".
        output: name of the output or input, one for each path; None for all of the node's, in their order.
        scale: factor, of all values or of each. Shape () or (values,) (default 1).
        offset: added after scaling, to all values or to each. Shape () or (values,) (default 0).
        time: dotted path of the time; None for the moment of arrival.
        time_unit: unit of a time that is a number (default "s").
        sequence: dotted path of the node's running count; None if there is none.
        plant: dotted path of the plant's name; None if there is one plant.
        step: seconds of a step of a network that counts steps, where times are dates; None for any other.

    Raises:
        ValueError: no path, as many outputs as paths expected and others given, numbers that are not finite, another
            unit of time, a step that is not positive.
    """
    paths, outputs = _texts("path", path), () if output is None else _texts("output", output)
    if not paths or (outputs and len(outputs) != len(paths)):
        raise fail("json_field, output", f"{max(len(paths), 1)} names, one for each path", shown(output))
    if time_unit not in get_args(TimeUnit):
        raise fail("json_field, time_unit", f"one of {', '.join(get_args(TimeUnit))}", shown(time_unit))
    for name, value in {"node": node, "time": time, "sequence": sequence, "plant": plant}.items():
        if value is not None or name == "node":
            text(f"json_field, {name}", value)
    if step is not None:
        step = float(scalar("json_field, step", step, TINY))
        if time_unit == "step":
            raise fail("json_field, step", "none where the time is in steps already", step)
    factors, shifts = (_per_path(name, value, len(paths)) for name, value in (("scale", scale), ("offset", offset)))
    return Source(paths, node, outputs, factors, shifts, time, time_unit, sequence, plant, step)


class Reading(NamedTuple):
    """Content of one message for one node.

    Attributes:
        plant: name of the plant, "" for a single one.
        node: name of the node, or "inputs".
        sequence: the node's running count; None if the message has none.
        time: nanoseconds since 1970, or a step; None for the moment of arrival.
        values: all values of the node, NaN for those that this message has not. Shape (size,).
    """

    plant: str
    node: str
    sequence: int | None
    time: int | None
    values: Float[np.ndarray, " size"]


class Sources:
    """Sources checked against a network: messages of a topic to readings; unknown topics are counted, never guessed.

    Args:
        table: sources by topic, as in a network's file.
        network: the network.

    Raises:
        ValueError: no such table, an unknown node or output, a time in steps where the network has continuous time or
            the other way round. One line that names the topic.
    """

    def __init__(self, table: object, network: Network):
        self.unknown = Counter[str]()  # messages of topics that are not in the table
        self.steps = TIME_STEP not in network.inputs
        self.names = {name: tuple(network.nodes[name].received_names) for name in network.names}
        self.names[INPUTS] = tuple(name for name in network.inputs if name != TIME_STEP)
        if not isinstance(table, Mapping):
            raise fail("sources", "a dictionary of topics, each with json_field or a list of them", shown(table))
        self._table = {topic: self._checked(topic, items) for topic, items in table.items()}
        self._known: dict[str, list[tuple[Source, np.ndarray]]] = {}
        steps = {source.step for items in self._table.values() for source, _ in items}
        if len(steps) > 1:
            raise fail("sources, step", "the same of all", sorted(map(str, steps)))
        self.step = next(iter(steps), None)

    @property
    def topics(self) -> list[str]:
        """Return the topics of the table, wildcards included."""
        return list(self._table)

    def of(self, topic: str) -> list[tuple[Source, np.ndarray]]:
        """Return the sources of a topic, each with the places of its values in the node's measurement."""
        if topic not in self._known:
            matching = [items for pattern, items in self._table.items() if matches(topic, pattern)]
            self._known[topic] = [source for items in matching for source in items]
        return self._known[topic]

    def read(self, topic: str, message: object, where: str) -> list[Reading]:
        """Read the message of a topic, one reading for each source; none, and counted, if the topic is unknown.

        Args:
            topic: the topic of the message.
            message: decoded JSON, a message of a bag, or a dictionary of a row.
            where: place of the message, for errors.

        Raises:
            ValueError: a field that is not there, or is no number, time or count; one line that names it.
        """
        sources = self.of(topic)
        self.unknown[topic] += not sources
        return [self._reading(source, places, message, where) for source, places in sources]

    def _reading(self, source: Source, places: np.ndarray, message: object, where: str) -> Reading:
        values = np.full(len(self.names[source.node]), np.nan)
        for column, path, scale, offset in zip(places, source.paths, source.scale, source.offset, strict=True):
            value = at(message, path, where)
            if type(value) is not float:  # names its place only where there may be something to say
                value = number(value, f"{where}, field {path!r}")
            values[column] = scale * value + offset if isfinite(value) else np.nan
        # A time names its measurement; without one the count is left to the receiver.
        time = None
        if source.time is not None:
            time = nanoseconds(at(message, source.time, where), source.time_unit, f"{where}, field {source.time!r}")
        sequence = None
        if source.sequence is not None:
            sequence = _count(at(message, source.sequence, where), f"{where}, field {source.sequence!r}")
        plant = "" if source.plant is None else at(message, source.plant, where)
        if not isinstance(plant, str):
            raise fail(f"{where}, field {source.plant!r}", "a name", shown(plant))
        return Reading(plant, source.node, sequence, time, values)

    def _checked(self, topic: object, items: object) -> list[tuple[Source, np.ndarray]]:
        """Check the sources of a topic, and look up where their values are in the node's measurement."""
        if not isinstance(topic, str) or not topic:
            raise fail("sources", "topics that are text", shown(topic))
        sources = [items] if isinstance(items, Source) else items
        if not isinstance(sources, Sequence) or not all(isinstance(s, Source) for s in sources) or not sources:
            raise fail(f"sources, {topic!r}", "json_field, or a list of them", shown(items))
        return [(source, self._places(f"sources, {topic!r}", source)) for source in sources]

    def _places(self, name: str, source: Source) -> np.ndarray:
        if source.node not in self.names:
            raise fail(f"{name}, node", f"one of {', '.join(self.names)}", _near(source.node, self.names))
        known = self.names[source.node]
        outputs = source.outputs or known
        if len(outputs) != len(source.paths):
            raise fail(f"{name}, path", f"{len(known)} paths, for {', '.join(known)}, or output=", len(source.paths))
        for output in outputs:
            if output not in known:
                raise fail(f"{name}, output", f"one of {', '.join(known)}", _near(output, known))
        # Either all times are moments, or all are steps.
        if self.steps != (source.step is not None or (source.time is not None and source.time_unit == "step")):
            expected = (
                "the seconds of a step (step=0.1), or a time field in steps (time=..., time_unit='step'), "
                "since the network counts steps: no input 'dt'"
                if self.steps
                else "a time that is no step, since the network's time is continuous"
            )
            raise fail(f"{name}, time", expected, f"{shown(source.time)} in {source.time_unit}")
        return np.array([known.index(output) for output in outputs])


def matches(topic: str, pattern: str) -> bool:
    """Return whether a topic matches a pattern with the wildcards of MQTT: + for one word, # for all that follow."""
    if topic == pattern:
        return True
    words, parts = topic.split("/"), pattern.split("/")
    if parts[-1] == "#":
        words, parts = words[: len(parts) - 1], parts[:-1]
    return len(words) == len(parts) and all(level in ("+", word) for word, level in zip(words, parts, strict=True))


def at(message: object, path: str, where: str) -> Any:
    """Return the field at a dotted path of a message: of dictionaries, lists, arrays and objects with attributes.

    Raises:
        ValueError: no such field; one line with the path and the fields that are there.
    """
    # Objects first, since a bag has millions of them.
    if path and not isinstance(message, PLAIN):
        with suppress(AttributeError):
            return _getter(path)(message)
    value: Any = message
    rest = path
    while rest:
        # A name that has dots itself comes first.
        if isinstance(value, Mapping) and rest in value:
            return value[rest]
        name, _, rest = rest.partition(".")
        if isinstance(value, Mapping) and name in value:
            value = value[name]
        elif name.isdigit() and isinstance(value, list | tuple | np.ndarray) and int(name) < len(value):
            value = value[int(name)]
        elif hasattr(value, name) and not isinstance(value, list | tuple | np.ndarray | Mapping | str | int | float):
            value = getattr(value, name)
        else:
            raise fail(where, f"a field {path!r}", f"no {name!r} in {_fields(value)}")
    return value


@lru_cache
def _getter(path: str) -> "attrgetter[Any]":
    return attrgetter(path)


def number(value: Any, name: str) -> float:
    """Convert a value to a number; NaN for null and for what is not finite."""
    if value is None or value == "":
        return np.nan
    if not isinstance(value, bool | int | float | np.number | np.bool_):
        raise fail(name, NUMBER, shown(value))
    try:
        numeric = float(value)
    except OverflowError:
        raise fail(name, NUMBER, shown(value)) from None
    return numeric if np.isfinite(numeric) else np.nan


def nanoseconds(value: Any, unit: TimeUnit, name: str) -> int:
    """Convert a time to nanoseconds since 1970, or to a step if that is its unit.

    Raises:
        ValueError: no time; a date without a zone; a stamp of zero, which nobody has set.
    """
    # Stamps of two whole numbers.
    for pair in STAMPS if not isinstance(value, int | float | str) else ():
        if isinstance(value, Mapping) and set(pair) <= value.keys():
            value = int(value[pair[0]]) * 10**9 + int(value[pair[1]])
            unit = "ns"
        elif hasattr(value, pair[0]) and hasattr(value, pair[1]):
            value = int(getattr(value, pair[0])) * 10**9 + int(getattr(value, pair[1]))
            unit = "ns"
            break
    # Dates, then numbers in their unit.
    if isinstance(value, str):
        try:
            instant(value)
        except ValueError:
            raise fail(name, "a date of ISO 8601 with its zone", shown(value)) from None
        return int(dates([value], name)[0].astype(np.int64))
    if isinstance(value, bool) or not isinstance(value, int | float | np.number) or not np.isfinite(value):
        raise fail(name, "a time: a date with its zone, a stamp, or a number", shown(value))
    if unit == "step":
        return _count(value, name)
    stamp = int(value) * UNITS[unit] if float(value).is_integer() else round(float(value) * UNITS[unit])
    if not 0 < stamp < 2**63:
        raise fail(name, "a time that was set, since 1970 (without time= it is the moment of arrival)", shown(value))
    return stamp


def _count(value: Any, name: str) -> int:
    if isinstance(value, float) and value.is_integer():  # as columns of numbers have it
        value = int(value)
    return whole(name, value)


def _texts(name: str, value: str | Sequence[str]) -> tuple[str, ...]:
    items = [value] if isinstance(value, str) else value
    if not isinstance(items, Sequence) or not all(isinstance(text, str) for text in items):
        raise fail(f"json_field, {name}", "a text, or a list of texts", shown(value))
    return tuple(items)


def _per_path(name: str, value: ArrayLike, count: int) -> tuple[float, ...]:
    """Return one number for each path."""
    values = np.atleast_1d(np.asarray(value, dtype=object))
    if values.ndim != 1 or len(values) not in (1, count):
        raise fail(f"json_field, {name}", f"1 number, or {count}", shown(value))
    numbers = [float(scalar(f"json_field, {name}", single)) for single in values]
    return tuple(numbers * (count if len(numbers) == 1 else 1))


def _fields(value: object) -> str:
    """Name the fields of a value, for an error."""
    if isinstance(value, Mapping):
        names = [str(key) for key in value]
    elif hasattr(value, "__dataclass_fields__"):
        names = list(value.__dataclass_fields__)
    else:
        return shown(value) if not isinstance(value, list | np.ndarray) else f"a list of {len(value)}"
    return ", ".join(name for name in names if not re.match("__", name))[:200] or "an empty message"


def _near(name: str, names: Sequence[str] | Mapping[str, object]) -> str:
    close = get_close_matches(name, list(names), 1)
    return f"{name!r}{f' (closest: {close[0]!r})' if close else ''}"
