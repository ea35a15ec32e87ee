"""Fields of messages to outputs and inputs of a network: values, times, counts, and each error in one line."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

import heliograph as hg
from heliograph.files.sources import TopicReader, Unread, convert_time, decode_json, match_topic
from heliograph.files.sources.message_fields import field_at

json_field = hg.files.json_field
PLANT = hg.Plant(
    lambda x, u: x + u[0] * u[1], [[0.1]], [0.0], [[1.0]], states=["temperature"], inputs=["heating", "dt"]
)
SENSOR = hg.Sensor(lambda x: x.repeat(2), np.eye(2), outputs=["in", "out"])
LINK = hg.parallel([hg.perfect(), hg.perfect()])
NETWORK = hg.Network(PLANT, {"garden": hg.Node(SENSOR, LINK, {"f": hg.cubature_filter(PLANT, SENSOR, LINK)})})
STEPS = hg.LinearPlant([[1.0]], [[0.1]], [0.0], [[1.0]], states=["x"])
COUNTING = hg.Network(STEPS, {"garden": hg.Node(hg.LinearSensor([[1.0]], 0.5), hg.perfect(), {})})


def only(readings):
    """Return the only reading; raise why it could not be read."""
    (reading,) = readings
    if isinstance(reading, Unread):
        raise reading.error
    return reading


def read(source, message, network=NETWORK):
    return only(TopicReader({"t": source}, network).read("t", message, "t"))


def test_a_field_becomes_its_output_in_its_unit():
    """Fahrenheit to Celsius; the other output did not arrive, and neither time nor count is guessed."""
    source = json_field("temp", node="garden", output="out", scale=5 / 9, offset=-160 / 9)
    reading = read(source, json.loads('{"temp": 50, "battery": 98}'))
    np.testing.assert_allclose(reading.values, [np.nan, 10.0], rtol=1e-14)  # rounding
    assert reading[:4] == ("", "garden", None, None)


def test_several_fields_are_one_measurement():
    source = json_field(("a.0", "b"), "garden", scale=(1.0, 2.0), sequence="n", plant="device.id")
    reading = read(source, {"a": [1, 7], "b": True, "n": 5, "device": {"id": "shed"}})
    assert reading.values.tolist() == [1.0, 2.0] and reading.sequence == 5 and reading.plant == "shed"
    assert read(json_field("", "inputs"), 3.5).values.tolist() == [3.5]


@pytest.mark.parametrize("value", [None, np.nan, np.inf, "", np.float32("-inf")])
def test_what_is_no_finite_number_did_not_arrive(value):
    assert np.isnan(read(json_field("v", "garden", "in"), {"v": value}).values).all()


def test_a_name_with_dots_comes_first():
    message = {"a.b": 1, "a": {"b": 2, "c.d": 3}}
    assert field_at(message, "a.b", "m") == 1 and field_at(message, "a.c.d", "m") == 3
    assert field_at(SimpleNamespace(pose=SimpleNamespace(x=np.array([4.0]))), "pose.x.0", "m") == 4.0


SECONDS = 1_700_000_000
STAMP = SECONDS * 10**9 + 123_456_789


@pytest.mark.parametrize(
    ("value", "unit", "expected"),
    [
        ("2023-11-14T22:13:20.123456789Z", "s", STAMP),
        ("2023-11-14T23:13:20.123456789+01:00", "s", STAMP),
        (SimpleNamespace(sec=SECONDS, nanosec=123_456_789), "s", STAMP),
        ({"secs": SECONDS, "nsecs": 123_456_789}, "s", STAMP),
        (STAMP, "ns", STAMP),
        (SECONDS * 1000, "ms", SECONDS * 10**9),
        (SECONDS + 0.5, "s", SECONDS * 10**9 + 500_000_000),
        (0.0, "s", 0),
        (-2.5, "s", -2_500_000_000),
        (17, "step", 17),
        (17.0, "step", 17),
    ],
)
def test_times_keep_every_nanosecond(value, unit, expected):
    assert convert_time(value, unit, "t") == expected


SECONDS = "1700000000.123456789"  # doubles are 2.4e-7 apart there


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("t.jsonl", f'{{"ts": {SECONDS}, "p": 1}}'),
        ("t.jsonl", f'{{"ts": {SECONDS}, "p": nan}}'),
        ("t.csv", f"ts,p\n{SECONDS},1"),
        ("log.jsonl", f'{{"topic": "t.csv", "payload": {{"ts": {SECONDS}, "p": 1}}}}'),
        ("log.jsonl", f'{{"topic": "t.csv", "payload": "{{\\"ts\\": {SECONDS}, \\"p\\": 1}}"}}'),
        ("log.txt", f'{SECONDS} u {{"p": 1}}'),
        ("log.csv", f'topic,timestamp,payload\nu,{SECONDS},"{{""p"": 1}}"'),
    ],
)
def test_seconds_with_nine_decimals_keep_every_nanosecond(tmp_path, name, text):
    (tmp_path / name).write_text(f"{text}\n")
    sources = dict.fromkeys(("t.jsonl", "t.csv"), json_field("p", "garden", output="in", time="ts"))
    sources["u"] = json_field("p", "garden", output="in")
    events = hg.files.read_messages(tmp_path / name, NETWORK, sources)
    assert len(events) == 1 and str(events.date) == "2023-11-14T22:13:20.123456789"


def test_a_count_with_many_digits_keeps_them():
    """2^53 + 1 is the first whole number that no double is."""
    content = '{"ts": 1, "p": 1, "n": 9007199254740993.0}'
    source = json_field("p", "garden", output="in", time="ts", sequence=hg.files.Count("n"))
    assert read(source, decode_json(content, "t")).sequence == 2**53 + 1


@pytest.mark.parametrize(
    "value", ["2023-11-14T22:13:20", "noon", True, None, np.nan, SimpleNamespace(sec=0, nanosec=0), 1e300]
)
def test_what_is_no_time_is_refused(value):
    with pytest.raises(ValueError, match=r"^t: expected "):
        convert_time(value, "s", "t")


@pytest.mark.parametrize(
    ("topic", "pattern", "expected"),
    [
        ("a/b", "a/b", True),
        ("a/b", "a/+", True),
        ("a/b/c", "a/+", False),
        ("a/b/c", "a/#", True),
        ("a", "a/#", True),
        ("b/a", "a/#", False),
        ("a/b/up", "+/b/up", True),
    ],
)
def test_wildcards_are_those_of_mqtt(topic, pattern, expected):
    assert match_topic(topic, pattern) == expected


def test_unknown_topics_are_counted_and_never_guessed():
    sources = TopicReader({"house/+": json_field("t", "garden", "in", plant=hg.files.Level(1))}, NETWORK)
    assert sources.read("house/garden", {"t": 1}, "m") and not sources.read("home/garden", {"t": 1}, "m")
    assert sources.read("home/garden", "no message", "m") == [] and dict(+sources.unknown) == {"home/garden": 2}


def test_a_topic_feeds_several_nodes():
    table = {"t": [json_field("a", "garden", "in"), json_field("h", "inputs", "heating")]}
    readings = TopicReader(table, NETWORK).read("t", {"a": 1, "h": 2}, "m")
    assert [reading.node for reading in readings] == ["garden", "inputs"]


def test_steps_are_times_of_networks_that_count_steps():
    assert read(json_field("v", "garden", time="k", time_unit="step"), {"v": 1, "k": 3}, COUNTING).time == 3
    with pytest.raises(ValueError, match=r"'t', time: expected the seconds of a step .* got 'k' in s"):
        TopicReader({"t": json_field("v", "garden", time="k")}, COUNTING)
    with pytest.raises(ValueError, match="expected a time that is no step"):
        TopicReader({"t": json_field("v", "garden", "in", time="k", time_unit="step")}, NETWORK)


@pytest.mark.parametrize(
    ("source", "message", "line"),
    [
        ({"path": "tmp"}, {"temp": 1, "b": 2}, "t: expected a field 'tmp', got no 'tmp' in temp, b"),
        ({"path": "v.x"}, {"v": 1}, "t: expected a field 'v.x', got no 'x' in 1"),
        ({"path": "v.2"}, {"v": [1, 2]}, "t: expected a field 'v.2', got no '2' in a list of 2"),
        ({"path": "v"}, {"v": "hot"}, "t, field 'v': expected a number, true or false, or null .* got 'hot'"),
        ({"path": "v"}, {"v": {"x": 1}}, "t, field 'v': expected a number, .* got {'x': 1}"),
        ({"path": "v", "sequence": "n"}, {"v": 1, "n": -1}, "t, field 'n': expected a whole number .* got -1"),
        ({"path": "v", "time": "at"}, {"v": 1, "at": "soon"}, "t, field 'at': expected a date .* got 'soon'"),
        ({"path": "v", "plant": "id"}, {"v": 1, "id": 3.5}, "t, field 'id': expected a name, got 3.5"),
    ],
)
def test_a_message_that_cannot_be_read_is_one_line(source, message, line):
    with pytest.raises(ValueError, match=line):
        read(json_field(node="garden", output="in", **source), message)


@pytest.mark.parametrize(
    ("table", "line"),
    [
        ([], r"sources: expected a dictionary of topics, .* got \[\]"),
        ({3: json_field("v", "garden", "in")}, "sources: expected topics that are text, got 3"),
        ({"t": "temp"}, "'t': expected json_field, or a list of them, got 'temp'"),
        ({"t": json_field("v", "gardn", "in")}, r"'t', node: expected one of .* got 'gardn' \(closest: 'garden'\)"),
        ({"t": json_field("v", "garden", "inn")}, r"'t', output: expected one of in, out, got 'inn' \(closest: 'in'\)"),
        ({"t": json_field("v", "garden")}, "'t', path: expected 2 paths, for in, out, or output=, got 1"),
    ],
)
def test_a_table_that_does_not_fit_is_one_line(table, line):
    with pytest.raises(ValueError, match=line):
        TopicReader(table, NETWORK)


@pytest.mark.parametrize(
    "arguments",
    [
        {"path": ()},
        {"path": 3},
        {"path": "v", "output": ("a", "b")},
        {"path": "v", "time_unit": "minutes"},
        {"path": "v", "scale": np.nan},
        {"path": ("v", "w"), "offset": (1.0, 2.0, 3.0)},
        {"path": "v", "node": 3},
        {"path": "v", "time": 3},
    ],
)
def test_bad_input_is_one_line(arguments):
    with pytest.raises(ValueError, match=r"^json_field, .*: expected"):
        json_field(**({"node": "garden"} | arguments))


TWO = hg.Network(PLANT, {"north": NETWORK.nodes["garden"], "south": NETWORK.nodes["garden"]})


def test_plant_and_node_come_from_a_topic_or_a_field():
    table = {
        "ranging/+": json_field("r", hg.files.Field("anchor_id", {"17": "north"}), "in", plant=hg.files.Level(1)),
        "+/south/t": json_field("t", hg.files.Level(-2), "out", plant="device"),
    }
    sources = TopicReader(table, TWO)
    (reading,) = sources.read("ranging/tag7", {"r": 2.0, "anchor_id": 17}, "m")
    assert (reading.plant, reading.node, reading.values[0]) == ("tag7", "north", 2.0)
    (reading,) = sources.read("house/south/t", {"t": 3.0, "device": 5}, "m")
    assert (reading.plant, reading.node, reading.values[1]) == ("5", "south", 3.0)
    with pytest.raises(ValueError, match="m, node: expected one of north, south, got '3'"):
        only(sources.read("ranging/tag7", {"r": 2.0, "anchor_id": 3}, "m"))


def test_a_wildcard_that_would_merge_sensors_is_refused():
    """What the line names mends it."""
    with pytest.raises(ValueError, match=r"'zigbee2mqtt/\+', plant: expected plant=hg.files.Level\(1\)"):
        TopicReader({"zigbee2mqtt/+": json_field("t", "garden", "in")}, NETWORK)
    sources = TopicReader({"zigbee2mqtt/+": json_field("t", "garden", "in", plant=hg.files.Level(1))}, NETWORK)
    assert [sources.read(f"zigbee2mqtt/{name}", {"t": 1}, "m")[0].plant for name in "ab"] == ["a", "b"]
    assert TopicReader({"zigbee2mqtt/+": json_field("t", hg.files.Level(1), "in")}, TWO).of("zigbee2mqtt/north")


@pytest.mark.parametrize(
    ("where", "used"),
    [
        ({"fix": 3}, [False, True]),
        ({"fix": range(1, 6)}, [True, True]),
        ({"fix": {3, 4}, "ok": True}, [False, True]),
    ],
)
def test_a_condition_leaves_messages_out_and_counts_them(where, used):
    sources = TopicReader({"t": json_field("v", "garden", "in", where=where)}, NETWORK)
    read = [bool(sources.read("t", {"v": 1, "fix": fix, "ok": fix > 2}, "m")) for fix in (1, 3)]
    assert read == used and sources.excluded["t"] == used.count(False)


def test_a_message_with_a_count_and_without_a_value_measured_nothing():
    sources = TopicReader({"t": json_field("v", "garden", "in", time="at", sequence="n")}, NETWORK)
    readings = [sources.read("t", {"at": 1, **rest}, "m")[0] for rest in ({"n": 4}, {"v": 2.0}, {"n": 5, "v": 3.0})]
    assert [r.sequence for r in readings] == [4, 0, 5] and not sources.describe_absent_field()
    np.testing.assert_array_equal([r.values[0] for r in readings], [np.nan, 2.0, 3.0])
    # Where no message has it, it is misspelt.
    sources = TopicReader({"t": json_field("w", "garden", "in", time="at", sequence="n")}, NETWORK)
    sources.read("t", {"at": 1, "n": 1, "v": 2}, "m")
    assert "expected a field 'w', got no 'w' in at, n, v" in sources.describe_absent_field()
    with pytest.raises(ValueError, match="expected a field 'v'"):
        read(json_field("v", "garden", "in", sequence="n"), {"at": 1})


@pytest.mark.parametrize("angle", [-3.0, -0.4, 0.0, 2.5])
def test_the_heading_of_a_quaternion(angle):
    """Of any length; with a pitch of 0.3 it is still the turn about the vertical."""
    z = np.array([0, 0, np.sin(angle / 2), np.cos(angle / 2)])
    y = np.array([0, np.sin(0.15), 0, np.cos(0.15)])
    x1, y1, z1, w1 = z
    x2, y2, z2, w2 = y
    turned = [w1 * x2 + x1 * w2 + y1 * z2 - z1 * y2, w1 * y2 - x1 * z2 + y1 * w2 + z1 * x2,
              w1 * z2 + x1 * y2 - y1 * x2 + z1 * w2, w1 * w2 - x1 * x2 - y1 * y2 - z1 * z2]  # fmt: skip
    message = dict(zip("xyzw", (2 * np.array(turned)).tolist(), strict=True))
    reading = read(json_field(hg.files.Yaw("q"), "garden", "in"), {"q": message})
    np.testing.assert_allclose(reading.values[0], angle, rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("up", [1, -1])
@pytest.mark.parametrize("precision", [np.float32, np.float64])
def test_a_body_that_points_straight_up_or_down_has_no_heading(up, precision):
    """Before, what was left by rounding was read: 0, or half a turn."""
    half = float(precision(np.sqrt(0.5)))
    heading = hg.files.Yaw("q").of(0.0, up * half, 0.0, half)
    assert np.isnan(heading)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ('{"v": nan, "w": "nan", "x": [-inf, 1.#QNAN]}', {"v": None, "w": "nan", "x": [None, None]}),
        ('{"v": -nan(ind), "w": Infinity}', {"v": None, "w": None}),
        ('{"w": "say \\"nan\\" ", "v": NAN}', {"w": 'say "nan" ', "v": None}),
    ],
)
def test_bare_words_for_no_number_cost_their_field_alone(text, expected):
    assert decode_json(text, "m") == expected


@pytest.mark.parametrize("text", ['{"v": 1, "v": 2}', '{"a": {"v": nan, "v": 2}}'])
def test_a_doubled_field_is_refused(text):
    with pytest.raises(ValueError, match="m: expected distinct fields, got 'v' more than once"):
        decode_json(text, "m")


def test_a_message_that_says_it_is_not_valid_is_refused_and_not_lost():
    """By a flag, by a checksum's result, by a word of its own; its count is read, so that it counts as none lost."""
    source = json_field("v", "garden", "in", sequence=hg.files.Count("n", bits=4), valid="crc_ok")
    sources = TopicReader({"t": source}, NETWORK)
    for flag, number in ((True, 14), (1, 15), (False, 0), ("yes", 1), (True, 2)):
        (item,) = sources.read("t", {"v": 1.5, "n": number, "crc_ok": flag}, "m")
        if isinstance(item, Unread):
            assert item.counted.sequence == number and "m, field 'crc_ok': expected true or 1, of a mess" in str(
                item.error
            )
        else:
            assert flag in (True, 1) and item.values[0] == 1.5
    worded = json_field("v", "garden", "in", valid={"state": ["ok", "warm"], "age": range(5)})
    assert read(worded, {"v": 1, "state": "warm", "age": 4}).values[0] == 1
    with pytest.raises(
        ValueError, match=r"t, field 'state': expected one of \['ok', 'warm'\], of a message that can be"
    ):
        read(worded, {"v": 1, "state": "hot", "age": 4})
    with pytest.raises(ValueError, match="json_field, valid: expected a dotted path, or a dictionary of paths"):
        json_field("v", "garden", valid=3)


@pytest.mark.parametrize("bits", [4, 8, 16])
def test_a_count_of_another_modulus_is_refused(bits):
    source = json_field("v", "garden", "in", sequence=hg.files.Count("n", bits=bits))
    assert read(source, {"v": 1, "n": 2**bits - 1}).sequence == 2**bits - 1
    expected = f"t, field 'n': expected a count below {2**bits}, got {2**bits}: of another modulus than bits={bits}"
    with pytest.raises(ValueError, match=expected):
        read(source, {"v": 1, "n": 2**bits})


@pytest.mark.parametrize(("bits", "said"), [(4, []), (8, ["after 15, not after 255: bits=4"])])
def test_a_count_that_begins_again_too_soon_or_stands_still_is_doubted(tmp_path, bits, said):
    """Of 64 messages of a 4-bit count two are lost and five repeated; read as one of 8 bits it is said what it is."""
    lines, counts = [], [k % 16 for k in range(64) if k not in (20, 21)]
    counts[40:45] = [counts[40]] * 5
    for k, number in enumerate(counts):
        content = {"time": 1_790_000_000 + k, "v": 0.1 * k, "n": number}
        lines.append(json.dumps({"topic": "t", "payload": content, "tst": 1_790_000_000 + k}))
    (tmp_path / "log.jsonl").write_text("\n".join(lines))
    sources = {"t": json_field("v", "garden", "in", time="time", sequence=hg.files.Count("n", bits=bits))}
    events = hg.files.read_messages(tmp_path / "log.jsonl", NETWORK, sources)
    notes = [note for note in events.notes if "count" in note]
    assert len(notes) == 1 + len(said) and all(word in notes[0] for word in said)
    assert "the count of 4 messages is that of the one before: repeated" in notes[-1]
