"""Bags that tests write: a vehicle on a line, its position with a header, its acceleration without, and a picture."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rosbags")
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

STORE = get_typestore(Stores.ROS2_JAZZY)
START = 1_700_000_000 * 10**9
ODOMETRY, ACCEL, PICTURE = "nav_msgs/msg/Odometry", "geometry_msgs/msg/Accel", "std_msgs/msg/UInt8MultiArray"

NETWORK = """
import jax.numpy as jnp
import heliograph as hg

def move(x, u):
    acceleration, dt = u
    return jnp.stack([x[0] + dt * x[1] + dt**2 / 2 * acceleration, x[1] + dt * acceleration])

def noise(u):
    dt = u[1]
    return 0.1 * jnp.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])

plant = hg.Plant(move, noise, [0.0, 1.0], [[1.0, 0.0], [0.0, 1.0]], states=["x", "vx"], inputs=["acceleration", "dt"])
sensor = hg.Sensor(lambda x: x[:1], noise=0.04, outputs=["position"])
node = hg.Node(sensor, hg.perfect(), {"filter": hg.cubature_filter(plant, sensor, hg.perfect())})
network = hg.Network(plant, {"gps": node})
sources = {
    "/odometry": hg.files.json_field("pose.pose.position.x", node="gps", output="position", time="header.stamp"),
    "/acceleration": hg.files.json_field("linear.x", node="inputs", output="acceleration"),
}
"""


class Drive:
    """Messages of a drive: times of measuring and logging in nanoseconds, positions, and accelerations."""

    def __init__(self, count: int = 200, seed: int = 0):
        chance = np.random.default_rng(seed)
        self.measured = START + np.arange(count) * 10**8
        self.logged = self.measured + (chance.exponential(0.15, count) * 1e9).astype(np.int64)
        time = np.arange(count) * 0.1
        self.truth = time + np.sin(time)
        self.position = self.truth + 0.2 * chance.standard_normal(count)
        self.set = START + np.arange(0, count, 10) * 10**8
        self.acceleration = -np.sin(np.arange(0, count, 10) * 0.1)

    def messages(self) -> list[tuple[int, str, str, Any]]:
        """Log time, topic, type and message, in order of logging."""
        results: list[tuple[int, str, str, Any]] = []
        for at, logged, x in zip(self.measured.tolist(), self.logged.tolist(), self.position.tolist(), strict=True):
            results.append((logged, "/odometry", ODOMETRY, odometry(at, x)))
        for at, a in zip(self.set.tolist(), self.acceleration.tolist(), strict=True):
            results.append((at, "/acceleration", ACCEL, acceleration(a)))
        kinds = STORE.types
        layout = kinds["std_msgs/msg/MultiArrayLayout"]([], 0)
        results += [
            (at, "/picture", PICTURE, kinds[PICTURE](layout, np.zeros(50, np.uint8))) for at in self.set.tolist()
        ]
        return sorted(results, key=lambda item: item[0])


def odometry(at: int, x: float) -> Any:
    kinds = STORE.types
    zero = kinds["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0)
    place = kinds["geometry_msgs/msg/Pose"](
        kinds["geometry_msgs/msg/Point"](x, 0.0, 0.0), kinds["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
    )
    twist = kinds["geometry_msgs/msg/Twist"](zero, zero)
    return kinds[ODOMETRY](
        kinds["std_msgs/msg/Header"](kinds["builtin_interfaces/msg/Time"](at // 10**9, at % 10**9), "map"),
        "base_link",
        kinds["geometry_msgs/msg/PoseWithCovariance"](place, np.zeros(36)),
        kinds["geometry_msgs/msg/TwistWithCovariance"](twist, np.zeros(36)),
    )


def acceleration(value: float) -> Any:
    vector = STORE.types["geometry_msgs/msg/Vector3"]
    return STORE.types[ACCEL](vector(value, 0.0, 0.0), vector(0.0, 0.0, 0.0))


def write(folder: Path, messages: list[tuple[int, str, str, Any]], plugin: Any = StoragePlugin.MCAP) -> Path:
    """A bag of messages, of which a topic may have several types; its file."""
    with Writer(folder, version=9, storage_plugin=plugin) as writer:
        pairs = dict.fromkeys((topic, kind) for _, topic, kind, _ in messages)
        connections = {pair: writer.add_connection(*pair, typestore=STORE) for pair in pairs}
        for logged, topic, kind, message in messages:
            writer.write(connections[topic, kind], logged, STORE.serialize_cdr(message, kind))
    return next(path for path in folder.iterdir() if path.suffix != ".yaml")
