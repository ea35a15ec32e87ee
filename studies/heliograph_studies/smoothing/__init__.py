"""What waiting is worth: smoothing behind fading links and relays, from a lag of one step to a whole run."""

import warnings
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import heliograph as hg
from heliograph.report.figures import AMBER, BLUE, GREEN, MUTED, PURPLE, VERMILION
from heliograph_studies import Stages, Study, Unlisted, check_fields
from heliograph_studies.curves import Curve, Panel, curves_over_time, errors_with_bands
from heliograph_studies.successive_relays import setting as successive_relays

STEPS = 100
STEADY = 1000  # steps after which the relays' receiver does not change any more
PENDULUM_STEP = 0.05  # s
SWINGS = {"tame": ((0.4, 0.0), 0.05), "large": ((2.8, 0.0), 0.3)}  # mean angle and speed at the start, variance of both


@dataclass(frozen=True)
class Setting:
    """How much is simulated."""

    runs: int = 1000
    seed: int = 0

    def __post_init__(self) -> None:
        check_fields(self, runs=2)


def moving_point() -> tuple[hg.LinearPlant, hg.LinearSensor, hg.random_affine.AbstractRandomAffine]:
    """Places and speeds in two directions, both places sent with one gain over two Rayleigh hops."""
    direction = np.array([[1.0, 1.0], [0.0, 1.0]])
    noise = 1e-3 * np.array([[1 / 3, 1 / 2], [1 / 2, 1.0]])
    plant = hg.LinearPlant(
        np.kron(np.eye(2), direction),
        np.kron(np.eye(2), noise),
        [0.0, 0.1, 0.0, -0.05],
        np.diag([1.0, 0.01, 1.0, 0.01]),
        states=["x", "vx", "y", "vy"],
    )
    sensor = hg.LinearSensor(np.eye(4)[[0, 2]], 0.25)
    hops = [
        hg.hop(hg.Rayleigh(0.8), 0.02, dimension=2),
        hg.hop(hg.Rayleigh(0.8), 0.01, amplification=1.2, dimension=2),
    ]
    return plant, sensor, hg.amplify_and_forward(hops)


def swing(x: jax.Array, u: jax.Array) -> jax.Array:
    """Angle and its speed over one step."""
    return jnp.stack([x[0] + PENDULUM_STEP * x[1], x[1] - PENDULUM_STEP * 9.81 * jnp.sin(x[0])])


def sine(x: jax.Array) -> jax.Array:
    """How far the pendulum is aside."""
    return jnp.sin(x[:1])


def pendulum(name: str) -> hg.Network:
    """A pendulum that starts tame or with a large swing, seen from below through a link of three gains."""
    (angle, speed), variance = SWINGS[name]
    h = PENDULUM_STEP
    noise = 0.01 * np.array([[h**3 / 3, h**2 / 2], [h**2 / 2, h]])
    plant = hg.Plant(swing, noise, [angle, speed], variance * np.eye(2), states=["angle", "speed"])
    sensor = hg.Sensor(sine, noise=0.02, outputs=["aside"])
    link = hg.hop(hg.Discrete([0.7, 1.0, 1.2], [0.2, 0.6, 0.2]), 0.01)
    return hg.Network(plant, {"node": hg.Node(sensor, link, {"extended": hg.extended_filter(plant, sensor, link)})})


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
    filtered, smoothed, lagged = stages("a moving point", known_covariances)
    traces = stages("relays in turn", relay_traces)
    measured, shown = stages("simulating the moving point", lambda: simulated(setting))
    swings = stages("simulating pendulums", lambda: {name: swung(name, setting) for name in SWINGS})
    at = LAG_STEP - 1
    lags = {lag: float(places(covariance)[at] / places(filtered)[at]) for lag, covariance in lagged.items()}
    return Outcome(
        {"filter": over_time(filtered), "smoother": over_time(smoothed), "lag": lags},
        {"lag": traces}, measured, swings, filtered, smoothed, lagged, shown,
    )  # fmt: skip


def known_covariances() -> tuple[np.ndarray, np.ndarray, dict[int, np.ndarray]]:
    """Covariances of the filter, of the smoother given all data, and of those of fixed lags; no data change them."""
    _, steps = hg.smoothing.smoother_steps(hg.linear_filter(*moving_point()), np.zeros((STEPS, 2)))
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
    gains = hg.relays.local_error_design(network, STEADY).gains
    receiver = hg.filters.LinearSystemFilter(hg.relays.receiver_system(network, gains))
    _, steps = hg.smoothing.smoother_steps(receiver, np.zeros((STEADY, 1)))
    even = (STEADY - max(RELAY_LAGS) - 2) // 2 * 2
    late = jax.tree.map(lambda leaf: leaf[even - 1 :], steps)  # x_1 stands at place 0
    result = {}
    for lag in RELAY_LAGS:
        trace = np.trace(hg.smoothing.FixedLag(lag).estimates(late).covariance, axis1=1, axis2=2)
        result[lag] = {"even": float(trace[0]), "odd": float(trace[1])}
    return result


def simulated(setting: Setting) -> tuple[dict[str, dict[str, float]], hg.Record]:
    """Error of filter and smoother over the runs, NEES, which is 1 if the claim is exact, and the first run."""
    plant, sensor, channel = moving_point()
    network = hg.Network(
        plant, {"node": hg.Node(sensor, channel, {"linear": hg.linear_filter(plant, sensor, channel)})}
    )
    record = hg.monte_carlo(network, STEPS, setting.runs, setting.seed, smooth=INTERVAL)
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
        network = pendulum(name)
        sums = hg.monte_carlo(network, STEPS, setting.runs, setting.seed, keep=hg.Statistics(), smooth=INTERVAL)
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


COLOURS = dict(zip(LAGS, (AMBER, PURPLE, GREEN, VERMILION), strict=True))
SHOWN_LAGS = (1, 5, 20)


def figures(outcome: Outcome) -> dict[str, Figure]:
    """Deviations over time, and the errors of one run."""
    curves = [Curve("filter", MUTED, _deviation(outcome.filtered))]
    curves += [Curve(f"{lag} later", COLOURS[lag], _deviation(outcome.lagged[lag])) for lag in SHOWN_LAGS]
    curves.append(Curve("all data", BLUE, _deviation(outcome.smoothed)))
    steps = np.arange(1, len(outcome.filtered) + 1)
    return {
        "deviations": curves_over_time(steps, [Panel("standard deviation", curves)]),
        "errors": _errors(outcome.shown),
    }


def _errors(run: hg.Record) -> Figure:
    """Errors of one run within what filter and smoother claim."""
    curves = []
    for name, part, colour in (("filter", run, MUTED), ("smoother", run.smoothed or run, BLUE)):
        deviation = np.sqrt(np.diagonal(part.estimates["node"]["linear"].covariance, axis1=1, axis2=2))
        curves.append(Curve(name, colour, part.errors("node", "linear")[:, [0, 2]], deviation[:, [0, 2]]))
    return errors_with_bands(run.time, curves, ["x", "y"])


def _deviation(covariance: np.ndarray) -> np.ndarray:
    return np.asarray(np.sqrt(places(covariance)))


example = Study("smoothing", Setting, compute, 4, figures)
run = example.run
