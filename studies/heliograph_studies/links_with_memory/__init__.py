"""Links that fade slowly: what a filter without memory claims and errs, what memory and side information are worth."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure

import heliograph as hg
from heliograph.numerics.check import TINY
from heliograph.report.figures import AMBER, BLUE, GREEN, INK, MUTED, PURPLE, VERMILION
from heliograph_studies import Stages, Study, Unlisted, check_fields
from heliograph_studies.curves import Curve, Panel, curves_over, curves_over_time

NOISE = 0.05
POWER = 0.04 / (1 - 0.98**2)  # E x^2 of the plant, where it starts
PLANT = hg.LinearPlant([[0.98]], [[0.04]], [0.0], [[POWER]])
SENSOR = hg.LinearSensor([[1.0]], NOISE)
TWO_SENSORS = hg.LinearSensor([[1.0], [1.0]], NOISE * np.eye(2))
DRIFTING_PLANT = hg.LinearPlant([[0.98, 0.1], [0.0, 0.95]], np.diag([0.002, 0.02]), [1.0, 0.0], np.diag([1.0, 0.2]))
DRIFTING_SENSOR = hg.LinearSensor([[1.0, 0.0]], NOISE)
CLASSES = np.array([[0.8, 0.2], [0.2, 0.8]])  # P(class of the signal's strength | mode)


@dataclass(frozen=True)
class Setting:
    """A link of two modes, bad and good, and how much is simulated.

    gains: of each mode. leaving: probability of leaving it at a step. arrival: of a packet in it, where losses are
    side information. particle_runs: of the particle filters, which cost more.
    """

    gains: tuple[float, float] = (0.2, 1.0)
    leaving: tuple[float, float] = (0.05, 0.03)
    arrival: tuple[float, float] = (0.5, 0.95)
    runs: int = 2048
    particle_runs: int = 128
    seed: int = 0

    def __post_init__(self) -> None:
        # a quarter of the runs where there is side information
        check_fields(self, gains=(), leaving=(TINY, 1.0), arrival=(0.0, 1.0), runs=8, particle_runs=2)


def bursts(setting: Setting, correlation: float | None = None, name: str | None = None) -> hg.random_affine.Modes:
    """A link whose gain stays at one of two levels for a while; the same law with another correlation over a step."""
    bad, good = setting.leaving
    transition = np.array([[1 - bad, bad], [good, 1 - good]])
    if correlation is not None:
        law = np.array([good, bad]) / (bad + good)
        transition = correlation * np.eye(2) + (1 - correlation) * law
    return hg.markov_fading(setting.gains, transition, NOISE, name=name)


def lossy(setting: Setting) -> hg.random_affine.Modes:
    """The same link; packets arrive less often while it is bad, and the receiver knows of each whether it did."""
    modes = zip(setting.gains, setting.arrival, strict=True)
    return hg.markov_fading(
        [hg.erasure(hg.hop(gain, NOISE), arrival) for gain, arrival in modes], bursts(setting).memory
    )


def drifting() -> hg.random_affine.AbstractRandomAffine:
    """Two hops whose gains drift."""
    first, second = ((1.0, 0.4, 0.95), (0.8, 0.3, 0.9))
    return hg.amplify_and_forward([hg.model.autoregressive_fading(*hop, NOISE) for hop in (first, second)])


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
    fading, slow = bursts(setting), drifting()
    plants = {"e1": (PLANT, SENSOR, fading), "e2": (DRIFTING_PLANT, DRIFTING_SENSOR, slow)}
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
    # Where the mode is not observed, one step late, and at once.
    places: Places = {
        "nothing known": (channel, {**linear, **weighing}),
        "late": (hg.model.with_flag(channel, late=True), {"mode_late": hg.filters.mode_late_filter(*model)}),
        "now": (hg.model.with_flag(channel), {"mode_known": hg.filters.mode_known_filter(*model)}),
    }
    horizon, begin = STEPS[which]
    result = simulated(plant, sensor, places, which, setting.runs, setting.seed, progress)
    particles = {"particles": (channel, {"particle": hg.filters.particle_filter(*model)})}
    result |= simulated(plant, sensor, particles, which, setting.particle_runs, setting.seed, progress)
    # Errors before any data, of filters whose gains depend on none.
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
    channel, losing = bursts(setting), lossy(setting)
    by_class = hg.filters.side_information_filter(PLANT, SENSOR, channel, CLASSES)
    places: Places = {
        "losses": (losing, {"losses": hg.linear_filter(PLANT, SENSOR, losing)}),
        "classes": (hg.model.with_flag(channel, CLASSES), {"classes": by_class}),
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


ROWS = {  # filter: how it is called, and its colour
    "memoryless": ("linear, no memory", VERMILION),
    "exact": ("linear, with the modes", BLUE),
    "gpb1": ("one Gaussian (GPB1)", AMBER),
    "imm": ("a Gaussian per mode (IMM)", PURPLE),
    "gpb2": ("a Gaussian per mode (GPB2)", GREEN),
    "particle": ("particles", MUTED),
    "mode_late": ("knows the mode one step late", INK),
    "mode_known": ("knows the mode", INK),
}
CLAIMING = {"memoryless": "no memory", "exact": "linear, modes", "gpb2": "GPB2"}
INFORMED = {"exact": ("nothing known", BLUE), "mode_late": ("one step late", PURPLE), "mode_known": ("mode known", INK)}


def figures(outcome: Outcome) -> dict[str, Figure]:
    """Errors over time beside claims, what telling is worth, and how wrong no memory is, by file name."""
    first = outcome.e1
    claims = [Curve(label, ROWS[name][1], first[name].claimed_over_time) for name, label in CLAIMING.items()]
    truths = [Curve(label, ROWS[name][1], first[name].true_over_time) for name, label in CLAIMING.items()]
    known = [Curve(*look, first[name].true_over_time) for name, look in INFORMED.items()]
    time = np.arange(1.0, len(first["exact"].true_over_time) + 1)
    correlations, ratios = (np.array(part) for part in outcome.curve.values())
    ratio = Panel("true over claimed variance", [Curve("no memory", VERMILION, ratios)])
    return {
        "claims": curves_over_time(time, [Panel("claimed variance", claims), Panel("mean square error", truths)]),
        "telling": curves_over_time(time, [Panel("mean square error", known)]),
        "correlation": curves_over(correlations, ratio, "correlation of the gain from step to step", logarithmic=False),
    }


example = Study("links-with-memory", Setting, compute, 6, figures)
run = example.run
