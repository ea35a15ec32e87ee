"""Messages decoded many at once against the same messages decoded one by one."""

import re

import numpy as np
import pytest

pytest.importorskip("rosbags")
from rosbags.interfaces import Nodetype

import heliograph as hg
from heliograph.files.bags.batch_decoder import BatchDecoder
from tests.files import bags

KINDS = bags.STORE.types
PLANT = hg.Plant(lambda x, u: x, 0.1, [0.0], 1.0, inputs=["wind", "dt"])
NODES = {name: hg.Node(hg.Sensor(lambda x: x[np.zeros(3, dtype=int)], np.eye(3)), hg.perfect(3), {}) for name in "ab"}
NETWORK = hg.Network(PLANT, NODES)
SCAN, IMU, BATTERY = "sensor_msgs/msg/LaserScan", "sensor_msgs/msg/Imu", "sensor_msgs/msg/BatteryState"


def header(at, chance):
    """A stamp, and a frame whose length moves all that follows."""
    stamp = KINDS["builtin_interfaces/msg/Time"](at // 10**9, at % 10**9)
    return KINDS["std_msgs/msg/Header"](stamp, "map"[: chance.integers(4)])


def messages(count, chance):
    """Messages of three types with texts, lists and numbers of all sizes, some not finite, and their log times."""
    results = []
    for k in range(count):
        at = bags.START + k * 10**7
        late = at + int(chance.integers(10**9))
        numbers = chance.standard_normal(20).astype(np.float32)
        numbers[chance.integers(20)] = np.nan
        three, kind = chance.standard_normal(3), chance.integers(3)
        vector = KINDS["geometry_msgs/msg/Vector3"](*map(float, three))
        if kind == 0:
            ranges = numbers[: chance.integers(4, 20)]
            results.append(
                (late, "/scan", SCAN, KINDS[SCAN](header(at, chance), *three, *three, 0.5, ranges, ranges[:3]))
            )
        elif kind == 1:
            turn, nine = KINDS["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0), chance.standard_normal(9)
            results.append((late, "/imu", IMU, KINDS[IMU](header(at, chance), turn, nine, vector, nine, vector, nine)))
        else:
            plain = (1, 2, 3, bool(k % 2), numbers[:3], numbers[:2], "wall", "12345")
            results.append(
                (late, "/battery", BATTERY, KINDS[BATTERY](header(at, chance), *map(float, numbers[:7]), *plain))
            )
    return sorted(results, key=lambda item: item[0])


SOURCES = {
    "/scan": hg.files.json_field(["ranges.3", "angle_max", "range_max"], "a", scale=2.0, offset=[0, 1, 2]),
    "/imu": [
        hg.files.json_field(
            ["orientation_covariance.4", "angular_velocity.x", "linear_acceleration.z"], "a", time="header.stamp"
        ),
        hg.files.json_field("linear_acceleration.y", "inputs", "wind"),
    ],
    "/battery": hg.files.json_field(
        ["cell_voltage.1", "present", "power_supply_health"], "b", time="header.stamp", sequence="power_supply_status"
    ),
}


def compared(table, other):
    assert (table.notes, table.broken, table.reasons) == (other.notes, other.broken, other.reasons)
    for node, columns in table.columns.items():
        expected = other.columns[node]
        assert [columns.time, columns.arrival, columns.sequence] == [expected.time, expected.arrival, expected.sequence]
        np.testing.assert_array_equal(columns.value_matrix(), expected.value_matrix())  # bit for bit, NaN where NaN


def test_many_at_once_are_bit_for_bit_those_one_by_one(tmp_path, monkeypatch):
    path = bags.write(tmp_path / "bag", messages(3000, np.random.default_rng(0)))
    used, whole = [], BatchDecoder.append_events

    def counted(decoder, batch, table):
        used.append(whole(decoder, batch, table))
        return used[-1]

    monkeypatch.setattr(BatchDecoder, "append_events", counted)
    monkeypatch.setattr("heliograph.files.bags.ros_bag.OFTEN", 400)
    table = hg.files.read_messages(path, NETWORK, SOURCES)
    assert len(table) > 3000 and used == [True] * 8
    monkeypatch.setattr(BatchDecoder, "append_events", lambda decoder, batch, table: False)
    compared(table, hg.files.read_messages(path, NETWORK, SOURCES))


@pytest.mark.parametrize("place", [0, 700])
def test_one_that_cannot_be_read_is_refused_alone_as_one_by_one(tmp_path, monkeypatch, place):
    """A stamp that nobody set, in a batch of others, which all are used."""
    some = messages(800, np.random.default_rng(1))
    unset = KINDS["std_msgs/msg/Header"](KINDS["builtin_interfaces/msg/Time"](0, 0), "")
    at = next(i for i in range(place, 800) if some[i][1] == "/imu")
    good = bags.write(tmp_path / "good", some)
    some[at][3].header = unset
    path = bags.write(tmp_path / "bag", some)
    table = hg.files.read_messages(path, NETWORK, SOURCES)
    assert table.refused == 1 and not table.broken
    assert f"message {at + 1}, logged at" in table.reasons[0] and "a time that was set" in table.reasons[0]
    assert len(table) == len(hg.files.read_messages(good, NETWORK, SOURCES)) - 1  # of two sources that with a stamp
    monkeypatch.setattr(BatchDecoder, "append_events", lambda decoder, batch, table: False)
    compared(table, hg.files.read_messages(path, NETWORK, SOURCES))


def test_a_list_that_is_too_short_is_one_line(tmp_path):
    path = bags.write(tmp_path / "bag", messages(300, np.random.default_rng(2)))
    sources = {"/scan": hg.files.json_field(["ranges.12", "angle_max", "range_max"], "a")}
    line = r"message 1, logged at .*, /scan: expected a field 'ranges.12', got no '12'"
    with pytest.raises(ValueError, match=line):
        hg.files.read_messages(path, NETWORK, sources, strict=True)
    table = hg.files.read_messages(path, NETWORK, sources)
    assert len(table) > 0 and table.refused > 0 and re.search(line, table.reasons[0])


def test_definitions_say_what_layouts_expect():
    """Kinds of fields of rosbags, which a layout goes by."""
    assert {kind.name for kind in Nodetype} == {"BASE", "NAME", "ARRAY", "SEQUENCE"}
