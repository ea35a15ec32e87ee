"""Statistics of the messages of a topic: how many, how often, how late, which fields, and which of these are times."""

import re
from array import array
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from heliograph.files.sources.message_fields import TimeUnit, convert_time, decode_json, is_stamp
from heliograph.numerics.check import InputError
from heliograph.numerics.times.dates import UNITS, looks_like_date

SECOND = 1e9  # nanoseconds
# What messages of devices say of themselves, and not of what they measure; words of a dotted path.
HOUSEKEEPING = re.compile(
    r"battery|batt|bat|voltage|linkquality|rssi|lqi|snr|link|signal|f_port|fport|port|channel|frequency|bandwidth|"
    r"spreading|coding|gateway|gateways|rx_metadata|rxinfo|txinfo|settings|data_rate|datarate|dr|version|firmware|"
    r"model|id|uptime|heap|free|wifi|timestamp|consumed_airtime|airtime|adr|confirmed|retain|qos|mid|status|error|"
    r"errors|code|locations|header|covariance|layout|table|result"
)
# Names of running counts.
COUNTS = re.compile(
    r"f_cnt|fcnt|fcntup|seq|sequence|seq_no|seqno|counter|count|cnt|packet|packet_id|msg_id|frame_count"
)
PAYLOADS = ("decoded_payload", "object", "value", "state", "measurement")  # levels under which values stand
YEARS = range(946_684_800, 2_366_841_600)  # seconds since 1970 of the years 2000 to 2044: 2.4 GHz is none of them
# Names of clocks that count from their own start, with a unit at the end: t, time_s, Time (ms), timestamp_us.
CLOCKS = re.compile(
    r"(?:t|time|timestamp|stamp|ts|clock|elapsed|boot|uptime|seconds|sec)(?:[ _]?[\[(]?(?P<unit>s|sec|ms|us|ns)[\])]?)?"
)


@dataclass
class TopicStatistics:
    """What messages of one topic have: their number, fields, times of logging or arrival, dates, and lateness.

    Attributes:
        kind: type of the messages.
        fields: dotted paths of their numbers.
        time: dotted path of their time; None if they have none.
        count: dotted path of their running count; None if they have none.
        logged: when each was logged, or arrived, in nanoseconds since 1970.
        late: seconds from the time in each to its logging.
        dates: by dotted path the dates in the messages, in nanoseconds since 1970, and how late these are.
        units: by dotted path the unit of dates that are numbers.
        messages: how many there were.
        bits: by dotted path the bits of a whole number, where the file says them.
        measured_in: by dotted path the unit of its values, where the file names one.
        clocks: by dotted path the numbers that are named as a clock is, with its unit, in messages that nothing dates.
        own_clock: whether the time counts from its own start.
    """

    kind: str
    fields: list[str] = field(default_factory=list)
    time: str | None = None
    logged: "array[int]" = field(default_factory=lambda: array("q"))
    late: "array[float]" = field(default_factory=lambda: array("d"))
    dates: "dict[str, tuple[array[int], array[float]]]" = field(default_factory=dict)
    units: dict[str, TimeUnit] = field(default_factory=dict)
    messages: int = 0
    measured_in: dict[str, str] = field(default_factory=dict)
    bits: Mapping[str, int] = field(default_factory=dict)
    clocks: "dict[str, array[float]]" = field(default_factory=dict)
    own_clock: bool = False

    def choose_time_field(self) -> None:
        """Choose the field that holds the time of the messages.

        It is the first date field whose values differ, or else the first date field. Without dates it is the first
        clock that never goes back. `self.dates` maps a date field to its times, in nanoseconds since 1970, and to how
        many seconds later messages came. `self.late`: how late messages came after this time; `self.logged`: when they
        were logged, by this time if nothing else says it.
        """
        if self.time is not None:
            return
        if not self.dates:
            self._choose_clock_field()
            return
        varying = (path for path, (moments, _) in self.dates.items() if len(set(moments)) > 1)
        self.time = next(varying, next(iter(self.dates)))
        moments, self.late = self.dates[self.time]
        self.logged = self.logged or moments

    def _choose_clock_field(self) -> None:
        """Choose as time the first clock with a number in every message that never goes back, if there is one.

        It then also says when messages were logged. If that is known already (`self.logged`), no clock is chosen.
        `self.clocks` has the numbers of each field that is named as a clock; UNITS maps a unit to its nanoseconds.
        """
        if self.logged:
            return
        for path, numbers in self.clocks.items():
            if len(numbers) == self.messages > 1 and numbers[0] < numbers[-1] and np.all(np.diff(numbers) >= 0):
                unit = _read_unit_of_clock_name(path)
                nanoseconds = np.rint(np.array(numbers) * UNITS[unit]).astype(np.int64)
                self.time, self.own_clock, self.units[path] = path, True, unit
                self.logged = array("q", nanoseconds.tobytes())
                return

    @property
    def count(self) -> str | None:
        """Return the path of the first field that is named as a running count is; None if none is."""
        return next((path for path in self.fields if COUNTS.fullmatch(path.split(".")[-1].lower())), None)

    def list_fields_by_likelihood(self) -> list[str]:
        """Return the fields besides the running count and times, those first that look like measurements."""
        return sorted((path for path in self.fields if path not in (self.count, *self.units)), key=_rank_field)

    def format_row(self) -> list[str]:
        """Return a table's row of texts: type, count, rate, largest gap, lateness (median, 95 % quantile, largest)."""
        self.choose_time_field()
        times = np.sort(np.array(self.logged, dtype=np.int64))
        intervals = np.diff(times) / SECOND
        span = float(intervals.sum())
        rate = f"{len(intervals) / span:.3g} Hz" if span > 0 else "-"
        count = f"{max(len(times), self.messages)}"  # some messages have no known time
        gap = f"{intervals.max():.3g} s" if len(intervals) else "-"
        quantiles = np.quantile(np.array(self.late), [0.5, 0.95, 1.0]) if self.late else []
        return [self.kind, count, rate, gap, " ".join(f"{value:.3g}" for value in quantiles) or "-"]


def note_payload(topics: dict[str, TopicStatistics], name: str, payload: str | bytes, arrival: int) -> None:
    """Add a message of a broker to its topic `name`, whether it is JSON or not; `arrival`: nanoseconds since 1970."""
    try:
        note_message(topics, name, decode_json(payload, name), "JSON", arrival)
    except InputError:
        note_message(topics, name, None, "no JSON", arrival)


def note_message(
    topics: dict[str, TopicStatistics], name: str, content: object, kind: str, arrival: int | None
) -> None:
    """Count a message under its topic; note its numeric fields, and its dates with how late the message came.

    `_yield_leaves` yields (dotted path, value) of all fields. A number that may be a clock from its own start is kept
    if no arrival is known.

    Args:
        topics: the topics by name; a new one is added.
        name: name of the message's topic.
        content: the decoded message; None if it could not be decoded.
        kind: type of the messages, for a new topic.
        arrival: in nanoseconds since 1970; None if it is not known.
    """
    topic = topics.setdefault(name, TopicStatistics(kind))
    topic.messages += 1
    if arrival is not None:
        topic.logged.append(arrival)
    for path, value in _yield_leaves(content):
        if isinstance(value, int | float) and path not in topic.fields:
            topic.fields.append(path)
        if arrival is None and isinstance(value, int | float) and _is_clock_from_start(path, value):
            topic.clocks.setdefault(path, array("d")).append(value)
        _note_date(topic, path, value, arrival)


def _note_date(topic: TopicStatistics, path: str, value: object, arrival: int | None) -> None:
    """Note a field's value if it is a date (a stamp, text or number): it may be the time of measurement.

    `arrival`: when the message came, in nanoseconds since 1970; None if it is not known. `topic.dates`: by path the
    times so far, and how late messages came after them.
    """
    is_date = is_stamp(value) or (isinstance(value, str) and looks_like_date(value))
    unit: TimeUnit | None = "s" if is_date else _find_unit_of_date(value)
    if unit is None:
        return
    with suppress(InputError):
        time = convert_time(value, unit, path)
        moments, late = topic.dates.setdefault(path, (array("q"), array("d")))
        moments.append(time)
        if arrival is not None:
            late.append((arrival - time) / SECOND)
        if not isinstance(value, str):
            topic.units[path] = unit


def _match_clock_name(path: str) -> re.Match[str] | None:
    """Return the match of CLOCKS with the last word of a path, if it is a clock's name such as "time_ms"; else None."""
    return CLOCKS.fullmatch(path.split(".")[-1].lower())


def _read_unit_of_clock_name(path: str) -> Literal["s", "ms", "us", "ns"]:
    """Return the unit with which a clock's name ends, as in "uptime_ms"; seconds if it has none.

    UNITS are s, ms, us and ns; `_match_clock_name` returns the match of the name's pattern, whose group `unit` is the
    ending, or None.
    """
    match = _match_clock_name(path)
    unit = None if match is None else match["unit"]
    return next((known for known in UNITS if known == unit), "s")


def _is_clock_from_start(path: str, value: float) -> bool:
    """Return whether a field is named as a clock is, and its number is no date of 2000 to 2044 in any unit."""
    return not isinstance(value, bool) and _find_unit_of_date(value) is None and _match_clock_name(path) is not None


def _find_unit_of_date(value: object) -> TimeUnit | None:
    """Return the unit in which a number since 1970 is a date from 2000 to 2044 (YEARS), or None if there is none.

    UNITS maps each unit to its nanoseconds.
    """
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    return next((unit for unit, size in UNITS.items() if YEARS.start <= value * size / SECOND < YEARS.stop), None)


def _rank_field(path: str) -> int:
    """Return a field's rank for sorting; the more the field looks like a measurement, the lower it is.

    It is 0 inside a payload (PAYLOADS holds the names of such objects), 2 for the device's own state, such as a
    battery's (HOUSEKEEPING matches the words), and 1 for any other field.
    """
    words = path.lower().split(".")
    if any(HOUSEKEEPING.fullmatch(word) for word in words):
        return 2
    return 0 if any(word in PAYLOADS for word in words) else 1


def _yield_leaves(content: object, prefix: str = "", depth: int = 6) -> Iterator[tuple[str, object]]:
    """Yield (dotted path, value) for each leaf of decoded JSON: a number, a text, a flag, null, or a stamp.

    A stamp is a dictionary of seconds and nanoseconds. Lists are left out. Dictionaries are searched `depth` levels
    deep.
    """
    if isinstance(content, dict) and depth and not is_stamp(content):
        for key, value in content.items():
            yield from _yield_leaves(value, f"{prefix}{key}.", depth - 1)
    elif is_stamp(content) or not isinstance(content, dict | list):
        yield prefix.rstrip("."), content
