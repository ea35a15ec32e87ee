"""Radio ranges with losses and outliers: drives of an outdoor ultra-wideband recording, and filters that doubt."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from heliograph.report.figures import AMBER, BLUE, GREEN, MUTED, PURPLE, VERMILION
from heliograph_studies import Study
from heliograph_studies.curves import Curve, Panel, curves_over_time, paths
from heliograph_studies.uwb import compute
from heliograph_studies.uwb.compute import OfDrive, Outcome, best_of
from heliograph_studies.uwb.setting import BEST, BIAS, BIASED
from heliograph_studies.uwb.setting import Setting as Setting

WHITE = {
    "plain": "no doubt",
    "gate": "chi-squared gate",
    "huber": "Huber",
    "wolf": "WoLF",
    "inverse_multiquadric": "inverse multiquadric",
    "student": "Student, score",
    "contaminated": "contaminated, score",
    "one_sided": "one-sided, score",
}
NAMES = {
    **WHITE,
    **{rule + BIAS: f"{WHITE[rule]}, bias of each anchor" for rule in BIASED},
    BEST: "contaminated, errors with memory",
}
COLOURS = (BLUE, AMBER, PURPLE, GREEN, VERMILION)
SMOOTH = 50  # slots over which weights are averaged for the eye


def figures(outcome: Outcome) -> dict[str, Figure]:
    """Of each drive the path, and errors and weights over time."""
    result: dict[str, Figure] = {}
    for name, drive in outcome.drives.items():
        best = best_of(drive)
        route = Curve(f"{best.rmse:.2f} m off", BLUE, best.place)
        result[f"path_{name}"] = paths(drive.truth, [route], drive.places[:, :2])
        result[f"errors_{name}"] = curves_over_time(best.time, [_errors(drive), _weights(drive)], "time (s)")
    return result


def _errors(drive: OfDrive) -> Panel:
    """The error against its claimed deviation."""
    best = best_of(drive)
    return Panel("error (m)", [Curve("claimed", MUTED, best.deviation), Curve("error", BLUE, best.error)])


def _weights(drive: OfDrive) -> Panel:
    """Mean weight of each anchor's ranges over some seconds."""
    curves = []
    for i, anchor in enumerate(best_of(drive).anchors):
        weight = best_of(drive).weight[:, i]
        there, box = np.isfinite(weight).astype(float), np.ones(min(SMOOTH, len(weight)))
        count = np.convolve(there, box, "same")
        mean = np.convolve(np.nan_to_num(weight), box, "same") / np.maximum(count, 1.0)
        curves.append(Curve(anchor, COLOURS[i % len(COLOURS)], np.where(count > 0, mean, np.nan)))
    return Panel("weight", curves)


def words(outcome: Outcome) -> dict[str, object]:
    """Errors over those of published least squares, where there are any."""
    known = [drive for drive in outcome.drives.values() if drive.published.ls]
    return {"ratios": [drive.rules[BEST].rmse / (drive.published.ls or 1) for drive in known]}


def files(setting: Setting) -> list[Path]:
    """The tables of the recording."""
    return sorted(Path(setting.recording).rglob("*.csv")) if setting.recording else []


example = Study("uwb", Setting, compute.compute, 2, figures, words, files=files)
run = example.run
