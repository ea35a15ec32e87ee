"""What a smoother claims before any data, what simulation says of it, and a filter that should not be smoothed."""

import warnings
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

import heliograph as hg
from heliograph_studies.outcome import Unlisted
from heliograph_studies.smoothing import setting as models
from heliograph_studies.smoothing.setting import Setting
from heliograph_studies.stages import Stages
from heliograph_studies.successive_relays import setting as successive_relays

SHOWN = (10, 50, 90)
LAGS, LAG_STEP = (1, 5, 10, 20), 50
RELAY_LAGS = (0, 1, 2, 5, 100)
INTERVAL = hg.smoothing.FixedInterval()


@dataclass(frozen=True)
class Outcome:
    """What smoothing is worth: deviations of the place at some steps, ratios of variances and traces by lag, and runs.

    filtered, smoothed: covariances (time, n, n) of the moving point; lagged: the same by lag; shown: one run of it.
    """

    constant_velocity: dict[str, dict[Any, float]]
    successive_relays: dict[str, dict[int, dict[str, float]]]
    measured: dict[str, dict[str, float]]
    pendulum: dict[str, dict[str, float | bool]]
    filtered: Unlisted[np.ndarray]
    smoothed: Unlisted[np.ndarray]
    lagged: Unlisted[dict[int, np.ndarray]]
    shown: Unlisted[hg.Record]


def compute(setting: Setting, stages: Stages) -> Outcome:
    """All of it."""
    filtered, smoothed, lagged = stages("a moving point", moving_point)
    traces = stages("relays in turn", relay_traces)
    measured, shown = stages("simulating the moving point", lambda: simulated(setting))
    swings = stages("simulating pendulums", lambda: {name: swung(name, setting) for name in models.SWINGS})
    at = LAG_STEP - 1
    lags = {lag: float(places(covariance)[at] / places(filtered)[at]) for lag, covariance in lagged.items()}
    return Outcome(
        {"filter": over_time(filtered), "smoother": over_time(smoothed), "lag": lags},
        {"lag": traces}, measured, swings, filtered, smoothed, lagged, shown,
    )  # fmt: skip


def moving_point() -> tuple[np.ndarray, np.ndarray, dict[int, np.ndarray]]:
    """Covariances of the filter, of the smoother given all data, and of those of fixed lags; no data change them."""
    _, steps = hg.smoothing.smoother_steps(hg.linear_filter(*models.moving_point()), np.zeros((models.STEPS, 2)))
    lagged = {lag: np.asarray(hg.smoothing.FixedLag(lag).estimates(steps).covariance) for lag in LAGS}
    return np.asarray(steps.covariance), np.asarray(INTERVAL.estimates(steps).covariance), lagged


def places(covariance: np.ndarray) -> np.ndarray:
    """P_xx + P_yy over time."""
    return np.asarray(covariance[:, 0, 0] + covariance[:, 2, 2])


def over_time(covariance: np.ndarray) -> dict[Any, float]:
    """Deviations of the place at the steps that are shown, and the mean trace."""
    mean = float(np.trace(covariance, axis1=1, axis2=2).mean())
    return {k: float(np.sqrt(places(covariance)[k - 1])) for k in SHOWN} | {"mean_trace": mean}


def relay_traces() -> dict[int, dict[str, float]]:
    """tr Cov(x_k | z_1 ... z_{k + lag}) at an even and an odd step of the receiver in its steady state."""
    network = successive_relays.Setting().network()
    gains = hg.relays.local_error_design(network, models.STEADY).gains
    receiver = hg.filters.LinearSystemFilter(hg.relays.receiver_system(network, gains))
    _, steps = hg.smoothing.smoother_steps(receiver, np.zeros((models.STEADY, 1)))
    even = (models.STEADY - max(RELAY_LAGS) - 2) // 2 * 2
    result = {}
    for lag in RELAY_LAGS:
        trace = np.trace(hg.smoothing.FixedLag(lag).estimates(steps).covariance, axis1=1, axis2=2)
        result[lag] = {"even": float(trace[even - 1]), "odd": float(trace[even])}  # x_1 stands at place 0
    return result


def simulated(setting: Setting) -> tuple[dict[str, dict[str, float]], hg.Record]:
    """Error of filter and smoother over the runs, NEES, which is 1 if the claim is exact, and the first run."""
    plant, sensor, channel = models.moving_point()
    network = hg.Network(
        plant, {"node": hg.Node(sensor, channel, {"linear": hg.linear_filter(plant, sensor, channel)})}
    )
    record = hg.monte_carlo(network, models.STEPS, setting.runs, setting.seed, smooth=INTERVAL)
    assert record.smoothed is not None  # by `smooth=` above
    result = {}
    for name, part in {"filter": record, "smoother": record.smoothed}.items():
        errors = hg.simulation.error_statistics(part, "node", "linear")
        nees, low, high = errors.nees_per_dimension()
        result[name] = {"rmse": errors.rmse()[0], "nees": nees, "nees_low": low, "nees_high": high}
    return result, first_run(record)


def swung(name: str, setting: Setting) -> dict[str, float | bool]:
    """Errors of the angle and NEES of an extended filter and of its smoother, and whether it warned."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        network = models.pendulum(name)
        sums = hg.monte_carlo(network, models.STEPS, setting.runs, setting.seed, keep=hg.Statistics(), smooth=INTERVAL)
    assert sums.smoothed is not None  # by `smooth=` above
    result: dict[str, float | bool] = {}
    for which, part in {"filter": sums, "smoother": sums.smoothed}.items():
        errors = part["node"]["extended"]
        result[f"{which}_angle"] = float(np.sqrt(errors.actual()[:, 0, 0].mean()))
        result[f"{which}_nees"] = errors.nees_per_dimension()[0]
    return {**result, "warned": any("squared innovations" in str(warning.message) for warning in caught)}


def first_run(record: hg.Record) -> hg.Record:
    """The first run of a record as a record of its own."""

    def first(part: hg.Record) -> hg.Record:
        estimates = {
            node: {name: hg.model.Estimate(e.mean[0], e.covariance[0], e.claim) for name, e in filters.items()}
            for node, filters in part.estimates.items()
        }
        received = {node: z[0] for node, z in part.measurements.items()}
        truth = None if part.truth is None else part.truth[0]
        return replace(part, truth=truth, measurements=received, estimates=estimates, smoothed=None)

    assert record.smoothed is not None
    return replace(first(record), smoothed=first(record.smoothed))
