"""Report of a design: Pareto front, powers by transmitter, map, certificate, and the value of changes."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator

from heliograph.disk.quoted_text import quote_for_figure, visible
from heliograph.numerics.confidence_intervals import round_to
from heliograph.planning.design_comparisons import ChangeWorth, ErrorsOverPower, ErrorsOverSites
from heliograph.planning.design_problem import PowerDesign
from heliograph.report.figures import AMBER, BLUE, GREEN, INK, PALE, STYLE, VERMILION, WIDTH
from heliograph.report.pages.page import Code, KeyFigure, KeyFigures, Page, Picture, Section, Table, Text
from heliograph.report.results_folder import Json, ResultsContent

MOST = 40  # transmitters that are drawn; the table and the summary hold all
ROUNDING = 1e-12  # of the total power
SOURCE, DESIGNED = "network.py", "designed.py"


@dataclass(frozen=True)
class DesignResults:
    """Content of the report of a design.

    Args:
        reference: the user's name of the network.
        source: its Python source.
        design: the designed powers, with their certificate.
        before: mean power of each transmitter before the design.
        front: least error over total power.
        changes: what one more transmitter, relay or place would save.
        map: error over places for one more; None unless asked for.
        written: the designed network as Python source.
    """

    reference: str
    source: str
    design: PowerDesign
    before: Mapping[str, float]
    front: ErrorsOverPower
    changes: Sequence[ChangeWorth]
    map: ErrorsOverSites | None
    written: str


def make_design_results(results: DesignResults) -> ResultsContent:
    """Return the content of the results folder of a design: figures, page, summary and the two networks' sources.

    `results` has the design, the powers before it, the least error by total power (`front`), what changes are worth,
    and the source of both networks. `page` and `write_data` are called later, with the figures as SVG and with the
    folder.
    """
    return ResultsContent(
        figures=draw_design_figures(results),
        page=partial(make_design_page, results),
        summary=make_design_summary(results),
        write_data=partial(write_networks, results),
    )


def write_networks(results: DesignResults, folder: Path) -> None:
    """Write the original network, and in the same folder the designed one, which reads it.

    SOURCE and DESIGNED are their file names.
    """
    (folder / SOURCE).write_text(results.source, encoding="utf-8")
    (folder / DESIGNED).write_text(results.written, encoding="utf-8")


def compute_mean_powers(design: PowerDesign) -> dict[str, float]:
    """Return the mean power of each transmitter over time; one that is only rounding error of the total counts as 0."""
    mean = {name: float(np.mean(power)) for name, power in design.powers.items()}
    return {name: power if power > ROUNDING * design.total else 0.0 for name, power in mean.items()}


def make_design_summary(results: DesignResults) -> dict[str, Json]:
    """Return all numbers of the report of a design by name, as summary.json holds them.

    `certificate` is the proof of how good the design is: a lower bound of the error, and the gap to it. `front` is the
    least error by total power; `changes` are what one more transmitter, relay or place saves; `map` has the error over
    places for one more, or is None.
    """
    design, certificate = results.design, results.design.certificate
    # JSON has no arrays: all numbers become lists.
    best = None if results.map is None else dict(zip(("x", "y", "error"), results.map.best, strict=True))
    return {
        "error": design.error,
        "present": design.present,
        "total": design.total,
        "powers": {name: np.asarray(power).tolist() for name, power in design.powers.items()},
        "certificate": {
            "words": certificate.words, "convex": certificate.convex, "value": certificate.value,
            "bound": certificate.bound, "gap": certificate.gap, "starts": certificate.starts,
        },
        "sensitivity": dict(design.sensitivity),
        "price": design.price,
        "front": {key: np.asarray(value).tolist() for key, value in results.front._asdict().items()},
        "changes": {change.name: {"value": change.value, "saved": change.saved} for change in results.changes},
        "map": best,
    }  # fmt: skip


def draw_design_figures(results: DesignResults) -> dict[str, Figure]:
    """Return figures by file name: the front (least error by total power), the powers, and the map if there is one.

    `results.before` holds the powers of the network before the design.
    """
    design = results.design
    figures = {"front": draw_pareto_front(results.front, {"this design": (design.total, design.error)})}
    figures["powers"] = draw_powers(results.before, compute_mean_powers(design))
    if results.map is not None:
        figures["map"] = draw_error_map(results.map)
    return figures


@matplotlib.rc_context(STYLE)
def draw_pareto_front(front: ErrorsOverPower, marks: Mapping[str, tuple[float, float]]) -> Figure:
    """Plot error over total power: the least error found, the proven lower bound, and named points.

    `marks`: {name: (power, error)} of points to mark, at most three. `front`: total powers, with errors and lower
    bounds.
    """
    figure = Figure(figsize=(WIDTH, 3.4), layout="constrained")
    axes = figure.subplots()
    # A bound at some power holds for all smaller powers: hence steps.
    axes.fill_between(front.totals, front.bounds, 0, step="pre", color=PALE, alpha=0.6, linewidth=0, label="impossible")
    axes.plot(front.totals, front.errors, "o-", color=BLUE, linewidth=1.6, markersize=4, label="found")
    for (name, (power, error)), colour in zip(marks.items(), (VERMILION, AMBER, GREEN), strict=False):
        axes.plot([power], [error], "D", color=colour, markeredgecolor=INK, markersize=8, label=quote_for_figure(name))
    spread = np.ptp(front.errors)
    every = [*front.errors, *(error for _, error in marks.values())]
    axes.set(xscale="log", xlabel="total mean power", ylabel="error", xlim=(front.totals[0], front.totals[-1]))
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter("{x:g}")
    axes.set_ylim(max(front.bounds.min() - 0.15 * spread, 0.0), max(every) + 0.1 * spread)
    axes.legend(frameon=False, fontsize=9)
    return figure


@matplotlib.rc_context(STYLE)
def draw_powers(before: Mapping[str, float], after: Mapping[str, float]) -> Figure:
    """Plot the mean power of the MOST (40) strongest transmitters: a bar for the design, a mark for what it was.

    `before` and `after` hold the powers by transmitter.
    """
    largest_names = sorted(after, key=lambda name: -after[name])[:MOST]
    names = [name for name in after if name in largest_names]
    figure = Figure(figsize=(WIDTH, 0.9 + 0.28 * len(names)), layout="constrained")
    axes = figure.subplots()
    heights = np.arange(len(names))[::-1]
    axes.barh(heights, [after[name] for name in names], height=0.55, color=BLUE, label="designed")
    axes.plot([before.get(name, np.nan) for name in names], heights, "|", color=VERMILION, markersize=13,
              markeredgewidth=2.2, label="as it is")  # fmt: skip
    axes.set_yticks(heights, [quote_for_figure(name) for name in names])
    largest = max(np.nanmax([values.get(name, np.nan) for name in names]) for values in (before, after))
    axes.set(xlabel="mean power", xlim=(0, 1.05 * (largest or 1.0)))
    axes.grid(visible=False, axis="y")
    figure.legend(loc="outside upper right", ncols=2, frameon=False, fontsize=9)
    return figure


@matplotlib.rc_context(STYLE)
def draw_error_map(sites: ErrorsOverSites) -> Figure:
    """Plot the error over places, darker where it is smaller, with the best place.

    `sites`: places x and y, the errors there, and the best place with its error.
    """
    figure = Figure(figsize=(WIDTH, 4.6), layout="constrained")
    axes = figure.subplots()
    picture = axes.contourf(sites.x, sites.y, sites.errors, levels=14, cmap="cividis")
    east, north, least = sites.best
    axes.plot([east], [north], "*", color="white", markeredgecolor=INK, markersize=16)
    axes.set(xlabel="x", ylabel="y", aspect="equal", title=f"best at ({east:.3g}, {north:.3g}): {least:.4g}")
    axes.grid(visible=False)
    figure.colorbar(picture, ax=axes, label="error", shrink=0.8, format="%.3g")
    return figure


def make_design_page(results: DesignResults, drawings: Mapping[str, bytes]) -> Page:
    """Return the page of a design; `drawings` holds each figure as SVG, by the names of `draw_design_figures`.

    Sections: the result with its certificate, the front (least error by total power), the powers, a map of places if
    one was asked for, what changes would save, and how to run the network.
    """
    design = results.design
    sections = [_make_result_section(results), _make_front_section(drawings), _make_powers_section(results, drawings)]
    if results.map is not None:
        sections.append(_make_map_section(drawings))
    return Page(
        kicker="Heliograph design",
        title=_make_headline(results),
        lead=(
            f"The network {visible(results.reference)} has the error {design.present:.4g} and sends "
            f"{sum(results.before.values()):.4g} as it is. Designed, it has the error {design.error:.4g} and sends "
            f"{design.total:.4g}."
        ),
        sections=[*sections, _make_changes_section(results), _explain_how_to_run()],
    )


def _make_headline(results: DesignResults) -> str:
    """Return the title: how much less or more error and total power the design has than the network as it is.

    `results`: the design, whose `present` is the error as the network is, and the powers `before` by transmitter.
    """
    design, power_now = results.design, sum(results.before.values())
    changes = []
    for what, designed, present in (("error", design.error, design.present), ("power", design.total, power_now)):
        if present > 0 and abs(designed - present) > 1e-3 * present:  # a smaller change is not worth a headline
            less_or_more = "less" if designed < present else "more"
            changes.append(f"{100 * abs(1 - designed / present):.3g} % {less_or_more} {what}")
    return f"By design: {' with '.join(changes)}" if changes else "No design is better than the network as it is"


def _make_result_section(results: DesignResults) -> Section:
    """Return the section on the design's error and power, beside those of the present network, and its certificate.

    The certificate is a proven bound: no design has a smaller error. `results`: the design, and the powers before it.
    """
    design = results.design
    keys = [
        KeyFigure("error", f"{design.error:.4g}", f"{design.present:.4g} as the network is", BLUE),
        KeyFigure("total power", f"{design.total:.4g}", f"{sum(results.before.values()):.4g} as it is", VERMILION),
        KeyFigure("not below", f"{design.certificate.bound:.4g}", f"{design.certificate.unit}, proven", GREEN),
    ]
    words = f"**How good it is:** {design.certificate.words}."
    return Section("The design", [KeyFigures(keys), Text([words])])


def _make_front_section(drawings: Mapping[str, bytes]) -> Section:
    """Return the section with the picture of the least error over total power, and its lower bound."""
    caption = "The least error found at each total power. Nothing lies in the grey region, whatever is tried."
    return Section("Error against power", [Picture(drawings["front"], "Error falling with total power.", caption)])


def _make_powers_section(results: DesignResults, drawings: Mapping[str, bytes]) -> Section:
    """Return the section on the powers by transmitter, before and after, and what one more watt saves at each.

    `slope`: by transmitter the change of the error for one unit more of its mean power, negative where that helps.
    `results`: the design, and the powers before it. `drawings`: each figure as SVG.
    """
    after = compute_mean_powers(results.design)
    slope = results.design.sensitivity
    rows = [
        [visible(name), f"{results.before.get(name, float('nan')):.4g}", f"{power:.4g}",
         f"{np.max(results.design.powers[name]):.4g}", f"{max(-slope[name], 0.0):.3g}"]
        for name, power in after.items()
    ]  # fmt: skip
    caption = (
        "**One more watt here**: by how much the error falls for one unit of mean power more at this transmitter; "
        f"where a total binds, it is the same ({results.design.price:.3g}) for all that send below limits of their "
        "own, and less for those that do not send."
    )
    headers = ("transmitter", "as it is", "designed", "peak", "one more watt here")
    picture = Picture(drawings["powers"], "Bars of power by transmitter, with marks for what is sent now.")
    return Section("Who sends how much", [picture, Table(headers, rows, caption)])


def _make_map_section(drawings: Mapping[str, bytes]) -> Section:
    """Return the section with the map of the error over the places where a node may stand."""
    caption = "The least error at the design's total power, with the network standing as the map's function says."
    return Section("Where", [Picture(drawings["map"], "The error over places, with the best one.", caption)])


def _make_changes_section(results: DesignResults) -> Section:
    """Return the section on what one more transmitter, relay or place would save.

    A change has a name, the error of the design made again (`value`), and by how much that is less (`saved`).
    """
    unit = results.design.certificate.unit
    # The search finds the error to about a thousandth, so a saving is rounded to two digits of that.
    rows = [
        [visible(change.name), f"{change.value:.4g}", round_to(change.saved, 1e-3 * change.value)]
        for change in results.changes
    ]
    caption = (
        f"The {unit} of the design made again after each change, and how much of it that saves. A relay halfway is put "
        "in where the exponent of the path loss is given."
    )
    return Section("What one more would buy", [Table(("change", unit, "saved"), rows, caption)])


def _explain_how_to_run() -> Section:
    """Return the section on how to run the designed network."""
    commands = f"heliograph run {DESIGNED} --measurements data.csv --out estimates.csv"
    text = (
        f"`{DESIGNED}` is the network with these powers and the best linear filters for them; it reads `{SOURCE}`, "
        "the network as it was, in the same folder. `summary.json` holds every number of this page."
    )
    return Section("Run it", [Code(commands), Text([text])])
