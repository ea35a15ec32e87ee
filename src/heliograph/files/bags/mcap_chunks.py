"""Messages of an indexed MCAP file, read a chunk at a time, which takes a quarter of the time of a record at a time."""

import struct
from bisect import bisect_left
from collections.abc import Iterator, Mapping, Sequence
from itertools import accumulate
from operator import attrgetter
from typing import TYPE_CHECKING, Any

from heliograph.files.bags.batch_decoder import RawMessage

if TYPE_CHECKING:  # an extra
    from rosbags.highlevel import AnyReader
    from rosbags.interfaces import Connection
    from rosbags.rosbag2.storage_mcap import ChunkInfo, McapReader

MESSAGE = 0x05  # kind of a record
RECORD_HEAD = struct.Struct("<BQ")  # begins each record: its kind, and the length of its content
MESSAGE_HEAD = struct.Struct("<HIQQ")  # begins a message's content: channel, count, times of logging and publishing
# A chunk's content: first and last time and size (24 bytes), a checksum (4), name of the compression after its length
# (4), size of the compressed records (8), and these records.
BYTES_BEFORE_CHECKSUM = 24
BYTES_BEFORE_RECORDS = 40  # and besides the bytes of the compression's name
CHECKSUM = struct.Struct("<I")


def read_messages_in_order(reader: "AnyReader", connections: "Sequence[Connection]") -> Iterator[RawMessage]:
    """Yield the messages of connections (topics with their types) in the order in which they were logged.

    MCAP files with chunks are read here, since that is faster; any other bag is read by rosbags.

    Args:
        reader: an open bag.
        connections: connections, at least one.
    """
    from rosbags.rosbag2.storage_mcap import McapReader

    # The MCAP file of the bag, or files of a bag in parts; [] for other formats. Files without chunks, and those with
    # each message compressed by itself, are left to rosbags.
    bag: Any = getattr(reader.readers[0], "storage", None) if len(reader.readers) == 1 else None
    files = [bag] if isinstance(bag, McapReader) else getattr(bag, "storages", [])
    have_chunks = files and all(isinstance(file, McapReader) and file.chunks for file in files)
    if not have_chunks or bag.metadata.compression_mode == "message":
        for connection, logged, data in reader.messages(connections):
            yield RawMessage(connection, logged, bytes(data))
        return
    # One file after another, as a bag in parts was written.
    known = {(connection.topic, connection.msgtype): connection for connection in connections}
    for file in files:
        # By number of a channel in this file its connection; and the chunks with messages of these, as they lie in the
        # file. Messages of chunks that overlap in time are merged.
        channels = {c.id: known[c.topic, c.msgtype] for c in file.connections if (c.topic, c.msgtype) in known}
        chunks = [chunk for chunk in file.chunks if any(chunk.channel_count.get(c) for c in channels)]
        yield from _merge_chunks(file, sorted(chunks, key=attrgetter("chunk_start_offset")), channels)


def _merge_chunks(
    storage: "McapReader", chunks: "Sequence[ChunkInfo]", channels: "Mapping[int, Connection]"
) -> Iterator[RawMessage]:
    """Yield the messages of chunks in the order of their times, although chunks may overlap in time.

    A message waits while a later chunk may hold an earlier one. Of messages of one time the first in the file comes
    first. `storage`: the open file. `chunks`: groups of records in it, with the time of their first message.
    `channels`: connections by the numbers of their channels.
    """
    starts = [chunk.message_start_time for chunk in chunks]
    earliest = [*accumulate(reversed(starts), min)][::-1]  # the earliest time of each chunk and all after it
    waiting: list[RawMessage] = []
    for chunk, earliest_of_later in zip(chunks, [*earliest[1:], None], strict=True):
        waiting = sorted([*waiting, *_yield_messages_of_chunk(storage, chunk, channels)], key=attrgetter("logged"))
        if earliest_of_later is None:
            yield from waiting
            return
        # Messages before the earliest time of all later chunks are complete, and can be yielded.
        complete = bisect_left(waiting, earliest_of_later, key=attrgetter("logged"))
        yield from waiting[:complete]
        waiting = waiting[complete:]


def _yield_messages_of_chunk(
    storage: "McapReader", chunk: "ChunkInfo", channels: "Mapping[int, Connection]"
) -> Iterator[RawMessage]:
    """Yield the messages of one chunk, as they stand in it.

    RECORD_HEAD, CHECKSUM and MESSAGE_HEAD are formats of `struct`: kind and length of a record; a checksum; channel,
    count, and times of logging and publishing of a message. MESSAGE is the kind of a record with a message.

    Args:
        storage: the open file.
        chunk: a compressed group of records in the file, as the file's index has it.
        channels: connections (topic and type) by the numbers of their channels; messages of others are passed over.

    Raises:
        ValueError: a record that is longer than the rest of the chunk.
    """
    from rosbags.rosbag2.storage_mcap import decompress

    # A chunk is itself a record, whose content begins after the record's head. Unpack the records in it; `decompress`
    # also compares their checksum.
    stream = storage.bio
    chunk_content = chunk.chunk_start_offset + RECORD_HEAD.size
    assert stream is not None  # since the file is open
    stream.seek(chunk_content + BYTES_BEFORE_CHECKSUM)
    (checksum,) = CHECKSUM.unpack(stream.read(CHECKSUM.size))
    stream.seek(chunk_content + BYTES_BEFORE_RECORDS + len(chunk.compression))
    records = decompress(stream.read(chunk.compressed_size), chunk.compression, chunk.uncompressed_size, checksum)
    # One record after the other: its head (kind and length), then its content.
    position, end = 0, len(records)
    while position < end:
        kind, size = RECORD_HEAD.unpack_from(records, position)
        content_begin = position + RECORD_HEAD.size
        content_end = content_begin + size
        if content_end > end:
            raise ValueError(f"a record of {size} bytes, of which {end - content_begin} are there")
        if kind == MESSAGE:
            channel, _, logged, _ = MESSAGE_HEAD.unpack_from(records, content_begin)
            if channel in channels:
                yield RawMessage(channels[channel], logged, records[content_begin + MESSAGE_HEAD.size : content_end])
        position = content_end
