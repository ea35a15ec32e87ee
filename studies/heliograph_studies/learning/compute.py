"""How often intervals cover the truth, recordings in batches, and what learning gives on a recorded drive."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache, partial
from typing import Any, NamedTuple

import numpy as np

import heliograph as hg
from heliograph_studies.demo import robot
from heliograph_studies.demo.compute import networks, one_trial, relay
from heliograph_studies.demo.learned import direct, fitted, judged, learn, parameters, relayed
from heliograph_studies.demo.recording import PlazaRecording, read_recording
from heliograph_studies.learning.recordings_apart import fit_each
from heliograph_studies.learning.setting import METHODS, ROWS, Row, Setting, learned, square_wave, true_values, world
from heliograph_studies.outcome import Unlisted
from heliograph_studies.stages import Stages

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
    whole = fitted(partial(direct, drive), recording, recording.ranges, len(recording.time))
    after = judged(whole.network, recording, recording.ranges)
    before = one_trial(recording, networks(drive, 1.0), 0).scores["perfect_channel"]
    numbers = _others(after.position_rmse_m, before.position_rmse_m, after.nees_per_dimension, whole)
    return {**vars(learn(recording)), **numbers, "log_likelihood": whole.best.total}


def of_relayed(recording: PlazaRecording, seed: int) -> Numbers:
    """Of the ranges behind the relay drawn with one seed."""
    drive, received = robot.DRIVES[recording.name], relay(robot.channel, recording.ranges, seed)
    fit = fitted(partial(relayed, drive), recording, received, len(received))
    after = judged(fit.network, recording, received)
    before = one_trial(recording, networks(drive, 1.0), seed).scores["relay_aware"]
    return {"seed": seed, **_others(after.position_rmse_m, before.position_rmse_m, after.nees_per_dimension, fit)}


def _others(rmse: float, calibrated: float, nees: float, fit: hg.learning.Fit) -> Numbers:
    return {"rmse": rmse, "calibrated": calibrated, "nees": nees, "parameters": parameters(fit)}
