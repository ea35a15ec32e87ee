"""What a smoother claims before any data, what simulation says of it, and a filter that should not be smoothed."""

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

import heliograph as hg
from heliograph_studies.smoothing import setting

SHOWN = (10, 50, 90)
LAGS, LAG_STEP = (1, 5, 10, 20), 50
RELAY_LAGS = (0, 1, 2, 5, 100)
RUNS = 1000
INTERVAL = hg.smoothing.FixedInterval()
STAGES = 4


@dataclass(frozen=True)
class Outcome:
    """Covariances of the moving point over time, the relays' traces by lag, what was measured, and a run to look at.

    Shapes: filtered, smoothed (time, n, n), lagged[lag] alike; relays[lag] of an even and an odd step; run: a record.
    """

    filtered: np.ndarray
    smoothed: np.ndarray
    lagged: dict[int, np.ndarray]
    relays: dict[int, dict[str, float]]
    measured: dict[str, dict[str, float]]
    pendulum: dict[str, dict[str, float]]
    warned: dict[str, bool]
    run: hg.Record


def compute(seed: int, advance: Callable[[str], None] = lambda what: None) -> Outcome:
    """Everything; `advance` is told what begins."""
    advance("a moving point")
    plant, sensor, channel = setting.moving_point()
    item = hg.linear_filter(plant, sensor, channel)
    _, steps = hg.smoothing.retained_steps(item, np.zeros((setting.STEPS, 2)))  # no data change a covariance
    smoothed = np.asarray(INTERVAL.estimates(steps).covariance)
    lagged = {lag: np.asarray(hg.smoothing.FixedLag(lag).estimates(steps).covariance) for lag in LAGS}
    advance("relays in turn")
    relays = relay_traces()
    advance("simulating the moving point")
    network = hg.Network(plant, {"node": hg.Node(sensor, channel, {"linear": item})})
    record = hg.monte_carlo(network, setting.STEPS, RUNS, seed, smooth=INTERVAL)
    advance("simulating pendulums")
    swings, warned = {}, {}
    for name in setting.SWINGS:
        swings[name], warned[name] = swung(name, seed)
    return Outcome(
        np.asarray(steps.covariance), smoothed, lagged, relays, measured(record), swings, warned, first_run(record)
    )


def relay_traces() -> dict[int, dict[str, float]]:
    """tr Cov(x_k | z_1 ... z_{k + lag}) at an even and an odd step of the receiver that has settled."""
    network = setting.relays_in_turn()
    gains = hg.relays.own_error_design(network, setting.STEADY).gains
    receiver = hg.filters.LinearSystemFilter(hg.relays.receiver_system(network, gains))
    _, steps = hg.smoothing.retained_steps(receiver, np.zeros((setting.STEADY, 1)))
    even = (setting.STEADY - max(RELAY_LAGS) - 2) // 2 * 2
    result = {}
    for lag in RELAY_LAGS:
        trace = np.trace(hg.smoothing.FixedLag(lag).estimates(steps).covariance, axis1=1, axis2=2)
        result[lag] = {"even": float(trace[even - 1]), "odd": float(trace[even])}  # x_1 stands at place 0
    return result


def measured(record: hg.Record) -> dict[str, dict[str, float]]:
    """Error of filter and smoother over the runs, and NEES, which is 1 if the claim is exact."""
    assert record.smoothed is not None  # by `smooth=` above
    result = {}
    for name, part in {"filter": record, "smoother": record.smoothed}.items():
        found = hg.simulation.error_statistics(part, "node", "linear")
        nees, low, high = found.nees_per_dimension()
        result[name] = {"rmse": found.rmse()[0], "nees": nees, "nees_low": low, "nees_high": high}
    return result


def swung(name: str, seed: int) -> tuple[dict[str, float], bool]:
    """Errors of the angle and NEES of an extended filter and of its smoother, and whether it warned."""
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        network = setting.pendulum(name)
        found = hg.monte_carlo(network, setting.STEPS, RUNS, seed, keep=hg.Statistics(), smooth=INTERVAL)
    assert found.smoothed is not None  # by `smooth=` above
    result = {}
    for which, part in {"filter": found, "smoother": found.smoothed}.items():
        one = part["node"]["extended"]
        result[f"{which}_angle"] = float(np.sqrt(one.actual()[:, 0, 0].mean()))
        result[f"{which}_nees"] = one.nees_per_dimension()[0]
    return result, any("squared innovations" in str(one.message) for one in heard)


def first_run(record: hg.Record) -> hg.Record:
    """The first run of a record as a record of its own."""

    def one(part: hg.Record) -> hg.Record:
        estimates = {
            node: {name: hg.model.Estimate(e.mean[0], e.covariance[0], e.claim) for name, e in filters.items()}
            for node, filters in part.estimates.items()
        }
        heard = {node: z[0] for node, z in part.measurements.items()}
        truth = None if part.truth is None else part.truth[0]
        return replace(part, truth=truth, measurements=heard, estimates=estimates, smoothed=None)

    assert record.smoothed is not None
    return replace(one(record), smoothed=one(record.smoothed))
