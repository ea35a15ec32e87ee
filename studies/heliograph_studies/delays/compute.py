"""What the example computes: claimed and true errors over time, before data where gains depend on none."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

import heliograph as hg
from heliograph_studies.delays.setting import (
    CLOCK_STEPS,
    LINK,
    LINKS,
    NOISE,
    PLANT,
    SENSOR,
    STEPS,
    listeners,
    moving,
)

RUNS = {"delays": 4096, "clocks": 1024}
STAGES = 4


@dataclass(frozen=True)
class Score:
    """Variances over time: claimed (mean over the runs), mean square errors, and these before any data if known.

    Numbers are means from step `begin` on; `true_se` is the standard error of that of `true`.
    """

    claim: str
    claimed: np.ndarray
    true: np.ndarray
    true_se: float
    begin: int
    before: np.ndarray | None = None

    def mean(self, values: np.ndarray) -> float:
        """From step `begin` on."""
        return float(values[self.begin :].mean())


@dataclass(frozen=True)
class Outcome:
    """Of the position: filters behind late links; of position, offset and drift: filters of clocks, by situation."""

    delays: dict[str, Score]
    clocks: dict[str, dict[str, dict[str, Score]]]


def compute(seed: int, advance: Callable[[str], None]) -> Outcome:
    """Everything, from the first seed of the runs."""
    advance("links that are late")
    delays = _late(seed)
    advance("a wrong clock, in motion")
    plant, sensors = moving(1.0)
    in_motion = _clocks(plant, sensors, listeners(plant, sensors), seed)
    advance("at rest")
    still, _ = moving(0.0, noise=0.0, spread=(0.0, 0.0))
    believed = listeners(*moving(0.0, spread=(1.0, 0.1)))
    at_rest = _clocks(still, sensors, believed, seed)
    alone = {name.removesuffix("_alone"): score for name, score in in_motion.items() if name.endswith("_alone")}
    kinds = {"moving": in_motion, "at_rest": at_rest}
    clocks = {kind: {n: s for n, s in found.items() if not n.endswith("_alone")} for kind, found in kinds.items()}
    advance("before data")
    return Outcome(_before(delays), clocks | {"no_true_clock": alone})


def late_filters() -> dict[str, dict[str, hg.filters.AbstractFilter]]:
    """What listens behind each link."""
    own: dict[str, dict[str, hg.filters.AbstractFilter]] = {
        name: {name: hg.linear_filter(PLANT, SENSOR, link)} for name, link in LINKS.items()
    }
    own["untold"]["as_current"] = hg.filters.as_current_filter(PLANT, SENSOR, LINKS["untold"])
    return own


def _late(seed: int) -> dict[str, Score]:
    nodes = {name: hg.Node(SENSOR, LINKS[name], filters) for name, filters in late_filters().items()}
    record = hg.monte_carlo(hg.Network(PLANT, nodes), STEPS, RUNS["delays"], seed)
    return {
        name: _score(record.errors(node, name)[..., 0], record.estimates[node][name], 0, STEPS // 2)
        for node, filters in record.estimates.items()
        for name in filters
    }


def _before(simulated: Mapping[str, Score]) -> dict[str, Score]:
    """The same with true errors before any data, of filters whose gains depend on none."""
    result = dict(simulated)
    for node, filters in late_filters().items():
        for name, item in filters.items():
            if node in ("untold", "none"):
                truth = hg.filters.true_error(item, PLANT, SENSOR, LINKS[node], STEPS)
                result[name] = Score(**{**vars(simulated[name]), "before": truth.true[:, 0, 0]})
    return result


def _clocks(
    plant: hg.LinearPlant,
    sensors: Mapping[str, hg.model.AbstractSensor],
    filters: Mapping[str, hg.filters.AbstractFilter],
    seed: int,
) -> dict[str, dict[str, Score]]:
    """Of each filter: position, present offset and drift."""
    nodes = {name: hg.Node(sensor, hg.perfect(), {}) for name, sensor in sensors.items()}
    record = hg.monte_carlo(hg.Network(plant, nodes, filters), CLOCK_STEPS, RUNS["clocks"], seed)
    parts, end = {"position": 0, "offset": 2, "drift": 3}, CLOCK_STEPS - 1
    return {
        name: {part: _score(record.errors("fused", name)[..., i], estimate, i, end) for part, i in parts.items()}
        for name, estimate in record.estimates["fused"].items()
    }


def _score(errors: np.ndarray, estimate: hg.model.Estimate, state: int, begin: int) -> Score:
    squares = errors**2
    claimed = np.broadcast_to(np.asarray(estimate.covariance)[..., state, state], squares.shape)
    by_run = squares[:, begin:].mean(axis=1)
    error = float(by_run.std() / np.sqrt(len(by_run)))
    return Score(estimate.claim, claimed.mean(axis=0), squares.mean(axis=0), error, begin)


def trap() -> float:
    """What a filter claims that holds past states in place of past signals: one y heard twice has two noises."""
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
