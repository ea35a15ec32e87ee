"""What a message of ROS says of itself to be no value is none: no fix, no estimate, a range to be discarded."""

import numpy as np
import pytest

pytest.importorskip("rosbags")

import heliograph as hg
from tests.files import bags

KINDS = bags.STORE.types
PLANT = hg.LinearPlant(lambda u: np.eye(1), lambda u: u[0] * np.eye(1), [0.0], 1.0, inputs=["dt"])
NETWORK = hg.Network(PLANT, {"a": hg.Node(hg.LinearSensor([[1.0]], 1.0), hg.perfect(), {})})
COUNT, BAD = 20, (5, 6, 13)
FIX, IMU = "sensor_msgs/msg/NavSatFix", "sensor_msgs/msg/Imu"
RANGE, SCAN = "sensor_msgs/msg/Range", "sensor_msgs/msg/LaserScan"


def fix(header, k, is_bad):
    status = KINDS["sensor_msgs/msg/NavSatStatus"](-1 if is_bad else 0, 1)
    return KINDS[FIX](header, status, 0.0 if is_bad else 52.0 + k, 13.0, 0.0, np.zeros(9), 0)


def imu(header, k, is_bad):
    first = np.array([-1.0 if is_bad else 0.0, *np.zeros(8)])
    turn, vector = KINDS["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0), KINDS["geometry_msgs/msg/Vector3"]
    rate, pull = vector(0.0, 0.0, 0.0 if is_bad else 1.0 + k), vector(0.0, 0.0, 9.81)
    return KINDS[IMU](header, turn, np.zeros(9), rate, first, pull, np.zeros(9))


def distance(header, k, is_bad):
    given = [0, 0.1, 0.2, 4.0, (0.0 if k == BAD[0] else 4.5) if is_bad else 1.0 + k / 10]
    return KINDS[RANGE](header, *given, *[0.0] * (len(KINDS[RANGE].__dataclass_fields__) - 1 - len(given) - 1))


def scan(header, k, is_bad):
    ranges = np.array([1.0, 65.0 if is_bad else 2.0 + k / 10, 3.0], dtype=np.float32)
    return KINDS[SCAN](header, 0.0, 1.0, 0.5, 0.0, 0.1, 0.2, 30.0, ranges, np.zeros(0, dtype=np.float32))


@pytest.mark.parametrize("alone", [False, True])
@pytest.mark.parametrize(
    ("kind", "make", "path"),
    [(FIX, fix, "latitude"), (IMU, imu, "angular_velocity.z"), (RANGE, distance, "range"), (SCAN, scan, "ranges.1")],
)
def test_what_says_that_it_is_no_value_did_not_arrive(tmp_path, kind, make, path, alone):
    """Many messages at once, and each by itself, as where a condition chooses some: a latitude of 0 was used."""
    messages = []
    for k in range(COUNT):
        at = bags.START + k * 10**8
        header = KINDS["std_msgs/msg/Header"](KINDS["builtin_interfaces/msg/Time"](at // 10**9, at % 10**9), "map")
        messages.append((at, "/topic", kind, make(header, k, k in BAD)))
    bag = bags.write(tmp_path / "bag", messages)
    where = {"header.frame_id": ["map"]} if alone else None
    events = hg.files.read_messages(bag, NETWORK, {"/topic": hg.files.json_field(path, "a", where=where)})
    values = np.array([event.values[0] for event in events.sort_events()])
    assert np.flatnonzero(np.isnan(values)).tolist() == list(BAD)
    assert any("without a value (no fix, no estimate, out of range): /topic (3)" in note for note in events.notes)
    kept = hg.files.json_field(path, "a", where=where, valid={})  # of a driver that sets marks beside values
    events = hg.files.read_messages(bag, NETWORK, {"/topic": kept})
    assert np.isfinite([event.values[0] for event in events.sort_events()]).all() and "/topic" not in str(events.notes)
    other = {FIX: "status.service", IMU: "linear_acceleration.z", RANGE: "max_range", SCAN: "ranges.2"}[kind]
    kept = hg.files.read_messages(bag, NETWORK, {"/topic": hg.files.json_field(other, "a", where=where)})
    assert np.isfinite([event.values[0] for event in kept.sort_events()]).all() and "/topic" not in str(kept.notes)
