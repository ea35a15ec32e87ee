"""The example's figures and page."""

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure

from heliograph.report.curves import Panel, curves_over
from heliograph.report.figures import AMBER, BLUE, GREEN, PURPLE, VERMILION, Curve, paths
from heliograph.report.page import KeyFigure, KeyFigures, Page, Picture, Points, Section, Table, Text
from heliograph_studies.range_bearing.compute import FADING_RUNS, RUNS, Outcome, Score

LABELS = {
    "quiet_cubature": "Gaussian noise: cubature",
    "quiet_extended": "Gaussian noise: extended",
    "bursts_cubature": "noise in bursts: cubature",
    "bursts_imm": "noise in bursts: IMM",
    "bursts_gpb1": "noise in bursts: GPB1",
    "bursts_gpb2": "noise in bursts: GPB2",
    "bursts_particle": "noise in bursts: particles",
    "fused_intersection": "both, intersected",
    "fused_central": "both, central filter",
}
RULES = {
    "extended": ("slope at the mean", VERMILION),
    "cubature": ("cubature, 8 points", AMBER),
    "second_order": ("second order, 15 points", PURPLE),
    "four_points": ("4 points a direction", GREEN),
    "seven_points": ("7 points a direction", BLUE),
}


def range_bearing_figures(outcome: Outcome) -> dict[str, Figure]:
    """One run across the cut, and errors behind the fading relay by how close the target passes."""
    named = {"across": ("with angles", BLUE), "on_a_line": ("plain numbers", VERMILION)}
    drawn = [Curve(*named[case], outcome.paths[case]) for case in named]
    curves = [
        Curve(label, colour, outcome.tails[name].rmse)
        for name, (label, colour) in RULES.items()
        if name in outcome.tails
    ]
    tenths = np.arange(1.0, len(curves[0].values) + 1)
    return {
        "across": paths(outcome.truth, drawn, np.zeros((1, 2))),
        "closest": curves_over(tenths, Panel("error (m, RMS)", curves), "tenth of the runs, closest pass first"),
    }


def range_bearing_page(outcome: Outcome, pictures: Mapping[str, bytes]) -> Page:
    """The report; `pictures` holds each figure as SVG."""
    across, line = outcome.scores["across"], outcome.scores["on_a_line"]
    own, lost = across["quiet_cubature"], line["quiet_cubature"]
    coarse, fine = outcome.tails["cubature"], outcome.tails[list(outcome.tails)[-1]]
    lead = (
        "A bearing of 3.1 and one of -3.1 are 0.08 apart, not 6.2. Filters that are told which numbers are angles are "
        f"as good where bearings cross ±π as elsewhere: {own.rmse:.2f} m, and the claimed covariance is right. As "
        f"plain numbers the same bearings put them off by up to {max(s.largest for s in line.values()):,.0f} m."
    )
    title = f"Bearings that cross ±π: {own.rmse:.2f} m off as angles, {lost.rmse:.1f} m as plain numbers"
    sections = [
        Section("Across ±π", [
            KeyFigures([
                KeyFigure("with angles", f"{own.rmse:.2f} m", _claim(own), BLUE),
                KeyFigure("plain numbers", f"{lost.rmse:.2f} m", _claim(lost), VERMILION),
            ]),
            Table(["filter", "elsewhere", "NEES", "across ±π", "NEES", "plain numbers", "NEES"], _rows(outcome),
                  f"{RUNS:,} runs: error of the place (m, RMS) and NEES per dimension (squared error in units of "
                  "the claimed covariance; 1 where that is right) with its standard error, east of the station, west "
                  "of it where bearings cross ±π, and there without angles."),
            Picture(pictures["across"], "One path twice: with angles on the true one, with plain numbers far off.",
                    "The run in which plain numbers do worst; both filters hear the same."),
        ]),
        Section("Close by, behind a relay that fades", [
            Text(["Here a target passes a station. Its range comes through two hops that fade (Rayleigh), which leaves "
                  "it almost unknown; its bearing comes as it is. Errors have a heavy tail: "
                  f"{coarse.score.rmse:.0f} m RMS for cubature points, {coarse.score.median:.0f} m median, "
                  f"{coarse.score.largest:,.0f} m at worst."]),
            Table(["rule", "RMS (m)", "median", "largest", "NEES", "worst 1 % of runs", "too sure", "begins close by"],
                  _tail_rows(outcome),
                  f"{FADING_RUNS:,} runs. Worst 1 %: their share of the square error. Too sure: runs in which the "
                  "error is once beyond what one in 10,000 reaches; and the share of these where that begins within 3 "
                  "steps of the closest pass."),
            Picture(pictures["closest"], "Errors by closest pass: all rules agree but for the closest tenth of runs.",
                    "Root mean square error of runs in order of their closest pass, a tenth of them at each point."),
            Points([
                "**Why.** All rules agree but where the target passes close. There the place is known no better than "
                "the distance itself, since the range fades, and the bearing bends over the width of the belief. A "
                "slope, or two points a direction, miss that: the bearing is trusted to its 0.02 rad, the filter "
                "corrects the speed by what is bending, and says it is sure.",
                "**What cures it.** A rule that sees the bend: Gauss-Hermite points in place of cubature's, "
                f"`gaussian_filter(..., PolynomialMoments(6))`: {fine.score.rmse:.0f} m RMS, NEES "
                f"{fine.score.nees:.2f}.",
                "**What does not.** Repeating the update from where it led (iterated posterior linearisation), the "
                "logarithm of what arrives, and a mixture over the gain: each leaves the tail (measured on this case), "
                "for none of them sees the bend.",
                "**What to look at.** A claimed deviation of the place above three tenths of the estimated distance.",
            ]),
        ]),
    ]  # fmt: skip
    return Page("Heliograph example", title, lead, sections)


def _claim(score: Score) -> str:
    return f"cubature filter; NEES {score.nees:.2f}, at worst {score.largest:,.0f} m off"


def _rows(outcome: Outcome) -> list[list[str]]:
    return [
        [label, *(cell for case in outcome.scores for cell in _cells(outcome.scores[case][name]))]
        for name, label in LABELS.items()
        if name in outcome.scores["across"]
    ]


def _cells(score: Score) -> list[str]:
    return [f"{score.rmse:.2f}", f"{score.nees:.2f} ± {score.nees_se:.2f}"]


def _tail_rows(outcome: Outcome) -> list[list[str]]:
    result = []
    for name, one in outcome.tails.items():
        label, s = RULES[name][0], one.score
        numbers = [f"{s.rmse:.1f}", f"{s.median:.1f}", f"{s.largest:,.0f}", f"{s.nees:.2f} ± {s.nees_se:.2f}"]
        result.append([label, *numbers, *(f"{100 * v:.1f} %" for v in (one.worst, one.broken, one.at_closest))])
    return result
