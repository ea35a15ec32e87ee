"""The node: topics in by a network's sources; odometry, transform and diagnostics out."""

import json
from collections import Counter, deque
from datetime import UTC, datetime

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import TransformStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rosidl_runtime_py.convert import message_to_ordereddict
from rosidl_runtime_py.utilities import get_message
from tf2_ros import TransformBroadcaster

from heliograph.files import Pose
from heliograph.files.network_file import load_module
from heliograph.serving import Fleet, InMemoryStore, NetworkProgram, Options, Service, Translator

AXES = ("x", "y", "z", "roll", "pitch", "yaw")


class Estimator(Node):
    """Runs the filters of a network; see README for its parameters and topics."""

    def __init__(self) -> None:
        super().__init__("heliograph")
        declare = self.declare_parameter
        path, chosen, window = (declare(n, v).value for n, v in [("network", ""), ("filter", ""), ("window", 10.0)])
        network, module = load_module(path)
        self.translator = Translator(module.get("sources"), network)
        options = Options(window)._replace(step=self.translator.sources.step_seconds)
        self.service = Service(Fleet(NetworkProgram(network), options), InMemoryStore())
        names = [f"{node}/{name}" for node, item in network.nodes.items() for name in item.filters]
        self.node, _, self.filter = (chosen or names[0]).partition("/")
        if f"{self.node}/{self.filter}" not in names:
            raise ValueError(f"filter: expected one of {', '.join(names)}, got {chosen!r}")
        named = {axis: axis for axis in (*AXES, *(f"v{axis}" for axis in AXES)) if axis in network.states}
        self.pose = module.get("pose") or Pose(**named)
        self.places = self.pose.places(tuple(network.states))
        self.waiting, self.counts, self.reasons = set(self.translator.sources.topics), Counter(), deque(maxlen=3)
        self.odometry = self.create_publisher(Odometry, "~/odometry", 10)
        self.diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self.transforms = TransformBroadcaster(self)
        self.create_timer(1.0, self.look)
        self.look()

    def look(self) -> None:
        """Subscribe to topics that have a type by now, let silence pass, and say how it goes."""
        for topic, types in self.get_topic_names_and_types():
            if topic in self.waiting:
                self.waiting.remove(topic)
                self.create_subscription(get_message(types[0]), topic, lambda m, t=topic: self.take(t, m), 50)
        self.publish(self.service.take([]))
        status = DiagnosticStatus(name="heliograph", hardware_id=f"{self.node}/{self.filter}")
        status.level = DiagnosticStatus.WARN if self.counts["refused"] or self.waiting else DiagnosticStatus.OK
        silent = [f"no topic {topic}" for topic in sorted(self.waiting)]
        status.message = "; ".join([*silent, *self.reasons]) or "every message is used"
        status.values = [KeyValue(key=key, value=str(count)) for key, count in sorted(self.counts.items())]
        message = DiagnosticArray(status=[status])
        message.header.stamp = self.get_clock().now().to_msg()
        self.diagnostics.publish(message)

    def take(self, topic: str, message: object) -> None:
        """Let the filters have a message, and publish what came of it."""
        self.counts["messages"] += 1
        payload = json.dumps(message_to_ordereddict(message)).encode()
        self.publish(self.service.take(self.translator.read(topic, payload, datetime.now(UTC))))

    def publish(self, outputs: list) -> None:
        """Publish the newest estimate; keep the reasons of what was refused."""
        bodies = [(output.kind, json.loads(output.body)) for output in outputs]
        refused = [body for kind, body in bodies if kind == "refused"]
        self.counts["refused"] += len(refused)
        self.reasons.extend(f"{body['node']}: {body['reason']}, {body['detail']}" for body in refused)
        newest = [body for kind, body in bodies if kind == "provisional"][-1:]
        for estimate in (body["estimates"][self.node][self.filter] for body in newest):
            if None not in estimate["mean"]:
                self.send(datetime.fromisoformat(newest[0]["time"]), estimate)

    def send(self, moment: datetime, estimate: dict) -> None:
        """Send odometry and transform of an estimate."""
        message, transform = Odometry(), TransformStamped()
        message.header.stamp.sec, message.header.stamp.nanosec = int(moment.timestamp()), moment.microsecond * 1000
        message.header.frame_id, message.child_frame_id = self.pose.frame, self.pose.child
        where, message.pose.covariance = self.select(estimate, self.places[0])
        moving, message.twist.covariance = self.select(estimate, self.places[1])
        there, rotation = message.pose.pose.position, message.pose.pose.orientation
        there.x, there.y, there.z = where[:3]
        rotation.x, rotation.y, rotation.z, rotation.w = quaternion(*where[3:])
        for part, numbers in ((message.twist.twist.linear, moving[:3]), (message.twist.twist.angular, moving[3:])):
            part.x, part.y, part.z = numbers
        self.odometry.publish(message)
        transform.header, transform.child_frame_id = message.header, message.child_frame_id
        moved = transform.transform.translation
        (moved.x, moved.y, moved.z), transform.transform.rotation = where[:3], rotation
        self.transforms.sendTransform(transform)

    def select(self, estimate: dict, places: list) -> tuple[list[float], list[float]]:
        """Return the six numbers of pose or twist, and their covariance, row by row; -1 first where none is claimed."""
        numbers = [0.0 if place is None else float(estimate["mean"][place]) for place in places]
        bound = np.zeros((6, 6))
        known = [(axis, place) for axis, place in enumerate(places) if place is not None]
        if estimate["covariance"] is None:
            bound[0, 0] = -1.0
        elif known:
            axes, states = np.array(known).T
            bound[np.ix_(axes, axes)] = np.array(estimate["covariance"], dtype=float)[np.ix_(states, states)]
        return numbers, bound.ravel().tolist()


def quaternion(roll: float, pitch: float, yaw: float) -> tuple[float, float, float, float]:
    """Return x, y, z, w of the rotation by yaw about z, then pitch about the new y, then roll about the new x."""
    (sr, sp, sy), (cr, cp, cy) = (f(np.array([roll, pitch, yaw]) / 2).tolist() for f in (np.sin, np.cos))
    x, y = sr * cp * cy - cr * sp * sy, cr * sp * cy + sr * cp * sy
    return x, y, cr * cp * sy - sr * sp * cy, cr * cp * cy + sr * sp * sy


def main() -> None:
    """Run the node until it is stopped."""
    rclpy.init()
    rclpy.spin(Estimator())
