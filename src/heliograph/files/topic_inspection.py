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
        """Choose the field that holds the time of the messages.

        It is the first date field whose values differ, or else the first date field. Without dates it is the first
        clock that never goes back. `self.dates` maps a date field to its times, in nanoseconds since 1970, and to how
        many seconds later messages came.
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
        """Return as texts the type, count, rate, largest gap and lateness (median, 95 % quantile and largest)."""
        self.choose_time_field()
        times = np.sort(np.array(self.logged, dtype=np.int64))
        intervals = np.diff(times) / SECOND
        span = float(intervals.sum())
        rate = f"{len(intervals) / span:.3g} Hz" if span > 0 else "-"
        count = f"{max(len(times), self.messages)}"  # some messages have no known time
        gap = f"{intervals.max():.3g} s" if len(intervals) else "-"
        quantiles = np.quantile(np.array(self.late), [0.5, 0.95, 1.0]) if self.late else []
        return [self.kind, count, rate, gap, " ".join(f"{value:.3g}" for value in quantiles) or "-"]


def inspect_bag(path: Path, progress: Progress | None = None) -> tuple[dict[str, TopicStatistics], str]:
    """Return the topics of a bag or of a folder's bags, and a line on where and why reading ended early, else "".

    Raises:
        ValueError: there is no bag, or one cannot be opened.
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
    """Return the statistics of a topic with messages of a ROS type: its numeric fields, and in ROS 2 its stamp.

    In ROS 1 a message does not begin with the header's stamp, so the stamp cannot be read without decoding.
    """
    fields = list(list_fields(reader, kind))
    numbers = [name for name, basic in fields if basic not in NO_NUMBERS and not name.startswith("header.")]
    has_stamp = any(name == f"{STAMP}.sec" for name, _ in fields) and reader.is2
    return TopicStatistics(kind, numbers, STAMP if has_stamp else None)


def _inspect_mcap(path: Path, topics: dict[str, TopicStatistics]) -> str:
    """Add the topics of an MCAP file without ROS; return where and why reading ended early, "" if it did not."""
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
    """Count a message under its topic; note its numeric fields, and its dates with how late the message came.

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

    `arrival`: when the message came, in nanoseconds since 1970; None if it is not known.
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
    """Return the unit with which a clock's name ends, as in "uptime_ms"; seconds if it has none."""
    match = _match_clock_name(path)
    unit = None if match is None else match["unit"]
    return next((known for known in UNITS if known == unit), "s")


def _is_clock_from_start(path: str, value: float) -> bool:
    """Return whether a number is named as a clock is, and no date of these years."""
    return not isinstance(value, bool) and _find_unit_of_date(value) is None and _match_clock_name(path) is not None


def _find_unit_of_date(value: object) -> TimeUnit | None:
    """Return the unit in which a number since 1970 is a date from 2000 to 2044 (YEARS), or None if there is none.

    UNITS maps each unit to its nanoseconds.
    """
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    return next((unit for unit, size in UNITS.items() if YEARS.start <= value * size / SECOND < YEARS.stop), None)


def inspect_file(path: Path) -> tuple[dict[str, TopicStatistics], str]:
    """Return the topics of a file of messages, and the first reason why one cannot be read, "" if all can be.

    The statistics (fields, times, values of each topic) help a user to say which field is which measurement. Messages
    that cannot be read are skipped.

    Raises:
        ValueError: no such file, or one that cannot be read at all.
    """
    topics, broken = dict[str, TopicStatistics](), ""
    for message in read_message_file(path):
        if isinstance(message, InputError):
            broken = broken or str(message)
            continue
        # A file without topics has one topic, named after the file. A stamp of arrival that cannot be read is left out.
        name = message.topic or make_default_topic(path)
        arrival = None
        with suppress(InputError):
            arrival = None if message.arrival is None else parse_arrival(message.arrival, message.where)
        # A text payload of a broker's message, with its arrival.
        if message.topic is not None and isinstance(message.content, str) and arrival is not None:
            note_payload(topics, name, message.content, arrival)
            continue
        # Else the decoded content; if it is no JSON, only the message is counted.
        try:
            _note_message(
                topics, name, decode_message_content(message), "JSON" if is_message_file(path) else "row", arrival
            )
        except InputError:
            _note_message(topics, name, None, "no JSON", arrival)
    return topics, broken


def inspect_folder(path: Path) -> tuple[dict[str, TopicStatistics], str]:
    """Return the topics of a folder's message files, and the first reason why a message cannot be read, or "".

    Raises:
        ValueError: the folder has no message file, or one cannot be read at all.
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
        dbc: file (.dbc) that says which signals the frames of the CAN bus hold. None for a log that has this itself, or
            to list the identifiers of the frames alone.

    Raises:
        ValueError: no such file, one that cannot be opened, a database that does not fit; one line.
    """
    # All messages, by name: the units and bits of their signals, and the moments when they were logged.
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
    # Frames without a database have identifiers alone.
    if topics and not log.units:
        broken = broken or str(fail(str(path), "the database of its frames, to list signals (--dbc car.dbc)", "none"))
    return topics, broken


def _rank_field(path: str) -> int:
    """Return a field's rank, which is lower the more it looks like a measurement.

    It is 0 inside a payload (PAYLOADS holds the names of such objects), 2 for the device's own state, such as a
    battery's (HOUSEKEEPING matches the words), and 1 for any other field.
    """
    words = path.lower().split(".")
    if any(HOUSEKEEPING.fullmatch(word) for word in words):
        return 2
    return 0 if any(word in PAYLOADS for word in words) else 1


def _read_stamp(data: bytes) -> int:
    """Return the stamp of the header that a message begins with, in nanoseconds since 1970.

    Four bytes come before it. The second of them says whether numbers are little-endian.
    """
    is_little_endian = data[1] & 1
    seconds, nanoseconds = struct.unpack_from("<iI" if is_little_endian else ">iI", data, 4)
    return int(seconds) * 10**9 + int(nanoseconds)


def _yield_leaves(content: object, prefix: str = "", depth: int = 6) -> Iterator[tuple[str, object]]:
    """Yield (dotted path, value) for each leaf of decoded JSON: neither a dictionary nor a list, or a stamp.

    A stamp is a dictionary of seconds and nanoseconds. Dictionaries are searched `depth` levels deep.
    """
    if isinstance(content, dict) and depth and not is_stamp(content):
        for key, value in content.items():
            yield from _yield_leaves(value, f"{prefix}{key}.", depth - 1)
    elif is_stamp(content) or not isinstance(content, dict | list):
        yield prefix.rstrip("."), content
