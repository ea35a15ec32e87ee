"""Report of a fit: estimates with intervals, numbers that the data do not determine, and effects on filters."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial

import matplotlib
import numpy as np
import scipy
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from heliograph.disk.quoted_text import quote_for_figure, visible
from heliograph.learning.estimate_row import Row
from heliograph.learning.fit_result import Fit
from heliograph.learning.held_out_comparison import HeldOutTransforms, PredictionBeforeAndAfter
from heliograph.learning.packet_losses.learn_losses import Losses
from heliograph.report.figures import (
    AMBER,
    BLUE,
    GREEN,
    MUTED,
    PALE,
    STYLE,
    VERMILION,
    make_stacked_panels,
    place_legend_above,
)
from heliograph.report.pages.page import Code, KeyFigure, KeyFigures, Page, Picture, Points, Section, Table, Text

MOST = 40  # numbers, filters and nodes that are drawn; tables hold all
BINS = 20
LOGARITHMIC = 10.0  # times the least of what is shown of a positive number: then its axis is logarithmic


@dataclass(frozen=True)
class FitResults:
    """Content of the report: the fit, from `learned` rows, and its effect on the `held_out` rows after them.

    Args:
        network: the user's name of the network.
        measurements: the user's name of the recording.
        fit: what was learned.
        learned: number of rows that it was learned from.
        held_out: number of rows after them.
        changes: each filter on the rows held out, before and after.
        uniform: whether the laws fit these rows, by node.
        losses: laws of lost measurements, by node.
    """

    network: str
    measurements: str
    fit: Fit
    learned: int
    held_out: int
    changes: list[PredictionBeforeAndAfter]
    uniform: list[HeldOutTransforms]
    losses: dict[str, Losses]

    @property
    def starts(self) -> dict[str, float]:
        """Return {name of a free number: the value at which the fit started}."""
        parameters = self.fit.description.parameters
        return dict(zip([e.name for e in parameters.entries], parameters.entries_at(parameters.start), strict=True))


def draw_fit_figures(learned: FitResults) -> dict[str, Figure]:
    """Return figures by file name: estimates, correlations of innovations before and after the fit, and PITs.

    PITs are probability integral transforms of what was received: the probability, by the network, of a smaller value.
    They are uniform if the network is right. A figure has at most MOST filters or nodes. Figures without data are left
    out.
    """
    figures = {"estimates": _draw_estimates(learned)}
    with_tests = [change for change in learned.changes if change.before.test and change.after.test]
    if with_tests:
        figures["innovations"] = _draw_correlations(with_tests[:MOST])
    with_numbers = [transforms for transforms in learned.uniform if np.any(~np.isnan(transforms.pit))]
    if with_numbers:
        figures["pits"] = _draw_probability_transforms(with_numbers[:MOST])
    return figures


@matplotlib.rc_context(STYLE)
def _draw_estimates(learned: FitResults) -> Figure:
    """Draw the estimates with intervals and start values, a panel for each free number, since units differ.

    There is an estimate for each form of the likelihood: "linear" takes what random gains add to the variance from
    moments before any data, "conditional" from moments given the data. The best form is drawn in blue. `rows` are the
    lines of the table of estimates: name, estimate and interval of each free number, one table for each form.
    `learned`: the fit, and the values at which it started.
    """
    rows = learned.fit.rows()[:MOST]
    # The best form is the last of the solutions. It is drawn at height 0, another one below it at -1.
    forms = [solution.form for solution in reversed(learned.fit.solutions)]
    by_form = [learned.fit.rows(form=form) for form in forms]
    figure, grid = make_stacked_panels(len(rows), height=0.62, margin=0.6, sharex=False)
    for i, (axes, row) in enumerate(zip(grid, rows, strict=True)):
        for height, estimates in enumerate(by_form):
            color, width = (BLUE, 3.0) if height == 0 else (MUTED, 1.5)
            _draw_estimate(axes, estimates[i], -height, color, width)
        start = learned.starts[row.name]  # a triangle above
        axes.plot(start, 0.6, "v", color=AMBER, markersize=5, clip_on=False)
        # A positive number whose panel spans more than a factor of ten gets a logarithmic axis.
        shown = [row.low, row.high, row.estimate, start]
        if min(shown) > 0 and max(shown) > LOGARITHMIC * min(shown):
            axes.set_xscale("log")
        axes.set_ylim(-len(forms) + 0.4, 0.9)
        axes.set_yticks([])
        axes.set_ylabel(quote_for_figure(row.name), rotation=0, ha="right", va="center")
        axes.margins(x=0.08)
        axes.grid(visible=False, axis="y")
    return figure


def _draw_estimate(axes: Axes, row: Row, height: float, color: str, width: float) -> None:
    """Draw an estimate and its interval, if it has one, at a height; a cross if the data do not determine it."""
    ends = [row.low, row.high]
    if np.isfinite(ends).all():
        axes.plot(ends, [height, height], color=color, linewidth=width, alpha=0.7)
    axes.plot(row.estimate, height, "o" if row.identified else "x", color=color, markersize=6)


@matplotlib.rc_context(STYLE)
def _draw_correlations(tested: list[PredictionBeforeAndAfter]) -> Figure:
    """Draw the correlations of innovations some rows apart, before and after learning, with 95 % intervals.

    `tested`: filters with a test of the innovations before and after, whose correlations are by lag.
    """
    figure, grid = make_stacked_panels(len(tested), height=1.6, margin=0.7)
    for axes, change in zip(grid, tested, strict=True):
        # Bars before learning stand left of each lag, those after it right.
        sides = ((-0.17, AMBER, change.before.test, "before"), (0.17, BLUE, change.after.test, "after"))
        for shift, color, test, label in sides:
            assert test is not None
            lags = np.arange(1, len(test.correlation) + 1)
            axes.bar(lags + shift, test.correlation, 0.3, color=color, label=label)
            axes.errorbar(lags + shift, test.correlation, 1.96 * test.standard_error, fmt="none", ecolor=MUTED, lw=1)
        axes.axhline(0.0, color=MUTED, linewidth=0.8)
        axes.set_title(quote_for_figure(f"{change.node}/{change.filter}"))
        axes.set_ylabel("correlation")
        axes.set_xticks(lags)
    place_legend_above(figure, grid[0])
    grid[-1].set_xlabel("rows apart")
    return figure


@matplotlib.rc_context(STYLE)
def _draw_probability_transforms(received: list[HeldOutTransforms]) -> Figure:
    """Draw the histogram of each node's probability integral transforms, which are uniform if the network is right.

    The grey band holds 95 % of the bars then. `received`: by node the transforms of the held-out rows (`pit`), NaN
    where nothing arrived.
    """
    figure, grid = make_stacked_panels(len(received), height=1.5, margin=0.7)
    edges = np.linspace(0, 1, BINS + 1).tolist()
    for axes, transforms in zip(grid, received, strict=True):
        values = transforms.pit[~np.isnan(transforms.pit)]
        count = len(values)
        # A bar holds a binomial number of `count`; as a density its share is divided by its width 1 / BINS.
        low, high = (scipy.stats.binom.ppf(p, count, 1 / BINS) / count * BINS for p in (0.025, 0.975))
        axes.hist(values, edges, weights=np.full(count, BINS / count), color=BLUE, alpha=0.8)
        axes.axhspan(low, high, color=PALE, alpha=0.6, linewidth=0, zorder=0)
        axes.axhline(1.0, color=MUTED, linewidth=0.8)
        axes.set_title(quote_for_figure(transforms.node))
        axes.set_ylabel("density")
    grid[-1].set_xlabel("probability of a smaller value")
    return figure


def make_fit_page(learned: FitResults, drawings: Mapping[str, bytes]) -> Page:
    """Return the page of a fit; `drawings` holds each figure as SVG, by the names of `draw_fit_figures`.

    `learned` has the fit, the numbers of rows that were learned from and held out, what each filter predicts of the
    held-out rows before and after, and the laws of lost measurements by node.
    """
    return Page(
        kicker="Heliograph fit",
        title=_make_headline(learned),
        lead=_summarise_gain(learned),
        sections=[
            Section("At a glance", _list_key_figures(learned)),
            Section("What was learned", _make_estimates_table(learned, drawings)),
            Section("What to keep in mind", _list_sentences(learned)),
            *_make_comparison_sections(learned, drawings),
            *_make_losses_section(learned),
            *_make_delays_section(learned),
            Section("Use it", [Code("heliograph run DIR/fitted_network.py --measurements data.csv --report report"),
                               Text(["DIR is this folder: `fitted_network.py` loads the numbers of `fitted.json`."])]),
        ],
    )  # fmt: skip


def _make_headline(learned: FitResults) -> str:
    """Return the title: how many numbers were learned."""
    rows = learned.fit.rows()
    return f"{sum(row.identified for row in rows)} of {len(rows)} free numbers learned from {learned.learned:,} rows"


def _summarise_gain(learned: FitResults) -> str:
    """Return the page's lead: whether the first filter predicts the held-out rows better after the fit than before.

    It also says from which recording, and for which network. A gain is significant beyond 1.96 standard errors.
    `learned.changes`: each filter on the held-out rows, with its `gain` of log-likelihood per row, None if there are
    too few.
    """
    source = f"From `{visible(learned.measurements)}`, for the network `{visible(learned.network)}`."
    gains = [(change, change.gain) for change in learned.changes if change.gain is not None]
    if not gains:
        return source
    change, gain = gains[0]
    half = 1.96 * gain.standard_error
    verdict = "neither better nor worse"
    if abs(gain.difference) > half:
        verdict = "better" if gain.difference > 0 else "worse"
    return (
        f"On the {learned.held_out:,} rows after these, which it was not given, the filter "
        f"{visible(f'{change.node}/{change.filter}')} predicts {verdict} with the learned numbers than with those "
        f"before: its log-likelihood changes by {gain.difference:+.3f} ± {half:.3f} a row. {source}"
    )


def _list_key_figures(learned: FitResults) -> list[KeyFigures]:
    """Return the key figures: how many numbers were learned, from how many rows, and the gain of the first filter.

    A gain is by how much the fit raises the log-likelihood of a held-out row, None if there are no such rows.
    """
    identified = [row for row in learned.fit.rows() if row.identified]
    keys = [
        KeyFigure("numbers learned", f"{len(identified)}", f"of {len(learned.fit.rows())} free ones", BLUE),
        KeyFigure("rows", f"{learned.learned:,}", f"learned from; {learned.held_out:,} held out", GREEN),
    ]
    gains = [change.gain for change in learned.changes if change.gain is not None]
    if gains:
        first = gains[0]
        note = f"held-out log-likelihood per row, ± {1.96 * first.standard_error:.3f}"
        keys.append(KeyFigure("gain", f"{first.difference:+.3f}", note, VERMILION))
    return [KeyFigures(keys)]


def _make_estimates_table(learned: FitResults, drawings: Mapping[str, bytes]) -> list[Picture | Table]:
    """Return the figure of the estimates, and the table with start, estimate and interval of each number.

    The form of the likelihood has a column: "linear" takes what a random gain adds to the variance from the state's
    moments before any data, "conditional" from its moments given the data, and "truth" is the density of known true
    states. `learned.fit.table` has a row of texts (value, interval, form) for each number. `drawings`: figures as SVG.
    """
    picture = Picture(
        drawings["estimates"],
        "Each number with its interval and its start, on a scale of its own.",
        "Estimates with their intervals (blue: the form that counts, grey: the other), from the starts (triangles). "
        "A cross: the data do not determine it.",
    )
    form = (
        "of the likelihood; the **conditional** one is sharper and counts where there is one, the **linear** one needs "
        "no more than second moments."
    )
    if learned.fit.best.form == "truth":
        form = "the density of the **true** states under what the filter claims."
    caption = (
        "95 % intervals that allow for scores that are correlated over time (long-run variance by cosines). "
        f"**Form**: {form}"
    )
    starts = learned.starts
    rows = [
        [visible(row.name), f"{starts[row.name]:.4g}", row.value, row.interval, row.form] for row in learned.fit.table
    ]
    return [picture, Table(["number", "start", "estimate", "95 %", "form"], rows, caption)]


def _list_sentences(learned: FitResults) -> list[Points | Text]:
    """Return the sentences on what is doubtful about the fit, as points; a sentence that all is well without any."""
    sentences = learned.fit.sentences
    if sentences:
        return [Points([visible(sentence) for sentence in sentences])]
    return [Text(["All free numbers are identified, all starts ended at one maximum, and none is at a boundary."])]


def _make_comparison_sections(learned: FitResults, drawings: Mapping[str, bytes]) -> list[Section]:
    """Return the sections on the held-out rows: each filter before and after, and whether the laws fit.

    `learned`: the fit, with what filters predict of the held-out rows. `drawings`: each figure as SVG, by its name.
    """
    if not learned.changes:
        return []
    blocks: list[Table | Picture] = [_make_changes_table(learned)]
    if "innovations" in drawings:
        text = "Correlations of innovations some rows apart, with 95 % intervals: white ones have none."
        blocks.append(Picture(drawings["innovations"], text, text))
    sections = [Section("Before and after", blocks)]
    if "pits" in drawings:
        text = (
            "Probability, under the learned network, of a smaller value than the one that came. Under the right laws "
            "all are equally likely: 95 % of the bars end in the grey band. High in the middle: the network expects "
            "too much spread; high at the ends: too little."
        )
        by_laws = all(transforms.by_law for transforms in learned.uniform)
        how = "The laws of the gains are used in full." if by_laws else "Some laws of gains are replaced by Gaussians."
        sections.append(Section("Do the laws fit", [Picture(drawings["pits"], text, text), Text([how])]))
    return sections


def _make_changes_table(learned: FitResults) -> Table:
    """Return each filter's gain of log-likelihood, and size and correlation of its innovations, before and after.

    `learned.changes`: each filter on the held-out rows, before and after the fit; a test is None with too few rows.
    """
    rows = []
    for change in learned.changes:
        tests = [judged.test for judged in (change.before, change.after)]
        sizes = ["–" if t is None else f"{t.power:.2f} ± {1.96 * t.power_error:.2f}" for t in tests]
        correlations = ["–" if t is None else f"{t.correlation[0]:.2f} (p {t.p_value:.2g})" for t in tests]
        gain = "–"
        if change.gain is not None:
            gain = f"{change.gain.difference:+.3f} ± {1.96 * change.gain.standard_error:.3f}"
        rows.append([visible(f"{change.node}/{change.filter}"), gain, *sizes, *correlations])
    headers = ["filter", "gain per row", "size before", "size after", "correlation before", "correlation after"]
    caption = (
        f"On the {learned.held_out:,} rows that were not learned from. **Gain**: of log-likelihood, nats per row, with "
        "its 95 % interval. **Size**: mean square of the innovations in units of what the filter claims; 1 where that "
        "is right. **Correlation**: of innovations one row apart; 0 where the filter uses all that it receives."
    )
    return Table(headers, rows, caption)


def _make_losses_section(learned: FitResults) -> list[Section]:
    """Return the section on the laws (models) of lost measurements; [] if no measurement was lost.

    `learned.losses`: by node the fitted laws, the best one, and their gains on packets that were not fitted.
    """
    # One row for each law of each node: its first four parameters, and gain on held-out packets.
    rows = []
    for node, losses in learned.losses.items():
        for name, law in losses.laws.items():
            score = losses.held_out.get(name)
            gain = "–" if score is None else f"{score.gain:+.4f} ± {1.96 * score.gain_error:.4f}"
            shares = [f"{key} {s.estimate:.3g} ({s.low:.3g} to {s.high:.3g})" for key, s in law.shares().items()]
            numbers = "; ".join(shares[:4]) + (" …" if len(shares) > 4 else "")
            rows.append([visible(node), name, numbers, gain, "best" if name == losses.best else ""])
    caption = (
        "Laws of the losses that the receiver knows of, with 95 % intervals, and what each predicts of the last "
        "third of the rows: log-likelihood per packet, less that of independent losses. `hg.learning.learn_losses` "
        "makes a channel of them."
    )
    table = Table(["lost", "law", "numbers", "gain", ""], rows, caption, wordy=True)
    return [Section("How measurements are lost", [table])] if rows else []


def _make_delays_section(learned: FitResults) -> list[Section]:
    """Return the section on how late measurements arrived; [] unless the fit was to events with times of arrival.

    `delays`: by node the probability of each delay in steps, and the seconds of a step.
    """
    rows = [
        [visible(node), f"{steps * delays.step:g}", f"{share.estimate:.3f}", f"{share.low:.3f} to {share.high:.3f}"]
        for node, delays in learned.fit.delays.items()
        for steps, share in delays.shares.items()
    ]
    caption = (
        "How long measurements were on their way, to the nearest step, with the probability of each delay and its 95 % "
        "interval. "
        "`delays[node].law` of a fit is the law, for `hg.model.delayed(link, law)`."
    )
    table = Table(["node", "seconds late", "probability", "95 %"], rows, caption)
    return [Section("How late measurements are", [table])] if rows else []


def make_page_of_drawings(learned: FitResults) -> "partial[Page]":
    """Return the function that makes the page of a fit from its figures as SVG."""
    return partial(make_fit_page, learned)
