"""Report of a campaign: one self-contained page, and its figures, scores with intervals against each parameter."""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import fill

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from heliograph.campaign.definition import BITWISE, Campaign, Setting, serialise_setting
from heliograph.campaign.failed_jobs import FAILURES, FailedJob, read_failures
from heliograph.campaign.summary import SUMMARY, Score, make_score_cells, make_score_headers
from heliograph.campaign.zarr_store import list_parameter_values
from heliograph.disk.quoted_text import quote_for_figure, visible
from heliograph.report.figures import COLOURS, INK, STYLE, WIDTH, svg
from heliograph.report.pages.page import Block, Code, Page, Picture, Points, Section, Table, Text

REPORT = "report.html"
DASHED = (0, (4, 1.6))  # of matplotlib: offset, then lengths of dashes and gaps
ROWS = 200  # of the table on the page
REPORTED = 20  # failures on the page
PANELS, SETTINGS, PARAMETERS = 6, 20, 3  # more than that is in the table
TITLE = 26  # characters in a line above a panel
LOGARITHMIC = 8.0  # ratio of the largest to the smallest value from which an axis is logarithmic


def write_campaign_report(campaign: Campaign, scores: Sequence[Score], out: Path) -> Path:
    """Write the report next to the store; return its path."""
    path = out / REPORT
    path.write_text(make_campaign_page(campaign, scores, read_failures(out)).html(), encoding="utf-8")
    return path


def make_campaign_page(campaign: Campaign, scores: Sequence[Score], failures: Sequence[FailedJob]) -> Page:
    """Return the page of a campaign with its scores and failures."""
    name = Path(campaign.path).name
    runs_by_setting = {score.setting: score.runs for score in scores}  # all scores of a setting have the same runs
    computed = sum(runs_by_setting.values())
    # Failures first, so that nobody reads the results without them.
    return Page(
        kicker="Heliograph campaign",
        title=describe_best_filter(scores),
        lead=f"{name}: {len(campaign.settings)} settings, {campaign.runs} runs each of {campaign.horizon} steps; "
        f"{computed} of {len(campaign.settings) * campaign.runs} runs are there. {_describe_failures(failures)} A case "
        "is a node in a setting.",
        sections=[
            *([_list_failures(failures)] if failures else []),
            Section("Results", draw_score_pictures(campaign, scores)),
            Section("All scores", [make_score_table(campaign, scores)]),
            _explain_opening_in_python(campaign),
            Section("The campaign", [Code(campaign.text.strip())]),
        ],
        footer=", ".join(f"{package} {campaign.versions[package]}" for package in BITWISE),
    )


def describe_best_filter(scores: Sequence[Score]) -> str:
    """Return which filter has the least error in most cases, in words; of a single filter the range of errors.

    A case is a node in a setting.
    """
    cases: dict[tuple[int, str], list[Score]] = {}
    for score in scores:
        if math.isfinite(score.rmse):
            cases.setdefault((score.setting, score.node), []).append(score)
    if not cases:
        return "No run is there yet"
    compared = [case for case in cases.values() if len(case) > 1]
    if not compared:
        errors = sorted(score.rmse for case in cases.values() for score in case)
        return f"RMSE from {errors[0]:.3g} to {errors[-1]:.3g}"
    wins = Counter(min(case, key=lambda score: score.rmse).filter for case in compared)
    name, count = wins.most_common(1)[0]
    return f"“{visible(name)}” has the least error in {count} of {len(compared)} cases"


def _describe_failures(failures: Sequence[FailedJob]) -> str:
    """Return in words how many jobs failed."""
    return f"{len(failures)} pieces of work failed and are missing here." if failures else "Nothing failed."


def _list_failures(failures: Sequence[FailedJob]) -> Section:
    """Return the section on failed jobs: the first REPORTED of them with their errors, and how to repeat one."""
    points = [
        f"setting {failure.setting} {failure.parameters}, runs {failure.runs[0]} to {failure.runs[1]}: {failure.error}"
        for failure in failures[:REPORTED]
    ]
    text = f"Tried three times. All of them, with tracebacks, are in {FAILURES}; run one again alone by its command:"
    return Section("What failed", [Points(points), Text([text]), Code(failures[0].command)])


def draw_score_pictures(campaign: Campaign, scores: Sequence[Score]) -> list[Block]:
    """Return the figures of a campaign's scores as pictures, the first with a caption for all."""
    caption = f"Bars: two standard errors to both sides. At most {PANELS} panels are drawn; {SUMMARY} has all."
    return [
        Picture(svg(figure), f"{name} of every filter.", caption if i == 0 else "")
        for i, (name, figure) in enumerate(draw_campaign_figures(campaign, scores).items())
    ]


def make_score_table(campaign: Campaign, scores: Sequence[Score]) -> Table:
    """Return the first rows of the table of scores, with an explanation of its columns."""
    rows = [[str(score.setting), *make_score_cells(campaign, score)] for score in scores[:ROWS]]
    more = f" The first {ROWS} rows of {len(scores)}." if len(scores) > ROWS else ""
    caption = (
        "**RMSE**: root of the mean over runs and steps of the squared error summed over the state. **NEES / dim**: "
        "squared error in units of the claimed covariance, per dimension; 1 where that is right, above 1 is too sure. "
        "**±**: one standard error of the number before it, from the scatter between runs. Only finite runs "
        f"count.{more}"
    )
    return Table(["setting", *make_score_headers(campaign)], rows, caption)


def _explain_opening_in_python(campaign: Campaign) -> Section:
    """Return the section of the page that shows how to open the errors of all runs in Python."""
    lines = [
        "import heliograph as hg",
        "",
        'results = hg.campaign.open_results("THIS FOLDER")  # an xarray.Dataset',
        'results.error.sel(setting=0).mean("run")',
    ]
    text = f"The errors of every run are in the store; axes: {', '.join(['setting', 'run', 'time', 'node', 'filter'])}."
    return Section("All runs", [Text([text]), Code("\n".join(lines))])


@dataclass(frozen=True)
class ScoreColumn:
    """A column of scores, `value`, and that of its standard error, `error`, by their names in `Score`."""

    label: str
    value: str
    error: str


RMSE = ScoreColumn("RMSE", "rmse", "rmse_error")
NEES = ScoreColumn("NEES per dimension", "nees_per_dimension", "nees_error")


def draw_campaign_figures(campaign: Campaign, scores: Sequence[Score]) -> dict[str, Figure]:
    """Return figures by name: RMSE and NEES against each of at most PARAMETERS numeric parameters, else by setting."""
    parameters = [name for name in campaign.parameters if _can_be_axis(campaign, name)][:PARAMETERS]
    figures = {}
    for quantity in (RMSE, NEES):
        for name in parameters:
            figures[f"{quantity.value} against {name}"] = plot_by_parameter(campaign, scores, name, quantity)
        if not parameters:
            figures[f"{quantity.value} by setting"] = plot_by_setting(campaign, scores, quantity)
    return figures


def _can_be_axis(campaign: Campaign, name: str) -> bool:
    """Return whether a parameter is always a finite number, and some settings differ only in this parameter."""
    values = list_parameter_values(campaign, name)
    if values.dtype.kind not in "if" or not np.all(np.isfinite(values)):
        return False
    other_parameters = [serialise_setting(_drop_parameter(setting, name)) for setting in campaign.settings]
    return len(set(other_parameters)) < len(other_parameters)


def _drop_parameter(setting: Setting, name: str) -> Setting:
    """Return a setting without the parameter of this name."""
    return {key: value for key, value in setting.items() if key != name}


@matplotlib.rc_context(STYLE)
def plot_by_parameter(campaign: Campaign, scores: Sequence[Score], parameter: str, quantity: ScoreColumn) -> Figure:
    """Plot a quantity against a parameter, a curve for each filter with error bars of two standard errors.

    There is one panel for each node and each choice of the other parameters, PANELS at most.
    """
    values = list_parameter_values(campaign, parameter)  # by setting
    shown = dict(list(_group_into_panels(campaign, scores, parameter).items())[:PANELS])  # title: scores
    figure, grid = _make_panels(len(shown), 2.5)
    colours = _assign_colours(scores)
    for axes, (title, of_panel) in zip(grid, shown.items(), strict=False):  # the grid may end with an empty place
        for name in dict.fromkeys(score.filter for score in of_panel):
            curve = [score for score in of_panel if score.filter == name]
            curve.sort(key=lambda score: float(values[score.setting]))
            x = [values[score.setting] for score in curve]
            y, error = _list_scores_and_errors(curve, quantity)
            label = quote_for_figure(name)
            axes.errorbar(x, y, 2 * error, color=colours[name], marker="o", markersize=4, linewidth=1.4, label=label)
        axes.set_title(fill(quote_for_figure(title), TITLE))
    drawn = [score for of_panel in shown.values() for score in of_panel]
    _choose_axis_scale(grid[0], [values[score.setting] for score in drawn], "x")
    figure.supxlabel(quote_for_figure(parameter), fontsize=10, color=INK)
    _finish_figure(figure, grid, drawn, quantity, colours)
    return figure


def _group_into_panels(campaign: Campaign, scores: Sequence[Score], parameter: str) -> dict[str, list[Score]]:
    """Return {title of a panel: its scores}: those of one node whose settings differ only in `parameter`.

    The title names the node, and the values of all other parameters.
    """
    panels: dict[str, list[Score]] = {}
    for score in scores:
        rest = _drop_parameter(campaign.settings[score.setting], parameter)
        title = ", ".join([score.node, *(f"{name} = {value}" for name, value in rest.items())])
        panels.setdefault(title, []).append(score)
    return panels


@matplotlib.rc_context(STYLE)
def plot_by_setting(campaign: Campaign, scores: Sequence[Score], quantity: ScoreColumn) -> Figure:
    """Plot a quantity by setting, a point for each filter with two standard errors; one panel for each node.

    A campaign simulates several settings of a network; `scores` has a mean and its standard error for each setting,
    node and filter. `quantity`: which score is plotted. At most PANELS nodes and SETTINGS settings are drawn.
    """
    nodes = list(dict.fromkeys(score.node for score in scores))[:PANELS]
    settings = list(dict.fromkeys(score.setting for score in scores))[:SETTINGS]
    # One panel for each node, with a row for each setting and a colour for each filter.
    figure, grid = _make_panels(len(nodes), 0.9 + 0.3 * len(settings), columns=1)
    colours = _assign_colours(scores)
    # Filters are shifted within a row, so that their error bars do not overlap.
    shifts = np.linspace(-0.2, 0.2, len(colours))
    for axes, node in zip(grid, nodes, strict=False):
        for shift, name in zip(shifts, colours, strict=True):
            points = [s for s in scores if s.filter == name and s.node == node and s.setting in settings]
            x, error = _list_scores_and_errors(points, quantity)
            heights = [settings.index(score.setting) + shift for score in points]
            label = quote_for_figure(name)
            axes.errorbar(x, heights, xerr=2 * error, color=colours[name], fmt="o", markersize=4, label=label)
        axes.set_yticks(range(len(settings)), [_name_setting(campaign, setting) for setting in settings])
        axes.set_ylim(len(settings) - 0.5, -0.5)  # from below: the first setting is on top
        axes.set_title(quote_for_figure(node))
        if quantity is NEES:  # which is 1 where the claim is right
            axes.axvline(1.0, color=INK, linewidth=1.0, linestyle=DASHED)
    # One scale for all panels, and one legend.
    drawn = [score for score in scores if score.node in nodes and score.setting in settings]
    _choose_axis_scale(grid[0], [getattr(score, quantity.value) for score in drawn], "x")
    grid[-1].set_xlabel(quantity.label)
    _draw_legend(figure, grid, colours)
    return figure


def _name_setting(campaign: Campaign, setting: int) -> str:
    """Return the parameters of a setting as a text for a figure, of 36 characters at most."""
    text = ", ".join(f"{name} = {value}" for name, value in campaign.settings[setting].items())
    return quote_for_figure(text if len(text) <= 36 else text[:35] + "…")


def _make_panels(count: int, height: float, columns: int = 2) -> tuple[Figure, list[Axes]]:
    """Return a figure with `count` axes that share their scales, in rows; axes beyond the count are hidden."""
    columns = min(columns, max(count, 1))
    rows = math.ceil(max(count, 1) / columns)
    figure = Figure(figsize=(WIDTH, 0.5 + height * rows), layout="constrained")
    grid = list(figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True).flat)
    for axes in grid[count:]:
        axes.set_axis_off()
    return figure, grid


def _assign_colours(scores: Sequence[Score]) -> dict[str, str]:
    """Return a colour for each filter, the same in all panels."""
    names = dict.fromkeys(score.filter for score in scores)
    return {name: COLOURS[i % len(COLOURS)] for i, name in enumerate(names)}


def _list_scores_and_errors(scores: Sequence[Score], quantity: ScoreColumn) -> tuple[np.ndarray, np.ndarray]:
    """Return a quantity of each score and its standard error (scores,), 0 where that is not known."""
    values = np.array([getattr(score, quantity.value) for score in scores])
    return values, np.nan_to_num(np.array([getattr(score, quantity.error) for score in scores]))


def _finish_figure(
    figure: Figure, grid: list[Axes], drawn: Sequence[Score], quantity: ScoreColumn, colours: Mapping[str, str]
) -> None:
    """Add what all panels share: the line NEES = 1, the scale, the quantity's name and the legend."""
    if quantity is NEES:
        for axes in grid:
            axes.axhline(1.0, color=INK, linewidth=1.0, linestyle=DASHED)
    _choose_axis_scale(grid[0], [getattr(score, quantity.value) for score in drawn], "y")
    figure.supylabel(quantity.label, fontsize=10, color=INK)
    _draw_legend(figure, grid, colours)


def _choose_axis_scale(axes: Axes, values: Sequence[float], axis: str) -> None:
    """Make a shared axis ("x" or "y") logarithmic if its values are positive and span a ratio above LOGARITHMIC."""
    finite = np.array([value for value in values if np.isfinite(value)])
    if len(set(finite)) > 2 and finite.min() > 0 and finite.max() > LOGARITHMIC * finite.min():
        axes.set_xscale("log") if axis == "x" else axes.set_yscale("log")


def _draw_legend(figure: Figure, grid: list[Axes], colours: Mapping[str, str]) -> None:
    """Draw one legend for all panels, with the colour of each filter that appears in any of them."""
    entries = {name: handle for axes in grid for handle, name in zip(*axes.get_legend_handles_labels(), strict=True)}
    names = [name for name in map(quote_for_figure, colours) if name in entries]
    figure.legend(
        [entries[name] for name in names],
        names,
        loc="outside upper center",
        ncols=min(len(names), 4) or 1,
        frameon=False,
    )
