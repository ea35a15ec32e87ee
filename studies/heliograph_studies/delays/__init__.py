"""Data that come late, with time stamps or without, and clocks that are wrong: what filters claim, and what is true."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from matplotlib.figure import Figure

import heliograph as hg
from heliograph.report.figures import AMBER, BLUE, GREEN, INK, PURPLE, VERMILION
from heliograph_studies import Inline, Stages, Study, Unlisted, check_fields
from heliograph_studies.curves import Curve, Panel, curves_over_time

STEPS = 60
LAW = hg.Discrete([0, 1, 2], [0.4, 0.35, 0.25])
NOISE = 0.05 * np.array([[1 / 3, 1 / 2], [1 / 2, 1.0]])
PLANT = hg.LinearPlant([[1.0, 1.0], [0.0, 0.95]], NOISE, [1.0, 0.5], np.diag([1.0, 0.2]))
SENSOR = hg.LinearSensor([[1.0, 0.0]], 0.3)
LINK = hg.hop(1.0, 0.05)
LINKS: Mapping[str, hg.random_affine.AbstractRandomAffine] = {
    "uninformed": hg.model.delayed(LINK, LAW),
    "informed": hg.model.delayed(LINK, LAW, timestamped=True),
    "constant": hg.model.delayed(LINK, 1),
    "none": LINK,
}

CLOCK_STEPS, STEP = 300, 0.5
CLOCK = hg.model.Clock(offset=0.5, drift=2e-3)
SPEED_NOISE = 0.02 * np.array([[STEP**3 / 3, STEP**2 / 2], [STEP**2 / 2, STEP]])
POSITION = hg.LinearSensor([[1.0, 0.0]], 0.04)


@dataclass(frozen=True)
class Setting:
    """How much is simulated: runs of links that are late, and of clocks."""

    late_runs: int = 4096
    clock_runs: int = 1024
    seed: int = 0

    def __post_init__(self) -> None:
        check_fields(self, late_runs=2, clock_runs=2)


def moving(
    speed: float, noise: float = 1.0, spread: tuple[float, float] = (1.0, 0.01)
) -> tuple[hg.LinearPlant, dict[str, hg.model.AbstractSensor]]:
    """A plant that moves along a line, seen by a node with a true clock and by one without."""
    plant = hg.LinearPlant([[1.0, STEP], [0.0, 1.0]], noise * SPEED_NOISE, [0.0, speed], np.diag(spread))
    nodes = {"true": POSITION, "wrong": POSITION}
    larger, sensors = hg.model.with_clocks(plant, nodes, {"wrong": CLOCK}, [[0.0, 1.0], [0.0, 0.0]], STEP)
    assert isinstance(larger, hg.LinearPlant)
    return larger, dict(sensors)


def listeners(
    plant: hg.LinearPlant, sensors: Mapping[str, hg.model.AbstractSensor]
) -> dict[str, hg.filters.AbstractFilter]:
    """Filters that receive both nodes, and two that receive the wrong clock alone."""
    joint, both = hg.model.joint_sensor(sensors), hg.parallel([hg.perfect(), hg.perfect()])
    alone = hg.parallel([hg.model.silent(1, 1, 1.0), hg.perfect()])
    blind = hg.LinearSensor([[1.0, 0, 0, 0], [1.0, 0, 0, 0]], 0.04 * np.eye(2))
    exact = hg.filters.PolynomialMoments(2)
    return {
        "ignored": hg.linear_filter(plant, blind, both),
        "estimated": hg.filters.gaussian_filter(plant, joint, both, exact),
        "guarded": hg.filters.clock_filter(plant, joint, both, ["wrong"]),
        "estimated_alone": hg.filters.gaussian_filter(plant, joint, alone, exact),
        "guarded_alone": hg.filters.clock_filter(plant, joint, alone, ["wrong"]),
    }


HALF = slice(STEPS // 2, None)  # the steps that are averaged
Errors = Mapping[str, float | np.ndarray]


@dataclass(frozen=True)
class Late:
    """Variance of the position: claimed and mean square error, means over the second half of the steps, and over time.

    true_se: the standard error of `true`; before_data: the errors before any data, where no gain depends on them.
    """

    claim: str
    claimed: float
    true: float
    true_se: float
    claimed_over_time: np.ndarray
    true_over_time: np.ndarray
    before_data: Inline[Errors]

    @property
    def error(self) -> float:
        """Mean square error, before data where that is known, else as simulated."""
        return float(self.before_data.get("true_before_data", self.true))

    @property
    def error_over_time(self) -> np.ndarray:
        """The same at each step."""
        return np.asarray(self.before_data.get("true_before_data_over_time", self.true_over_time))


@dataclass(frozen=True)
class Deviation:
    """Root mean square error and claimed deviation at the last step, and at all of them."""

    true: float
    claimed: float
    true_over_time: Unlisted[np.ndarray]
    claimed_over_time: Unlisted[np.ndarray]


Clocks = dict[str, dict[str, Deviation]]  # by filter, of position, offset and drift


@dataclass(frozen=True)
class Outcome:
    """Filters behind late links, what one of past states claims, and filters of clocks by situation."""

    runs: dict[str, int]
    steps: dict[str, int]
    delays: dict[str, Late]
    past_states_claim: float
    clocks: dict[str, Clocks]


def compute(setting: Setting, stages: Stages) -> Outcome:
    """Everything."""
    simulated = stages("links that are late", lambda: late_scores(setting))
    moved, still = moving(1.0), moving(0.0, noise=0.0, spread=(0.0, 0.0))
    believed = moving(0.0, spread=(1.0, 0.1))  # at rest, but the filters believe in motion
    in_motion = stages("a wrong clock, in motion", lambda: clock_scores(*moved, listeners(*moved), setting))
    at_rest = stages("at rest", lambda: clock_scores(*still, listeners(*believed), setting))
    delays, claim = stages("before data", lambda: (before_data(simulated), trap()))
    alone = {name.removesuffix("_alone"): score for name, score in in_motion.items() if name.endswith("_alone")}
    clocks = {"moving": in_motion, "at_rest": at_rest}
    clocks = {kind: {n: s for n, s in scores.items() if not n.endswith("_alone")} for kind, scores in clocks.items()}
    return Outcome(
        {"delays": setting.late_runs, "clocks": setting.clock_runs}, {"delays": STEPS, "clocks": CLOCK_STEPS},
        delays, claim, clocks | {"no_true_clock": alone},
    )  # fmt: skip


def late_filters() -> dict[str, dict[str, hg.filters.AbstractFilter]]:
    """What listens behind each link."""
    filters: dict[str, dict[str, hg.filters.AbstractFilter]] = {
        name: {name: hg.linear_filter(PLANT, SENSOR, link)} for name, link in LINKS.items()
    }
    filters["uninformed"]["as_current"] = hg.filters.as_current_filter(PLANT, SENSOR, LINKS["uninformed"])
    return filters


def late_scores(setting: Setting) -> dict[str, Late]:
    """Of each filter behind a late link, as simulated."""
    nodes = {name: hg.Node(SENSOR, LINKS[name], filters) for name, filters in late_filters().items()}
    record = hg.monte_carlo(hg.Network(PLANT, nodes), STEPS, setting.late_runs, setting.seed)
    result = {}
    for node, filters in record.estimates.items():
        for name, estimate in filters.items():
            squares, claimed = variances(record, node, name, 0)
            by_run, true = squares[:, HALF].mean(axis=1), squares.mean(axis=0)
            error = float(by_run.std() / np.sqrt(len(by_run)))
            means = float(claimed[HALF].mean()), float(true[HALF].mean())
            result[name] = Late(estimate.claim, *means, error, claimed, true, {})
    return result


def variances(record: hg.Record, node: str, name: str, state: int) -> tuple[np.ndarray, np.ndarray]:
    """Squared errors of a state (runs, steps), and the variance that is claimed of it, its mean over the runs."""
    squares = record.errors(node, name)[..., state] ** 2
    claimed = np.asarray(record.estimates[node][name].covariance)[..., state, state]
    return squares, np.broadcast_to(claimed, squares.shape).mean(axis=0)


def before_data(simulated: Mapping[str, Late]) -> dict[str, Late]:
    """The same with true errors before any data, of filters whose gains depend on none."""
    result = dict(simulated)
    for node in ("uninformed", "none"):
        for name, item in late_filters()[node].items():
            true = hg.filters.true_error(item, PLANT, SENSOR, LINKS[node], STEPS).true[:, 0, 0]
            mean = float(true[HALF].mean())
            errors: Errors = {"true_before_data": mean, "true_before_data_over_time": true}
            result[name] = replace(simulated[name], before_data=errors)
    return result


def clock_scores(
    plant: hg.LinearPlant,
    sensors: Mapping[str, hg.model.AbstractSensor],
    filters: Mapping[str, hg.filters.AbstractFilter],
    setting: Setting,
) -> Clocks:
    """Of each filter: position, present offset and drift."""
    nodes = {name: hg.Node(sensor, hg.perfect(), {}) for name, sensor in sensors.items()}
    record = hg.monte_carlo(hg.Network(plant, nodes, filters), CLOCK_STEPS, setting.clock_runs, setting.seed)
    parts = {"position": 0, "offset": 2, "drift": 3}
    return {name: {part: deviation(record, name, i) for part, i in parts.items()} for name in record.estimates["fused"]}


def deviation(record: hg.Record, name: str, state: int) -> Deviation:
    """Of one state and filter."""
    squares, claimed = variances(record, "fused", name, state)
    true, claims = np.sqrt(squares.mean(axis=0)), np.sqrt(claimed)
    return Deviation(float(true[-1]), float(claims[-1]), true, claims)


def trap() -> float:
    """What a filter claims that holds past states in place of past signals: one y received twice has two noises."""
    noise, spread = np.zeros((6, 6)), np.zeros((6, 6))
    noise[:2, :2], spread[:2, :2] = NOISE, PLANT.initial_covariance
    moved = np.block([[np.asarray(PLANT.matrix), np.zeros((2, 4))], [np.eye(4), np.zeros((4, 2))]])
    plant = hg.LinearPlant(moved, noise, [*PLANT.initial_mean, *np.zeros(4)], spread)
    sensor = hg.LinearSensor(np.kron(np.eye(3), SENSOR.matrix), 0.3 * np.eye(3))
    choice = hg.random_affine.Mixture([hg.random_affine.known(np.eye(1, 3, d)) for d in range(3)], [0.4, 0.35, 0.25])
    item: hg.filters.AbstractFilter = hg.linear_filter(plant, sensor, hg.amplify_and_forward([choice, LINK]))
    state = item.init()
    for k in range(STEPS):
        state = item.correct(item.predict(state, k=k), [0.0], k)[0]
    return float(item.estimate(state).covariance[0, 0])


LATE = {  # filter: how it is called, and its colour
    "as_current": ("taken as current", VERMILION),
    "uninformed": ("delays not known", BLUE),
    "informed": ("time stamps", GREEN),
    "constant": ("all one step late", PURPLE),
    "none": ("not late", INK),
}
CLOCKS = {
    "ignored": "stamps taken as true",
    "estimated": "clock estimated",
    "guarded": "clock estimated while it can be",
}
SITUATIONS = {"moving": "in motion", "at_rest": "at rest", "no_true_clock": "no true clock"}


def figures(outcome: Outcome) -> dict[str, Figure]:
    """Claims beside truths of late data; clocks in motion, and where nobody can know them."""
    late = {name: (outcome.delays[name], *shown) for name, shown in LATE.items()}
    claims = [Curve(label, colour, score.claimed_over_time) for score, label, colour in late.values()]
    truths = [Curve(label, colour, score.error_over_time) for score, label, colour in late.values()]
    motion, rest, alone = (outcome.clocks[name] for name in SITUATIONS)
    position = pair(motion["ignored"]["position"], VERMILION, "ignored")
    position += pair(motion["guarded"]["position"], BLUE, "estimated")
    offset = pair(motion["guarded"]["offset"], BLUE, "estimated")
    traps = [Panel("offset in s, at rest", offsets(rest)), Panel("offset in s, no true clock", offsets(alone))]
    steps = np.arange(1.0, len(outcome.delays["none"].true_over_time) + 1)
    time = STEP * np.arange(1.0, len(motion["ignored"]["position"].true_over_time) + 1)
    return {
        "late": curves_over_time(steps, [Panel("claimed variance", claims), Panel("mean square error", truths)]),
        "clocks": curves_over_time(time, [Panel("position error", position), Panel("offset error in s", offset)], "s"),
        "traps": curves_over_time(time, traps, "s"),
    }


def offsets(scores: Clocks) -> list[Curve]:
    """Of the filter that always estimates, and of the one that checks first."""
    always, guarded = (scores[name]["offset"] for name in ("estimated", "guarded"))
    return [*pair(always, AMBER, "always"), *pair(guarded, BLUE, "while it can be")]


def pair(score: Deviation, colour: str, name: str) -> list[Curve]:
    """What is true, and what is claimed in grey or green, as deviations."""
    return [
        Curve(f"{name}: true", colour, score.true_over_time),
        Curve(f"{name}: claims", INK if colour == VERMILION else GREEN, score.claimed_over_time),
    ]


example = Study("delays", Setting, compute, 4, figures)
run = example.run
