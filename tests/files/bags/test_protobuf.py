"""Protocol Buffers in MCAP files: numbers of all types as they were written, what is absent, and what does not fit."""

import struct

import numpy as np
import pytest

pytest.importorskip("rosbags")
pytest.importorskip("mcap")
from mcap.writer import Writer

import heliograph as hg
from heliograph import cli
from tests.cli.walk import WALK, agrees

START = 1_790_503_200 * 10**9  # nanoseconds since 1970
TIMES, VALUES = [0.0, 0.25, 1.0, 1.25, 2.0], [20.0, 20.1, 20.3, 20.2, 20.4]
DOUBLE, FLOAT, INT64, BOOL, STRING, MESSAGE, ENUM, SINT32 = 1, 2, 3, 8, 9, 11, 14, 17


def varint(number):
    number &= (1 << 64) - 1
    parts = []
    while number > 127:
        parts.append(number & 127 | 128)
        number >>= 7
    return bytes([*parts, number])


def sized(number, content):
    content = content.encode() if isinstance(content, str) else content
    return varint(number << 3 | 2) + varint(len(content)) + content


def whole(number, value):
    return varint(number << 3) + varint(value)


def field(name, number, kind, of="", label=1, more=b""):
    """Return the description of a field."""
    parts = sized(1, name) + whole(3, number) + whole(4, label) + whole(5, kind) + more
    return sized(2, parts + (sized(6, f".{of}") if of else b""))


STAMP = sized(1, sized(1, "time.proto") + sized(2, "google.protobuf") + sized(
    4, sized(1, "Timestamp") + field("seconds", 1, INT64) + field("nanos", 2, 5)) + sized(12, "proto3"))  # fmt: skip
AIR = sized(1, sized(1, "air.proto") + sized(2, "house") + sized(
    4, sized(1, "Air") + field("stamp", 1, MESSAGE, "google.protobuf.Timestamp") + field("t", 2, DOUBLE)
    + field("seq", 3, INT64) + field("state", 4, ENUM, "house.State") + field("note", 5, STRING)
    + field("ranges", 6, FLOAT, label=3) + field("offset", 7, SINT32) + field("good", 8, BOOL)
    + field("height", 9, DOUBLE, more=whole(9, 0) + whole(17, 1)))
    + sized(5, sized(1, "State") + sized(2, sized(1, "COLD") + whole(2, 0)) + sized(2, sized(1, "WARM") + whole(2, 1)))
    + sized(12, "proto3"))  # fmt: skip
SCHEMA = STAMP + AIR


def air(moment, value, seq=7, **more):
    """A message; numbers of 0 are left out, as proto3 does."""
    stamp = whole(1, moment // 10**9) + (whole(2, moment % 10**9) if moment % 10**9 else b"")
    parts = sized(1, stamp) + (struct.pack("<Bd", 2 << 3 | 1, value) if value else b"") + whole(3, seq)
    return parts + more.get("tail", b"")


def write(path, messages, schema=SCHEMA):
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=200)
        writer.start()
        number = writer.register_schema("house.Air", "protobuf", schema)
        channel = writer.register_channel("/attic", "protobuf", number)
        for moment, data in messages:
            writer.add_message(channel, moment + 30_000_001, data, moment)
        writer.finish()
    return path


def drive():
    moments = [START + round(t * 1e9) for t in TIMES]
    return [(moment, air(moment, v, 7 + k)) for k, (moment, v) in enumerate(zip(moments, VALUES, strict=True))]


@pytest.fixture
def network(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "net.py").write_text(
        f'{WALK}\nsources = {{"/attic": field("t", node="a", time="stamp", sequence="seq")}}\n'
    )
    return hg.files.load_network("net.py")


def test_estimates_are_those_of_the_messages(tmp_path, network, capsys):
    write(tmp_path / "log.mcap", drive())
    assert cli.main(["run", "net.py", "--measurements", "log.mcap", "--out", "out.csv"]) == 0
    said = capsys.readouterr()
    agrees(hg.files.read_table("out.csv"), TIMES, VALUES)
    assert said.err == "" and "a: 5 used" in said.out
    assert cli.main(["inspect", "log.mcap"]) == 0
    listed = capsys.readouterr().out
    assert "Protobuf" in listed and "'t'" in listed.replace('"', "'")


@pytest.mark.parametrize(
    ("path", "tail", "value"),
    [
        ("t", b"", 0.0),  # absent, and so 0
        ("ranges.1", sized(6, struct.pack("<3f", 1.5, 2.5, 3.5)), 2.5),  # packed
        ("ranges.1", b"".join(struct.pack("<Bf", 6 << 3 | 5, x) for x in (1.5, 2.5)), 2.5),
        ("offset", whole(7, 5), -3.0),  # zigzag
        ("good", whole(8, 1), 1.0),
        ("good", b"", 0.0),
        ("height", struct.pack("<Bd", 9 << 3 | 1, -0.5), -0.5),
        ("t", whole(99, 12) + sized(98, "newer"), 0.0),  # fields of a newer schema
    ],
)
def test_numbers_of_all_types_are_what_was_written(tmp_path, network, path, tail, value):
    write(tmp_path / "log.mcap", [(START, air(START, 0.0, tail=tail))])
    source = hg.files.json_field(path, node="a", time="stamp")
    (event,) = hg.files.read_messages("log.mcap", network, {"/attic": source}).sort_events()
    assert event.values.tolist() == [value]


def test_what_is_optional_and_absent_is_not_zero_and_enumerations_are_names(tmp_path, network):
    warm = [(START + k * 10**9, air(START + k * 10**9, 20.0 + k, tail=whole(4, k % 2))) for k in range(4)]
    write(tmp_path / "log.mcap", warm)
    source = hg.files.json_field("t", node="a", time="stamp", where={"state": "WARM"})
    events = list(hg.files.read_messages("log.mcap", network, {"/attic": source}).sort_events())
    assert [event.values[0] for event in events] == [21.0, 23.0]
    with pytest.raises(ValueError, match="height"):
        hg.files.read_messages("log.mcap", network, {"/attic": hg.files.json_field("height", node="a", time="stamp")})


def test_one_that_does_not_fit_is_refused_alone(tmp_path, network):
    broken = air(START, 20.0)[:-3]
    messages = drive()
    messages[2] = messages[2][0], broken
    write(tmp_path / "log.mcap", messages)
    source = hg.files.json_field("t", node="a", time="stamp")
    events = hg.files.read_messages("log.mcap", network, {"/attic": source})
    assert len(events) == 4 and events.refused == 1
    assert events.reasons[0].startswith("log.mcap, message 3, /attic: expected a message of house.Air, got ")
    write(tmp_path / "log.mcap", drive(), AIR)  # the schema lacks a type that it names
    with pytest.raises(ValueError, match=r"no type 'google.protobuf.Timestamp' in the schema"):
        hg.files.read_messages("log.mcap", network, {"/attic": source})


def test_random_bytes_end_in_one_line(tmp_path, network):
    random = np.random.default_rng(0)
    messages = [(START + k, random.bytes(int(random.integers(1, 40)))) for k in range(1, 200)]
    messages.insert(0, (START, air(START, 20.0)))
    write(tmp_path / "log.mcap", messages)
    source = hg.files.json_field("t", node="a")
    events = hg.files.read_messages("log.mcap", network, {"/attic": source})
    assert (
        events.refused + len(events) == 200
        and events.refused > 100
        and all("\n" not in reason for reason in events.reasons)
    )
