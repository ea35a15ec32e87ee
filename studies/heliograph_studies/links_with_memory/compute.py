"""What the example computes: claimed and true errors of every filter, by simulation and, where possible, exactly."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

import heliograph as hg
from heliograph_studies.links_with_memory import setting as models
from heliograph_studies.links_with_memory.setting import PLANT, SENSOR, TWO_SENSORS, Setting, bursts
from heliograph_studies.outcome import Unlisted
from heliograph_studies.stages import Stages

STEPS = {"e1": (300, 100), "e2": (100, 50)}  # horizon, and the first step that counts
CORRELATIONS = (0.0, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.99)  # of the gain over a step
LONG = 1000  # steps after which nothing changes any more

Progress = Callable[[int, int], None]
Places = Mapping[str, tuple[hg.random_affine.AbstractRandomAffine, Mapping[str, hg.filters.AbstractFilter]]]


@dataclass(frozen=True)
class Score:
    """Claimed variance of the first state and its mean square error: means over the steps that count, and over time."""

    claim: str
    claimed: float
    true: float
    true_se: float
    claimed_over_time: Unlisted[np.ndarray]
    true_over_time: Unlisted[np.ndarray]


@dataclass(frozen=True)
class Known(Score):
    """With the true error before any data, where gains depend on none."""

    true_before_data: float


@dataclass(frozen=True)
class Outcome:
    """Scores by example and filter, and with side information; variances where two links fade together.

    curve: true over claimed variance by correlation of the gain. memory_test: memory that a recording shows, to lag 3.
    """

    runs: dict[str, int]
    steps: dict[str, dict[str, int]]
    e1: dict[str, Score]
    e2: dict[str, Score]
    known: dict[str, Score]
    one_fading: dict[str, float]
    curve: dict[str, list[float]]
    memory_test: dict[str, float | np.ndarray]


def compute(setting: Setting, stages: Stages) -> Outcome:
    """Everything."""
    fading, drifting = bursts(setting), models.drifting()
    plants = {"e1": (PLANT, SENSOR, fading), "e2": (models.DRIFTING_PLANT, models.DRIFTING_SENSOR, drifting)}
    e1 = stages("fading in bursts", lambda: scores("e1", *plants["e1"], setting, stages.progress))
    e2 = stages("two hops that drift", lambda: scores("e2", *plants["e2"], setting, stages.progress))
    informed = stages("what telling is worth", lambda: with_side_information(setting, stages.progress))
    together = stages("links that fade together", lambda: fading_together(setting))
    ratios = stages("correlation over time", lambda: [too_sure(setting, value) for value in CORRELATIONS])
    return Outcome(
        dict.fromkeys(STEPS, setting.runs),
        {name: {"horizon": horizon, "from": begin} for name, (horizon, begin) in STEPS.items()},
        e1, e2, informed, together, {"lambda": list(CORRELATIONS), "ratio": ratios},
        stages("memory found in data", lambda: memory_in_data(setting)),
    )  # fmt: skip


def scores(
    which: str,
    plant: hg.LinearPlant,
    sensor: hg.LinearSensor,
    channel: hg.random_affine.AbstractRandomAffine,
    setting: Setting,
    progress: Progress,
) -> dict[str, Score]:
    """Every filter of one example."""
    model = (plant, sensor, channel)
    linear = {"memoryless": hg.filters.memoryless_filter(*model), "exact": hg.linear_filter(*model)}
    weighing = {
        "gpb1": hg.filters.gpb1_filter(*model),
        "imm": hg.filters.imm_filter(*model),
        "gpb2": hg.filters.gpb2_filter(*model),
    }
    places: Places = {
        "nothing known": (channel, {**linear, **weighing}),
        "late": (hg.model.with_flag(channel, late=True), {"mode_late": hg.filters.mode_late_filter(*model)}),
        "now": (hg.model.with_flag(channel), {"mode_known": hg.filters.mode_known_filter(*model)}),
    }
    horizon, begin = STEPS[which]
    result = simulated(plant, sensor, places, which, setting.runs, setting.seed, progress)
    particles = {"particles": (channel, {"particle": hg.filters.particle_filter(*model)})}
    result |= simulated(plant, sensor, particles, which, setting.particle_runs, setting.seed, progress)
    for name, item in linear.items():
        truth = hg.filters.true_error(item, *model, horizon)
        result[name] = Known(**vars(result[name]), true_before_data=float(truth.true[begin:, 0, 0].mean()))
    return result


def simulated(
    plant: hg.LinearPlant,
    sensor: hg.LinearSensor,
    places: Places,
    which: str,
    runs: int,
    seed: int,
    progress: Progress,
) -> dict[str, Score]:
    """Scores of the filters at each place, by filter."""
    horizon, begin = STEPS[which]
    nodes = {name: hg.Node(sensor, channel, filters) for name, (channel, filters) in places.items()}
    record = hg.monte_carlo(hg.Network(plant, nodes), horizon, runs, seed, progress=progress)
    result = {}
    for name, (_, filters) in places.items():
        for filter in filters:
            squares = record.errors(name, filter)[..., 0] ** 2
            estimate = record.estimates[name][filter]
            claimed = np.broadcast_to(estimate.covariance[..., 0, 0], squares.shape).mean(axis=0)
            by_run = squares[:, begin:].mean(axis=1)
            averages = float(claimed[begin:].mean()), float(by_run.mean()), float(by_run.std() / np.sqrt(runs))
            result[filter] = Score(estimate.claim, *averages, claimed, squares.mean(axis=0))
    return result


def with_side_information(setting: Setting, progress: Progress) -> dict[str, Score]:
    """Fading in bursts: losses that depend on the mode and are observed, and classes of the signal's strength."""
    channel, losing = bursts(setting), models.lossy(setting)
    by_class = hg.filters.side_information_filter(PLANT, SENSOR, channel, models.CLASSES)
    places: Places = {
        "losses": (losing, {"losses": hg.linear_filter(PLANT, SENSOR, losing)}),
        "classes": (hg.model.with_flag(channel, models.CLASSES), {"classes": by_class}),
    }
    return simulated(PLANT, SENSOR, places, "e1", setting.runs // 4, setting.seed, progress)


def fading_together(setting: Setting) -> dict[str, float]:
    """Two sensors whose links fade together: the best filter, and that for separate fades, claimed and true."""
    together, apart = (hg.parallel([bursts(setting, name=name) for _ in range(2)]) for name in ("road", None))
    best, wrong = (
        hg.filters.true_error(hg.linear_filter(PLANT, TWO_SENSORS, channel), PLANT, TWO_SENSORS, together, LONG)
        for channel in (together, apart)
    )
    return {
        "shared": float(best.true[-1, 0, 0]),
        "separate_claimed": float(wrong.claimed[-1, 0, 0]),
        "separate_true": float(wrong.true[-1, 0, 0]),
    }


def too_sure(setting: Setting, correlation: float) -> float:
    """True over claimed variance of the filter without memory in the long run, where gains have this correlation."""
    channel = bursts(setting, correlation)
    item = hg.filters.memoryless_filter(PLANT, SENSOR, channel)
    return float(hg.filters.true_error(item, PLANT, SENSOR, channel, LONG).ratio[-1, 0])


def memory_in_data(setting: Setting) -> dict[str, float | np.ndarray]:
    """What one recording of 10,000 steps says of the link, by the innovations of the filter without memory."""
    channel = bursts(setting)
    item = hg.filters.memoryless_filter(PLANT, SENSOR, channel)
    network = hg.Network(PLANT, {"node": hg.Node(SENSOR, channel, {"it": item})})
    record = hg.monte_carlo(network, 10_000, 1, setting.seed)
    test = hg.simulation.memory_test(record.measurements["node"][0], item)
    numbers = {"correlation": test.correlation[:3], "standard_error": test.standard_error[:3]}
    return {**numbers, "p_value": test.p_value, "predictable": test.predictable}
