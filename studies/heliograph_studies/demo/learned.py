"""The robot's constants learned from its own ranges, without the truth: on the first half, judged on the second."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

import heliograph as hg
from heliograph.learning import Fit, Row
from heliograph.learning.free_marks import Kind
from heliograph.report.results import Json
from heliograph_studies.demo import robot
from heliograph_studies.demo.recording import PlazaRecording
from heliograph_studies.demo.scores import Score, score

FIRST_GUESS = robot.Constants(0.0, 1.0, 1.0, 0.02, 1e-5)  # of one who knows nothing but that odometry drifts slowly
HELD = 1e-9  # rad^2/s: heading walk of relayed ranges, which are too noisy to tell of it
GUESSED_SPREAD = 0.1  # variance of the relay's gain, whose mean is known
STARTS = 1  # others end where this one does, or far below
RELAY_NOISE = (robot.gain.moment(2) + 1) * robot.HOP_VARIANCE  # of both hops, behind the second


@dataclass(frozen=True)
class Learned:
    """What was learned from the first `rows` of the ranges, and how good it is on the second half of the drive.

    drift: what the gyro read over the whole drive beside the true turns, rad/s, which nobody learned from.
    """

    rows: int
    result: Fit
    second_half: Score
    second_half_calibrated: Score
    rest: float
    drift: float


def direct(drive: robot.Drive) -> hg.Network:
    """The robot whose ranges arrive as they are, with all five constants free."""
    guess = FIRST_GUESS._asdict()
    kinds: dict[str, Kind] = {"gyro_rate": "real", "range_scale": "real"}
    results = {name: hg.free(value, name, kinds.get(name, "positive")) for name, value in guess.items()}
    return received_by_one(drive, robot.Constants(**results), hg.perfect(len(drive.beacons)))


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
    return received_by_one(drive, constants, hg.parallel([hg.hop(gain, RELAY_NOISE)] * len(drive.beacons)))


def received_by_one(
    drive: robot.Drive, constants: robot.Constants, channel: hg.random_affine.AbstractRandomAffine
) -> hg.Network:
    """A network of one filter."""
    plant, sensor = robot.model(drive, constants)
    filters = {"learned": hg.cubature_filter(plant, sensor, channel)}
    return hg.Network(plant, {"robot": hg.Node(sensor, channel, filters)})


def learn(recording: PlazaRecording, advance: Callable[[str], None] = lambda what: None) -> Learned:
    """Fit the direct ranges of the first half, and judge on the second."""
    advance("learning the constants without the truth")
    drive, half = robot.DRIVES[recording.name], len(recording.time) // 2
    outcome = fitted(partial(direct, drive), recording, recording.ranges, half)
    calibrated = received_by_one(drive, robot.Constants(drive.gyro_rate), hg.perfect(len(drive.beacons)))
    after, before = (judged(n, recording, recording.ranges, half) for n in (outcome.network, calibrated))
    turned = recording.truth[-1, 2] - recording.start_pose[2]
    _, turn, duration = recording.odometry.sum(axis=0)
    return Learned(half, outcome, after, before, recording.gyro_rate, float((turn - turned) / duration))


def fitted(build: Callable[[], hg.Network], recording: PlazaRecording, received: np.ndarray, rows: int) -> Fit:
    """Learn from the first rows of what was heard."""
    return hg.fit(build, {"robot": received[:rows]}, recording.odometry[:rows], starts=STARTS)


def judged(network: hg.Network, recording: PlazaRecording, received: np.ndarray, first: int = 0) -> Score:
    """The filter over all rows, its score from row `first` on."""
    record = hg.run(network, {"robot": received}, recording.odometry, recording.time)
    return score(record.estimates["robot"]["learned"], recording.truth, first)


def said(result: Learned) -> str:
    """What was found, in words."""
    row = next(row for row in result.result.rows() if row.name == "gyro_rate")
    apart = not row.low <= result.rest <= row.high
    verdict = (
        "That is not what it reads at rest, so the rate at rest is wrong while driving"
        if apart
        else "That agrees with what it reads at rest"
    )
    return (
        f"While driving the gyro is off by {row.estimate:.2e} rad/s ({row.low:.2e} to {row.high:.2e}). {verdict} "
        f"({result.rest:.2e}); the true turns, which nobody learned from, say {result.drift:.2e}."
    )


def learned_line(result: Learned) -> str:
    """One line for the terminal."""
    local, calibrated = result.second_half.position_rmse_m, result.second_half_calibrated.position_rmse_m
    return (
        f"Learned without the truth from the first {result.rows} rows: {local:.3f} m on the second half without a relay, "
        f"where the calibrated filter has {calibrated:.3f} m. {said(result)}"
    )


def interval(row: Row) -> str:
    """Of an estimate, as a page has it."""
    if row.boundary:
        return f"below {row.high:.2g}"
    return f"{row.low:.4g} to {row.high:.4g}" if row.identified else "not told"


def learned_summary(result: Learned) -> dict[str, Json]:
    """All numbers."""
    return {
        "rows": result.rows,
        "second_half": result.second_half.position_rmse_m,
        "second_half_calibrated": result.second_half_calibrated.position_rmse_m,
        "second_half_nees": result.second_half.nees_per_dimension,
        "gyro_rate_at_rest": result.rest,
        "gyro_rate_of_truth": result.drift,
        "parameters": parameters(result.result),
    }


def parameters(outcome: Fit) -> dict[str, Json]:
    """Estimates with their intervals, by name; null where there is none."""

    def finite(value: float) -> float | None:
        return float(value) if np.isfinite(value) else None

    return {
        row.name: {"estimate": row.estimate, "low": finite(row.low), "high": finite(row.high), "boundary": row.boundary}
        for row in outcome.rows()
    }
