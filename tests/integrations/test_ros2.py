"""The node of ROS 2, by a stand-in of the parts of rclpy that it calls: there is no ROS here, and no robot."""

import importlib
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

ROOT = Path(__file__).parents[2] / "integrations" / "ros2"
NETWORK = """
import numpy as np
import heliograph as hg

plant = hg.Plant(lambda x, u: x + u[0] * x[1] * np.array([1.0, 0.0]), lambda u: u[0] * np.diag([0.01, 0.1]),
                 [0.0, 1.0], np.eye(2), states=["x", "vx"], inputs=["dt"])
sensor = hg.LinearSensor([[1.0, 0.0]], 0.01, outputs=["position"])
filters = {"aware": hg.extended_filter(plant, sensor, hg.perfect())}
network = hg.Network(plant, {"beacon": hg.Node(sensor, hg.perfect(), filters)})
sources = {"/range": hg.files.json_field("range", node="beacon", time="header.stamp", sequence="count"),
           "/never": hg.files.json_field("range", node="beacon", time="header.stamp", sequence="count")}
pose = hg.files.Pose(x="x", vx="vx", frame="odom", child="mower")
"""


class Anything(SimpleNamespace):
    """A message: parts come into being when they are first named, as those of a message type are there."""

    def __getattr__(self, name):
        if name.startswith("__"):
            raise AttributeError(name)
        setattr(self, name, made := Anything())
        return made


class StandIn:
    """rclpy.node.Node: parameters, topics, publishers, timers; what is published is kept."""

    parameters, topics = {}, []

    def __init__(self, name):
        self.name, self.published, self.subscribed, self.timers = name, {}, {}, []

    def declare_parameter(self, name, default):
        return SimpleNamespace(value=self.parameters.get(name, default))

    def get_topic_names_and_types(self):
        return self.topics

    def create_publisher(self, kind, topic, depth):
        kept = self.published.setdefault(topic, [])
        return SimpleNamespace(publish=kept.append)

    def create_subscription(self, kind, topic, callback, depth):
        self.subscribed[topic] = kind, callback

    def create_timer(self, seconds, callback):
        self.timers.append((seconds, callback))

    def get_clock(self):
        return SimpleNamespace(now=lambda: SimpleNamespace(to_msg=lambda: Anything(sec=0, nanosec=0)))


class Status(Anything):
    """diagnostic_msgs/DiagnosticStatus."""

    OK, WARN = b"\0", b"\1"


class Broadcaster:
    """tf2_ros.TransformBroadcaster."""

    def __init__(self, node):
        self.sendTransform = node.published.setdefault("/tf", []).append


@pytest.fixture
def make(tmp_path, monkeypatch):
    """Makes the node of a network's file, in a world with these topics."""
    parts = {
        "rclpy": {},
        "rclpy.node": {"Node": StandIn},
        "diagnostic_msgs.msg": {"DiagnosticArray": Anything, "DiagnosticStatus": Status, "KeyValue": Anything},
        "geometry_msgs.msg": {"TransformStamped": Anything},
        "nav_msgs.msg": {"Odometry": Anything},
        "rosidl_runtime_py.convert": {"message_to_ordereddict": dict},
        "rosidl_runtime_py.utilities": {"get_message": lambda name: f"type {name}"},
        "tf2_ros": {"TransformBroadcaster": Broadcaster},
    }
    for name, content in parts.items():
        for part in (name.partition(".")[0], name):
            if part not in sys.modules:
                monkeypatch.setitem(sys.modules, part, ModuleType(part))
        for key, value in content.items():
            setattr(sys.modules[name], key, value)
    monkeypatch.syspath_prepend(ROOT)
    (tmp_path / "net.py").write_text(NETWORK)
    module = importlib.import_module("heliograph_ros.node")

    def make(topics=(("/range", ["pkg/msg/Range"]),), **parameters):
        monkeypatch.setattr(StandIn, "topics", list(topics))
        monkeypatch.setattr(StandIn, "parameters", {"network": str(tmp_path / "net.py"), **parameters})
        return module.Estimator()

    yield make
    sys.modules.pop("heliograph_ros.node", None)


def sent(count, position, second=None):
    """A message as rosidl's conversion gives it."""
    stamp = {"sec": 1_790_000_000 + (count if second is None else second), "nanosec": 500_000_000}
    return {"header": {"stamp": stamp, "frame_id": "x"}, "range": position, "count": count}


@pytest.mark.slow
def test_topics_become_odometry_transform_and_diagnostics(make, monkeypatch):
    clock = SimpleNamespace(now=lambda zone: __import__("datetime").datetime.fromtimestamp(1_790_000_010, zone))
    node = make()
    monkeypatch.setattr("heliograph_ros.node.datetime", SimpleNamespace(
        now=clock.now, fromisoformat=__import__("datetime").datetime.fromisoformat))  # fmt: skip
    kind, take = node.subscribed["/range"]
    assert kind == "type pkg/msg/Range"
    for k in range(4):
        take(sent(k, 1.0 * k))
    last, transform = node.published["~/odometry"][-1], node.published["/tf"][-1]
    assert (last.header.frame_id, last.child_frame_id) == ("odom", "mower")
    assert (last.header.stamp.sec, last.header.stamp.nanosec) == (1_790_000_003, 500_000_000)
    assert abs(last.pose.pose.position.x - 3) < 0.3 and abs(last.twist.twist.linear.x - 1) < 0.3
    bound = np.reshape(last.pose.covariance, (6, 6))
    assert 0 < bound[0, 0] < 0.01 and not bound[1:].any()  # below the sensor's variance
    assert last.pose.pose.orientation.w == 1.0
    assert transform.transform.translation.x == last.pose.pose.position.x
    assert (transform.header.frame_id, transform.child_frame_id) == ("odom", "mower")
    # A clock that is wrong, and a topic that nobody publishes, are said each second.
    take(sent(9, 3.0, second=4000))
    ((seconds, look),) = node.timers
    look()
    status = node.published["/diagnostics"][-1].status[0]
    assert seconds == 1.0 and status.level == Status.WARN and status.hardware_id == "beacon/aware"
    assert "no topic /never" in status.message and "beacon: future" in status.message
    assert {value.key: value.value for value in status.values} == {"messages": "5", "refused": "1"}


def test_a_filter_that_there_is_not_is_one_line(make):
    with pytest.raises(ValueError, match="filter: expected one of beacon/aware, got 'beacon/none'"):
        make(filter="beacon/none")


def test_what_colcon_reads_is_there():
    assert (ROOT / "resource" / "heliograph_ros").is_file()
    assert "<name>heliograph_ros</name>" in (ROOT / "package.xml").read_text()
    assert "estimator = heliograph_ros.node:main" in (ROOT / "setup.py").read_text()
