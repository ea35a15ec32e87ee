"""What the example computes: claimed and true errors of every filter, by simulation and, where possible, exactly."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

import heliograph as hg
from heliograph_studies.links_with_memory.setting import (
    CLASSES,
    DRIFTING_PLANT,
    DRIFTING_SENSOR,
    PLANT,
    SENSOR,
    TWO_SENSORS,
    bursts,
    correlated,
    drifting,
    lossy,
)

RUNS = {"e1": 2048, "e2": 2048}
PARTICLE_RUNS = 128
STEPS = {"e1": (300, 100), "e2": (100, 50)}  # horizon, and the first step that counts
LAGS = (0.0, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.99)
LONG = 1000  # steps after which nothing changes any more
STAGES = 6


@dataclass(frozen=True)
class Score:
    """Claimed variance of the first state and its mean square error, means over the steps that count.

    exact: the true error before any data, where gains depend on none. over_time: mean square error at each step.
    """

    claim: str
    claimed: float
    true: float
    true_se: float
    exact: float | None
    claimed_over_time: np.ndarray
    true_over_time: np.ndarray


@dataclass(frozen=True)
class Outcome:
    """Scores by example and filter; of being told; variances in one shadow; true over claimed by correlation."""

    e1: dict[str, Score]
    e2: dict[str, Score]
    told: dict[str, Score]
    shadow: dict[str, float]
    lags: np.ndarray
    ratios: np.ndarray
    memory: hg.simulation.MemoryTest


Place = tuple[hg.random_affine.AbstractRandomAffine, Mapping[str, hg.filters.AbstractFilter]]


def compute(seed: int, advance: Callable[[str], None]) -> Outcome:
    """Everything, from the first seed of the runs."""
    advance("fading in bursts")
    e1 = _scores("e1", PLANT, SENSOR, bursts(), seed)
    advance("two hops that drift")
    e2 = _scores("e2", DRIFTING_PLANT, DRIFTING_SENSOR, drifting(), seed)
    advance("what telling is worth")
    told = _told(seed)
    advance("one shadow")
    shadow = _shadow()
    advance("correlation over time")
    ratios = np.array([_memoryless_truth(correlated(lag)).ratio[-1, 0] for lag in LAGS])
    advance("memory found in data")
    return Outcome(e1, e2, told, shadow, np.array(LAGS), ratios, _found(seed))


def _scores(
    which: str,
    plant: hg.LinearPlant,
    sensor: hg.LinearSensor,
    channel: hg.random_affine.AbstractRandomAffine,
    seed: int,
) -> dict[str, Score]:
    """Every filter of one example."""
    own = (plant, sensor, channel)
    linear = {
        "memoryless": hg.filters.memoryless_filter(plant, sensor, channel),
        "exact": hg.linear_filter(*own),
    }
    weighing = {
        "gpb1": hg.filters.gpb1_filter(*own),
        "imm": hg.filters.imm_filter(*own),
        "gpb2": hg.filters.gpb2_filter(*own),
    }
    places: dict[str, Place] = {
        "nothing told": (channel, {**linear, **weighing}),
        "late": (hg.model.with_flag(channel, late=True), {"mode_late": hg.filters.mode_late_filter(*own)}),
        "now": (hg.model.with_flag(channel), {"mode_known": hg.filters.mode_known_filter(*own)}),
    }
    horizon, begin = STEPS[which]
    truths = {name: hg.filters.true_error(item, plant, sensor, channel, horizon) for name, item in linear.items()}
    scores = _simulated(plant, sensor, places, horizon, begin, RUNS[which], seed)
    particles: dict[str, Place] = {"particles": (channel, {"particle": hg.filters.particle_filter(*own)})}
    scores |= _simulated(plant, sensor, particles, horizon, begin, PARTICLE_RUNS, seed)
    for name, truth in truths.items():
        exact = float(truth.true[begin:, 0, 0].mean())
        scores[name] = Score(**{**vars(scores[name]), "exact": exact})
    return scores


def _simulated(
    plant: hg.LinearPlant,
    sensor: hg.LinearSensor,
    places: Mapping[str, Place],
    horizon: int,
    begin: int,
    runs: int,
    seed: int,
) -> dict[str, Score]:
    """Scores of the filters at each place, by filter."""
    nodes = {name: hg.Node(sensor, channel, filters) for name, (channel, filters) in places.items()}
    record = hg.monte_carlo(hg.Network(plant, nodes), horizon, runs, seed)
    result = {}
    for name, (_, filters) in places.items():
        for item in filters:
            squares = record.errors(name, item)[..., 0] ** 2
            estimate = record.estimates[name][item]
            claimed = np.broadcast_to(estimate.covariance[..., 0, 0], squares.shape).mean(axis=0)
            by_run = squares[:, begin:].mean(axis=1)
            error = float(by_run.std() / np.sqrt(runs))
            averages = float(claimed[begin:].mean()), float(by_run.mean()), error
            result[item] = Score(estimate.claim, *averages, None, claimed, squares.mean(axis=0))
    return result


def _told(seed: int) -> dict[str, Score]:
    """Fading in bursts: losses that depend on the mode and are told, and classes of the signal's strength."""
    channel = bursts()
    places: dict[str, Place] = {
        "losses": (lossy(), {"losses": hg.linear_filter(PLANT, SENSOR, lossy())}),
        "classes": (
            hg.model.with_flag(channel, CLASSES),
            {"classes": hg.filters.told_filter(PLANT, SENSOR, channel, CLASSES)},
        ),
    }
    horizon, begin = STEPS["e1"]
    return _simulated(PLANT, SENSOR, places, horizon, begin, RUNS["e1"] // 4, seed)


def _memoryless_truth(channel: hg.random_affine.AbstractRandomAffine) -> hg.filters.TrueError:
    item = hg.filters.memoryless_filter(PLANT, SENSOR, channel)
    return hg.filters.true_error(item, PLANT, SENSOR, channel, LONG)


def _shadow() -> dict[str, float]:
    """Two sensors in one shadow: the best filter, and that for two shadows, claimed and true."""
    chain = [bursts(name="road") for _ in range(2)]
    together, apart = hg.parallel(chain), hg.parallel([bursts(), bursts()])
    best, wrong = (
        hg.filters.true_error(hg.linear_filter(PLANT, TWO_SENSORS, c), PLANT, TWO_SENSORS, together, LONG)
        for c in (together, apart)
    )
    return {
        "shared": float(best.true[-1, 0, 0]),
        "separate_claimed": float(wrong.claimed[-1, 0, 0]),
        "separate_true": float(wrong.true[-1, 0, 0]),
    }


def _found(seed: int) -> hg.simulation.MemoryTest:
    """What one recording of 10,000 steps tells the filter without memory."""
    item = hg.filters.memoryless_filter(PLANT, SENSOR, bursts())
    record = hg.monte_carlo(hg.Network(PLANT, {"node": hg.Node(SENSOR, bursts(), {"it": item})}), 10_000, 1, seed)
    return hg.simulation.memory_test(record.measurements["node"][0], item)
