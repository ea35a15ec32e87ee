"""The Plaza2 recording of a robot mower: ranges to four beacons, odometry and truth, as the gtsam wheel brings them.

Source: Djugash, Hamner and Roth, Navigating with ranging radios: five data sets with ground truth (2009).
"""

from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from scipy.io import loadmat

from heliograph.numerics.check import fail
from heliograph.numerics.extras import how_to_install

MOVING = 0.01  # m in one odometry row of 0.1 s: the robot has started


@dataclass(frozen=True)
class PlazaRecording:
    """One row for each range received; odometry is summed up to the range's time stamp.

    start (s) and start_pose (3,): the first truth sample, before any row. time (rows,) s. truth (rows, 3): x m, y m,
    heading of travel rad, not wrapped. odometry (rows, 3): distance m, gyro's turn rad, duration s since the row
    before. ranges (rows, 4) m, NaN for beacons not heard. beacons (4, 2) m. gyro_rate rad/s: the gyro at rest.
    """

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
        return PlazaRecording(self.start, self.start_pose, time, truth, odometry, ranges, self.beacons, self.gyro_rate)

    def distances(self) -> np.ndarray:
        """True distance to each beacon, (rows, 4) m."""
        result: np.ndarray = np.linalg.norm(self.truth[:, None, :2] - self.beacons, axis=-1)
        return result


def find_recording() -> Path:
    """Path of the recording inside the installed gtsam wheel, which is not imported.

    Raises:
        ModuleNotFoundError: the extra `recordings` is not installed.
        ValueError: the installed gtsam comes without the recording.
    """
    spec = find_spec("gtsam")
    if spec is None or spec.origin is None:
        raise ModuleNotFoundError(
            f"gtsam: expected to be installed, got no such package: {how_to_install('recordings')}", name="gtsam"
        )
    path = Path(spec.origin).parent / "Data" / "Plaza2_.mat"
    if not path.is_file():
        raise fail("Plaza2 recording", "the file Data/Plaza2_.mat in the gtsam package", "a gtsam without it")
    return path


def read_recording() -> PlazaRecording:
    """Read Plaza2, one row for each of its 1816 ranges.

    The recorded heading points backwards along the motion, so pi is added. The distance travelled and the gyro's turn
    are summed and interpolated to the times of the ranges.

    Raises:
        ModuleNotFoundError: the extra `recordings` is not installed.
        ValueError: the installed gtsam comes without the recording.
    """
    tables = loadmat(find_recording(), variable_names=["GT", "DR", "TD", "TL"])
    truth, odometry, heard, beacons = (tables[name] for name in ("GT", "DR", "TD", "TL"))
    clock = truth[:, 0]  # odometry row i is the increment from clock[i] to clock[i + 1]
    time = np.concatenate([clock[:1], heard[:, 0]])
    sums = [np.interp(time, clock, np.concatenate([[0.0], np.cumsum(odometry[:, c])])) for c in (1, 2)]
    pose = np.column_stack([
        np.interp(time, clock, truth[:, 1]),
        np.interp(time, clock, truth[:, 2]),
        np.interp(time, clock, np.unwrap(truth[:, 3])) + np.pi,
    ])  # fmt: skip
    columns = {beacon: c for c, beacon in enumerate(beacons[:, 0])}
    ranges = np.full((len(heard), len(beacons)), np.nan)
    ranges[np.arange(len(heard)), [columns[beacon] for beacon in heard[:, 2]]] = heard[:, 3]
    departure = int(np.argmax(odometry[:, 1] > MOVING))
    rate = float(odometry[:departure, 2].sum() / (clock[departure] - clock[0]))
    steps = np.column_stack([np.diff(sums[0]), np.diff(sums[1]), np.diff(time)])
    return PlazaRecording(float(time[0]), pose[0], time[1:], pose[1:], steps, ranges, beacons[:, 1:], rate)
