"""A house whose rooms report on change over a lossy link: what usual recipes claim, what is true, messages saved."""

from collections.abc import Callable
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import heliograph as hg
from heliograph.numerics.check import TINY
from heliograph.planning.messages import least_error, simulated_rate
from heliograph.report.figures import AMBER, BLUE, GREEN, MUTED, PURPLE, VERMILION
from heliograph_studies import Stages, Study, check_fields

ROOMS = ("hall", "kitchen", "living room", "study", "bedroom", "nursery", "bath", "attic", "cellar", "garage")


@dataclass(frozen=True)
class Setting:
    """Sensors that measure each minute and report on change, over a link that fails for a while at a time.

    delta: change in kelvin that is reported; heartbeat: minutes after which a sensor reports in any case. noise: of a
    sensor, a deviation in kelvin. fail, recover: of the link, at each minute; it loses all while it is down. hours: of
    each run.
    """

    delta: float = 0.5
    heartbeat: int = 120
    noise: float = 0.1
    fail: float = 0.02
    recover: float = 0.1
    hours: int = 12
    runs: int = 32
    seed: int = 0

    def __post_init__(self) -> None:
        probability = (TINY, 1.0)
        check_fields(self, delta=(TINY,), noise=(TINY,), fail=probability, recover=probability)
        check_fields(self, heartbeat=1, hours=1, runs=2)

    @property
    def trigger(self) -> hg.SendOnDelta:
        """When a sensor reports."""
        return hg.SendOnDelta(self.delta, heartbeat=self.heartbeat)

    @property
    def link(self) -> hg.random_affine.Modes:
        """What is between a sensor and the house's computer."""
        up, down = (hg.erasure(hg.perfect(), arrival) for arrival in (1.0, 0.0))
        return hg.gilbert_elliott(up, down, self.fail, self.recover)

    @property
    def sensor(self) -> hg.LinearSensor:
        """A thermometer."""
        return hg.LinearSensor([[1.0]], self.noise**2, outputs=["temperature"])


def rooms() -> dict[str, hg.LinearPlant]:
    """Temperatures about their mean: from half an hour to five hours to follow, deviations of 0.9 to 1.8 K."""
    minutes, deviations = np.geomspace(30, 300, len(ROOMS)), np.linspace(0.9, 1.8, len(ROOMS))
    results = {}
    for name, time, deviation in zip(ROOMS, minutes, deviations, strict=True):
        a, variance = np.exp(-1 / time), deviation**2
        noise = variance * (1 - a * a)
        results[name] = hg.LinearPlant([[a]], [[noise]], [0.0], [[variance]], states=["temperature"])
    return results


RECIPES = ("missing", "last", "one", "sum")
DELTAS = (0.25, 0.5, 0.8, 1.2, 1.8)  # kelvin
WEIGHTS = (8.0, 2.0, 0.5, 0.12, 0.03)  # of the stochastic rule, per square kelvin
PERIODS = (3, 8, 20, 50, 100)  # minutes
TYPICAL = "nursery"

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Score:
    """Root mean square error in kelvin, and mean squared error in units of the claimed variance (1 if it is right)."""

    error: float
    nees: float


@dataclass(frozen=True)
class Outcome:
    """Scores by recipe over all rooms and in each; messages an hour of a room, and the share that was lost.

    curves: of each rule messages an hour and the error of the estimator that knows the rule, no losses; bound: the
    least error at the rates of "on change". saved: share of messages that on change saves against a schedule whose
    error is as small.
    """

    scores: dict[str, Score]
    rooms: dict[str, dict[str, Score]]
    messages: float
    lost: float
    curves: dict[str, dict[str, list[float]]]
    bound: list[float]
    saved: float


def compute(setting: Setting, stages: Stages) -> Outcome:
    """Everything."""
    result = stages("ten rooms", lambda: house(setting, stages.progress))
    curves, bound = stages("messages against error", lambda: against_messages(setting))
    whole = {
        recipe: Score(
            float(np.sqrt(np.mean([room[recipe].error ** 2 for room in result[0].values()]))),
            float(np.mean([room[recipe].nees for room in result[0].values()])),
        )
        for recipe in RECIPES
    }
    return Outcome(whole, *result, curves, bound, messages_saved(curves))


def house(setting: Setting, progress: Progress) -> tuple[dict[str, dict[str, Score]], float, float]:
    """Scores of every recipe in every room; messages an hour, and the share that was lost."""
    scores, sent, lost = {}, 0.0, 0.0
    for i, (name, plant) in enumerate(rooms().items()):
        scores[name], transmissions = room(setting, plant, setting.seed + i)
        sent += float(np.mean(transmissions != 0)) / len(rooms())
        lost += float(np.mean(transmissions < 0)) / len(rooms())
        progress(i + 1, len(rooms()))
    return scores, 60 * sent, lost / sent


def room(setting: Setting, plant: hg.LinearPlant, seed: int) -> tuple[dict[str, Score], np.ndarray]:
    """Scores of every recipe in a room, and what its sensor transmitted."""
    # Each recipe as a filter of the same room.
    parts = plant, setting.sensor, setting.link, setting.trigger
    filters = {
        "missing": hg.kalman_filter(plant, setting.sensor),
        "one": hg.event_filter(*parts, known=1, lost=1),
        "sum": hg.event_filter(*parts),
    }
    network = hg.Network(plant, {"room": hg.Node(setting.sensor, setting.link, filters, trigger=setting.trigger)})
    record = hg.monte_carlo(network, 60 * setting.hours, setting.runs, seed)
    # Squared error over the claimed variance, by recipe.
    scores = {}
    for name in filters:
        squares = record.errors("room", name)[..., 0] ** 2
        scores[name] = score(squares, np.asarray(record.estimates["room"][name].covariance)[..., 0, 0])
    assert record.truth is not None  # it was simulated
    # The last value as a measurement is no filter of the library.
    mean, variance = last_value(setting, plant, record.measurements["room"][..., 0])
    scores["last"] = score((record.truth[..., 0] - mean) ** 2, variance)
    return scores, record.transmissions["room"]


def score(squares: np.ndarray, variance: np.ndarray) -> Score:
    """Of squared errors and claimed variances."""
    return Score(float(np.sqrt(squares.mean())), float((squares / variance).mean()))


def last_value(setting: Setting, plant: hg.LinearPlant, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The recipe that takes the last value as a measurement at each step, of the variance R + delta^2 / 3."""
    a, q = float(np.asarray(plant.matrix)[0, 0]), float(np.asarray(plant.noise_covariance(jnp.zeros(0)))[0, 0])
    mean, variance = np.zeros(len(z)), np.full(len(z), float(np.asarray(plant.initial_covariance)[0, 0]))
    held, means, variances = np.full(len(z), np.nan), [], []
    for row in z.T:
        came = ~np.isnan(row)
        held = np.where(came, row, held)
        mean, variance = a * mean, a * a * variance + q
        noise = setting.noise**2 + np.where(came, 0.0, setting.delta**2 / 3)
        gain = np.where(np.isnan(held), 0.0, variance / (variance + noise))
        mean, variance = mean + gain * (np.nan_to_num(held) - mean), variance * (1 - gain)
        means.append(mean)
        variances.append(variance)
    return np.array(means).T, np.array(variances).T


def against_messages(setting: Setting) -> tuple[dict[str, dict[str, list[float]]], list[float]]:
    """Of each rule in a typical room messages an hour and errors in kelvin, and the least errors, without losses."""
    plant, sensor = rooms()[TYPICAL], setting.sensor
    # Each rule at several thresholds.
    rules: dict[str, list[hg.model.AbstractTrigger]] = {
        "periodic": [hg.Periodic(period) for period in PERIODS],
        "on change": [hg.SendOnDelta(delta) for delta in DELTAS],
        "prediction error": [hg.SendOnPredictionError(delta) for delta in DELTAS],
        "by chance": [hg.StochasticTrigger(weight, reference="prediction") for weight in WEIGHTS],
    }
    curves, steps = {}, 60 * setting.hours
    for name, triggers in rules.items():
        results = [
            simulated_rate(plant, sensor, hg.perfect(), rule, setting.runs, steps, setting.seed) for rule in triggers
        ]
        curves[name] = {
            "messages": [60 * item.rate for item in results],
            "error": [float(np.sqrt(item.error[0])) for item in results],
        }
    # Least error of any rule at the rates of on change.
    rates = [count / 60 for count in curves["on change"]["messages"]]
    return curves, [float(np.sqrt(least_error(plant, sensor, rate))) for rate in rates]


def messages_saved(curves: dict[str, dict[str, list[float]]]) -> float:
    """Share of a schedule's messages that on change saves at the same error: the median over its thresholds."""
    schedule, changes = curves["periodic"], curves["on change"]
    needed = np.exp(np.interp(changes["error"], schedule["error"], np.log(schedule["messages"])))
    return float(np.median(1 - np.array(changes["messages"]) / needed))


ROWS = {  # recipe: how it is called, and its colour
    "missing": ("silence taken for missing", AMBER),
    "last": ("the last value as a measurement", VERMILION),
    "one": ("event filter, one and one", GREEN),
    "sum": ("event filter", BLUE),
}
RULES = {"periodic": MUTED, "on change": BLUE, "prediction error": GREEN, "by chance": PURPLE}


def figures(outcome: Outcome) -> dict[str, Figure]:
    """Claims in every room, and error against messages, by file name."""
    return {"rooms": _rooms(outcome), "messages": _messages(outcome)}


def _rooms(outcome: Outcome) -> Figure:
    figure = Figure(figsize=(7.2, 3.2), layout="constrained")
    axes, place = figure.subplots(), np.arange(len(outcome.rooms))
    for recipe, (label, colour) in ROWS.items():
        axes.plot(place, [room[recipe].nees for room in outcome.rooms.values()], "o-", color=colour, label=label)
    axes.axhline(1.0, color=MUTED, linewidth=0.8)
    axes.set_xticks(place, list(outcome.rooms), rotation=30, ha="right")
    axes.set(yscale="log", ylabel="squared error over claimed")
    axes.set_yticks((0.5, 1, 2, 4))
    axes.yaxis.set_major_formatter("{x:g}")
    axes.minorticks_off()
    axes.legend(fontsize="small", ncols=2)
    return figure


def _messages(outcome: Outcome) -> Figure:
    figure = Figure(figsize=(7.2, 3.4), layout="constrained")
    axes = figure.subplots()
    for rule, colour in RULES.items():
        curve = outcome.curves[rule]
        axes.plot(curve["messages"], curve["error"], "o-", color=colour, label=rule)
    axes.plot(outcome.curves["on change"]["messages"], outcome.bound, "--", color=MUTED, label="least error")
    axes.set(xscale="log", xlabel="messages an hour", ylabel="error (K)")
    axes.xaxis.set_major_formatter("{x:g}")
    axes.legend(fontsize="small")
    return figure


example = Study("event-triggered", Setting, compute, 2, figures)
run = example.run
