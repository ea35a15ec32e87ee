"""A mower's recorded ranges to four beacons through a simulated relay, to filters that know it or do not."""

import numpy as np
from matplotlib.figure import Figure

from heliograph.report.figures import BLUE, GREEN, MUTED, PURPLE, VERMILION
from heliograph_studies import Study
from heliograph_studies.curves import Curve, consistency_over_time, errors_with_bands, paths
from heliograph_studies.demo import compute, robot
from heliograph_studies.demo.compute import NAMES, Outcome
from heliograph_studies.demo.compute import Setting as Setting
from heliograph_studies.demo.learned import position_nees
from heliograph_studies.demo.robot import CALIBRATED as CALIBRATED
from heliograph_studies.demo.robot import WINDOW as WINDOW

NEEDS = ("gtsam", "pyarrow")
COLOURS = dict(zip(NAMES, (BLUE, PURPLE, VERMILION, GREEN, MUTED), strict=True))
LABELS = {name: name.replace("_", " ").replace("relay aware", "relay-aware") for name in NAMES}
SHOWN = ("relay_aware", "mean_gain", "perfect_channel")
AVERAGED = 44  # rows, 10 s: wide enough to read, narrow enough to see when a filter goes wrong


def figures(outcome: Outcome) -> dict[str, Figure]:
    """Trajectory, errors with the claimed band, and consistency over time."""
    drive, estimates = outcome.drive, outcome.shown.estimates
    clock, truth = drive.time - drive.start, drive.truth[:, :2]
    routes, errors, nees = [], [], []
    for name in SHOWN:
        label, colour, estimate = LABELS[name], COLOURS[name], estimates[name]
        mean = np.asarray(estimate.mean)[:, :2]
        variance = np.diagonal(np.asarray(estimate.covariance), axis1=1, axis2=2)[:, :2]
        routes.append(Curve(f"{label}: {outcome.shown.scores[name].position_rmse_m:.2f} m off", colour, mean))
        errors.append(Curve(label, colour, mean - truth, np.sqrt(variance)))
        nees.append(Curve(label, colour, position_nees(estimate, drive.truth)))
    return {
        "trajectory": paths(truth, routes[:2], drive.beacons),
        "errors": errors_with_bands(clock, errors, ("x", "y")),
        "consistency": consistency_over_time(clock, nees, AVERAGED),
    }


def words(outcome: Outcome) -> dict[str, object]:
    """The constants of the drive's model by name."""
    return {"constants": robot.Constants(robot.DRIVES[outcome.drive.name].gyro_rate)._asdict()}


example = Study(
    "demo",
    Setting,
    compute.compute,
    4,
    figures,
    words,
    data=compute.data,
    needs=NEEDS,
    files=Setting.files,
)
run = example.run
