"""How the example is shown: its figure and its report."""

from collections.abc import Mapping

import matplotlib
from matplotlib.figure import Figure

from heliograph.report.figures import AMBER, BLUE, INK, PURPLE, STYLE, VERMILION, WIDTH
from heliograph.report.page import Code, KeyFigure, KeyFigures, Page, Picture, Section, Table, Text
from heliograph_studies.learning.compute import Coverage
from heliograph_studies.learning.setting import METHODS

PARAMETERS = {
    "mean_gain": "mean gain",
    "gain_variance": "gain variance",
    "hop_noise": "hop noise",
    "plant_noise": "plant noise",
    "sensor_noise": "sensor noise",
    "arrival": "arrival",
}
LABELS = {
    "rayleigh": "Rayleigh",
    "two_point": "two gains",
    "log_normal": "log-normal",
    "rare": "rare, large gains",
    "rayleigh_short": "Rayleigh, 500 steps",
    "two_point_undriven": "two gains, no input",
    "untold": "untold losses",
}
COLOURS = {"hessian": VERMILION, "white": AMBER, "bartlett": PURPLE, "cosines": BLUE}


def labelled(key: str) -> str:
    """A row by its name and form."""
    row, form = key.split(".")
    return f"{LABELS[row]}, {form}"


@matplotlib.rc_context(STYLE)
def learning_figures(coverage: Mapping[str, Coverage]) -> dict[str, Figure]:
    """What intervals cover by parameter and method; a line at 95 %."""
    keys = list(coverage)
    names = [name for name in PARAMETERS if any(name in item.covered["cosines"] for item in coverage.values())]
    figure = Figure(figsize=(WIDTH, 1.0 + 0.4 * len(keys)), layout="constrained")
    grid = figure.subplots(1, len(names), sharey=True, squeeze=False)[0]
    for axes, name in zip(grid, names, strict=True):
        axes.axvline(95, color=INK, linewidth=0.8)
        for method in ("hessian", "cosines"):
            places = [
                (item.covered[method][name], y)
                for y, item in enumerate(coverage.values())
                if name in item.covered[method]
            ]
            shape = "o" if method == "cosines" else "D"
            axes.scatter(*zip(*places, strict=True), s=26, color=COLOURS[method], marker=shape, label=method, zorder=3)
        axes.set(xlim=(35, 103), xticks=[50, 95])
        axes.set_title(PARAMETERS[name].replace(" ", "\n"), fontsize=9)
        axes.set_yticks(range(len(keys)), [",\n".join(labelled(key).rsplit(", ", 1)) for key in keys])
    grid[0].invert_yaxis()
    figure.legend(*grid[0].get_legend_handles_labels(), loc="outside lower center", ncols=2, frameon=False)
    return {"coverage": figure}


def learning_page(coverage: Mapping[str, Coverage], drawings: Mapping[str, bytes]) -> Page:
    """The report; `drawings` holds the figure as SVG."""
    naive = coverage["rare.linear"].covered["hessian"]["gain_variance"]
    honest = coverage["rare.conditional"].covered["cosines"]["gain_variance"]
    worst = min(v for item in coverage.values() for v in item.covered["cosines"].values())
    best = max(v for item in coverage.values() for v in item.covered["cosines"].values())
    keys = [
        KeyFigure("rare gains, curvature alone", f"{naive:.0f} %", "of 95 % claimed", VERMILION),
        KeyFigure("rare gains, cosines", f"{honest:.0f} %", "of 95 % claimed", BLUE),
        KeyFigure("cosines, everywhere", f"{worst:.0f} to {best:.0f} %", "least and most of the table", BLUE),
    ]
    picture = Picture(
        drawings["coverage"],
        "Percentage of intervals that cover the truth, by parameter: cosines near 95, the curvature often below.",
        "How many of the 95 % intervals cover the truth: from the likelihood's curvature, and by cosines.",
    )
    counted = sorted({item.recordings for item in coverage.values()})
    caption = (
        f"Percent of {', '.join(map(str, counted))} recordings a row, less those in which a number ran to a limit "
        "(last column). Two standard errors are about 1.8 at 600 recordings. **Intervals**: from the curvature of the "
        "likelihood (hessian), or from the spread of the scores: as if these were white, and with their long-run "
        "variance by Bartlett's weights or by cosines."
    )
    return Page(
        kicker="Heliograph example",
        title=f"95 % intervals that cover {naive:.0f} %, and others that cover {honest:.0f} %",
        lead=(
            "Behind a random gain the data are not Gaussian, and intervals from the curvature of the likelihood are "
            f"too short: {naive:.0f} % of the 95 % intervals hold the variance of a gain that is large now and then. "
            f"Of the intervals from the scores' own long-run spread {honest:.0f} % hold it."
        ),
        sections=[
            Section("What intervals cover", [KeyFigures(keys), picture]),
            Section("The whole table", [Table(_headers(), _cells(coverage), caption)]),
            Section("Run it again", [Text(_AGAIN), Code("heliograph example learning --out out")]),
        ],
        footer="All numbers: summary.json.",
    )


_AGAIN = (
    "One plant with a square wave as input, one sensor, a relayed link of which a fifth of the packets is lost, which "
    "is told, and a direct link. Every recording is fitted by itself; a run that was stopped goes on where it was."
)


def _headers() -> list[str]:
    return ["law and form", "intervals", *PARAMETERS.values(), "left out"]


def _cells(coverage: Mapping[str, Coverage]) -> list[list[str]]:
    return [
        [
            labelled(key),
            method,
            *(f"{item.covered[method][name]:.1f}" if name in item.covered[method] else "" for name in PARAMETERS),
            f"{100 * item.left_out:.1f}",
        ]
        for key, item in coverage.items()
        for method in METHODS
    ]
