"""Topics and fields of messages: patterns of topics, what stands at a dotted path, and its conversion to a number."""

import json
import re
from collections.abc import Iterator, Mapping
from contextlib import suppress
from decimal import Decimal
from functools import lru_cache
from math import isfinite
from operator import attrgetter
from typing import Any, Literal, NamedTuple

import numpy as np

from heliograph.files.text.csv_dialects import NO_VALUE
from heliograph.live.event import check_63_bits
from heliograph.numerics.check import InputError, fail, show_value
from heliograph.numerics.times.dates import UNITS, parse_dates, parse_instant

TimeUnit = Literal["s", "ms", "us", "ns", "step"]
# Fields of a stamp, of seconds and nanoseconds: of ROS 2 and 1, protobuf, Foxglove.
STAMPS = (("sec", "nanosec"), ("secs", "nsecs"), ("seconds", "nanos"), ("sec", "nsec"))
PLAIN = (Mapping, list, tuple, str, int, float, np.ndarray, type(None))  # any other message is an object of rosbags
NUMBER = "a number, true or false, or null for what did not arrive"
EXACT, DIGITS = 2**53, 20  # up to here doubles hold every whole number; as many digits at most have 64 bits
SHORT = 16  # characters: a double tells apart any two numbers of 15 digits and a point
# Bare words that C, C++ and JavaScript print for what is no number, outside of texts.
NO_NUMBERS = re.compile(
    r'"(?:[^"\\]|\\.)*"|[-+]?\b(?:nan\([a-z0-9]*\)|(?:nan|inf(?:inity)?)\b|1\.#(?:q?nan|snan|ind|inf)\d*)',
    re.IGNORECASE,
)


class LongDecimal(float):
    """The double nearest to a number that is written with more digits than doubles hold, and the number itself.

    Seconds since 1970 with nine decimals are such numbers: doubles are 2.4e-7 apart there.
    """

    def __init__(self, text: str):
        """Keep the decimal number that a text has, beside the double that this is."""
        self.decimal = Decimal(text)


class _DoubledField(NamedTuple):
    """An object of JSON in which a field occurs twice, as a dictionary, and the field's name."""

    fields: dict[str, Any]
    name: str


class MissingFieldError(InputError):
    """A message has no field at a path."""


def decode_json(text: str | bytes, name: str) -> Any:
    """Return the content of JSON; a bare nan or inf, as printf writes them, counts as null.

    A number of many digits is a `LongDecimal`. `name` is the text's place, for errors.

    Raises:
        ValueError: the text is not JSON, or a field occurs twice in an object.
    """
    content, doubled = _decode_json(text, name)
    if doubled:
        raise fail_of_doubled(name, doubled[0].name)
    return content


def decode_items(text: str | bytes, name: str) -> list[tuple[Any, str | None]]:
    """Return the items of a JSON text, read as `decode_json` does; nested lists are flattened.

    Returns:
        For each item the pair of its content and the name of a field that occurs twice in it, None if there is none.

    Raises:
        ValueError: the text is not JSON.
    """
    content, doubled = _decode_json(text, name)
    return [(item, _name_doubled_field(item, doubled)) for item in _flatten_lists(content)]


def fail_of_doubled(name: str, field: str) -> InputError:
    """Return the error for an object of JSON that has a field twice; decoders would silently use the last one."""
    return fail(name, "distinct fields", f"{field!r} more than once")


def _decode_json(text: str | bytes, name: str) -> tuple[Any, list[_DoubledField]]:
    """Return the content of JSON, and each object in it that has a field twice, with the field's name.

    Decoders keep the last of two fields of one name without a word, so the caller refuses such an object. `name`: of
    the text, for errors. Words such as nan or inf, which are no JSON, are read as null. NO_NUMBERS is a pattern of such
    words, and of quoted texts, which stay.
    """
    doubled = list[_DoubledField]()

    def collect(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        """Return an object's fields as a dictionary; if one occurs twice, append the object to `doubled`."""
        fields = dict(pairs)
        if len(fields) < len(pairs):
            names = [name for name, _ in pairs]
            doubled.append(_DoubledField(fields, next(name for name in names if names.count(name) > 1)))
        return fields

    # First as it is, which is fast; then once more with null for words such as nan outside of quoted texts.
    try:
        return json.loads(text, object_pairs_hook=collect, parse_float=_parse_float), doubled
    except ValueError:
        doubled.clear()
    except RecursionError:
        raise fail(name, "JSON", "brackets nested too deeply") from None
    try:
        decoded = text.decode() if isinstance(text, bytes) else text
        repaired = NO_NUMBERS.sub(lambda match: match[0] if match[0][0] == '"' else "null", decoded)
        return json.loads(repaired, object_pairs_hook=collect, parse_float=_parse_float), doubled
    except (ValueError, RecursionError):  # also bytes that are no text
        raise fail(name, "JSON", show_value(text)) from None


def _name_doubled_field(content: Any, doubled: list[_DoubledField]) -> str | None:
    """Return the name of a field that occurs twice in `content` or in an object inside it, or None.

    `doubled` holds the objects with such a field that were found while decoding.
    """
    if not doubled or not isinstance(content, dict | list):
        return None
    for field in doubled:
        if field.fields is content:
            return field.name
    items = content.values() if isinstance(content, dict) else content
    names = (_name_doubled_field(item, doubled) for item in items)
    return next((name for name in names if name is not None), None)


def _flatten_lists(content: object) -> Iterator[object]:
    """Yield the items of a list, and of lists inside it, one by one; anything but a list is yielded itself."""
    if not isinstance(content, list):
        yield content
        return
    for item in content:
        yield from _flatten_lists(item)


def match_topic(topic: str, pattern: str) -> bool:
    """Return whether a topic matches a pattern with the wildcards of MQTT: + for one word, # for all that follow."""
    if topic == pattern:
        return True
    words, levels = topic.split("/"), pattern.split("/")
    if levels[-1] == "#":
        levels = levels[:-1]
        words = words[: len(levels)]
    return len(words) == len(levels) and all(level in ("+", word) for word, level in zip(words, levels, strict=True))


def field_at(message: object, path: str, where: str) -> Any:
    """Return the field at a dotted path of a message: of dictionaries, lists, arrays and objects with attributes.

    Args:
        message: the message, decoded.
        path: names between dots, positions in lists as numbers; "" for the message itself.
        where: place of the message, for errors.

    Raises:
        ValueError: no such field; one line with the path and the fields that are there.
    """
    # A message of a bag is an object with attributes (not of a PLAIN type, as JSON has), and there are millions: read
    # all of the path at once, if it has them.
    if path and not isinstance(message, PLAIN):
        with suppress(AttributeError):
            return _make_attribute_getter(path)(message)
    value: Any = message
    rest = path
    while rest:
        # A name that has dots itself comes first.
        if isinstance(value, Mapping) and rest in value:
            return value[rest]
        name, _, rest = rest.partition(".")
        # A key of a dictionary, a position in a list, an attribute of any other object.
        if isinstance(value, Mapping) and name in value:
            value = value[name]
        elif name.isdigit() and isinstance(value, list | tuple | np.ndarray) and int(name) < len(value):
            value = value[int(name)]
        elif hasattr(value, name) and not isinstance(value, list | tuple | np.ndarray | Mapping | str | int | float):
            value = getattr(value, name)
        else:
            raise MissingFieldError(str(fail(where, f"a field {path!r}", f"no {name!r} in {_list_field_names(value)}")))
    return value


@lru_cache
def _make_attribute_getter(path: str) -> "attrgetter[Any]":
    """Return a function that reads the attribute at a dotted path of an object; cached, since paths are few."""
    return attrgetter(path)


def convert_number(value: Any, name: str, quoted: bool = False) -> float:
    """Return a value as a double; it is NaN for null, for words such as "null" (NO_VALUE), and for infinities.

    A number that is written as a text is only accepted if `quoted`. `name` is the value's place, for errors.
    """
    if value is None or value == "" or (isinstance(value, str) and NO_VALUE.fullmatch(value.strip())):
        return np.nan
    if quoted and isinstance(value, str):
        value = parse_number(value)
    if not isinstance(value, bool | int | float | Decimal | np.number | np.bool_):
        raise fail(name, NUMBER, show_value(value))
    try:
        numeric = float(value)
    except OverflowError:
        raise fail(name, NUMBER, show_value(value)) from None
    return numeric if isfinite(numeric) else np.nan


def parse_number(text: str) -> int | float | str:
    """Return the number that a text holds, or the text itself if it is not a number.

    Integers keep every digit, and a number of many digits is a `LongDecimal`. An integer that ends in .0 becomes a
    double, unless this would lose digits. DIGITS: the most digits of an integer that is read so; EXACT is 2^53, from
    where doubles skip integers.
    """
    digits = text.strip()
    if "_" in digits:  # only Python accepts such numbers
        return text
    whole, point, zeros = digits.partition(".")
    is_whole = point and not zeros.strip("0") and whole.lstrip("+-").isdecimal() and len(whole) <= DIGITS
    if is_whole and abs(int(whole)) >= EXACT:
        digits = whole
    try:
        return int(digits) if digits.lstrip("+-").isdecimal() else _parse_float(digits)
    except ValueError:
        return text


def _parse_float(text: str) -> float:
    """Return the number in a text that is no integer, with all digits if these may be too many for a double."""
    return float(text) if len(text) <= SHORT else LongDecimal(text)


def is_stamp(value: object) -> bool:
    """Return whether decoded JSON is a stamp of two whole numbers, seconds and nanoseconds, and nothing else."""
    return isinstance(value, Mapping) and any(set(pair) == value.keys() for pair in STAMPS)


def convert_time(value: Any, unit: TimeUnit, name: str, quoted: bool = False) -> int:
    """Return a time in nanoseconds since 1970, or as a step if that is its unit.

    Args:
        value: a stamp (seconds and nanoseconds), a date with its zone, or a number.
        unit: unit of a time that is a number.
        name: name of the value, for errors.
        quoted: whether a text such as "1.5" counts as a number.

    Raises:
        ValueError: no time; a date without a zone; a stamp of zero, which nobody has set.
    """
    # A stamp (seconds and nanoseconds) first: its number is in nanoseconds already.
    stamp = None if isinstance(value, int | float | str) else _read_stamp(value, name)
    if stamp is not None:
        return _convert_number_to_nanoseconds(stamp, "ns", name)
    # Dates, then numbers in their unit.
    if isinstance(value, str):
        value = parse_number(value) if quoted else value
    if isinstance(value, str):
        try:
            parse_instant(value)
        except ValueError:
            raise fail(name, "a date of ISO 8601 with its zone", show_value(value)) from None
        return int(parse_dates([value], name)[0].astype(np.int64))
    is_number = isinstance(value, int | float | Decimal | np.number) and not isinstance(value, bool)
    if not is_number or not isfinite(value):
        raise fail(name, "a time: a date with its zone, a stamp, or a number", show_value(value))
    if unit == "step":
        return convert_count(value, name)
    return _convert_number_to_nanoseconds(value, unit, name)


def _read_stamp(value: Any, name: str) -> int | None:
    """Return a stamp of seconds and nanoseconds as nanoseconds since 1970, or None if the value is no such stamp.

    A stamp is a dictionary or an object. STAMPS holds the pairs of names that its two integers have in ROS 1, in ROS 2
    and in Protocol Buffers.

    Raises:
        ValueError: the stamp is zero, so that nobody has set it. The error begins with `name`.
    """
    is_map = isinstance(value, Mapping)
    for names in STAMPS:
        if all(name in value if is_map else hasattr(value, name) for name in names):
            seconds, nanoseconds = (int(value[name] if is_map else getattr(value, name)) for name in names)
            if seconds == nanoseconds == 0:
                raise fail(name, "a time that was set (without time= it is the moment of arrival)", "a stamp of 0")
            return seconds * 10**9 + nanoseconds
    return None


def _convert_number_to_nanoseconds(value: Any, unit: Literal["s", "ms", "us", "ns"], name: str) -> int:
    """Return a finite number of `unit` since 1970 as nanoseconds; raise ValueError if 64 bits do not hold it.

    UNITS maps each unit to its nanoseconds. The error suggests a unit in which the number would be a time.
    """
    # Compute with the decimal number that was meant: a double of seconds times 10^9 is off by up to 128 ns.
    if isinstance(value, Decimal | LongDecimal):
        decimal: Decimal | int = value if isinstance(value, Decimal) else value.decimal
    else:
        decimal = int(value) if float(value).is_integer() else Decimal(repr(float(value)))
    stamp = round(decimal * UNITS[unit])
    if not -(2**63) < stamp < 2**63:
        fits = next((other for other, size in UNITS.items() if 0 <= float(value) * size < 2**63), None)
        hint = "" if fits is None else f": in {fits} it is one (time_unit={fits!r})"
        raise fail(name, f"a time in {unit} since 1970", f"{show_value(value)}{hint}")
    return stamp


def parse_arrival(value: Any, name: str) -> int:
    """Return a log's time of arrival, which is a date or seconds and may be a text, as nanoseconds since 1970."""
    if isinstance(value, np.datetime64):
        return int(value.astype("datetime64[ns]").astype(np.int64))
    return convert_time(value, "s", name, quoted=True)


def parse_start(name: str, start: object) -> int:
    """Return the date from which a clock counts, as nanoseconds since 1970.

    Raises:
        ValueError: `start` is not a date with a zone.
    """
    if not isinstance(start, str):
        raise fail(name, "a date of ISO 8601 with its zone, such as 2026-09-27T10:00:00Z", show_value(start))
    return convert_time(start, "s", name)


def convert_count(value: Any, name: str, quoted: bool = False) -> int:
    """Return a running count as an integer; columns of numbers hold it as a float, and if `quoted` it may be a text.

    `name`: place of the value, for errors. Numbers of more than 63 bits are refused.
    """
    if quoted and isinstance(value, str):
        value = parse_number(value)
    value = value.decimal if isinstance(value, LongDecimal) else value
    if isinstance(value, float | Decimal) and isfinite(value) and value == int(value):
        value = int(value)
    return check_63_bits(name, value)


def convert_name(value: Any, name: str) -> str:
    """Return the name of a plant or a node as a text; `value` may be an integer, `name` is its place, for errors."""
    if isinstance(value, int | np.integer) and not isinstance(value, bool):
        return str(int(value))
    if isinstance(value, float) and value.is_integer():
        return str(int(value))
    if not isinstance(value, str):
        raise fail(name, "a name", show_value(value))
    return value


def _list_field_names(value: object) -> str:
    """Return the names of a value's fields, for an error, in at most 200 letters; a value without fields itself."""
    if isinstance(value, Mapping):
        names = [str(key) for key in value]
    elif hasattr(value, "__dataclass_fields__"):
        names = list(value.__dataclass_fields__)
    else:
        return show_value(value) if not isinstance(value, list | np.ndarray) else f"a list of {len(value)}"
    return ", ".join(name for name in names if not re.match("__", name))[:200] or "an empty message"
