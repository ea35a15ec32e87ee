"""The example's figure, and what its page says beside the numbers."""

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from heliograph.report.figures import AMBER, BLUE, INK, PURPLE, STYLE, VERMILION, WIDTH
from heliograph_studies.learning.compute import Coverage, Outcome

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
        "parameters": PARAMETERS,
        "vermilion": VERMILION,
        "blue": BLUE,
        "worst": min(cosines),
        "best": max(cosines),
        "counted": ", ".join(map(str, sorted({row.recordings for row in rows.values()}))),
        "mean": {name: np.mean(relayed[name]) for name in ("rmse", "calibrated")},
    }
