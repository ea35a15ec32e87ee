"""Recordings of a robot mower: ranges to four beacons, odometry and truth, as the gtsam wheel brings them.

Source: Djugash, Hamner and Roth, Navigating with ranging radios: five data sets with ground truth (2009).
"""

from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from scipy.io import loadmat

from heliograph.numerics.check import fail, show_value
from heliograph.numerics.process.optional_packages import check_installed

MOVING = 0.01  # m in one odometry row of 0.1 or 0.2 s: the robot has started
LONGEST = 1.0  # s without a range after which the rows of the odometry are kept: a chord stands for a second at most
FILES = {"plaza1": "Plaza1_.mat", "plaza2": "Plaza2_.mat"}
BACKWARDS = {"plaza1": 0.0, "plaza2": np.pi}  # rad, from the recorded heading to that of travel


@dataclass(frozen=True)
class PlazaRecording:
    """One row for each range received, and those of the odometry where none is for long.

    name: a key of FILES. start (s) and start_pose (3,): the first truth sample, before any row. time (rows,) s. truth
    (rows, 3): x m, y m, heading of travel rad, not wrapped. odometry (rows, 3): distance m, gyro's turn rad, duration
    s, summed up since the row before. ranges (rows, 4) m, NaN for beacons not received. beacons (4, 2) m. gyro_rate
    rad/s: the gyro at rest.
    """

    name: str

    start: float
    start_pose: np.ndarray
    time: np.ndarray
    truth: np.ndarray
    odometry: np.ndarray
    ranges: np.ndarray
    beacons: np.ndarray
    gyro_rate: float

    def first(self, rows: int) -> "PlazaRecording":
        """The beginning of the recording."""
        time, truth, odometry, ranges = (a[:rows] for a in (self.time, self.truth, self.odometry, self.ranges))
        return replace(self, time=time, truth=truth, odometry=odometry, ranges=ranges)

    def place(self, time: np.ndarray) -> np.ndarray:
        """Where the mower was, (time, 2) in metres, at seconds after the start."""
        known = np.concatenate([[0.0], self.time - self.start])
        path = np.concatenate([self.start_pose[None, :2], self.truth[:, :2]])
        x, y = (np.interp(time, known, path[:, i]) for i in range(2))
        return np.column_stack([x, y])

    def distances(self) -> np.ndarray:
        """True distance to each beacon, (rows, 4) m."""
        result: np.ndarray = np.linalg.norm(self.truth[:, None, :2] - self.beacons, axis=-1)
        return result


def find_recording(name: str = "plaza2") -> Path:
    """Path of the recording inside the installed gtsam wheel, which is not imported.

    Raises:
        ModuleNotFoundError: the extra `recordings` is not installed.
        ValueError: no recording of this name, or the installed gtsam comes without it.
    """
    if name not in FILES:
        raise fail("recording", f"one of {', '.join(FILES)}", show_value(name))
    check_installed(["gtsam"])
    spec = find_spec("gtsam")
    assert spec is not None and spec.origin is not None
    path = Path(spec.origin).parent / "Data" / FILES[name]
    if not path.is_file():
        raise fail(f"recording {name}", f"the file Data/{FILES[name]} in the gtsam package", "a gtsam without it")
    return path


def plaza2(_: object) -> list[Path]:
    """The file that a study reads whatever its setting."""
    return [find_recording()]


def read_recording(name: str = "plaza2") -> PlazaRecording:
    """Read a recording, in the order of its time stamps: ranges stand in the file as a logger wrote them.

    Plaza2's heading points backwards along the motion, so pi is added. The distance travelled and the gyro's turn
    are summed and interpolated to the times of the rows.

    Raises:
        ModuleNotFoundError: the extra `recordings` is not installed.
        ValueError: no recording of this name, or the installed gtsam comes without it.
    """
    tables = loadmat(find_recording(name), variable_names=["GT", "DR", "TD", "TL"])
    truth, odometry, received, beacons = (tables[key] for key in ("GT", "DR", "TD", "TL"))
    clock = truth[:, 0]  # odometry row i is the increment from clock[i] to clock[i + 1]
    # Rows in time order: ranges, and odometry where none comes for long.
    received = received[np.argsort(received[:, 0], kind="stable")]
    between = _without_ranges(clock, received[:, 0])
    rows = np.argsort(np.concatenate([received[:, 0], between]), kind="stable")
    time = np.concatenate([clock[:1], np.concatenate([received[:, 0], between])[rows]])
    # Odometry and truth at the rows' times.
    sums = [np.interp(time, clock, np.concatenate([[0.0], np.cumsum(odometry[:, c])])) for c in (1, 2)]
    pose = np.column_stack([
        np.interp(time, clock, truth[:, 1]),
        np.interp(time, clock, truth[:, 2]),
        np.interp(time, clock, np.unwrap(truth[:, 3])) + BACKWARDS[name],
    ])  # fmt: skip
    # One column for each beacon.
    columns = {beacon: c for c, beacon in enumerate(beacons[:, 0])}
    ranges = np.full((len(rows), len(beacons)), np.nan)
    ranges[np.arange(len(received)), [columns[beacon] for beacon in received[:, 2]]] = received[:, 3]
    ranges = ranges[rows]
    # The gyro's rate at rest: its turn before the first motion.
    departure = int(np.argmax(odometry[:, 1] > MOVING))
    rate = float(odometry[:departure, 2].sum() / (clock[departure] - clock[0]))
    steps = np.column_stack([np.diff(sums[0]), np.diff(sums[1]), np.diff(time)])
    return PlazaRecording(name, float(time[0]), pose[0], time[1:], pose[1:], steps, ranges, beacons[:, 1:], rate)


def _without_ranges(clock: np.ndarray, received: np.ndarray) -> np.ndarray:
    """Times of the odometry in every stretch of more than LONGEST without a range."""
    ends = np.concatenate([clock[:1], received, clock[-1:]])
    long = np.flatnonzero(np.diff(ends) > LONGEST)
    inside = [clock[(clock > ends[i]) & (clock < ends[i + 1])] for i in long]
    return np.concatenate([np.zeros(0), *inside])
