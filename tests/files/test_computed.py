"""Covariances and reception that messages declare, as numbers that are told: of bags, of JSON, of LoRaWAN uplinks."""

import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as hg
from heliograph.files import Covariance, json_field
from heliograph.files.sources import Sources, Unread
from tests.files import bags

PLANT = hg.Plant(lambda x, u: x, 0.1 * np.eye(2), [0.0, 0.0], np.eye(2), states=["east", "north"], inputs=["dt"])
SENSOR = hg.Sensor(lambda x: x, np.zeros((2, 2)), outputs=["east", "north"])
NAMES = ["var_east", "cov", "var_north"]
LINK = hg.model.told(
    lambda a: hg.hop(1.0, jnp.array([[a[0], a[1]], [a[1], a[2]]])), NAMES, typical=np.array([1.0, 0.0, 1.0])
)
NODE = hg.Node(SENSOR, LINK, {"f": hg.extended_filter(PLANT, SENSOR, LINK)})
NETWORK = hg.Network(PLANT, {"gps": NODE})
KIND = "position_covariance_type"
ABOUT = [Covariance("position_covariance", row, column, kind=KIND) for row, column in ((0, 0), (0, 1), (1, 1))]
FIX = json_field(["longitude", "latitude", *ABOUT], "gps", scale=2.0, offset=1.0)
MATRIX = [4.0, 0.5, 0.1, 0.5, 9.0, 0.2, 0.1, 0.2, 25.0]  # rows east, north, up


def read(source, message, network=NETWORK):
    (reading,) = Sources({"t": source}, network).read("t", message, "t")
    if isinstance(reading, Unread):
        raise reading.error
    return reading.values


def fix(covariance, kind=2):
    return {"latitude": 1.0, "longitude": 2.0, "position_covariance": covariance, KIND: kind}


def test_entries_stand_after_the_values_unscaled():
    assert NODE.received_names == ("east", "north", *NAMES)
    assert read(FIX, fix(MATRIX)).tolist() == [5.0, 3.0, 4.0, 0.5, 9.0]


@pytest.mark.parametrize(
    ("covariance", "kind"),
    [([-1.0, *MATRIX[1:]], 2), ([0.0] * 9, 2), (MATRIX, 0), ([*MATRIX[:3], 0.7, *MATRIX[4:]], 2)],
)
def test_unknown_covariances_are_missing(covariance, kind):
    """First entry -1, nothing but zeros, kind 0; or an entry and its mirror image that differ, which spoils one."""
    values = read(FIX, fix(covariance, kind))
    assert values[:2].tolist() == [5.0, 3.0]
    unknown = np.isnan(values[2:]).tolist()
    assert unknown == ([False, True, False] if covariance[3] == 0.7 else [True] * 3)


def test_pose_and_twist_have_six_rows():
    entries = np.arange(36.0).reshape(6, 6)
    message = {"pose": {"covariance": (entries + entries.T).ravel().tolist(), "pose": {"x": 1.0, "y": 2.0}}}
    about = [Covariance("pose.covariance", row, column, size=6) for row, column in ((0, 0), (0, 5), (5, 5))]
    assert read(json_field(["pose.pose.x", "pose.pose.y", *about], "gps"), message).tolist() == [
        1.0, 2.0, 0.0, 35.0, 70.0,
    ]  # fmt: skip


def test_fixes_of_a_bag(tmp_path):
    """Decoded many at once: the same numbers as of one message."""
    kinds, name = bags.STORE.types, "sensor_msgs/msg/NavSatFix"
    messages = []
    for k in range(20):
        at = bags.START + k * 10**8
        stamp = kinds["builtin_interfaces/msg/Time"](at // 10**9, at % 10**9)
        status = kinds["sensor_msgs/msg/NavSatStatus"](0, 1)
        matrix = (1 + k) * np.array(MATRIX)
        header = kinds["std_msgs/msg/Header"](stamp, "map")
        messages.append(
            (at, "/fix", name, kinds[name](header, status, 1.0 * k, 2.0 * k, 0.0, matrix, 0 if k == 3 else 2))
        )
    bag = bags.write(tmp_path / "drive", messages)
    sources = {"/fix": json_field(["longitude", "latitude", *ABOUT], "gps", time="header.stamp")}
    events = list(hg.files.read_messages(str(bag), NETWORK, sources).sort_events())
    expected = [[2.0 * k, 1.0 * k, *(np.nan if k == 3 else (1 + k) * x for x in (4.0, 0.5, 9.0))] for k in range(20)]
    np.testing.assert_array_equal([event.values for event in events], expected)


@pytest.mark.parametrize(
    ("source", "message"),
    [
        (
            hg.files.the_things_stack(["e", "n"], "gps", radio=["rssi", "snr"]),
            {
                "end_device_ids": {"device_id": "soil"}, "received_at": "2026-09-27T10:00:00Z",
                "uplink_message": {"f_cnt": 3, "decoded_payload": {"e": 1.0, "n": 2.0}, "rx_metadata": [{"rssi": -97}]},
            },
        ),
        (
            hg.files.chirpstack(["e", "n"], "gps", radio=["rssi", "snr"]),
            {
                "deviceInfo": {"devEui": "soil"}, "time": "2026-09-27T10:00:00Z", "fCnt": 3,
                "object": {"e": 1.0, "n": 2.0}, "rxInfo": [{"rssi": -97}, {"rssi": -80, "snr": 7.0}],
            },
        ),
    ],
)  # fmt: skip
def test_reception_of_an_uplink(source, message):
    """A ratio of 0 dB is left out, as protobuf does."""
    link = hg.model.told(lambda a: hg.hop(1.0, 0.1 * np.eye(2)), ["rssi", "snr"], typical=[-90.0, 5.0])
    network = hg.Network(PLANT, {"gps": hg.Node(SENSOR, link, {})})
    ((_, single),) = source.items()
    assert read(single, message, network).tolist() == [1.0, 2.0, -97.0, 0.0]


def test_radio_has_two_numbers():
    with pytest.raises(ValueError, match="some of rssi, snr, got 'strength'"):
        hg.files.chirpstack("e", "gps", radio="strength")
    with pytest.raises(ValueError, match="fCnt"):
        uplink = hg.files.chirpstack("e", "gps", "east", radio="snr")["application/+/device/+/event/up"]
        message = {"deviceInfo": {"devEui": "a"}, "time": "2026-09-27T10:00:00Z", "fCnt": 1, "object": {"e": 1.0}}
        network = hg.Network(PLANT, {"gps": hg.Node(SENSOR, hg.model.told(
            lambda a: hg.hop(1.0, np.eye(2)), ["snr"], typical=[0.0]), {})})  # fmt: skip
        assert np.isnan(read(uplink, message, network)[2])
        read(uplink, message | {"fCnt": "1"}, network)
