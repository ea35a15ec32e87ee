"""Topics of a bag or a broker: their rates, gaps and lateness, and sources to paste."""

import re
import struct
from array import array
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from heliograph.files.bags.mcap_chunks import read_messages_in_order as bag_messages
from heliograph.files.bags.mcap_json_and_protobuf import holds_messages, read_mcap_messages
from heliograph.files.bags.ros_bag import OFTEN, Progress, list_fields, open_bag, parts_of
from heliograph.files.logs.log_reading import open_logs
from heliograph.files.logs.log_sources import LogSources
from heliograph.files.messages.folder_of_message_files import list_message_files
from heliograph.files.messages.message_files import (
    decode_message_content,
    is_message_file,
    make_default_topic,
    read_message_file,
)
from heliograph.files.sources.message_fields import TimeUnit, convert_time, decode_json, is_stamp, parse_arrival
from heliograph.numerics.check import InputError, error_text, fail
from heliograph.numerics.times.dates import UNITS, looks_like_date

if TYPE_CHECKING:  # an extra
    from rosbags.highlevel import AnyReader

SECOND = 1e9  # nanoseconds
STAMP = "header.stamp"
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
NO_NUMBERS = ("string", "wstring", "list", "char", "wchar")


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
        """Take for the time of the messages the first date that is not the same in all of them, or else the first.

        Without dates it is the first clock by name that never goes back; its messages were logged when it says. A date
        has its moments, in nanoseconds since 1970, and by how many seconds messages came later.
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
        """Take for the time the first clock that has a number in every message and never goes back, if there is one.

        Not where it is known when messages were logged. UNITS: nanoseconds of each unit.
        """
        for path, numbers in self.clocks.items() if not self.logged else ():
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
        """Return the fields, those first that look like measurements."""
        return sorted((path for path in self.fields if path not in (self.count, *self.units)), key=_rank_field)

    def format_row(self) -> list[str]:
        """Return type, count, rate, largest gap and lateness (median, 95 %, largest), as text."""
        self.choose_time_field()
        times = np.sort(np.array(self.logged, dtype=np.int64))
        intervals = np.diff(times) / SECOND
        span = float(intervals.sum())
        rate = f"{len(intervals) / span:.3g} Hz" if span > 0 else "-"
        count = f"{max(len(times), self.messages)}"  # some may have come at a time that is not known
        gap = f"{intervals.max():.3g} s" if len(intervals) else "-"
        quantiles = np.quantile(np.array(self.late), [0.5, 0.95, 1.0]) if self.late else []
        return [self.kind, count, rate, gap, " ".join(f"{value:.3g}" for value in quantiles) or "-"]


def inspect_bag(path: Path, progress: Progress | None = None) -> tuple[dict[str, TopicStatistics], str]:
    """Return the topics of a bag or of the bags in a folder, and where and why reading one ended early, "" if none did.

    Raises:
        ValueError: no bag, or one that cannot be opened.
    """
    topics, broken = dict[str, TopicStatistics](), ""
    for bag in parts_of(path) or [path]:
        reason = _inspect_mcap(bag, topics) if holds_messages(bag) else _inspect_one_bag(bag, topics, progress)
        broken = broken or reason
    return topics, broken


def _inspect_one_bag(path: Path, topics: dict[str, TopicStatistics], progress: Progress | None) -> str:
    """Add the topics of one bag of ROS, and return where and why reading it ended early, "" if it did not.

    Args:
        path: the bag.
        topics: by name, to which those of the bag are added.
        progress: called with the numbers of messages read and to be read.
    """
    with open_bag(path) as (reader, cut_off):
        # Types first, then each message's times, of which a header is read without decoding the rest.
        for connection in reader.connections:
            topics.setdefault(connection.topic, _describe_type(reader, connection.msgtype))
        total, done = reader.message_count, 0
        try:
            for done, (connection, logged, data) in enumerate(bag_messages(reader, reader.connections), 1):
                topic = topics[connection.topic]
                topic.logged.append(logged)
                if topic.time is not None and len(data) >= 12:  # 4 bytes of encoding, then the stamp's 8
                    topic.late.append((logged - _read_stamp(data)) / SECOND)
                if progress is not None and done % OFTEN == 0:
                    progress(done, total)
        except Exception as error:  # whatever damage makes a reader do
            return str(fail(f"{path}, after message {done}", "a bag without damage", error_text(error)))
        return cut_off


def _describe_type(reader: "AnyReader", kind: str) -> TopicStatistics:
    """Return a topic of messages of a type of ROS: its fields of numbers, and the stamp of its header, of ROS 2 alone.

    In ROS 1 a message does not begin with the stamp, by which it could be read without decoding.
    """
    fields = list(list_fields(reader, kind))
    numbers = [name for name, basic in fields if basic not in NO_NUMBERS and not name.startswith("header.")]
    has_stamp = any(name == f"{STAMP}.sec" for name, _ in fields) and reader.is2
    return TopicStatistics(kind, numbers, STAMP if has_stamp else None)


def _inspect_mcap(path: Path, topics: dict[str, TopicStatistics]) -> str:
    """Add the topics of an MCAP file without ROS, and return where and why reading it ended early."""
    for message in read_mcap_messages(path):
        if isinstance(message, InputError):
            return str(message)
        arrival = parse_arrival(message.arrival, message.where)
        if isinstance(message.content, dict):
            _note_message(topics, str(message.topic), message.content, "Protobuf", arrival)
        else:
            note_payload(topics, str(message.topic), str(message.content or ""), arrival)
    return ""


def note_payload(topics: dict[str, TopicStatistics], name: str, payload: str | bytes, arrival: int) -> None:
    """Add a message of a broker to its topic `name`, whether it is JSON or not; `arrival`: nanoseconds since 1970."""
    try:
        _note_message(topics, name, decode_json(payload, name), "JSON", arrival)
    except InputError:
        _note_message(topics, name, None, "no JSON", arrival)


def _note_message(
    topics: dict[str, TopicStatistics], name: str, content: object, kind: str, arrival: int | None
) -> None:
    """Count a message under its topic; note its fields of numbers, and its dates with how late it came.

    Args:
        topics: by name, to which a new one is added.
        name: of the message's topic.
        content: the message, decoded; None where it could not be.
        kind: type of the message, of a new topic.
        arrival: in nanoseconds since 1970; None where it is not known.
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
    """Note a value as a date of its field, which may be the time of measurement, if it is one: a stamp, text or number.

    `arrival`: of its message, in nanoseconds since 1970; None where it is not known.
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
    """Return the match of a path whose last word is named as a clock is; None for any other."""
    return CLOCKS.fullmatch(path.split(".")[-1].lower())


def _read_unit_of_clock_name(path: str) -> Literal["s", "ms", "us", "ns"]:
    """Return the unit that the name of a clock ends in, as "uptime_ms"; seconds where it has none."""
    match = _match_clock_name(path)
    unit = None if match is None else match["unit"]
    return next((known for known in UNITS if known == unit), "s")


def _is_clock_from_start(path: str, value: float) -> bool:
    """Return whether a number is named as a clock is, and no date of these years."""
    return not isinstance(value, bool) and _find_unit_of_date(value) is None and _match_clock_name(path) is not None


def _find_unit_of_date(value: object) -> TimeUnit | None:
    """Return the unit in which a number, counted from 1970, is a date of 2000 to 2044 (YEARS); None of any other value.

    UNITS: nanoseconds of each unit.
    """
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    return next((unit for unit, size in UNITS.items() if YEARS.start <= value * size / SECOND < YEARS.stop), None)


def inspect_file(path: Path) -> tuple[dict[str, TopicStatistics], str]:
    """Return the topics of a file of messages, and the first reason why one cannot be read, "" if all can be.

    Raises:
        ValueError: no such file, or one that cannot be read at all.
    """
    topics, broken = dict[str, TopicStatistics](), ""
    for message in read_message_file(path):
        if isinstance(message, InputError):
            broken = broken or str(message)
            continue
        name = message.topic or make_default_topic(path)
        arrival = None
        with suppress(InputError):
            arrival = None if message.arrival is None else parse_arrival(message.arrival, message.where)
        if message.topic is not None and isinstance(message.content, str) and arrival is not None:
            note_payload(topics, name, message.content, arrival)
            continue
        try:
            _note_message(
                topics, name, decode_message_content(message), "JSON" if is_message_file(path) else "row", arrival
            )
        except InputError:
            _note_message(topics, name, None, "no JSON", arrival)
    return topics, broken


def inspect_folder(path: Path) -> tuple[dict[str, TopicStatistics], str]:
    """Return the topics of the files of messages in a folder, and the first reason why a message cannot be read.

    Raises:
        ValueError: no file of messages in it, or one that cannot be read at all.
    """
    topics, broken = dict[str, TopicStatistics](), ""
    for file in list_message_files(path):
        found, reason = inspect_file(file)
        topics |= found
        broken = broken or reason
    return topics, broken


def inspect_log(path: Path, dbc: Path | None) -> tuple[dict[str, TopicStatistics], str]:
    """Return the messages of a vehicle's log, and the first reason why some cannot be read, "" if all can be.

    Args:
        path: the log, or a folder with several.
        dbc: database of its bus; None where it needs none, or for the identifiers alone.

    Raises:
        ValueError: no such file, one that cannot be opened, a database that does not fit; one line.
    """
    log = open_logs(path, LogSources({}, dbc=dbc), lambda name: True)
    topics, broken = dict[str, TopicStatistics](), ""
    for message in log.messages:
        if isinstance(message, InputError):
            broken = broken or str(message)
            continue
        name = str(message.topic)
        if name not in topics:
            units = log.units.get(name, {})
            known = {signal: unit for signal, unit in units.items() if unit}
            kind, bits = log.kinds.get(name, "CAN, not described"), log.bits.get(name, {})
            topics[name] = TopicStatistics(kind, list(units), measured_in=known, bits=bits)
        topics[name].logged.append(parse_arrival(message.arrival, message.where))
    if topics and not log.units:
        broken = broken or str(fail(str(path), "the database of its frames, to list signals (--dbc car.dbc)", "none"))
    return topics, broken


def _rank_field(path: str) -> int:
    """Return how little a field looks like a measurement: 0 under a payload, 2 for a device's own state, else 1.

    HOUSEKEEPING matches words of the latter, such as a battery's; PAYLOADS are names of what holds measurements.
    """
    words = path.lower().split(".")
    if any(HOUSEKEEPING.fullmatch(word) for word in words):
        return 2
    return 0 if any(word in PAYLOADS for word in words) else 1


def _read_stamp(data: bytes) -> int:
    """Return the stamp of the header that a message begins with, in nanoseconds since 1970.

    Four bytes come before it, of which the second says whether the little end comes first.
    """
    is_little_endian = data[1] & 1
    seconds, nanoseconds = struct.unpack_from("<iI" if is_little_endian else ">iI", data, 4)
    return int(seconds) * 10**9 + int(nanoseconds)


def _yield_leaves(content: object, prefix: str = "", depth: int = 6) -> Iterator[tuple[str, object]]:
    """Yield dotted path and value of what is no dictionary or list in decoded JSON, and of stamps.

    A stamp is a dictionary of seconds and nanoseconds; `depth`: how many dictionaries deep it looks.
    """
    if isinstance(content, dict) and depth and not is_stamp(content):
        for key, value in content.items():
            yield from _yield_leaves(value, f"{prefix}{key}.", depth - 1)
    elif is_stamp(content) or not isinstance(content, dict | list):
        yield prefix.rstrip("."), content
