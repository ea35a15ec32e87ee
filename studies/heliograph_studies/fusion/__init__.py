"""Fusion that knows what is shared: what intersection throws away, a centre that remembers every report, trees."""

from collections.abc import Mapping

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from heliograph.report.figures import AMBER, BLUE, GREEN, INK, PURPLE, STYLE, VERMILION, WIDTH, legend_above
from heliograph_studies import Study
from heliograph_studies.fusion import compute
from heliograph_studies.fusion.compute import Outcome
from heliograph_studies.fusion.compute import Setting as Setting

DRAWN = {"three_partial": BLUE, "three_rooms": AMBER, "four_equal": PURPLE}
LABELS = {
    "equal_intersection_claimed": "equal intersection, claimed",
    "equal_intersection_true": "equal intersection, its error",
    "scalar": "scalar weights",
    "matrix": "matrix weights",
    "matrix_with_mean": "matrix weights and the plant's mean",
    "all_reports": "all reports ever received",
    "central": "central filter",
}
SHORT = {
    "equal_intersection_claimed": "intersection,\nclaimed",
    "equal_intersection_true": "intersection,\nits error",
    "matrix_with_mean": "matrix weights,\nplant's mean",
    "all_reports": "all reports",
}
NETWORKS = {"three_partial": "partial sensors", "three_rooms": "three rooms", "four_equal": "equal sensors"}
KINDS = {"every": ("every d-th step", BLUE), "informed": ("on event, silence understood", GREEN),
         "uninformed": ("on event, silence taken for a loss", VERMILION)}  # fmt: skip
PLACES = 0, 2  # the states drawn: where the point is in either direction
LEFT_OUT = ("scalar", "central")  # one is far off, the other is what all are divided by


def figures(outcome: Outcome) -> dict[str, Figure]:
    """All of them, by name."""
    return {
        "traces": traces_picture(outcome.cases),
        "tree": tree_picture(outcome.levels),
        "traffic": traffic_picture(outcome),
    }


@matplotlib.rc_context(STYLE)
def traces_picture(cases: Mapping[str, Mapping[str, float | list[float]]]) -> Figure:
    """Each rule's trace over that of the central filter, which receives every sensor itself: 1 is the best there is."""
    figure = Figure(figsize=(WIDTH, 3.2), layout="constrained")
    axes = figure.subplots()
    rules = [rule for rule in LABELS if rule not in LEFT_OUT]
    for i, (name, colour) in enumerate(DRAWN.items()):
        traces = np.array([cases[name][rule] for rule in rules]) / np.array(cases[name]["central"])
        axes.plot(traces, np.arange(len(rules)) + 0.22 * (i - 1), "o", color=colour, label=NETWORKS[name])
    axes.axvline(1.0, color=INK, linewidth=1.0, linestyle=(0, (4, 1.6)))
    axes.set_yticks(range(len(rules)), [SHORT.get(rule, LABELS[rule]) for rule in rules])
    axes.set(xlabel="trace over the central filter's", ylim=(len(rules) - 0.5, -0.5))
    axes.grid(visible=False, axis="y")
    legend_above(figure, axes, 3)
    return figure


@matplotlib.rc_context(STYLE)
def tree_picture(levels: list[np.ndarray]) -> Figure:
    """Each node's covariance of the point's place as an ellipse at the node, with the trace of all of it.

    The axes of an ellipse are standard deviations, so that sizes can be compared from the leaves to the root.
    """
    figure = Figure(figsize=(WIDTH, 3.0), layout="constrained")
    axes = figure.subplots()
    count = len(levels[0])
    where = [np.arange(count) + 0.5]
    for level in levels[1:]:
        where.append(where[-1].reshape(len(level), -1).mean(axis=1))
    shown = [level[:, PLACES][:, :, PLACES] for level in levels]
    unit = 0.42 / np.sqrt(np.median([np.linalg.eigvalsh(part).max() for part in shown[0]]))
    height = count / (2.2 * len(levels))
    for depth, (xs, parts) in enumerate(zip(where, shown, strict=True)):
        for i, (x, part) in enumerate(zip(xs, parts, strict=True)):
            if depth + 1 < len(levels):
                above = where[depth + 1][i * len(where[depth + 1]) // len(xs)]
                axes.plot([x, above], [depth * height, (depth + 1) * height], color=INK, linewidth=0.6, zorder=1)
            axes.add_patch(_ellipse(x, depth * height, part, unit, GREEN if depth + 1 == len(levels) else BLUE))
            note = f"{np.trace(levels[depth][i]):.2f}"
            if depth:
                axes.text(x + 0.5, depth * height + 0.1, note, ha="left", va="bottom", fontsize=8)
            else:
                axes.text(x, -0.9, note, ha="center", va="top", fontsize=8)
    axes.set(xlim=(0, count), ylim=(-1.6, (len(levels) - 1) * height + 0.8), aspect="equal")
    axes.axis("off")
    return figure


def _ellipse(x: float, y: float, covariance: np.ndarray, unit: float, colour: str) -> Ellipse:
    values, vectors = np.linalg.eigh(covariance)
    width, height = 2 * unit * np.sqrt(np.maximum(values[::-1], 0.0))
    angle = float(np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1])))
    return Ellipse((x, y), width, height, angle=angle, facecolor=colour, edgecolor="white", alpha=0.85, zorder=2)


@matplotlib.rc_context(STYLE)
def traffic_picture(outcome: Outcome) -> Figure:
    """Reports per step and node against the mean square error, and what is claimed of it."""
    figure = Figure(figsize=(WIDTH, 3.8), layout="constrained")
    axes = figure.subplots()
    for kind, (label, colour) in KINDS.items():
        points = sorted(outcome.traffic[kind], key=lambda point: point["reports"])
        sent = [point["reports"] for point in points]
        axes.plot(sent, [p["error"] for p in points], "o-", color=colour, linewidth=1.4, label=label)
        axes.plot(sent, [p["claimed"] for p in points], ":", color=colour, linewidth=1.4)
    axes.plot([], [], ":", color=INK, label="claimed")
    axes.set(xlabel="reports per step and node", ylabel="mean square error", yscale="log")
    axes.legend(frameon=False, fontsize=9)
    return figure


example = Study("fusion", Setting, compute.compute, len(compute.CASES) + 5, figures)
run = example.run
