"""Fields that a message of ROS itself marks as having no value, as the definition of its type says.

A GPS message without a fix, for example, has a latitude, but its status says that it means nothing.
"""

from collections.abc import Callable, Collection, Mapping
from typing import Any, NamedTuple

import numpy as np


class Mark(NamedTuple):
    """How messages of a type say that some of their fields have no value.

    Attributes:
        fields: dotted paths of the fields that may have no value; of a list or message all that is in it is meant.
        flags: dotted paths of the numbers in the same message that decide it.
        is_none: function of a field's value and the flags, numbers or arrays of equal shape, that returns whether the
            field has no value.
    """

    fields: tuple[str, ...]
    flags: tuple[str, ...]
    is_none: Callable[..., Any]

    def covers(self, path: str) -> bool:
        """Return whether the field at a dotted path is one of `self.fields`, or an item of one."""
        return any(path == field or path.startswith(f"{field}.") for field in self.fields)


def _is_negative(_value: Any, status: Any) -> Any:
    """Return whether a satellite receiver had no fix: its status is -1 then (STATUS_NO_FIX), otherwise not negative."""
    return status < 0


def _is_minus_one(_value: Any, first: Any) -> Any:
    """Return whether an inertial sensor gave no estimate: the first entry of its covariance is -1 then."""
    return first == -1


def _is_out_of_range(value: Any, least: Any, most: Any) -> Any:
    """Return whether a distance is outside the sensor's range, from `least` to `most`.

    A driver that does not give the limits sets both to 0; then every distance counts.
    """
    return (most > least) & ((value < least) | (value > most))


POSITION = ("latitude", "longitude", "altitude")
# {message type: its marks}, as the comments in the definitions of the types say.
MARKS = {
    "sensor_msgs/msg/NavSatFix": [Mark(POSITION, ("status.status",), _is_negative)],
    "gps_msgs/msg/GPSFix": [Mark((*POSITION, "track", "speed", "climb"), ("status.status",), _is_negative)],
    "sensor_msgs/msg/Imu": [
        Mark((field,), (f"{field}_covariance.0",), _is_minus_one)
        for field in ("orientation", "angular_velocity", "linear_acceleration")
    ],
    "sensor_msgs/msg/Range": [Mark(("range",), ("min_range", "max_range"), _is_out_of_range)],
    "sensor_msgs/msg/LaserScan": [Mark(("ranges",), ("range_min", "range_max"), _is_out_of_range)],
}


def list_flags(kind: str, paths: Collection[str]) -> set[str]:
    """Return the paths of the numbers by which a message of this type says that the fields at `paths` have no value."""
    return {flag for mark in MARKS.get(kind, ()) if any(map(mark.covers, paths)) for flag in mark.flags}


def blank_columns(
    kind: str, columns: Mapping[str, np.ndarray], judged: Collection[str]
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Return the columns of many messages with NaN for fields without a value, and which messages have such fields.

    MARKS has by type of message the rules by which ROS says that a field has no value: `covers(path)` says whether a
    rule is on a field, `is_none(value, flags)` whether it has no value then.

    Args:
        kind: type of the messages.
        columns: {path of a field or flag: its numbers (messages,)}.
        judged: paths of the fields that are looked at; others stay as they are.

    Returns:
        The columns, and a mask (messages,) of the messages in which some field has no value.
    """
    blank = dict(columns)
    marked = np.zeros(len(next(iter(columns.values()), ())), dtype=bool)
    for mark in MARKS.get(kind, ()):
        for path in filter(mark.covers, judged):
            is_none = mark.is_none(columns[path], *(columns[flag] for flag in mark.flags))
            blank[path] = np.where(is_none, np.nan, columns[path].astype(np.float64))
            marked |= is_none
    return blank, marked


def blank_message(kind: str, message: Any, paths: Collection[str]) -> bool:
    """Set the fields of a message to NaN that have no value, as the message itself says; return whether there are any.

    MARKS has by type of message the rules by which ROS says that a field has no value: `covers(path)` says whether a
    rule is on a field, `is_none(value, flags)` whether it has no value then.

    Args:
        kind: the type of the message.
        message: the message, as rosbags decoded it.
        paths: dotted paths of the fields that are judged.
    """
    marked = False
    for mark in MARKS.get(kind, ()):
        for path in filter(mark.covers, paths):
            if mark.is_none(*(float(_get(message, part)) for part in (path, *mark.flags))):
                _set(message, path, np.nan)
                marked = True
    return marked


def _get(message: Any, path: str) -> Any:
    """Return the field of a message at a dotted path, or NaN if there is no such field."""
    for part in path.split("."):
        if part.isdigit():
            message = message[int(part)] if int(part) < len(message) else np.nan
        else:
            message = getattr(message, part, np.nan)
    return message


def _set(message: Any, path: str, value: float) -> None:
    """Set the field of a message at a dotted path; a list is copied, since its memory may belong to the file."""
    *parents, last = path.split(".")
    content: object = value
    if last.isdigit():  # an item of a list: set the whole list anew
        numbers = np.array(_get(message, ".".join(parents)), dtype=np.float64)
        numbers[int(last)] = value
        content = numbers
        *parents, last = parents
    setattr(_get(message, ".".join(parents)) if parents else message, last, content)
