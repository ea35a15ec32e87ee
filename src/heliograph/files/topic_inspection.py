"""Topics of a bag, a file or folder of messages, or a vehicle's log, and statistics of their messages.

They are shown to a user who wants to know which field of which topic is a measurement (`heliograph inspect`).
"""

import struct
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

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
from heliograph.files.sources.message_fields import parse_arrival
from heliograph.files.topic_statistics import SECOND, TopicStatistics, note_message, note_payload
from heliograph.numerics.check import InputError, error_text, fail

if TYPE_CHECKING:  # an extra
    from rosbags.highlevel import AnyReader

STAMP = "header.stamp"
NO_NUMBERS = ("string", "wstring", "list", "char", "wchar")


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

    The statistics of a topic have its type, numeric fields, stamp (`time`), moments of logging and how late messages
    were logged.

    Args:
        path: the bag.
        topics: statistics of topics by name, to which those of the bag are added.
        progress: called with how many messages have been read, and how many there are.
    """
    # `cut_off` is a line that says where the bag was cut off, "" if it is complete.
    with open_bag(path) as (reader, cut_off):
        # The types of the topics first; then the times of each message, without decoding more than its stamp.
        for connection in reader.connections:
            topics.setdefault(connection.topic, _describe_type(reader, connection.msgtype))
        total, done = reader.message_count, 0
        try:
            for done, (connection, logged, data) in enumerate(bag_messages(reader, reader.connections), 1):
                topic = topics[connection.topic]
                topic.logged.append(logged)
                # Messages that begin with a stamp: how long after it they were logged. 4 bytes, then the stamp's 8.
                if topic.time is not None and len(data) >= 12:
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
            note_message(topics, str(message.topic), message.content, "Protobuf", arrival)
        else:
            note_payload(topics, str(message.topic), str(message.content or ""), arrival)
    return ""


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
        # A broker's message has a payload, which is a text, and a time of arrival.
        if message.topic is not None and isinstance(message.content, str) and arrival is not None:
            note_payload(topics, name, message.content, arrival)
            continue
        # Any other message: its decoded content; if it is no JSON, the message is only counted.
        try:
            kind = "JSON" if is_message_file(path) else "row"
            note_message(topics, name, decode_message_content(message), kind, arrival)
        except InputError:
            note_message(topics, name, None, "no JSON", arrival)
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


def inspect_log(path: Path, sources: LogSources) -> tuple[dict[str, TopicStatistics], str]:
    """Return the messages of a vehicle's log, and the first reason why some cannot be read, "" if all can be.

    Args:
        path: the log, or a folder with several.
        sources: the database (.dbc) that says which signals the frames of a CAN bus hold, and the channel of the bus.
            Without a database the identifiers of frames are listed alone; other logs name their signals themselves.

    Raises:
        ValueError: no such file, one that cannot be opened, a database that does not fit; one line.
    """
    # All messages, by name: the units and bits of their signals, and the moments when they were logged.
    log = open_logs(path, sources, lambda name: True)
    topics, broken = dict[str, TopicStatistics](), ""
    for message in log.messages:
        if isinstance(message, InputError):
            broken = broken or str(message)
            continue
        name = str(message.topic)
        if name not in topics:
            units = log.units.get(name, {})
            known = {signal: unit for signal, unit in units.items() if unit}
            kind = log.kinds.get(name, "CAN, not described")
            bits = log.bits.get(name, {})
            topics[name] = TopicStatistics(kind, list(units), measured_in=known, bits=bits)
        topics[name].logged.append(parse_arrival(message.arrival, message.where))
    # Frames without a database have identifiers alone.
    if topics and not log.units:
        broken = broken or str(fail(str(path), "the database of its frames, to list signals (--dbc car.dbc)", "none"))
    return topics, broken


def _read_stamp(data: bytes) -> int:
    """Return the stamp of the header that a message begins with, in nanoseconds since 1970.

    Four bytes come before it. The second of them says whether numbers are little-endian.
    """
    is_little_endian = data[1] & 1
    seconds, nanoseconds = struct.unpack_from("<iI" if is_little_endian else ">iI", data, 4)
    return int(seconds) * 10**9 + int(nanoseconds)
