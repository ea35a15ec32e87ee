import numpy as np
import pytest

from heliograph.numerics.process import optional_packages
from heliograph_studies.demo import robot
from heliograph_studies.demo.recording import (
    PlazaRecording,
    find_recording,
    read_recording,
)
from heliograph_studies.demo.robot import WINDOW
from tests.studies.demo.calibration import calibrate, calibrate_odometry, calibrate_ranges

PLAZA2 = robot.DRIVES["plaza2"]


@pytest.fixture(scope="module")
def recording() -> PlazaRecording:
    return read_recording()


def test_one_range_a_row(recording: PlazaRecording) -> None:
    assert recording.ranges.shape == (1816, 4)
    assert np.all(np.sum(~np.isnan(recording.ranges), axis=1) == 1)
    assert np.all(np.diff(recording.time) > 0)
    assert recording.time[0] > recording.start


def test_odometry_belongs_to_the_truth_of_its_row(recording: PlazaRecording) -> None:
    poses = np.vstack([recording.start_pose, recording.truth])
    steps = np.diff(poses[:, :2], axis=0)
    moved = np.linalg.norm(steps, axis=1)
    # The odometry's distance is nearly the truth's own; a shift by one row changes single steps by much more.
    np.testing.assert_allclose(recording.odometry[:, 0], moved, atol=0.02)
    np.testing.assert_allclose(recording.odometry[:, 2].sum(), recording.time[-1] - recording.start)
    course = np.arctan2(steps[:, 1], steps[:, 0])
    off = np.angle(np.exp(1j * (course - (poses[:-1, 2] + poses[1:, 2]) / 2)))
    # Heading of travel, neither reversed nor lagging. In the last 10 s the mower turns on the spot and backs up.
    forward = (moved > 0.1) & (recording.time < recording.start + 400)
    assert np.max(np.abs(off[forward])) < np.deg2rad(15)


def test_constants_of_the_example_are_what_the_recording_gives(recording: PlazaRecording) -> None:
    got = calibrate(recording)
    # Half a unit in the last digit printed in the example.
    assert got.gyro_rate == pytest.approx(PLAZA2.gyro_rate, abs=0.5e-6)
    assert got.range_scale == pytest.approx(robot.RANGE_SCALE, abs=0.5e-5)
    assert got.range_variance == pytest.approx(robot.RANGE_VARIANCE, abs=0.5e-5)
    assert got.position_walk == pytest.approx(robot.POSITION_WALK, abs=0.5e-7)
    assert got.heading_walk == pytest.approx(robot.HEADING_WALK, abs=0.5e-9)
    np.testing.assert_allclose(PLAZA2.beacons, recording.beacons, atol=0.5e-3)
    np.testing.assert_allclose(PLAZA2.start, recording.start_pose, atol=0.5e-3)


@pytest.fixture(scope="module")
def other() -> PlazaRecording:
    return read_recording("plaza1")


def test_another_drive_is_read_in_the_order_of_its_time_stamps(other: PlazaRecording) -> None:
    received = ~np.isnan(other.ranges)
    assert received.sum() == 3529 and np.all(received.sum(axis=1) <= 1)  # every range, none twice in a row
    step = other.odometry[:, 2]
    assert np.all(np.diff(other.time) >= 0)
    assert step.max() <= 1.0 and np.all(step >= 0)  # gaps of up to 97 s are bridged by the odometry
    np.testing.assert_allclose(step.sum(), other.time[-1] - other.start)
    # Ranges are where their stamps say, before and after the file goes back: a scale is all that is off.
    off = other.ranges[received] - robot.RANGE_SCALE * other.distances()[received]
    assert all(abs(part.mean()) < 0.25 and part.std() < 0.8 for part in np.array_split(off, 30))


def test_the_other_drive_has_three_things_of_its_own(other: PlazaRecording) -> None:
    local = robot.DRIVES["plaza1"]
    assert other.gyro_rate == pytest.approx(local.gyro_rate, abs=0.5e-9)
    np.testing.assert_allclose(local.beacons, other.beacons, atol=0.5e-3)
    np.testing.assert_allclose(local.start, other.start_pose, atol=0.5e-3)


def test_headings_are_those_of_travel_on_either_drive(recording: PlazaRecording, other: PlazaRecording) -> None:
    for drive in (recording, other):
        poses = np.vstack([drive.start_pose, drive.truth])
        steps = np.diff(poses[:, :2], axis=0)
        forward = np.linalg.norm(steps, axis=1) > 0.1
        course = np.arctan2(steps[:, 1], steps[:, 0]) - (poses[:-1, 2] + poses[1:, 2]) / 2
        assert abs(np.angle(np.mean(np.exp(1j * course[forward])))) < 0.02
    with pytest.raises(ValueError, match="recording: expected one of plaza1, plaza2, got 'plaza3'"):
        find_recording("plaza3")


def synthetic(rows: int, seed: int) -> PlazaRecording:
    """A straight drive whose odometry misses known random walks, with ranges of a known law."""
    rng = np.random.default_rng(seed)
    odometry = np.column_stack([np.full(rows, 0.8), rng.normal(0, 0.03, rows), np.full(rows, 0.2)])
    heading = np.cumsum(odometry[:, 1] + rng.normal(0, np.sqrt(4e-5 * 0.2), rows))  # 4e-5 rad^2/s
    course = np.append(0.0, heading)[:-1] + np.diff(np.append(0.0, heading)) / 2
    moved = 0.8 * np.column_stack([np.cos(course), np.sin(course)]) + rng.normal(0, np.sqrt(3e-3 * 0.8), (rows, 2))
    truth = np.column_stack([np.cumsum(moved, axis=0), heading])
    beacons = np.array([[0.0, 30.0], [50.0, -20.0]])
    distance = np.linalg.norm(truth[:, None, :2] - beacons, axis=-1)
    ranges = 1.1 * distance + rng.normal(0, 0.5, distance.shape)
    ranges[::2, 0] = np.nan
    return PlazaRecording(
        "plaza2", 0.0, np.zeros(3), np.arange(1, rows + 1) * 0.2, truth, odometry, ranges, beacons, 0.0
    )


def test_calibration_recovers_known_constants() -> None:
    made = synthetic(20_000, 1)
    scale, variance = calibrate_ranges(made)
    assert scale == pytest.approx(1.1, rel=1e-4)
    assert variance == pytest.approx(0.25, rel=4 * np.sqrt(2 / 30_000))  # four standard errors of a mean square
    position, heading = calibrate_odometry(made)
    independent = 20_000 / WINDOW  # windows that do not overlap: a lower bound on what the overlapping ones know
    assert position == pytest.approx(3e-3, rel=3 * np.sqrt(2 / (2 * independent)))
    assert heading == pytest.approx(4e-5, rel=3 * np.sqrt(2 / independent))


def test_a_beginning_keeps_the_start(recording: PlazaRecording) -> None:
    short = recording.first(7)
    assert len(short.time) == len(short.truth) == len(short.odometry) == len(short.ranges) == 7
    assert short.start == recording.start


def test_missing_extra_is_one_line_that_names_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(optional_packages, "find_spec", lambda name: None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install .*\[recordings\]") as caught:
        find_recording()
    assert caught.value.name == "gtsam"
    assert "\n" not in str(caught.value)
