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
LENGTH = 9  # bytes of a record before its content: kind and length
CRC = 24  # bytes of a chunk's content before its checksum: first and last time, size
FIXED = 40  # bytes of a chunk's content before its messages, but for the name of the compression
HEADER = struct.Struct("<QHIQQ")  # of a message: its length, channel, count, times of logging and publishing
SIZE, CHECKSUM = struct.Struct("<Q"), struct.Struct("<I")


def read_messages_in_order(reader: "AnyReader", connections: "Sequence[Connection]") -> Iterator[RawMessage]:
    """Yield the messages of connections in the order in which they were logged.

    Args:
        reader: an open bag.
        connections: connections, at least one.
    """
    from rosbags.rosbag2.storage_mcap import McapReader

    # Of one bag its MCAP file, or files. Anything without chunks, and with each message compressed by itself, is read
    # by rosbags.
    bag: Any = getattr(reader.readers[0], "storage", None) if len(reader.readers) == 1 else None
    files = [bag] if isinstance(bag, McapReader) else getattr(bag, "storages", [])
    have_chunks = files and all(isinstance(file, McapReader) and file.chunks for file in files)
    if not have_chunks or bag.metadata.compression_mode == "message":
        yield from (RawMessage(of, logged, bytes(data)) for of, logged, data in reader.messages(connections))
        return
    # One file after another, as a bag in parts was written.
    known = {(connection.topic, connection.msgtype): connection for connection in connections}
    for file in files:
        channels = {c.id: known[c.topic, c.msgtype] for c in file.connections if (c.topic, c.msgtype) in known}
        chunks = [chunk for chunk in file.chunks if any(chunk.channel_count.get(c) for c in channels)]
        yield from _merge_chunks(file, sorted(chunks, key=attrgetter("chunk_start_offset")), channels)


def _merge_chunks(
    storage: "McapReader", chunks: "Sequence[ChunkInfo]", channels: "Mapping[int, Connection]"
) -> Iterator[RawMessage]:
    """Yield the messages of chunks in the order of their times, although chunks may overlap in time.

    A message waits while a later chunk may hold an earlier one. Of messages of one time the first in the file comes
    first.
    """
    starts = [chunk.message_start_time for chunk in chunks]
    earliest = [*accumulate(reversed(starts), min)][::-1]  # the earliest time of each chunk and all after it
    waiting: list[RawMessage] = []
    for chunk, earliest_of_later in zip(chunks, [*earliest[1:], None], strict=True):
        waiting = sorted([*waiting, *_yield_messages_of_chunk(storage, chunk, channels)], key=attrgetter("logged"))
        if earliest_of_later is None:
            yield from waiting
            return
        count = bisect_left(waiting, earliest_of_later, key=attrgetter("logged"))  # of those before later chunks
        yield from waiting[:count]
        waiting = waiting[count:]


def _yield_messages_of_chunk(
    storage: "McapReader", chunk: "ChunkInfo", channels: "Mapping[int, Connection]"
) -> Iterator[RawMessage]:
    """Yield the messages of one chunk, as they stand in it.

    Args:
        storage: the open file.
        chunk: a compressed group of records in the file, as the file's index has it.
        channels: connections (topic and type) by the numbers of their channels; messages of others are passed over.

    Raises:
        ValueError: a record that is longer than the rest of the chunk.
    """
    from rosbags.rosbag2.storage_mcap import decompress

    # A chunk is a record itself: LENGTH bytes, then its content. CRC bytes into that stands the checksum of its
    # messages, which `decompress` compares; they begin after FIXED bytes and the name of the compression.
    stream, content_begin = storage.bio, chunk.chunk_start_offset + LENGTH
    assert stream is not None  # since the file is open
    stream.seek(content_begin + CRC)
    (checksum,) = CHECKSUM.unpack(stream.read(CHECKSUM.size))
    stream.seek(content_begin + FIXED + len(chunk.compression))
    content = decompress(stream.read(chunk.compressed_size), chunk.compression, chunk.uncompressed_size, checksum)
    # Record after record: a byte for its kind, eight for its length, its content.
    begin, end = 0, len(content)
    while begin < end:
        (size,) = SIZE.unpack_from(content, begin + 1)
        after = begin + LENGTH + size
        if after > end:
            raise ValueError(f"a record of {size} bytes, of which {end - begin - LENGTH} are there")
        if content[begin] == MESSAGE:
            _, channel, _, logged, _ = HEADER.unpack_from(content, begin + 1)
            if channel in channels:
                yield RawMessage(channels[channel], logged, content[begin + 1 + HEADER.size : after])
        begin = after
