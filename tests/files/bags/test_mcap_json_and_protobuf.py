"""MCAP files with messages in JSON or Protobuf: their events, what `inspect` lists, what is damaged or refused."""

import json

import pytest

pytest.importorskip("rosbags")
pytest.importorskip("mcap")
from mcap.writer import CompressionType, Writer

import heliograph as hg
from heliograph import cli
from tests.cli.walk import WALK, agrees

START = 1_790_503_200 * 10**9  # nanoseconds since 1970
TIMES = [0.0, 0.25, 1.0, 1.25, 2.0]
VALUES = [20.0, 20.1, 20.3, 20.2, 20.4]
LATE = 30_000_001  # nanoseconds from measuring to logging
SOURCE = '{"/attic": field("air.t", node="a", time="timestamp")}'


def write(path, encoding="json", compression=CompressionType.ZSTD, **options):
    """A measurement and a picture each time, the second a message that is of no use here."""
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=300, compression=compression, **options)
        writer.start()
        schema = writer.register_schema("Air", "jsonschema", b'{"type": "object"}')
        attic = writer.register_channel("/attic", encoding, schema)
        picture = writer.register_channel("/picture", "protobuf", 0)
        for t, v in zip(TIMES, VALUES, strict=True):
            moment = START + round(t * 1e9)
            content = {"timestamp": {"sec": moment // 10**9, "nsec": moment % 10**9}, "air": {"t": v}, "seq": 7}
            for channel, data in ((attic, json.dumps(content).encode()), (picture, b"\x00\xff\x10")):
                writer.add_message(channel, moment + LATE, data, moment)
        writer.finish()


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run(folder, capsys, sources=SOURCE):
    """What `heliograph run` says, and its table; None where it refuses."""
    (folder / "net.py").write_text(f"{WALK}\nsources = {sources}\n")
    code = cli.main(["run", "net.py", "--measurements", "log.mcap", "--out", "out.csv"])
    said = capsys.readouterr()
    return said.out, said.err, hg.files.read_table("out.csv") if code == 0 else None


@pytest.mark.parametrize("compression", ["NONE", "LZ4", "ZSTD"])
@pytest.mark.parametrize("chunks", [True, False], ids=["in chunks", "one by one"])
def test_estimates_are_those_of_the_messages(folder, capsys, compression, chunks):
    write(folder / "log.mcap", compression=CompressionType[compression], use_chunking=chunks)
    out, err, table = run(folder, capsys)
    agrees(table, TIMES, VALUES)
    assert err == "" and "a: 5 used" in out and "log.mcap: not among the sources: /picture (5)" in out


def test_times_are_those_of_the_messages_to_the_nanosecond(folder, capsys):
    """Measured when the message says, arrived when it was logged; without a time it is of that moment."""
    write(folder / "log.mcap")
    run(folder, capsys)
    network = hg.files.load_network("net.py")
    stamped = hg.files.json_field("air.t", node="a", time="timestamp")
    logged = hg.files.json_field("air.t", node="a")
    for source, begin, late in ((stamped, START, LATE), (logged, START + LATE, 0)):
        events = hg.files.read_messages("log.mcap", network, {"/attic": source})
        assert events.origin == begin and (events.lateness()["a"] * 1e9).round().tolist() == [late] * 5
        assert [event.time for event in events.sort_events()] == TIMES


def test_inspect_lists_topics_and_proposes_sources(folder, capsys):
    write(folder / "log.mcap")
    assert cli.main(["inspect", "log.mcap"]) == 0
    said = capsys.readouterr().out
    assert "/attic" in said and "2 Hz" in said and "0.75 s" in said and "0.03" in said
    assert (
        "'/attic': hg.files.json_field('air.t', node='NODE', output='OUTPUT', time='timestamp', sequence='seq')" in said
    )


def test_bags_in_a_folder_are_one(folder, capsys):
    """Their messages are one recording, and `inspect` counts them together."""
    (folder / "log.mcap").mkdir()
    for name in ("first.mcap", "second.mcap"):
        write(folder / "log.mcap" / name)
    out, _, table = run(folder, capsys)
    assert "a: 10 used" in out and len(table["x"]) == 10  # without a count two of one time are two
    assert cli.main(["inspect", "log.mcap"]) == 0
    row = next(line for line in capsys.readouterr().out.splitlines() if "/attic" in line)
    assert row.split()[:3] == ["/attic", "JSON", "10"]


def test_what_was_cut_off_or_damaged_is_used_up_to_there(folder, capsys):
    write(folder / "log.mcap", compression=CompressionType.NONE, use_chunking=False, use_statistics=False)
    whole = (folder / "log.mcap").read_bytes()
    cut = whole.index(json.dumps({"t": VALUES[3]}).encode())
    (folder / "log.mcap").write_bytes(whole[:cut])
    _, err, table = run(folder, capsys)
    agrees(table, TIMES[:3], VALUES[:3])
    assert "log.mcap: expected whole records, got one that was cut off; what was read before it stays" in err
    # A chunk whose content does not match its checksum.
    write(folder / "log.mcap", compression=CompressionType.NONE)
    whole = (folder / "log.mcap").read_bytes()
    (folder / "log.mcap").write_bytes(whole.replace(b'{"t": 20.4}', b'{"t": 99.4}'))
    _, err, table = run(folder, capsys)
    assert len(table["x"]) == 4 and "Chunk checksum mismatch" in err
    # A message that is no JSON is refused alone.
    write(folder / "log.mcap", compression=CompressionType.NONE, enable_crcs=False)
    whole = (folder / "log.mcap").read_bytes()
    (folder / "log.mcap").write_bytes(whole.replace(b'{"t": 20.1}', b'{"t": 20.1 '))
    _, err, table = run(folder, capsys)
    agrees(table, TIMES[:1] + TIMES[2:], VALUES[:1] + VALUES[2:])
    assert "messages that could not be read: 1; log.mcap, message 3" in err


def test_other_encodings_are_refused(folder, capsys):
    """Of a topic of the sources, or of all topics: one line with the topic and what is read."""
    write(folder / "log.mcap")
    assert (
        "log.mcap: not in the bag: /cellar" in run(folder, capsys, f'{SOURCE} | {{"/cellar": field("t", node="a")}}')[0]
    )
    _, err, _ = run(folder, capsys, '{"/picture": field("t", node="a"), "/attic": field("air.t", node="a")}')
    expected = "messages in JSON or Protobuf with its schema, as others of this file are"
    assert f"log.mcap, /picture: expected {expected}, got protobuf" in err
    write(folder / "log.mcap", encoding="protobuf")
    _, err, _ = run(folder, capsys)
    expected = "messages of ROS, in JSON, or in Protobuf with its schema"
    assert err == f"heliograph: log.mcap: expected {expected}, got protobuf without its schema\n"
    assert cli.main(["inspect", "log.mcap"]) == 2 and "got protobuf" in capsys.readouterr().err


def test_a_part_of_a_type_that_is_not_described_is_one_line(tmp_path):
    """`wstring` of ROS 2, which nobody decodes here: it was a KeyError with a traceback."""
    with (tmp_path / "log.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2")
        schema = writer.register_schema("tank/msg/Named", "ros2msg", b"float64 level\nwstring name\n")
        tank = writer.register_channel("/tank", "cdr", schema)
        for k in range(20):  # many, so that they are decoded together
            moment = START + k * 10**8
            writer.add_message(tank, moment, bytes([0, 1, 0, 0]) + bytes(8) + bytes([1, 0, 0, 0, 97, 0]), moment)
        writer.finish()
    plant, sensor = hg.LinearPlant([[0.9]], 1.0, [0.0], 1.0, [[0.0]], inputs=["dt"]), hg.LinearSensor([[1.0]], 1.0)
    network = hg.Network(plant, {"a": hg.Node(sensor, hg.perfect(), {})})
    with pytest.raises(ValueError, match=r"/tank, logged at .*: expected a message of tank/msg/Named"):
        hg.files.read_messages(tmp_path / "log.mcap", network, {"/tank": hg.files.json_field("level", node="a")})
