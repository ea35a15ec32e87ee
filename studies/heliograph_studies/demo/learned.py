"""The robot's constants learned from its own ranges, without the truth: on the first half, judged on the second."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

import heliograph as hg
from heliograph.model.estimate import Estimate
from heliograph_studies.demo import robot
from heliograph_studies.demo.recording import PlazaRecording

INSIDE_95 = -2 * np.log(0.05)  # 95 % point of chi-square with two degrees of freedom


@dataclass(frozen=True)
class Score:
    """How far off the position is, and whether the filter knew.

    NEES e' B^-1 e / 2 of the 2-D position error e against the claimed covariance B; 1 is honest. claimed_rmse_m:
    root of the mean trace of B. inside_95: share of rows where the truth lies inside the claimed 95 % ellipse.
    """

    position_rmse_m: float
    claimed_rmse_m: float
    nees_per_dimension: float
    inside_95: float


def score(estimate: Estimate, truth: np.ndarray, first: int = 0) -> Score:
    """Score one filter's estimates of the position, from row `first` on."""
    estimate = Estimate(np.asarray(estimate.mean)[first:], np.asarray(estimate.covariance)[first:], estimate.claim)
    truth = truth[first:]
    nees = position_nees(estimate, truth)
    squared = np.sum((np.asarray(estimate.mean) - truth)[:, :2] ** 2, axis=1)
    claimed = np.trace(np.asarray(estimate.covariance)[:, :2, :2], axis1=1, axis2=2)
    inside = np.mean(2 * nees <= INSIDE_95)
    return Score(float(np.sqrt(squared.mean())), float(np.sqrt(claimed.mean())), float(nees.mean()), float(inside))


def position_nees(estimate: Estimate, truth: np.ndarray) -> np.ndarray:
    """e' B^-1 e / 2 of the position at each row, (rows,)."""
    mean, covariance = np.asarray(estimate.mean)[:, :2], np.asarray(estimate.covariance)[:, :2, :2]
    return np.asarray(hg.nees(truth[:, :2], mean, covariance) / 2)


FIRST_GUESS = robot.Constants(0.0, 1.0, 1.0, 0.02, 1e-5)  # of one who knows nothing but that odometry drifts slowly
HELD = 1e-9  # rad^2/s: heading walk of relayed ranges, which are too noisy to tell of it
GUESSED_SPREAD = 0.1  # variance of the relay's gain, whose mean is known
STARTS = 1  # others end where this one does, or far below
RELAY_NOISE = (robot.gain.moment(2) + 1) * robot.HOP_VARIANCE  # of both hops, behind the second


@dataclass(frozen=True)
class Parameter:
    """An estimate with its 95 % interval, None where there is none; boundary: it ran to the end of its range."""

    estimate: float
    low: float | None
    high: float | None
    boundary: bool


@dataclass(frozen=True)
class Learned:
    """What was learned from the first `rows` of the ranges, and the error (m) on the second half of the drive.

    gyro_rate_of_truth: what the gyro read over the whole drive beside the true turns, rad/s, which nobody learned from.
    """

    rows: int
    second_half: float
    second_half_calibrated: float
    second_half_nees: float
    gyro_rate_at_rest: float
    gyro_rate_of_truth: float
    parameters: dict[str, Parameter]


def direct(drive: robot.Drive) -> hg.Network:
    """The robot whose ranges arrive as they are, with all five constants free."""
    constants = {
        name: hg.free(value, name, "real" if name in ("gyro_rate", "range_scale") else "positive")
        for name, value in FIRST_GUESS._asdict().items()
    }
    return single(drive, robot.Constants(**constants), hg.perfect(len(drive.beacons)))


def relayed(drive: robot.Drive) -> hg.Network:
    """The robot behind the relays: their gain's variance is free too, the ranges' own and the heading walk are not."""
    gain = hg.random_affine.GivenMoments([1.0, 1.0 + hg.free(GUESSED_SPREAD, "gain_variance", "positive")])
    constants = robot.Constants(
        hg.free(FIRST_GUESS.gyro_rate, "gyro_rate", "real"),
        hg.free(FIRST_GUESS.range_scale, "range_scale", "real"),
        robot.RANGE_VARIANCE,
        hg.free(FIRST_GUESS.position_walk, "position_walk", "positive"),
        HELD,
    )
    return single(drive, constants, hg.parallel([hg.hop(gain, RELAY_NOISE)] * len(drive.beacons)))


def single(
    drive: robot.Drive, constants: robot.Constants, channel: hg.random_affine.AbstractRandomAffine
) -> hg.Network:
    """A network of one filter."""
    plant, sensor = robot.model(drive, constants)
    filters = {"learned": hg.cubature_filter(plant, sensor, channel)}
    return hg.Network(plant, {"robot": hg.Node(sensor, channel, filters)})


def first_half(recording: PlazaRecording) -> hg.learning.Fit:
    """What the direct ranges of the first half say."""
    build = partial(direct, robot.DRIVES[recording.name])
    return fitted(build, recording, recording.ranges, len(recording.time) // 2)


def learn(recording: PlazaRecording, fit: hg.learning.Fit | None = None) -> Learned:
    """Fit the first half, unless the fit is given, and judge on the second."""
    drive, half = robot.DRIVES[recording.name], len(recording.time) // 2
    fit = fit or first_half(recording)
    calibrated = single(drive, robot.Constants(drive.gyro_rate), hg.perfect(len(drive.beacons)))
    after, before = (judged(n, recording, recording.ranges, half) for n in (fit.network, calibrated))
    turned = recording.truth[-1, 2] - recording.start_pose[2]
    _, turn, duration = recording.odometry.sum(axis=0)
    return Learned(
        half, after.position_rmse_m, before.position_rmse_m, after.nees_per_dimension, recording.gyro_rate,
        float((turn - turned) / duration), parameters(fit),
    )  # fmt: skip


def fitted(
    build: Callable[[], hg.Network], recording: PlazaRecording, received: np.ndarray, rows: int
) -> hg.learning.Fit:
    """Learn from the first rows of what was received."""
    result = hg.fit(build, {"robot": received[:rows]}, recording.odometry[:rows], starts=STARTS)
    assert isinstance(result, hg.learning.Fit)  # since no sender decides
    return result


def judged(network: hg.Network, recording: PlazaRecording, received: np.ndarray, first: int = 0) -> Score:
    """The filter over all rows, its score from row `first` on."""
    record = hg.run(network, {"robot": received}, recording.odometry, recording.time)
    return score(record.estimates["robot"]["learned"], recording.truth, first)


def parameters(fit: hg.learning.Fit) -> dict[str, Parameter]:
    """Estimates with their intervals, by name."""

    def finite(value: float) -> float | None:
        return float(value) if np.isfinite(value) else None

    return {r.name: Parameter(r.estimate, finite(r.low), finite(r.high), r.boundary) for r in fit.rows()}
