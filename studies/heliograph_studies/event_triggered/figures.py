"""Figures of the example, and what its page says beside the numbers."""

import numpy as np
from matplotlib.figure import Figure

from heliograph.report.figures import AMBER, BLUE, GREEN, MUTED, PURPLE, VERMILION
from heliograph_studies.event_triggered.compute import Outcome

ROWS = {  # recipe: how it is called, and its colour
    "missing": ("silence taken for missing", AMBER),
    "last": ("the last value as a measurement", VERMILION),
    "one": ("event filter, one and one", GREEN),
    "sum": ("event filter", BLUE),
}
RULES = {"periodic": MUTED, "on change": BLUE, "prediction error": GREEN, "by chance": PURPLE}


def figures(outcome: Outcome) -> dict[str, Figure]:
    """Claims in every room, and error against messages, by file name."""
    return {"rooms": _rooms(outcome), "messages": _messages(outcome)}


def _rooms(outcome: Outcome) -> Figure:
    figure = Figure(figsize=(7.2, 3.2), layout="constrained")
    axes, place = figure.subplots(), np.arange(len(outcome.rooms))
    for recipe, (label, colour) in ROWS.items():
        axes.plot(place, [room[recipe].nees for room in outcome.rooms.values()], "o-", color=colour, label=label)
    axes.axhline(1.0, color=MUTED, linewidth=0.8)
    axes.set_xticks(place, list(outcome.rooms), rotation=30, ha="right")
    axes.set(yscale="log", ylabel="squared error over claimed")
    axes.legend(fontsize="small")
    return figure


def _messages(outcome: Outcome) -> Figure:
    figure = Figure(figsize=(7.2, 3.4), layout="constrained")
    axes = figure.subplots()
    for rule, colour in RULES.items():
        curve = outcome.curves[rule]
        axes.plot(curve["messages"], curve["error"], "o-", color=colour, label=rule)
    axes.plot(outcome.curves["on change"]["messages"], outcome.bound, "--", color=MUTED, label="least error")
    axes.set(xscale="log", xlabel="messages an hour", ylabel="error (K)")
    axes.legend(fontsize="small")
    return figure


def words(outcome: Outcome) -> dict[str, object]:
    """How the recipes are called, and how much worse they are."""
    best = outcome.scores["sum"]
    return {
        "labels": ROWS,
        "worse": {name: 100 * (score.error / best.error - 1) for name, score in outcome.scores.items()},
    }
