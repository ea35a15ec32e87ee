"""Covariances and reception that messages declare, as numbers that are told: of bags, of JSON, of LoRaWAN uplinks."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as hg
from heliograph.files import Covariance, json_field
from heliograph.files.sources import TopicReader, Unread
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
    (reading,) = TopicReader({"t": source}, network).read("t", message, "t")
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
    # On a plane: longitudes and latitudes of up to 38 degrees, the covariance that of the axes there.
    on_plane = {"/fix": replace(GEODETIC, time=hg.files.Stamp("header.stamp"))}
    events = list(hg.files.read_messages(str(bag), NETWORK, on_plane).sort_events())
    np.testing.assert_array_equal(
        [event.values[:2] for event in events], [PLANE.to_plane(1.0 * k, 2.0 * k, 0.0)[:2] for k in range(20)]
    )
    turned = PLANE.turn_covariance(19.0, 38.0, 20 * np.reshape(MATRIX, (3, 3)))
    np.testing.assert_allclose(events[19].values[2:], turned[[0, 0, 1], [0, 1, 1]], rtol=1e-13)


PLANE = hg.models.LocalPlane(52.5, 13.4, 34.0)
POSITION = hg.files.Geodetic(PLANE)
GEODETIC = json_field(
    [POSITION.east, POSITION.north, *(POSITION.covariance(i, j) for i, j in ((0, 0), (0, 1), (1, 1)))], "gps"
)


def at_place(latitude, longitude, covariance=MATRIX, kind=2):
    return fix(covariance, kind) | {"latitude": latitude, "longitude": longitude, "altitude": 50.0}


def test_a_fix_in_degrees_is_on_the_plane():
    """Its covariance, declared in the axes of the fix, is turned into those of the plane."""
    values = read(GEODETIC, at_place(53.1, 14.9))
    np.testing.assert_array_equal(values[:2], PLANE.to_plane(53.1, 14.9, 50.0)[:2])
    turned = PLANE.turn_covariance(53.1, 14.9, np.reshape(MATRIX, (3, 3)))
    np.testing.assert_allclose(values[2:], turned[[0, 0, 1], [0, 1, 1]], rtol=1e-14)
    assert np.isnan(read(GEODETIC, at_place(None, 14.9))).all()
    assert np.isnan(read(GEODETIC, at_place(53.1, 14.9, kind=0))).tolist() == [False, False, True, True, True]


def test_whole_numbers_of_degrees_and_millimetres():
    small = hg.files.Geodetic(PLANE, "lat", "lon", "alt", degrees=1e-7, metres=1e-3)
    names = ["east", "north"]
    network = hg.Network(PLANT, {"gps": hg.Node(SENSOR, hg.perfect(2), {})})
    message = {"lat": 525100000, "lon": 134100000, "alt": 50000}
    values = read(json_field([small.east, small.north], "gps", names), message, network)
    np.testing.assert_allclose(values, PLANE.to_plane(52.51, 13.41, 50.0)[:2], rtol=1e-13)
    flat = hg.files.Geodetic(PLANE, "lat", "lon", None, degrees=1e-7)
    values = read(json_field([flat.east, flat.up], "gps", names), message, network)
    np.testing.assert_allclose(values, PLANE.to_plane(52.51, 13.41, 34.0)[[0, 2]], rtol=1e-12)


def test_what_is_no_latitude_is_refused_alone():
    with pytest.raises(ValueError, match=r"latitude of points: expected -90 to 90 degrees .* got 134"):
        read(GEODETIC, at_place(134.0, 52.5))
    with pytest.raises(ValueError, match="Geodetic, covariance: expected a row and a column from 0 to 2"):
        POSITION.covariance(0, 3)
    with pytest.raises(ValueError, match=r"Geodetic, plane: expected a hg.models.LocalPlane"):
        hg.files.Geodetic([52.5, 13.4])


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
