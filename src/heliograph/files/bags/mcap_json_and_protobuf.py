"""Messages in JSON or Protocol Buffers in MCAP files, as viewers and loggers without ROS write them."""

import os
import struct
from collections.abc import Iterable, Iterator, Mapping
from io import BytesIO
from itertools import takewhile
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from heliograph.files.bags.protobuf import ProtobufSchema
from heliograph.files.bags.ros_bag import DATA_END, FOOTER, MAGIC, BagDamagedError
from heliograph.files.messages.message_files import FileMessage
from heliograph.files.sources.topic_reader import TopicReader
from heliograph.files.text.text_file import CutOffError
from heliograph.numerics.check import InputError, error_text, fail

SCHEMA, CHANNEL, MESSAGE, CHUNK = 0x03, 0x04, 0x05, 0x06  # kinds of records
RECORD = struct.Struct("<BQ")  # kind and length of a record
HEADER = struct.Struct("<HIQQ")  # of a message: channel, count, times of logging and publishing
PART = struct.Struct("<QQQI")  # of a chunk: first and last time, size and checksum of its content
LENGTH, SIZE, NUMBER = struct.Struct("<I"), struct.Struct("<Q"), struct.Struct("<H")
END = struct.Struct("<BQQQI")  # a footer: kind, length, where the summary begins, where its offsets do, checksum
JSON, PROTOBUF = "json", "protobuf"
BARE = "protobuf without its schema"
OTHERS = {BARE, "flatbuffer", "cbor", "msgpack"}  # encodings of MCAP's registry that nothing here reads


class McapChannel(NamedTuple):
    """A channel of an MCAP file: its topic, how its messages are encoded, and the number of their schema."""

    topic: str
    encoding: str  # JSON, PROTOBUF, one of OTHERS, or of ROS; "" if the file names none
    schema: int  # of Protocol Buffers it describes the message's type


class ProtobufType(NamedTuple):
    """Name of a message type of Protocol Buffers, and the schema of the file, by which its messages are decoded."""

    name: str
    schema: ProtobufSchema


def holds_messages(path: Path) -> bool:
    """Return whether a file is MCAP with messages in JSON or Protocol Buffers.

    False also means messages of ROS, which another module reads. OTHERS holds the encodings that nothing here reads.

    Raises:
        ValueError: all messages of the MCAP file are in encodings of OTHERS.
    """
    if path.suffix.lower() != ".mcap" or not path.is_file():
        return False
    try:
        with path.open("rb") as file:
            channels = _find_channels(file)
    except Exception:  # the file is damaged, which its reader will report
        return False
    encodings = {channel.encoding for channel in channels}
    if encodings and encodings <= OTHERS:
        raise fail(str(path), "messages of ROS, in JSON, or in Protobuf with its schema", ", ".join(sorted(encodings)))
    return bool(encodings & {JSON, PROTOBUF})


def read_mcap_messages(path: Path, sources: TopicReader | None = None) -> Iterator[FileMessage | InputError]:
    """Yield the messages of an MCAP file in its order, each with the moment when it was logged.

    Contents in JSON and Protocol Buffers are decoded; messages in other encodings have the content None. A message that
    does not fit its schema is yielded as an error. If the file is damaged or cut off, the last thing yielded is a
    `CutOffError`, so that the messages before it can be used.

    Args:
        path: the file.
        sources: sources of measurements; only messages of their topics are decoded. None for all topics.

    Raises:
        ValueError: a topic of the sources that is in another encoding; one line.
    """
    count = 0
    with path.open("rb") as file:
        file.seek(len(MAGIC))
        try:
            # Number, topic with encoding and schema, moment of logging, bytes, and the types of Protocol Buffers so
            # far.
            for count, channel, logged, data, types in _yield_stored_messages(path, file, sources):
                # Decode only what the sources read.
                where = f"{path}, message {count}"
                wanted = sources is None or bool(sources.of(channel.topic))
                payload = _decode_payload(where, channel, types, data) if wanted else None
                if isinstance(payload, InputError):
                    yield payload
                else:
                    yield FileMessage(where, channel.topic, payload, np.datetime64(logged, "ns"))
        except InputError as error:
            if not isinstance(error, BagDamagedError):
                raise
            yield CutOffError(f"{error}; what was read before it stays")
        except Exception as error:  # whatever damage makes a reader do
            why = fail(f"{path}, after message {count}", "a file without damage", error_text(error))
            yield CutOffError(f"{why}; what was read before it stays")


class _StoredMessage(NamedTuple):
    """A message as it stands in the file."""

    number: int  # among the messages of the file, from 1
    channel: McapChannel
    logged: int  # nanoseconds since 1970
    data: bytes
    types: dict[int, ProtobufType]  # types of messages in Protocol Buffers, by the number of their schema


def _yield_stored_messages(path: Path, file: BinaryIO, sources: TopicReader | None) -> Iterator[_StoredMessage]:
    """Yield the messages of an open file in its order; schemas and channels stand before the messages that need them.

    `_read_records` yields kind and content of each record. A channel is a topic with its encoding and the number of its
    schema; a message record begins with a head (HEADER) that has the channel's number and the moment of logging.
    `types`: {number of a schema: its message type}, as far as they have come.

    Raises:
        ValueError: a topic of the sources in an encoding that is not read.
        Exception: whatever damage leads to.
    """
    channels = dict[int, McapChannel]()
    types = dict[int, ProtobufType]()
    count = 0
    for kind, content in _read_records(file):
        if kind == SCHEMA:
            types |= _read_protobuf_schemas(content)
        elif kind == CHANNEL:
            number, channel = _read_channel(content, types)
            channels[number] = channel
            if channel.encoding not in (JSON, PROTOBUF) and sources is not None and sources.of(channel.topic):
                expected = "messages in JSON or Protobuf with its schema, as others of this file are"
                raise fail(f"{path}, {channel.topic}", expected, channel.encoding or "no encoding")
        elif kind == MESSAGE:
            count += 1
            number, _, logged, _ = HEADER.unpack_from(content)
            yield _StoredMessage(count, channels[number], logged, content[HEADER.size :], types)


def _decode_payload(where: str, channel: McapChannel, types: dict[int, ProtobufType], data: bytes) -> object:
    """Return the content of a message: a text of JSON, a dictionary of Protocol Buffers, None in other encodings.

    If a message does not fit its schema, the error is returned and not raised, so that the caller counts it and goes
    on.

    Args:
        where: place of the message, for the error.
        channel: topic, encoding and schema number of the message.
        types: {number of a schema: name and schema of the message's type}.
        data: the message as it stands in the file.
    """
    if channel.encoding == JSON:
        return data.decode(errors="replace")
    if channel.encoding != PROTOBUF:
        return None
    name, schema = types[channel.schema]
    try:
        return schema.decode(data, name)
    except (ValueError, IndexError, struct.error) as error:
        return fail(f"{where}, {channel.topic}", f"a message of {name}", error)


def _read_protobuf_schemas(content: bytes) -> dict[int, ProtobufType]:
    """Return {number of the schema: the message type that it describes} from the content of a schema record.

    The answer is {} if the record is damaged or has another encoding than Protocol Buffers. A record consists of the
    schema's number, its name and its encoding (each after its length), and the description of types after its length.
    NUMBER and LENGTH are formats of `struct`.
    """
    (number,) = NUMBER.unpack_from(content)
    name, end = _read_sized_text(content, NUMBER.size)
    encoding, end = _read_sized_text(content, end)
    if encoding != PROTOBUF:
        return {}
    try:
        return {number: ProtobufType(name, ProtobufSchema.of(content[end + LENGTH.size :]))}
    except (ValueError, KeyError):
        return {}


def _find_channels(file: BinaryIO) -> list[McapChannel]:
    """Return the channels in the summary of an MCAP file, or, without a summary, those before the first message.

    MAGIC stands at both ends of an MCAP file, and the footer before the last one; END is the format of the footer.
    `_read_records` yields (kind, content) from the present place on.
    """
    # The footer says where the summary begins; 0 means that there is none.
    file.seek(-END.size - len(MAGIC), os.SEEK_END)
    kind, _length, summary_start, _offsets_start, _checksum = END.unpack(file.read(END.size))
    if kind == FOOTER and summary_start and file.read() == MAGIC:
        file.seek(summary_start)
        if channels := _list_channels(_read_records(file)):
            return channels
    # Without a summary each channel stands where it is first used. Those after the first message are not searched.
    file.seek(len(MAGIC))
    return _list_channels(takewhile(lambda record: record[0] != MESSAGE, _read_records(file)))


def _list_channels(records: Iterable[tuple[int, bytes]]) -> list[McapChannel]:
    """Return the channels among records (kind, content); a channel's schema stands before it."""
    channels, types = list[McapChannel](), dict[int, ProtobufType]()
    for kind, content in records:
        if kind == SCHEMA:
            types |= _read_protobuf_schemas(content)
        elif kind == CHANNEL:
            _number, channel = _read_channel(content, types)
            channels.append(channel)
    return channels


def _read_records(file: BinaryIO) -> Iterator[tuple[int, bytes]]:
    """Yield kind and content of each record of an MCAP file, up to the end of its data; chunks are unpacked.

    A record is one byte for its kind, its size, and its content. A chunk is a record that holds others, compressed:
    these are yielded in its place. Names in capitals are kinds of records, and formats of `struct`: RECORD for kind and
    size, PART for the head of a chunk, SIZE for a size. DATA_END and FOOTER are the kinds behind the data.

    Raises:
        BagDamagedError: a record that is longer than the rest of the file.
        Exception: whatever else damage leads to.
    """
    from rosbags.rosbag2.storage_mcap import decompress

    while head := file.read(RECORD.size):
        kind, size = RECORD.unpack(head) if len(head) == RECORD.size else (0, 0)
        if kind in (DATA_END, FOOTER):
            return
        content = file.read(size)
        if len(head) < RECORD.size or len(content) < size:
            raise BagDamagedError(
                str(fail(str(getattr(file, "name", "a chunk")), "whole records", "one that was cut off"))
            )
        if kind != CHUNK:
            yield kind, content
            continue
        # A chunk: size and checksum of what it holds, name of the compression, then the size of the compressed bytes.
        _, _, size_unpacked, checksum = PART.unpack_from(content)
        compression, at = _read_sized_text(content, PART.size)
        (size_packed,) = SIZE.unpack_from(content, at)
        packed = content[at + SIZE.size : at + SIZE.size + size_packed]
        yield from _read_records(BytesIO(decompress(packed, compression, size_unpacked, checksum)))


def _read_channel(content: bytes, types: Mapping[int, ProtobufType]) -> tuple[int, McapChannel]:
    """Return the number of a channel, and its topic, encoding and schema, from the content of its record.

    The record begins with the numbers of the channel and of its schema. `types` maps schemas' numbers to types. If the
    schema of a Protocol Buffers channel is not among them, its encoding is BARE, which cannot be read. NUMBER is a
    format of `struct`.
    """
    (number,), (schema,) = NUMBER.unpack_from(content), NUMBER.unpack_from(content, NUMBER.size)
    topic, end = _read_sized_text(content, 2 * NUMBER.size)
    encoding, _end = _read_sized_text(content, end)
    if encoding == PROTOBUF and schema not in types:
        encoding = BARE
    return number, McapChannel(topic, encoding, schema)


def _read_sized_text(content: bytes, at: int) -> tuple[str, int]:
    """Return the text that stands at byte `at`, as its length (4 bytes) and its letters, and the byte after it."""
    (size,) = LENGTH.unpack_from(content, at)
    begin = at + LENGTH.size
    return content[begin : begin + size].decode(), begin + size
