"""Where the constants of the robot's model come from: each is measured on the recording."""

from dataclasses import dataclass

import numpy as np

from heliograph_studies.demo.recording import PlazaRecording
from heliograph_studies.demo.robot import WINDOW


@dataclass(frozen=True)
class Calibration:
    """The five numbers of the robot's model, each with its unit; see the functions that measure them."""

    gyro_rate: float  # rad/s
    range_scale: float
    range_variance: float  # m^2
    position_walk: float  # m^2 for each metre travelled, each axis
    heading_walk: float  # rad^2/s


def calibrate(recording: PlazaRecording) -> Calibration:
    """Measure the model's five constants on the recording; all but the gyro's rate use the truth."""
    scale, variance = calibrate_ranges(recording)
    position, heading = calibrate_odometry(recording)
    return Calibration(recording.gyro_rate, scale, variance, position, heading)


def calibrate_ranges(recording: PlazaRecording) -> tuple[float, float]:
    """Scale s and variance of range = s distance + noise: regression through the origin, mean squared residual."""
    arrived = ~np.isnan(recording.ranges)
    distance, measured = recording.distances()[arrived], recording.ranges[arrived]
    scale = float(distance @ measured / (distance @ distance))
    return scale, float(np.mean((measured - scale * distance) ** 2))


def calibrate_odometry(recording: PlazaRecording) -> tuple[float, float]:
    """Random walks of position (m^2/m per axis) and heading (rad^2/s) that match the odometry's drift over WINDOW rows.

    Position: dead reckoning along the true headings against the truth. Heading: gyro, less its rate at rest, against
    the truth. Drifts are correlated over seconds, so single rows would understate them.
    """
    poses = np.concatenate([recording.start_pose[None], recording.truth])
    distance, turn, duration = recording.odometry.T
    turned = np.diff(poses[:, 2])
    course = poses[:-1, 2] + turned / 2  # the chord of an arc
    moved = distance[:, None] * np.column_stack([np.cos(course), np.sin(course)])
    position = _over_windows(np.diff(poses[:, :2], axis=0) - moved)
    heading = _over_windows(turned - (turn - recording.gyro_rate * duration))
    position_walk = np.mean(position**2) / np.mean(_over_windows(distance))
    return float(position_walk), float(np.mean(heading**2) / np.mean(_over_windows(duration)))


def _over_windows(increments: np.ndarray) -> np.ndarray:
    """Sums over every stretch of WINDOW rows."""
    total = np.cumsum(increments, axis=0)
    result: np.ndarray = total[WINDOW:] - total[:-WINDOW]
    return result
