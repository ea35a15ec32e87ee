"""Page of a backtest: what forecasts said ahead, and what came, by horizon."""

from collections.abc import Mapping
from typing import TYPE_CHECKING

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from heliograph.disk.quoting import quote_for_figure, visible
from heliograph.report.figures import COLOURS, MUTED, STYLE, WIDTH, place_legend_above
from heliograph.report.outputs import round_to
from heliograph.report.pages.page import Page, Picture, Points, Section, Table, Text
from heliograph.report.results import Json, Results

if TYPE_CHECKING:
    import heliograph

FAR = 3.0  # standard errors beyond which a coverage is doubted
SHARES = ("50 %", "80 %", "95 %")
CLAIMED = (0.5, 0.8, 0.95)


def make_backtest_results(found: "heliograph.forecasting.Backtest", network: str, refit: int = 0) -> Results:
    """Return the content of the results folder.

    Args:
        found: the scores.
        network: the user's name of the network.
        refit: rows between fits of its free numbers; 0 by default, for none.
    """
    return Results(
        {"coverage": _draw_coverage(found)},
        lambda drawings: make_backtest_page(found, network, drawings, refit),
        _summarise(found) | ({"refit": refit} if refit else {}),
    )


def list_doubts(found: "heliograph.forecasting.Backtest") -> list[str]:
    """List coverages that are further from what was claimed than chance explains, a line each."""
    return [
        f"{s.node}/{s.filter}, {s.part} {s.name}, {s.horizon} ahead: the interval of {said} held {share.value:.1%} "
        f"+- {share.error:.1%}: {'too sure' if share.value < claimed else 'too cautious'}"
        for s in found.scores
        for said, claimed, share in zip(SHARES, CLAIMED, s.coverage, strict=True)
        if abs(share.value - claimed) > FAR * share.error
    ]


@matplotlib.rc_context(STYLE)
def _draw_coverage(found: "heliograph.forecasting.Backtest") -> Figure:
    """Return the share within the intervals of 80 and 95 % over the horizon, with two standard errors on each side."""
    figure = Figure(figsize=(WIDTH, 3.2), layout="constrained")
    axes = figure.subplots()
    named = list(dict.fromkeys((s.node, s.filter, s.part, s.name) for s in found.scores))
    for number, key in enumerate(named):
        scores = [s for s in found.scores if (s.node, s.filter, s.part, s.name) == key]
        for place, marker in ((1, "s"), (2, "o")):
            shares, errors = zip(*((s.coverage[place].value, 2 * s.coverage[place].error) for s in scores), strict=True)
            label = quote_for_figure(f"{key[0]}/{key[1]} {key[3]}") if place == 2 else None
            colour, places = COLOURS[number % len(COLOURS)], [s.horizon for s in scores]
            axes.errorbar(places, shares, errors, label=label, color=colour, marker=marker, markersize=4, linewidth=1)
    for claimed in CLAIMED[1:]:
        axes.axhline(claimed, color=MUTED, linewidth=1)
    axes.set(xlabel="rows ahead", ylabel="share inside", ylim=(None, 1.02), xticks=found.horizons)
    place_legend_above(figure, axes, 2)
    return figure


def make_backtest_page(
    found: "heliograph.forecasting.Backtest", network: str, drawings: Mapping[str, bytes], refit: int = 0
) -> Page:
    """Return the page; `drawings` holds each figure as SVG, `refit` is how many rows lay between fits, 0 for none."""
    doubts = [visible(line) for line in list_doubts(found)]
    title = f"{len(doubts)} claims ahead do not hold" if doubts else "What was said ahead held"
    lead = (
        f"From each of {found.rows:,} rows `{visible(network)}` forecast {', '.join(map(str, found.horizons))} rows "
        "ahead, as if nothing more arrived; scored is what came."
        + (f" Its free numbers were fitted every {refit} rows, to those before." if refit else "")
    )
    caption = (
        "Share of what came within the intervals of 80 % (squares) and 95 % (dots), with two standard errors, which "
        "know that forecasts overlap; the lines are what was claimed."
    )
    parts: list[Picture | Table] = [Picture(drawings["coverage"], caption, caption), _make_score_table(found)]
    none = "No coverage is further from its claim than chance explains."
    said = Points(doubts) if doubts else Text([none])
    return Page(f"Heliograph backtest: {visible(network)}", title, lead,
                [Section("At a glance", [said]), Section("By horizon", parts)])  # fmt: skip


def _make_score_table(found: "heliograph.forecasting.Backtest") -> Table:
    """Return all scores, a row for each forecast and horizon, with their standard errors."""
    rows = [
        [visible(f"{s.node}/{s.filter} {s.part} {s.name}"), str(s.horizon), f"{s.compared:,}",
         round_to(s.rmse, s.mse.error / (2 * s.rmse) if s.rmse > 0 else np.nan),
         round_to(s.bias.value, s.bias.error),
         *(f"{share.value:.1%} ± {share.error:.1%}" for share in s.coverage),
         round_to(s.log_score.value, s.log_score.error), round_to(s.crps.value, s.crps.error)]
        for s in found.scores
    ]  # fmt: skip
    headers = ["forecast of", "ahead", "compared", "RMSE", "bias", *SHARES, "log score", "CRPS"]
    return Table(headers, rows, "**Log score**: the larger the better. **CRPS**: the smaller the better, in its unit.")


def _summarise(found: "heliograph.forecasting.Backtest") -> dict[str, Json]:
    """Return all numbers; what is no number is null."""

    def plain(value: object) -> Json:
        if isinstance(value, str | int):
            return value
        return float(value) if isinstance(value, float) and np.isfinite(value) else None

    scores: list[Json] = [{name: plain(value) for name, value in s.row().items()} for s in found.scores]
    return {"rows": found.rows, "horizons": list(found.horizons), "warnings": list_doubts(found), "scores": scores}
