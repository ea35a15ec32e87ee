"""Chunks of an MCAP file read at once: the same messages in the same order as record after record."""

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rosbags")
pytest.importorskip("mcap")
from mcap.writer import CompressionType, Writer
from rosbags.highlevel import AnyReader

from heliograph.files.bags import read_messages_in_order
from tests.files.bags import ACCEL, ODOMETRY, START, STORE, acceleration, odometry


def written(path: Path, compression: CompressionType, seed: int) -> Path:
    """An MCAP file by the other library: chunks of a few messages that overlap in time, of three topics."""
    chance = np.random.default_rng(seed)
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=1500, compression=compression)
        writer.start(profile="ros2", library="test")
        channels = []
        for topic, kind in (("/odometry", ODOMETRY), ("/acceleration", ACCEL), ("/other", ACCEL)):
            text = STORE.generate_msgdef(kind, ros_version=2)[0]
            channels.append(
                writer.register_channel(topic, "cdr", writer.register_schema(kind, "ros2msg", text.encode()))
            )
        for k in range(300):
            which = int(chance.integers(3))
            at = START + k * 10**7
            message = odometry(at, float(k)) if which == 0 else acceleration(float(k))
            logged = at + int(chance.integers(0, 4)) * 5 * 10**7  # some at the same time, many before the one before
            writer.add_message(
                channels[which], logged, STORE.serialize_cdr(message, (ODOMETRY, ACCEL)[which > 0]), logged
            )
        writer.finish()
    return path


@pytest.mark.parametrize("compression", ["NONE", "LZ4", "ZSTD"])
def test_messages_are_those_of_a_record_at_a_time_in_their_order(tmp_path, compression):
    path = written(tmp_path / "a.mcap", CompressionType[compression], 3)
    with AnyReader([path]) as reader:
        assert len(reader.readers[0].storage.chunks) > 10
        some = [connection for connection in reader.connections if connection.topic != "/other"]
        known = [(of.topic, logged, bytes(data)) for of, logged, data in reader.messages(some)]
        assert [(of.topic, logged, data) for of, logged, data in read_messages_in_order(reader, some)] == known
        assert len(known) > 150


def test_a_chunk_whose_bytes_have_changed_ends_the_reading_after_what_was_before(tmp_path):
    path = written(tmp_path / "a.mcap", CompressionType.NONE, 4)
    with AnyReader([path]) as reader:
        chunk = sorted(reader.readers[0].storage.chunks)[5]
        whole = list(read_messages_in_order(reader, reader.connections))
    content = bytearray(path.read_bytes())
    content[chunk.chunk_start_offset + 300] ^= 0xFF
    path.write_bytes(content)
    read = []
    with AnyReader([path]) as reader, pytest.raises(Exception, match="checksum"):
        read.extend(read_messages_in_order(reader, reader.connections))
    assert 20 < len(read) < len(whole) and [m.data for m in read] == [m.data for m in whole[: len(read)]]
