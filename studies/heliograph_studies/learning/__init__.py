"""Links learned from recordings: whether intervals cover the truth behind random gains, method by method."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache, partial
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from matplotlib.figure import Figure

import heliograph as hg
from heliograph.learning.intervals import Method
from heliograph.learning.likelihood.objective import Form
from heliograph.report.figures import AMBER, BLUE, INK, PURPLE, STYLE, VERMILION, WIDTH
from heliograph_studies import Stages, Study, Unlisted, check_fields
from heliograph_studies.demo import learned as recorded
from heliograph_studies.demo import robot
from heliograph_studies.demo.compute import networks, one_trial, relay
from heliograph_studies.demo.recording import PlazaRecording, plaza2, read_recording
from heliograph_studies.learning.recordings_apart import fit_each

MEAN, VARIANCE = 0.8, 0.16
PLANT_NOISE, SENSOR_NOISE, HOP_NOISE, DIRECT_NOISE = 0.2, 0.3, 0.3, 0.2
ARRIVAL = 0.8  # observed
UNTOLD = 0.7
STEPS, SHORT = 2000, 500
PERIOD, LEVEL = 60, 0.4  # of the input, a square wave
FORMS: tuple[Form, ...] = ("linear", "conditional")
METHODS: tuple[Method, ...] = ("hessian", "white", "bartlett", "cosines")

RARE = 0.04  # probability of the large gain
RARE_STEP = np.sqrt(VARIANCE / (RARE * (1 - RARE)))  # how much larger it is
LOG_VARIANCE = np.log(1 + VARIANCE / MEAN**2)

LAWS: dict[str, hg.random_affine.AbstractLaw] = {
    "rayleigh": hg.Rayleigh(MEAN / np.sqrt(np.pi / 2)),
    "two_point": hg.Discrete([MEAN - 0.4, MEAN + 0.4], [0.5, 0.5]),
    "log_normal": hg.random_affine.LogNormal(np.log(MEAN) - LOG_VARIANCE / 2, np.sqrt(LOG_VARIANCE)),
    "rare": hg.Discrete([MEAN - RARE * RARE_STEP, MEAN + (1 - RARE) * RARE_STEP], [1 - RARE, RARE]),
}


@dataclass(frozen=True)
class Setting:
    """batches of `batch` recordings for each row of the table; relays: draws of the recorded drive's relays."""

    batches: int = 10
    batch: int = 64
    relays: int = 5
    seed: int = 0

    def __post_init__(self) -> None:
        check_fields(self, batches=1, batch=1, relays=1)


class Row(NamedTuple):
    """One row of the table: what is recorded, how long, and which form of the likelihood is climbed."""

    name: str
    law: str
    form: Form
    steps: int
    driven: bool = True


ROWS = (
    *(Row(law, law, form, STEPS) for law in LAWS for form in FORMS),
    Row("rayleigh_short", "rayleigh", "linear", SHORT),
    Row("two_point_undriven", "two_point", "conditional", STEPS, driven=False),
    *(Row("uninformed", "uninformed", form, STEPS) for form in FORMS),
)


def square_wave(row: Row) -> np.ndarray:
    """The input of each step."""
    half = np.arange(row.steps) // (PERIOD // 2)
    return np.where(half % 2 == 0, LEVEL, -LEVEL)[:, None] * row.driven


def world(row: Row) -> hg.Network:
    """The network that is recorded."""
    if row.law == "uninformed":
        return unpublished(PLANT_NOISE, HOP_NOISE, UNTOLD)
    return relayed(LAWS[row.law], PLANT_NOISE, SENSOR_NOISE, HOP_NOISE)


def learned(row: Row) -> hg.Network:
    """What is learned of it."""
    plant_noise, hop_noise = hg.free(PLANT_NOISE, "plant_noise"), hg.free(HOP_NOISE, "hop_noise")
    if row.law == "uninformed":
        return unpublished(plant_noise, hop_noise, hg.free(UNTOLD, "arrival"))
    mean, variance = hg.free(MEAN, "mean_gain"), hg.free(true_values(row)["gain_variance"], "gain_variance", "positive")
    law = hg.random_affine.GivenMoments([mean, mean**2 + variance])
    return relayed(law, plant_noise, hg.free(SENSOR_NOISE, "sensor_noise"), hop_noise)


def true_values(row: Row) -> dict[str, float]:
    """What is to be covered, by name."""
    noises = {"plant_noise": PLANT_NOISE, "hop_noise": HOP_NOISE}
    if row.law == "uninformed":
        return {**noises, "arrival": UNTOLD}
    law = LAWS[row.law]
    variance = float(law.moment(2)) - float(law.moment(1)) ** 2
    return {**noises, "mean_gain": MEAN, "gain_variance": variance, "sensor_noise": SENSOR_NOISE}


def relayed(law: hg.random_affine.AbstractLaw, plant_noise: float, sensor_noise: float, hop_noise: float) -> hg.Network:
    """z1 = g y + n1 of which a part is lost and observed, z2 = y + n2 with n2 known."""
    hop = hg.erasure(hg.hop(law, hop_noise), ARRIVAL)
    return _network(plant_noise, sensor_noise, hg.model.with_direct_link(hop, hg.hop(1.0, DIRECT_NOISE)))


def unpublished(plant_noise: float, hop_noise: float, arrival: float) -> hg.Network:
    """Lost without a word, and then noise is added."""
    lossy = hg.dropout(hg.perfect(), arrival)
    return _network(plant_noise, 0.0, hg.amplify_and_forward([lossy, hg.hop(1.0, hop_noise)]))


def _network(plant_noise: float, sensor_noise: float, channel: hg.random_affine.AbstractRandomAffine) -> hg.Network:
    plant = hg.LinearPlant([[0.95]], plant_noise, [0.0], [[1.0]], [[1.0]])
    return hg.Network(plant, {"node": hg.Node(hg.LinearSensor([[1.0]], sensor_noise), channel, {})})


Numbers = dict[str, Any]


class Counts(NamedTuple):
    """Of one batch: recordings, those in which no number ran to a limit, and of these those covered."""

    recordings: int
    inside: int
    covered: dict[str, dict[str, int]]


@dataclass(frozen=True)
class Coverage:
    """Of one row: recordings, the share left out, and by method and parameter the percentage covered."""

    recordings: int
    left_out: float
    covered: Unlisted[Mapping[str, Mapping[str, float]]]


@dataclass(frozen=True)
class Outcome:
    """Percentages covered by law, form, method and parameter, how many recordings they are of, and the recorded drive.

    plaza: errors with learned and with calibrated constants. rmse and nees: learned from the whole drive, without the
    truth, and judged on it; calibrated: with the constants that were measured with the truth. second_half: learned from
    the first half, judged on the second.
    """

    nominal: float
    batch: int
    coverage: dict[str, dict[str, Mapping[str, Mapping[str, float]]]]
    recordings: dict[str, dict[str, Coverage]]
    plaza: dict[str, Numbers]


def compute(setting: Setting, stages: Stages) -> Outcome:
    """The recorded drive first, then the table."""
    drive = plaza(setting, stages)
    recordings = table(setting, stages)
    covered = {law: {form: c.covered for form, c in forms.items()} for law, forms in recordings.items()}
    return Outcome(95.0, setting.batch, covered, recordings, drive)


def table(setting: Setting, stages: Stages, rows: tuple[Row, ...] = ROWS) -> dict[str, dict[str, Coverage]]:
    """Coverage by the name of a row and its form; every batch is a piece that is stored."""
    total, batches = setting.batches * len(rows), []
    for batch in range(setting.batches):
        for i, row in enumerate(rows):
            work = partial(counts, row, setting, batch)
            batches.append(stages("recordings of the table", work, batch * len(rows) + i, total))
    result: dict[str, dict[str, Coverage]] = {}
    for i, row in enumerate(rows):
        result.setdefault(row.name, {})[row.form] = pooled(batches[i :: len(rows)])
    return result


def counts(row: Row, setting: Setting, batch: int) -> Counts:
    """One batch of one row, fitted and counted."""
    u, size = square_wave(row), setting.batch
    record = hg.monte_carlo(world(row), row.steps, size, setting.seed, inputs=u, first_run=batch * size)
    fits = fit_each(builder(row), record.measurements["node"], u, row.form)
    names = [parameter.name for parameter in fits.parameters.every]
    truth = np.array([true_values(row)[name] for name in names])
    covered: dict[str, dict[str, int]] = {}
    for method in METHODS:
        low, high = fits.intervals(method)
        hits = ((low <= truth) & (truth <= high))[fits.inside].sum(axis=0)
        covered[method] = {name: int(hit) for name, hit in zip(names, hits, strict=True)}
    return Counts(size, int(fits.inside.sum()), covered)


@cache
def builder(row: Row) -> Callable[[], hg.Network]:
    """The function that builds a row's network, the same one for all batches, so that one program serves them."""
    return partial(learned, row)


def pooled(batches: list[Counts]) -> Coverage:
    """Percentages over all batches."""
    recordings, inside = sum(b.recordings for b in batches), sum(b.inside for b in batches)
    covered = {
        method: {name: 100 * sum(b.covered[method][name] for b in batches) / max(inside, 1) for name in names}
        for method, names in batches[0].covered.items()
    }
    return Coverage(recordings, 1 - inside / recordings, covered)


def plaza(setting: Setting, stages: Stages) -> dict[str, Numbers]:
    """The drive's direct ranges, and relayed ones for several draws of the relay."""
    recording, count = read_recording(), setting.relays
    numbers = stages("learning from direct ranges", partial(of_direct, recording))
    behind = [
        stages("learning from a relay", partial(of_relayed, recording, seed), seed, count) for seed in range(count)
    ]
    return {"direct": numbers, "relayed": {name: [draw[name] for draw in behind] for name in behind[0]}}


def of_direct(recording: PlazaRecording) -> Numbers:
    """Of the ranges as they were recorded."""
    drive = robot.DRIVES[recording.name]
    whole = recorded.fitted(partial(recorded.direct, drive), recording, recording.ranges, len(recording.time))
    after = recorded.judged(whole.network, recording, recording.ranges)
    before = one_trial(recording, networks(drive, 1.0), 0).scores["perfect_channel"]
    numbers = _others(after.position_rmse_m, before.position_rmse_m, after.nees_per_dimension, whole)
    return {**vars(recorded.learn(recording)), **numbers, "log_likelihood": whole.best.total}


def of_relayed(recording: PlazaRecording, seed: int) -> Numbers:
    """Of the ranges behind the relay drawn with one seed."""
    drive, received = robot.DRIVES[recording.name], relay(robot.channel, recording.ranges, seed)
    fit = recorded.fitted(partial(recorded.relayed, drive), recording, received, len(received))
    after = recorded.judged(fit.network, recording, received)
    before = one_trial(recording, networks(drive, 1.0), seed).scores["relay_aware"]
    return {"seed": seed, **_others(after.position_rmse_m, before.position_rmse_m, after.nees_per_dimension, fit)}


def _others(rmse: float, calibrated: float, nees: float, fit: hg.learning.Fit) -> Numbers:
    return {"rmse": rmse, "calibrated": calibrated, "nees": nees, "parameters": recorded.parameters(fit)}


PARAMETERS = ("mean_gain", "gain_variance", "hop_noise", "plant_noise", "sensor_noise", "arrival")
LABELS = {
    "rayleigh": "Rayleigh",
    "two_point": "two gains",
    "log_normal": "log-normal",
    "rare": "rare, large gains",
    "rayleigh_short": "Rayleigh, 500 steps",
    "two_point_undriven": "two gains, no input",
    "uninformed": "unobserved losses",
}
COLOURS = {"hessian": VERMILION, "white": AMBER, "bartlett": PURPLE, "cosines": BLUE}


def labelled(outcome: Outcome) -> dict[str, Coverage]:
    """Rows by law and form, as they are called."""
    pairs = ((law, form, c) for law, forms in outcome.recordings.items() for form, c in forms.items())
    return {f"{LABELS[law]}, {form}": c for law, form, c in pairs}


@matplotlib.rc_context(STYLE)
def figures(outcome: Outcome) -> dict[str, Figure]:
    """What intervals cover by parameter and method; a line at 95 %."""
    rows = labelled(outcome)
    names = [name for name in PARAMETERS if any(name in row.covered["cosines"] for row in rows.values())]
    figure = Figure(figsize=(WIDTH, 1.0 + 0.4 * len(rows)), layout="constrained")
    grid = figure.subplots(1, len(names), sharey=True, squeeze=False)[0]
    for axes, name in zip(grid, names, strict=True):
        axes.axvline(95, color=INK, linewidth=0.8)
        for method, shape in (("hessian", "D"), ("cosines", "o")):
            places = [
                (row.covered[method][name], y) for y, row in enumerate(rows.values()) if name in row.covered[method]
            ]
            axes.scatter(*zip(*places, strict=True), s=26, color=COLOURS[method], marker=shape, label=method, zorder=3)
        axes.set(xlim=(35, 103), xticks=[50, 95])
        axes.set_title(name.replace("_", "\n"), fontsize=9)
        axes.set_yticks(range(len(rows)), [",\n".join(label.rsplit(", ", 1)) for label in rows])
    grid[0].invert_yaxis()
    figure.legend(*grid[0].get_legend_handles_labels(), loc="outside lower center", ncols=2, frameon=False)
    return {"coverage": figure}


def words(outcome: Outcome) -> dict[str, object]:
    """Rows and columns of the table, and what cosines cover at least and most."""
    rows, relayed = labelled(outcome), outcome.plaza["relayed"]
    cosines = [value for row in rows.values() for value in row.covered["cosines"].values()]
    return {
        "rows": rows,
        "worst": min(cosines),
        "best": max(cosines),
        "counted": ", ".join(map(str, sorted({row.recordings for row in rows.values()}))),
        "mean": {name: np.mean(relayed[name]) for name in ("rmse", "calibrated")},
    }


example = Study("learning", Setting, compute, 3, figures, words, files=plaza2)
run = example.run
