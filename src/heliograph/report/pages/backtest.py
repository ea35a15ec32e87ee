"""Page of a backtest: what forecasts said ahead, and what came, by horizon."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import matplotlib
import matplotlib.ticker
import numpy as np
from matplotlib.figure import Figure
from scipy.special import bdtr, bdtrc, ndtr

from heliograph.disk.quoted_text import quote_for_figure, visible
from heliograph.report.diagnosis.sensor_output_health import round_to
from heliograph.report.figures import COLOURS, MUTED, STYLE, make_stacked_panels, place_legend_above
from heliograph.report.pages.page import Page, Picture, Points, Section, Table
from heliograph.report.results_folder import Json, ResultsContent

if TYPE_CHECKING:
    import heliograph

FAR = 3.0  # standard errors beyond which a coverage is doubted
SHARES = ("50 %", "80 %", "95 %")
CLAIMED = (0.5, 0.8, 0.95)
DRAWN = 1  # of these, the interval that the figure shows
PANELS = 6  # numbers that it shows; the table has all
LISTED = 3  # filters of which the page speaks before its table


@dataclass(frozen=True)
class CoverageMiss:
    """An interval that held another share of what came than it claims, by more than chance explains."""

    score: "heliograph.forecasting.Score"
    level: int  # index of the interval in SHARES, which claims the share CLAIMED[level]

    @property
    def excess(self) -> float:
        """The share that was inside less the share that was claimed."""
        return self.score.coverage[self.level].value - CLAIMED[self.level]

    @property
    def chance(self) -> float:
        """Probability that an interval which holds what it claims is off as far to this side.

        Forecasts h rows ahead overlap, so that only one in h counts as independent: of n = compared / h values the
        number inside the interval has the binomial law with the claimed share.
        """
        count = max(self.score.compared // self.score.horizon, 1)
        claimed = CLAIMED[self.level]
        inside = self.score.coverage[self.level].value * count
        if self.excess < 0:  # P(at most as many inside), rounded up
            return float(bdtr(np.ceil(inside), count, claimed))
        # P(at least as many inside), rounded down.
        return float(bdtrc(np.floor(inside) - 1, count, claimed)) if inside >= 1 else 1.0

    def describe(self) -> str:
        """Return in words what share of the values an interval held, and what this says of the forecast.

        `self.level` is the interval's index in SHARES, and `self.excess` the share that it held minus that it claims.
        """
        score = self.score
        claim = SHARES[self.level]
        share = self.score.coverage[self.level]
        verdict = "too sure" if self.excess < 0 else "too cautious"
        forecast = f"{score.part} {score.name}, {score.horizon} ahead"
        return f"{forecast}: the interval of {claim} held {share.value:.1%} +- {share.error:.1%}: {verdict}"


@dataclass(frozen=True)
class FilterVerdict:
    """What a filter's forecasts were worth: how many intervals were compared, and those that did not hold."""

    name: str
    compared: int
    misses: Sequence[CoverageMiss]

    def summarise(self) -> str:
        """Return what its forecasts are worth in words: "hold", "are off", "are too sure" or "are too cautious".

        They "are not judged" where nothing came that an interval could miss.
        """
        if not self.compared:
            return "are not judged"
        if not self.misses:
            return "hold"
        if all(miss.excess < 0 for miss in self.misses):
            return "are too sure"
        return "are off" if any(miss.excess < 0 for miss in self.misses) else "are too cautious"

    def describe(self) -> str:
        """Return a sentence on what the filter's forecasts are worth, with numbers and the interval furthest off."""
        if not self.compared:
            return f"{self.name}: nothing came that an interval could miss."
        if not self.misses:
            return f"{self.name}: all {self.compared} intervals held what they claim, as far as chance lets tell."
        worst = max(self.misses, key=lambda miss: abs(miss.excess))
        failed = f"{len(self.misses)} of {self.compared} intervals did not hold"
        return f"{self.name}: {failed}; furthest off {worst.describe()}."


def make_backtest_results(found: "heliograph.forecasting.Backtest", network: str, refit: int = 0) -> ResultsContent:
    """Return the content of the results folder of a backtest: its figure, page and summary.

    Args:
        found: the scores.
        network: the user's name of the network.
        refit: rows between fits of its free numbers; 0 by default, for none.
    """
    return ResultsContent(
        figures={"coverage": _draw_coverage(found)},
        page=lambda drawings: make_backtest_page(found, network, drawings, refit),
        summary=_list_all_numbers(found) | ({"refit": refit} if refit else {}),
    )


def judge_forecasts_of_filters(found: "heliograph.forecasting.Backtest") -> list[FilterVerdict]:
    """Return the verdict on each filter's forecast intervals, the filter with the largest share of misses first.

    An interval claims to hold a share (SHARES) of what comes. It is a miss if the share that it held differs from the
    claim by more than FAR (3) of its standard errors, and the binomial probability of such a difference (`chance`) is
    also below that of 3 standard errors under a normal law. A filter's `compared` counts its intervals in which
    anything came. `found`: the scores of forecasts, by filter, number and horizon.
    """
    verdicts = []
    for name in dict.fromkeys(f"{score.node}/{score.filter}" for score in found.scores):
        scores = [s for s in found.scores if f"{s.node}/{s.filter}" == name and np.isfinite(s.coverage[0].value)]
        intervals = [CoverageMiss(score, level) for score in scores for level in range(len(SHARES))]
        misses = [
            miss
            for miss in intervals
            if abs(miss.excess) > FAR * miss.score.coverage[miss.level].error and miss.chance < ndtr(-FAR)
        ]
        verdicts.append(FilterVerdict(name, len(intervals), misses))
    return sorted(verdicts, key=lambda verdict: len(verdict.misses) / max(verdict.compared, 1), reverse=True)


def describe_coverage_misses(found: "heliograph.forecasting.Backtest") -> list[str]:
    """Return a line for each coverage that is further from what was claimed than chance explains."""
    return [f"{v.name}, {miss.describe()}" for v in judge_forecasts_of_filters(found) for miss in v.misses]


@matplotlib.rc_context(STYLE)
def _draw_coverage(found: "heliograph.forecasting.Backtest") -> Figure:
    """Draw how often what came was within the forecast's interval of 80 %, over the horizon.

    There is a panel for each forecast state or output (the first PANELS), and a line for each filter. The dashed line
    is the claimed 80 %. Bars are 2 standard errors. `found` holds the scores of forecasts on recorded data.
    `s.coverage` has the shares that came within the intervals of 50, 80 and 95 %, with standard errors; DRAWN picks 80
    %.
    """
    numbers = list(dict.fromkeys((s.node, s.part, s.name) for s in found.scores))[:PANELS]
    filters = list(dict.fromkeys(s.filter for s in found.scores))
    nodes = {node for node, _, _ in numbers}
    figure, panels = make_stacked_panels(len(numbers), height=1.3, margin=0.9)
    for axes, (node, part, name) in zip(panels, numbers, strict=True):
        for i, filter in enumerate(filters):
            scores = [s for s in found.scores if (s.node, s.part, s.name, s.filter) == (node, part, name, filter)]
            shares = [s.coverage[DRAWN] for s in scores]
            # A factor shifts by the same length everywhere on a logarithmic axis: filters stand side by side, about 1.
            shift = np.exp(0.04 * (i - (len(filters) - 1) / 2))
            axes.errorbar(
                [s.horizon * shift for s in scores],
                [share.value for share in shares],
                [2 * share.error for share in shares],
                label=quote_for_figure(filter) if axes is panels[0] else None,
                color=COLOURS[i % len(COLOURS)],
                marker="o",
                markersize=4,
                linewidth=1,
            )
        axes.axhline(CLAIMED[DRAWN], color=MUTED, linewidth=1, linestyle="--")
        axes.set_title(quote_for_figure(f"{part} {name}" if len(nodes) == 1 else f"{node}: {part} {name}"))
        axes.set(ylim=(-0.03, 1.03), yticks=[0, 0.4, 0.8], xscale="log")
        axes.set_xticks(found.horizons, [str(h) for h in found.horizons])
        axes.xaxis.set_minor_locator(matplotlib.ticker.NullLocator())
    panels[-1].set_xlabel("rows ahead")
    place_legend_above(figure, panels[0], 2)
    return figure


def make_backtest_page(
    found: "heliograph.forecasting.Backtest", network: str, drawings: Mapping[str, bytes], refit: int = 0
) -> Page:
    """Return the page of a backtest: forecasts from past rows, scored by what came later.

    A verdict says of one filter how many of its intervals were compared, and which missed what they claim. DRAWN is the
    index of the interval of 80 % in SHARES; PANELS numbers are drawn, LISTED filters get a sentence.

    Args:
        found: the scores of each forecast number, by node, filter and horizon.
        network: the user's name of the network.
        drawings: each figure as SVG, by name.
        refit: rows between fits of the network's free numbers; 0 by default, for none.
    """
    # Text at the head of the page, below the figure, and a sentence for each filter.
    verdicts = judge_forecasts_of_filters(found)
    lead = (
        f"From each of {found.rows:,} rows `{visible(network)}` forecast {', '.join(map(str, found.horizons))} rows "
        "ahead, as if nothing more arrived; scored is what came."
    )
    if refit:
        lead += f" Its free numbers were fitted every {refit} rows, to those before."
    caption = (
        f"Share of what came within the interval of {SHARES[DRAWN]}, with two standard errors, which know that "
        "forecasts overlap; the dashed line is what was claimed."
    )
    not_drawn = len({(s.node, s.part, s.name) for s in found.scores}) - PANELS
    if not_drawn > 0:
        caption += f" {not_drawn} more numbers are in the table."
    sentences = [visible(v.describe()) for v in verdicts[:LISTED]]
    if len(verdicts) > LISTED:
        sentences.append(f"{len(verdicts) - LISTED} more filters, none of them further off: in the table.")
    by_horizon: list[Picture | Table] = [Picture(drawings["coverage"], caption, caption), _make_score_table(found)]
    return Page(
        kicker=f"Heliograph backtest: {visible(network)}",
        title=_make_title(verdicts),
        lead=lead,
        sections=[Section("At a glance", [Points(sentences)]), Section("By horizon", by_horizon)],
    )


def _make_title(verdicts: Sequence[FilterVerdict]) -> str:
    """Return the page's title: what the forecasts of one or two filters are worth, or of more how many hold.

    The most doubtful verdict is the first of `verdicts`, and is named last in the title.
    """
    if len(verdicts) > 2:
        count = sum(not verdict.misses for verdict in verdicts)
        return f"The forecasts of {count} of {len(verdicts)} filters hold"
    of_filters = [f"{visible(verdict.name)} {verdict.summarise()}" for verdict in reversed(verdicts)]
    return "Forecasts of " + ", those of ".join(of_filters)


def _make_score_table(found: "heliograph.forecasting.Backtest") -> Table:
    """Return all scores, a row for each forecast and horizon, with their standard errors.

    `found`: the scores; a score has node, filter, part (state or output), name, horizon, and means with standard
    errors.
    """
    # The RMSE is a root, so its standard error is that of the mean square divided by twice the root.
    rows = [
        [visible(f"{s.node}/{s.filter} {s.part} {s.name}"), str(s.horizon), f"{s.compared:,}",
         round_to(s.rmse, s.mse.error / (2 * s.rmse) if s.rmse > 0 else np.nan),
         round_to(s.bias.value, s.bias.error),
         *("–" if np.isnan(share.value) else f"{share.value:.1%} ± {share.error:.1%}" for share in s.coverage),
         round_to(s.log_score.value, s.log_score.error), round_to(s.crps.value, s.crps.error)]
        for s in found.scores
    ]  # fmt: skip
    headers = ["forecast of", "ahead", "compared", "RMSE", "bias", *SHARES, "log score", "CRPS"]
    return Table(headers, rows, "**Log score**: the larger the better. **CRPS**: the smaller the better, in its unit.")


def _list_all_numbers(found: "heliograph.forecasting.Backtest") -> dict[str, Json]:
    """Return all numbers of the backtest for its summary.

    `found.scores` has a score for each forecast number, filter and horizon, whose `row()` is {name: number}. JSON has
    no NaN: it becomes None.
    """

    def convert_to_json(value: object) -> Json:
        """Return texts and integers as they are, finite numbers as floats, and None for everything else."""
        if isinstance(value, str | int):
            return value
        return float(value) if isinstance(value, float) and np.isfinite(value) else None

    scores: list[Json] = [{name: convert_to_json(value) for name, value in s.row().items()} for s in found.scores]
    return {
        "rows": found.rows,
        "horizons": list(found.horizons),
        "warnings": describe_coverage_misses(found),
        "scores": scores,
    }
