"""The textbook cubature filter of a robot that measures ranges through a relay, in NumPy."""

import numpy as np

from heliograph_studies.demo import robot
from heliograph_studies.demo.recording import PlazaRecording

PLAZA2 = robot.DRIVES["plaza2"]


def cubature_oracle(
    recording: PlazaRecording,
    received: np.ndarray,
    gain_variance: float,
    noise: float,
    taken_off: np.ndarray | float = 0,
) -> tuple[np.ndarray, np.ndarray]:
    """The textbook cubature filter in NumPy, Var(z) = Pyy + gain_variance (Pyy + (y - r)^2) + noise by component."""

    def points(x: np.ndarray, p: np.ndarray) -> np.ndarray:
        spread = np.sqrt(3) * np.linalg.cholesky(p).T
        return np.asarray(x + np.vstack([spread, -spread]))

    x, p, means, covariances = PLAZA2.start, np.diag(robot.START_DEVIATION**2), [], []
    for (distance, turn, dt), z in zip(recording.odometry, received, strict=True):
        turn = turn - PLAZA2.gyro_rate * dt
        c = points(x, p)
        course = c[:, 2] + turn / 2
        c = c + np.column_stack([distance * np.cos(course), distance * np.sin(course), np.full(6, turn)])
        x = c.mean(0)
        walk = [robot.POSITION_WALK * distance] * 2 + [robot.HEADING_WALK * dt]
        p = (c - x).T @ (c - x) / 6 + np.diag(walk)
        c = points(x, p)
        b = PLAZA2.beacons[~np.isnan(z)]
        r = np.broadcast_to(taken_off, (4,))[~np.isnan(z)]
        y = robot.RANGE_SCALE * np.linalg.norm(c[:, None, :2] - b, axis=-1)
        mean, pyy = y.mean(0), (y - y.mean(0)).T @ (y - y.mean(0)) / 6 + robot.RANGE_VARIANCE * np.eye(len(b))
        s = pyy + np.diag(gain_variance * (np.diag(pyy) + (mean - r) ** 2) + noise)
        k = (c - x).T @ (y - mean) / 6 @ np.linalg.inv(s)
        x, p = x + k @ (z[~np.isnan(z)] - mean), p - k @ s @ k.T
        means.append(x)
        covariances.append(p)
    return np.array(means), np.array(covariances)
