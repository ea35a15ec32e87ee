"""Bags of ROS: MCAP and SQLite files, folders of them, and bags of ROS 1, read by the sources of a network."""

import os
import struct
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import numpy as np

from heliograph.files.bags.batch_decoder import BatchDecoder, RawMessage
from heliograph.files.bags.mcap_chunks import read_messages_in_order
from heliograph.files.bags.no_value_marks import blank_message
from heliograph.files.events.event_table import EventTable
from heliograph.files.sources.message_reading import Unread
from heliograph.files.sources.topic_reader import TopicReader
from heliograph.numerics.check import InputError, error_text, fail

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader

BAGS = (".mcap", ".db3", ".bag")
OFTEN = 5000  # messages that are decoded at once, and between two reports of progress
LARGE = 1 << 22  # bytes that are decoded at once
LISTED = 8  # topics in one line
Progress = Callable[[int, int], None]  # called with how many messages have been read, and how many there are
MAGIC = b"\x89MCAP0\r\n"  # how MCAP begins and ends
DATA_END, FOOTER = 0x0F, 0x02  # records of MCAP that follow the data
# An end of data without a checksum, and a footer without a summary: all is then found by reading on.
ENDING = struct.pack("<BQI", DATA_END, 4, 0) + struct.pack("<BQQQI", FOOTER, 20, 0, 0, 0) + MAGIC
BLOCK = 1 << 20  # bytes copied at once


class BagDamagedError(InputError):
    """A bag is damaged, so that nothing can be read beyond some place in it; the message names the place."""


def is_bag(path: Path) -> bool:
    """Return whether a path is that of a bag: a file that ends in .mcap, .db3 or .bag, or a folder of these."""
    return path.suffix.lower() in BAGS or (path / "metadata.yaml").is_file() or bool(parts_of(path))


def parts_of(path: Path) -> list[Path]:
    """Return the bag files in a folder, sorted by name; [] if the path is a single bag or no folder.

    A folder with the file metadata.yaml is a single bag of ROS 2.
    """
    if not path.is_dir() or (path / "metadata.yaml").is_file():
        return []
    return sorted(file for file in path.iterdir() if file.suffix.lower() in BAGS)


def read_bag(
    path: Path, sources: TopicReader, events: EventTable, progress: Progress | None = None, strict: bool = False
) -> None:
    """Append the events of a network in a bag to a table; only the topics of the sources are decoded.

    A message that cannot be read is refused alone. If the bag ends in the middle, or a topic changes its type, what
    came before stays, and `broken` of the table says where it ended and why.

    Args:
        path: the bag.
        sources: for each topic, which fields of its messages are the measurements of which node.
        events: the table; its `broken` and `notes` are set, too.
        progress: called with how many messages have been read, and how many there are.
        strict: whether the first message that cannot be read is an error.

    Raises:
        ValueError: no bag, fields that are not in it, or no topic of the sources; one line.
        ModuleNotFoundError: rosbags is not installed (extra "bags").
    """
    with open_bag(path) as (reader, cut_off):
        events.broken = cut_off
        counts = Counter[str]()  # messages by topic
        for connection in reader.connections:
            counts[connection.topic] += connection.msgcount
        if cut_off and not counts:
            raise fail(str(path), "a bag with messages", "one that was cut off before its first part was whole")
        used = [topic for topic in counts if sources.of(topic)]
        if not used:
            expected = f"a topic of the sources, {_join_names(sources.topics)}"
            raise fail(f"{path}", expected, f"only {_join_names(counts)}")
        _check_fields_of_sources(path, reader, sources)
        # Decode the messages of a batch all at once if their layouts allow it (else `append_events` returns False), or
        # one after another.
        total = sum(counts[topic] for topic in used)
        done = 0
        decoder = BatchDecoder(reader, sources)
        marked = Counter[str]()  # by topic: messages that say that something read of them has no value
        try:
            for batch in group_into_batches(read_raw_messages(path, reader, used)):
                if not decoder.append_events(batch, events):
                    marked += _append_messages(path, reader, sources, batch, done, events, strict)
                done += len(batch)
                if progress is not None:
                    progress(done, total)
        except BagDamagedError as error:
            if strict:
                raise
            events.broken = f"{error}; what was read before it stays"
    if marked := decoder.marked + marked:
        events.notes.append(
            f"{path}: by their own word without a value (no fix, no estimate, out of range): "
            f"{_format_topic_counts(marked)}"
        )
    _note_unmatched_topics(path, sources, counts, events)


def _note_unmatched_topics(path: Path, sources: TopicReader, counts: Counter[str], events: EventTable) -> None:
    """Add notes to the events: on topics of the bag that no source has, and on sources' topics that the bag lacks.

    `counts` maps a topic of the bag to its number of messages. A source's topic with a wildcard (+ or #) never counts
    as missing.
    """
    others = {topic: count for topic, count in counts.items() if not sources.of(topic)}
    if others:
        events.notes.append(f"{path}: not among the sources: {_format_topic_counts(others)}")
    missing = [topic for topic in sources.topics if not set("+#") & set(topic) and topic not in counts]
    if missing:
        events.notes.append(f"{path}: not in the bag: {_join_names(missing)}")


@contextmanager
def open_bag(path: Path) -> "Iterator[tuple[AnyReader, str]]":
    """Open a bag and yield its reader, and a line that says where the bag was cut off, "" if it is complete.

    If an MCAP file was cut off, the reader reads a copy of its whole records.

    Raises:
        ValueError: there is no bag, or it cannot be opened. The error is one line that names it.
    """
    if not path.exists():
        raise fail(str(path), "a bag", "nothing of that name")
    with ExitStack() as stack:
        readable, cut_off = path, ""
        if path.suffix.lower() == ".mcap" and is_mcap_cut_off(path):
            readable, end = stack.enter_context(make_copy_of_whole_records(path))
            got = f"one that was cut off after {end:,} bytes of whole records"
            cut_off = str(fail(str(path), "a bag that ends", f"{got}; what was read before it stays"))
        yield stack.enter_context(_open_reader(path, readable)), cut_off


@contextmanager
def _open_reader(path: Path, readable: Path) -> "Iterator[AnyReader]":
    """Open a bag, yield its reader, and close it at the end; raise a one-line ValueError if it cannot be opened.

    `path` is named in the error, and `readable` is the file that is read: the bag, or a copy of its whole records.
    """
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    try:
        # Older releases did not write message types into the bag. Then those of ROS itself are taken.
        reader = AnyReader([readable], default_typestore=get_typestore(Stores.LATEST))
        reader.open()
    except Exception as error:  # whatever a damaged file makes a reader do
        raise fail(str(path), "a bag that can be opened", _format_reason(error)) from None
    try:
        yield reader
    finally:
        reader.close()


def read_raw_messages(path: Path, reader: "AnyReader", topics: list[str]) -> Iterator[RawMessage]:
    """Yield the messages of topics in the order in which they were logged.

    Args:
        path: the bag, for errors.
        reader: its reader.
        topics: names of the topics.

    Raises:
        BagDamagedError: damage, a topic that changes its type; one line with the place.
    """
    connections = [connection for connection in reader.connections if connection.topic in topics]
    messages = read_messages_in_order(reader, connections) if connections else iter(())
    types = dict[str, str]()  # {topic: type of its first message, which all others must have}
    count, last_logged = 0, 0
    while True:
        try:
            message = next(messages)
        except StopIteration:
            return
        except Exception as error:  # whatever damage makes a reader do
            where = "before any message"
            if count:
                where = f"after message {count} of its topics, logged at {format_moment(last_logged)}"
            raise BagDamagedError(
                str(fail(f"{path}, {where}", "a bag without damage", _format_reason(error)))
            ) from None
        topic = message.connection.topic
        kind = message.connection.msgtype
        last_logged = message.logged
        if types.setdefault(topic, kind) != kind:
            where = f"{path}, {topic}, logged at {format_moment(last_logged)}"
            raise BagDamagedError(str(fail(where, f"messages of {types[topic]}, as before", kind)))
        yield message
        count += 1


def group_into_batches(messages: Iterator[RawMessage]) -> Iterator[list[RawMessage]]:
    """Yield messages in lists of at most OFTEN messages, which end once they have LARGE bytes.

    If reading fails, the messages before the failure are yielded first, and the error is raised then. A batch is
    decoded all at once; its size bounds the memory.
    """
    batch, size, failure = list[RawMessage](), 0, None
    while failure is None:
        try:
            message = next(messages, None)
        except InputError as error:
            message, failure = None, error
        if message is not None:
            batch.append(message)
            size += len(message.data)
        if batch and (message is None or len(batch) >= OFTEN or size >= LARGE):
            yield batch
            batch, size = [], 0
        if message is None:
            break
    if failure is not None:
        raise failure


def _append_messages(
    path: Path,
    reader: "AnyReader",
    sources: TopicReader,
    batch: list[RawMessage],
    done: int,
    table: EventTable,
    strict: bool,
) -> Counter[str]:
    """Append the events of messages one after another; a message that cannot be read is counted and left out.

    Args:
        path: the bag, for errors.
        reader: decodes its messages.
        sources: which fields of which topic are a node's measurement.
        batch: the messages: connection (topic and type), time of logging, and bytes.
        done: how many messages of the sources' topics were read before.
        table: where the events go.
        strict: whether the first message that cannot be read is an error.

    Returns:
        By topic, the number of messages which say themselves that a value in them is not valid.
    """
    marked = Counter[str]()
    for number, (connection, logged, data) in enumerate(batch, done + 1):
        topic, kind = connection.topic, connection.msgtype
        # Decode the message; a decoder may raise any error at bad bytes.
        try:
            content = reader.deserialize(data, kind)
        except Exception as error:
            where = f"{path}, {topic}, logged at {format_moment(logged)}"
            table.refuse(fail(where, f"a message of {kind}", _format_reason(error)), strict)
            continue
        # Fields that the message itself marks as not valid become NaN, except where a source asks for none ({}).
        judged = {f for single in sources.of(topic) if single.source.valid != {} for f in single.source.fields}
        marked[topic] += blank_message(kind, content, judged)
        # Each source of the topic makes an event of the message, or returns the error that says why it cannot.
        for reading in sources.read(topic, content, topic):
            if isinstance(reading, Unread):
                where = f"{path}, message {number}, logged at {format_moment(logged)}"
                table.refuse(InputError(f"{where}, {reading.error}"), strict)
                table.note_unread(reading, logged)
            else:
                table.add(reading, logged)
    return marked


def list_fields(reader: "AnyReader", kind: str, prefix: str = "", depth: int = 6) -> Iterator[tuple[str, str]]:
    """Yield (dotted path, basic type) of the fields of a message type, down to `depth` messages inside it.

    A list has the type "list", and nothing is yielded for its items. A type that the bag does not define has no fields.
    `kind`: the type. `prefix`: begins the paths. `fielddefs` of the bag has by type its constants and fields: a basic
    type, a message, or a list.
    """
    from rosbags.interfaces import Nodetype

    if depth == 0:
        return
    _constants, fields = reader.typestore.fielddefs.get(kind, ([], []))
    for name, (node, field_type) in fields:
        if node == Nodetype.BASE:
            yield prefix + name, str(field_type[0])
        elif node == Nodetype.NAME:  # a message within this one
            yield from list_fields(reader, str(field_type), f"{prefix}{name}.", depth - 1)
        else:
            yield prefix + name, "list"


def format_moment(nanoseconds: int) -> str:
    """Return nanoseconds since 1970 as a date of ISO 8601."""
    return f"{np.datetime64(nanoseconds, 'ns')}Z"


def _check_fields_of_sources(path: Path, reader: "AnyReader", sources: TopicReader) -> None:
    """Raise ValueError if a source maps a field that the message type of its topic does not have.

    A connection is a topic of the bag with its message type. `list_fields` yields (path, basic type) of the type's
    fields; `_has_field` looks a source's path up among them.
    """
    for connection in reader.connections:
        what = f"{path}, {connection.topic}"
        fields = dict(list_fields(reader, connection.msgtype))
        needed = [field for mapped in sources.of(connection.topic) for field in mapped.source.fields if field]
        if needed and not fields:
            raise fail(what, "a message type that the bag defines", f"{connection.msgtype!r}, which it does not")
        for field in needed:
            if not _has_field(fields, field):
                expected = f"a field {field!r} in {connection.msgtype}"
                raise fail(what, expected, f"only {_join_names(list(fields), 24)}")


def _has_field(fields: dict[str, str], path: str) -> bool:
    """Return whether a path is that of a field, of a message with fields (such as a stamp), or of something in a list.

    `fields` maps the path of each field to its type, which is "list" for a list. What a list contains is not checked.
    """
    lists = [name for name, kind in fields.items() if kind == "list"]
    is_field_or_message = any(name == path or name.startswith(f"{path}.") for name in fields)
    return is_field_or_message or any(path.startswith(f"{name}.") for name in lists)


def _format_reason(error: Exception) -> str:
    """Return why something cannot be read, on one line without a full stop."""
    return " ".join(error_text(error).split()).rstrip(".")


def _join_names(names: "list[str] | Counter[str]", most: int = LISTED) -> str:
    """Return names joined by commas: the first `most` of them, and how many more there are."""
    names = list(names)
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def _format_topic_counts(counts: Mapping[str, int]) -> str:
    """Return topics, each with its count in brackets."""
    return _join_names([f"{topic} ({count})" for topic, count in counts.items()])


def is_mcap_cut_off(path: Path) -> bool:
    """Return whether an MCAP file was cut off: it begins with MAGIC, but does not end with MAGIC."""
    if not path.is_file() or path.stat().st_size < 2 * len(MAGIC):
        return False
    with path.open("rb") as file:
        begins = file.read(len(MAGIC)) == MAGIC
        file.seek(-len(MAGIC), os.SEEK_END)
        return begins and file.read() != MAGIC


def find_end_of_whole_records(path: Path) -> int:
    """Return the number of bytes of an MCAP file up to the end of its last whole record of data.

    The file begins with MAGIC. The data end at a record of kind DATA_END or FOOTER, or where a record is incomplete.
    """
    size, end = path.stat().st_size, len(MAGIC)
    # A record consists of a byte for its kind, eight bytes for the length of its content, and the content.
    head = struct.Struct("<BQ")
    with path.open("rb") as file:
        while end + head.size <= size:
            file.seek(end)
            kind, length = head.unpack(file.read(head.size))
            if kind in (DATA_END, FOOTER) or end + head.size + length > size:
                break
            end += head.size + length
    return end


@contextmanager
def make_copy_of_whole_records(path: Path) -> Iterator[tuple[Path, int]]:
    """Yield a temporary copy of an MCAP file's whole records, and how many bytes were copied.

    The copy is completed by ENDING, with which every whole file ends. BLOCK bytes are copied at a time.
    """
    size = find_end_of_whole_records(path)
    with TemporaryDirectory() as folder:
        copy = Path(folder) / path.name
        with path.open("rb") as source, copy.open("wb") as target:
            to_copy = size
            while to_copy and (block := source.read(min(BLOCK, to_copy))):
                target.write(block)
                to_copy -= len(block)
            target.write(ENDING)
        yield copy, size
