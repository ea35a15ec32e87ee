"""Estimates as a bag: an odometry message with its covariance, and a number for each state, for a viewer of bags."""

import re
import shutil
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from typing_extensions import TypeAliasType

from heliograph.disk.atomic_files import check_writable, whole_file
from heliograph.model.estimate import Claim, mask_sound_estimates
from heliograph.numerics.check import fail, instance, text
from heliograph.numerics.module import readable
from heliograph.numerics.types import Float
from heliograph.simulation.results.record import Record

AXES = ("x", "y", "z", "roll", "pitch", "yaw")  # rows of the covariance of a pose, and of a twist
UNKNOWN = -1.0  # first entry of a covariance that is not known, as messages of ROS have it
ODOMETRY, NUMBER = "nav_msgs/msg/Odometry", "std_msgs/msg/Float64"

LATEST = 2**31 * 10**9  # nanoseconds since 1970 below which a stamp's seconds have 32 bits

State = TypeAliasType("State", str | None)  # name of a state of the plant; None if the plant has no such state


@readable
@dataclass(frozen=True)
class Pose:
    """States that are the pose and the twist of an odometry message, by name; an axis without a state stays at 0.

    A network's file names it `pose`; without it states called x, y, z, roll, pitch, yaw and vx, vy, vz, vroll, vpitch,
    vyaw are taken. Angles are in radians; velocities are those of the message, which are in the child's frame.

    Args:
        x, y, z: states of the position in metres.
        roll, pitch, yaw: states of the rotation.
        vx, vy, vz: states of the velocity.
        vroll, vpitch, vyaw: states of the rate of rotation.
        frame: name of the frame of the pose.
        child: name of the frame that moves.
    """

    x: State = None
    y: State = None
    z: State = None
    roll: State = None
    pitch: State = None
    yaw: State = None
    vx: State = None
    vy: State = None
    vz: State = None
    vroll: State = None
    vpitch: State = None
    vyaw: State = None
    frame: str = "map"
    child: str = "base_link"

    def __post_init__(self) -> None:
        """Raise ValueError unless each field, one an axis, is the name of a state or None."""
        for axis, state in vars(self).items():
            if state is not None:
                text(f"pose, {axis}", state)

    def places(self, states: tuple[str, ...]) -> tuple[list[int | None], list[int | None]]:
        """Return the index of each axis's state, or None, for the pose's six axes and for the twist's six.

        AXES names the axes of the pose: x, y, z and three angles. The twist's axes, velocities, have a "v" before
        these names.

        Raises:
            ValueError: an axis has an unknown state.
        """
        axes = (*AXES, *(f"v{axis}" for axis in AXES))
        state_of_axis: list[str | None] = [getattr(self, axis) for axis in axes]
        for state in state_of_axis:
            if state is not None and state not in states:
                raise fail("pose", f"names of the states {', '.join(states)}", repr(state))
        indices = [None if state is None else states.index(state) for state in state_of_axis]
        return indices[:6], indices[6:]


def find_pose_states(states: tuple[str, ...]) -> Pose:
    """Return the pose of the states that are named after axes."""
    axes = (*AXES, *(f"v{axis}" for axis in AXES))  # x, y, z, roll, pitch, yaw, and the same with v for velocities
    return Pose(**{axis: axis for axis in axes if axis in states})


def write_bag(record: Record, path: str | Path, origin: np.datetime64 | None = None, pose: Pose | None = None) -> None:
    """Write the estimates of a record to an MCAP file, as a whole or not at all.

    Topics are /NODE/FILTER/odometry if a state is on an axis of the pose, and a number for each state and deviation,
    /NODE/FILTER/STATE and /NODE/FILTER/STATE/sd; only rows with sound estimates. A covariance that nobody claims begins
    with -1, as messages of ROS say that it is unknown.

    Args:
        record: the result of `run`, or final estimates of events.
        path: the file, ending in .mcap.
        origin: date from which times are counted that are numbers; by default the beginning of 1970.
        pose: states that are pose and twist; by default those named after axes.

    Raises:
        ValueError: another ending, a folder that cannot be written, a pose of unknown states.
        ModuleNotFoundError: rosbags is not installed (extra "bags").
    """
    instance("record", record, Record, "a Record")
    path = Path(path)
    check_writable(path, (".mcap",))
    pose = find_pose_states(record.states) if pose is None else instance("pose", pose, Pose, "a Pose")
    pose.places(record.states)  # raises ValueError where the pose names a state that is not there
    from rosbags.rosbag2 import StoragePlugin, Writer

    store = _load_ros2_message_types()
    times = _convert_times_to_nanoseconds(record.time, origin)
    # The type of each topic's messages.
    types = {
        topic: kind
        for node, filters in record.estimates.items()
        for name, estimate in filters.items()
        for topic, kind in _yield_topics_and_types(_make_topic_prefix(node, name), record.states, estimate.claim, pose)
    }
    # The writer makes a folder; the file in it is complete in itself. It is moved to `partial`, which gets its final
    # name when all is written.
    with whole_file(path) as partial, tempfile.TemporaryDirectory(dir=path.parent) as folder:
        bag = Path(folder) / "bag"
        with Writer(bag, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
            connections = {topic: writer.add_connection(topic, kind, typestore=store) for topic, kind in types.items()}
            for stamp, topic, message in _yield_messages(record, times, pose, store.types):
                writer.write(connections[topic], stamp, store.serialize_cdr(message, types[topic]))
        shutil.move(bag / f"{bag.name}.mcap", partial)


def _load_ros2_message_types() -> Any:
    """Return the types of ROS 2 Humble's messages."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_HUMBLE)


def _convert_times_to_nanoseconds(time: np.ndarray, origin: np.datetime64 | None) -> list[int]:
    """Return times in nanoseconds since 1970, from dates or from seconds after `origin` (1970 if it is None).

    Times that are numbers of steps are taken as seconds. LATEST is 2^31 seconds: later ones have no 32 bits.

    Raises:
        ValueError: a time that no stamp of ROS can say.
    """
    if time.dtype.kind == "M":
        stamps = [int(nanoseconds) for nanoseconds in time.astype("datetime64[ns]").astype(np.int64)]
    else:
        start = 0 if origin is None else int(origin.astype("datetime64[ns]").astype(np.int64))
        stamps = [start + round(seconds * 1e9) for seconds in time.tolist()]
    outside = next((i for i, stamp in enumerate(stamps) if not 0 <= stamp < LATEST), None)
    if outside is not None:
        raise fail("times of a bag", "dates, or seconds since then, from 1970 to 2038", f"{time[outside]}")
    return stamps


def _make_valid_topic_word(name: str) -> str:
    """Return a name as a word of a topic."""
    return re.sub(r"\W", "_", name)


def _make_topic_prefix(node: str, filter_name: str) -> str:
    """Return the beginning of the topics of one filter at a node, /NODE/FILTER."""
    return f"/{_make_valid_topic_word(node)}/{_make_valid_topic_word(filter_name)}"


def _yield_topics_and_types(
    prefix: str, states: tuple[str, ...], claim: Claim, pose: Pose
) -> Iterator[tuple[str, str]]:
    """Yield (topic, message type) for each part of one filter's estimates: odometry, states and their deviations.

    There is odometry if a state is an axis of the pose or twist. There are standard deviations (sd) if the filter
    claims a covariance. ODOMETRY and NUMBER are names of message types of ROS.
    """
    axes_of_pose, axes_of_twist = pose.places(states)
    if any(state is not None for state in (*axes_of_pose, *axes_of_twist)):
        yield f"{prefix}/odometry", ODOMETRY
    for state in states:
        yield f"{prefix}/{_make_valid_topic_word(state)}", NUMBER
        if claim != "none":
            yield f"{prefix}/{_make_valid_topic_word(state)}/sd", NUMBER


class _FilterEstimates(NamedTuple):
    """Estimates of one filter at all times: beginning of its topics, and by row mean, covariance, claim, soundness.

    Shapes: mean (rows, n), covariance (rows, n, n), claims and sound (rows,).
    """

    prefix: str
    mean: np.ndarray
    covariance: np.ndarray
    claims: np.ndarray
    sound: np.ndarray


def _yield_messages(record: Record, times: list[int], pose: Pose, types: Any) -> Iterator[tuple[int, str, object]]:
    """Yield time, topic and message of each sound estimate, in order of time.

    Estimates are written as ROS messages: pose and twist together as odometry, and each state as numbers under topics
    of their own. A sound estimate has a finite mean and a valid covariance.

    Args:
        record: the estimates of all nodes and filters.
        times: times of the record's rows, in nanoseconds since 1970.
        pose: says which states are positions, angles and velocities of a pose and a twist.
        types: {name of a message type: its class}.
    """
    # Estimates as arrays, once for all rows.
    all_estimates = [
        _FilterEstimates(
            prefix=_make_topic_prefix(node, name),
            mean=np.asarray(estimate.mean),
            covariance=np.asarray(estimate.covariance),
            claims=np.asarray(estimate.claims),
            sound=mask_sound_estimates(estimate),
        )
        for node, filters in record.estimates.items()
        for name, estimate in filters.items()
    ]
    state_indices = pose.places(record.states)
    # Without any state of a pose no odometry is written.
    is_on_some_axis = any(state is not None for axes in state_indices for state in axes)
    for k, stamp in enumerate(times):
        for estimates in all_estimates:
            if not estimates.sound[k]:
                continue
            if is_on_some_axis:
                # A filter without a claim has no covariance to write.
                claimed = None if estimates.claims[k] == "none" else estimates.covariance[k]
                odometry = _make_odometry(stamp, estimates.mean[k], claimed, state_indices, pose, types)
                yield stamp, f"{estimates.prefix}/odometry", odometry
            for topic, number in _yield_state_numbers(estimates, k, record.states):
                yield stamp, topic, types[NUMBER](number)  # a message of one number


def _yield_state_numbers(estimates: _FilterEstimates, k: int, states: tuple[str, ...]) -> Iterator[tuple[str, float]]:
    """Yield topic and number of each state in row k: its mean, and its standard deviation if the filter claims one."""
    for i, state in enumerate(states):
        topic = f"{estimates.prefix}/{_make_valid_topic_word(state)}"
        yield topic, float(estimates.mean[k, i])
        if estimates.claims[k] != "none":
            yield f"{topic}/sd", float(np.sqrt(max(estimates.covariance[k, i, i], 0.0)))


def _make_odometry(
    stamp: int,
    mean: Float[np.ndarray, " n"],
    covariance: Float[np.ndarray, "n n"] | None,
    state_indices: tuple[list[int | None], list[int | None]],
    pose: Pose,
    types: Any,
) -> object:
    """Return an odometry message of ROS: position, orientation and velocities, with their covariances.

    Args:
        stamp: time of the estimate in nanoseconds since 1970.
        mean: mean of the states.
        covariance: covariance of the states; None where none is claimed.
        state_indices: by axis the index of the state that is along or about it, of the pose and of the twist (its
            velocity), as `Pose.places` returns them.
        pose: names of the frames.
        types: classes of messages by the names of their types.
    """
    geometry = "geometry_msgs/msg/"
    vector, point, quaternion = (types[f"{geometry}{name}"] for name in ("Vector3", "Point", "Quaternion"))
    pose_states, twist_states = state_indices
    # Six numbers each, three along the axes and three about them, and their covariance (36,).
    position, position_covariance = _select_pose_and_covariance(mean, covariance, pose_states)
    velocity, velocity_covariance = _select_pose_and_covariance(mean, covariance, twist_states)
    rotation = quaternion(*_convert_angles_to_quaternion(*position[3:]))
    pose_message = types[f"{geometry}Pose"](position=point(*position[:3]), orientation=rotation)
    twist_message = types[f"{geometry}Twist"](linear=vector(*velocity[:3]), angular=vector(*velocity[3:]))
    seconds, nanoseconds = divmod(stamp, 10**9)
    time = types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=nanoseconds)
    return types[ODOMETRY](
        header=types["std_msgs/msg/Header"](stamp=time, frame_id=pose.frame),
        child_frame_id=pose.child,
        pose=types[f"{geometry}PoseWithCovariance"](pose=pose_message, covariance=position_covariance),
        twist=types[f"{geometry}TwistWithCovariance"](twist=twist_message, covariance=velocity_covariance),
    )


def _select_pose_and_covariance(
    mean: Float[np.ndarray, " n"], covariance: Float[np.ndarray, "n n"] | None, state_indices: list[int | None]
) -> tuple[list[float], Float[np.ndarray, " 36"]]:
    """Return the six numbers of a pose or twist, and their covariance (6, 6) row by row, (36,).

    `state_indices` holds for each axis the index of its state, or None; an axis without a state has zeros. If
    `covariance` is None, the first entry of the result is UNKNOWN, -1, as ROS prescribes.
    """
    numbers = [0.0 if state is None else float(mean[state]) for state in state_indices]
    covariance_of_axes = np.zeros((6, 6))
    pairs = [(axis, state) for axis, state in enumerate(state_indices) if state is not None]
    if covariance is None:
        covariance_of_axes[0, 0] = UNKNOWN
    elif pairs:
        axes, states = np.array(pairs).T
        covariance_of_axes[np.ix_(axes, axes)] = covariance[np.ix_(states, states)]
    return numbers, covariance_of_axes.ravel()


def _convert_angles_to_quaternion(roll: float, pitch: float, yaw: float) -> tuple[float, float, float, float]:
    """Return the quaternion (x, y, z, w) of a turn by yaw about z, pitch about the new y, and roll about the new x."""
    # Sines and cosines of half the angles.
    (sr, sp, sy), (cr, cp, cy) = (f(np.array([roll, pitch, yaw]) / 2).tolist() for f in (np.sin, np.cos))
    return (
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        cr * cp * cy + sr * sp * sy,
    )
