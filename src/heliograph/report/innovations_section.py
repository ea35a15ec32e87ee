"""Section of a run's report on innovations: their tests, their pictures, and what they say of each output."""

from collections.abc import Iterable, Mapping, Sequence

import matplotlib
import numpy as np
from cycler import cycler
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from heliograph.disk.quoted_text import quote_for_figure, visible
from heliograph.report.diagnosis.health import FilterHealth, Health
from heliograph.report.diagnosis.sensor_output_health import OutputHealth, round_to
from heliograph.report.figures import AMBER, BLUE, GREEN, MUTED, PURPLE, STYLE, VERMILION, make_stacked_panels
from heliograph.report.pages.page import Picture, PictureChoice, Section, Table, Text
from heliograph.simulation.declared_noise.judgement import DeclaredJudgement
from heliograph.simulation.network import Network
from heliograph.simulation.results.record import Record

COLOURS = (BLUE, VERMILION, GREEN, PURPLE, AMBER)
FEW = 8  # pictures one below the other; of more, one is chosen from a list
MOST = 64  # nodes and links that are drawn; tables and summary hold all
BAND = 2.0  # deviations
LOOK = STYLE | {"axes.prop_cycle": cycler(color=COLOURS), "date.converter": "concise"}


def group_tested_filters_by_figure(health: Health) -> dict[str, list[FilterHealth]]:
    """Return {name of a figure of innovations: filters that it shows}, of the filters whose innovations are tested.

    Up to FEW filters share one figure. More filters get a figure for each node, of MOST nodes at most. `filter.white`
    are innovations in units of their claim, None for a filter without one. `health`: the diagnosis of a run, with its
    filters.
    """
    tested = _sort_fused_first(filter for filter in health.filters if filter.white is not None)
    if len(tested) <= FEW:
        return {"innovations": tested} if tested else {}
    nodes: dict[str, list[FilterHealth]] = {}
    for judged in tested:
        nodes.setdefault(judged.node, []).append(judged)
    return {f"innovations_{i}": filters for i, filters in enumerate(list(nodes.values())[:MOST])}


@matplotlib.rc_context(LOOK)
def draw_innovations(health: Health, tested: Sequence[FilterHealth]) -> Figure:
    """Draw the innovations of each filter in `tested` over time, in claimed deviations, a panel each.

    Lines at ±BAND (2) deviations show where 95 of 100 should lie. `judged.white` are the innovations (time, outputs);
    `names` has by node the names of its outputs. `health`: the diagnosis of a run, with the record's times.
    """
    figure, grid = make_stacked_panels(len(tested), height=1.5, margin=0.6)
    names = _name_components(health)
    for axes, judged in zip(grid, tested, strict=True):
        white = np.asarray(judged.white)  # (time, outputs)
        colours, labels = _choose_colours(white.shape[1], names[judged.node])
        for component, colour, label in zip(white.T, colours, labels, strict=False):
            axes.plot(health.record.time, component, ".", markersize=3, color=colour, label=label)
        for level in (-BAND, BAND):
            axes.axhline(level, color=MUTED, linewidth=0.8, linestyle=(0, (4, 1.6)))
        axes.set_title(quote_for_figure(f"{judged.node}/{judged.filter}"))
        axes.set_ylabel("in deviations")
        axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False, markerscale=2)
    label_time_axis(health.record, grid[-1])
    return figure


def _choose_colours(count: int, names: Sequence[str]) -> tuple[list[str], list[str | None]]:
    """Return the colours and the labels of `count` outputs with these names.

    If there are more outputs than colours, all have one colour, and only the first has a label.
    """
    if count > len(COLOURS):
        return [BLUE] * count, [f"{count} outputs", *[None] * (count - 1)]
    return list(COLOURS[:count]), list(map(quote_for_figure, names))


def _name_components(health: Health) -> dict[str, list[str]]:
    """Return the names of the components that each node receives; the centre (FUSED) has "node: component" of all.

    `health`: the diagnosis of a run, with a link for each received number.
    """
    names: dict[str, list[str]] = {}
    for link in health.links:
        names.setdefault(link.node, []).append(link.component)
    return names | {Network.FUSED: [f"{link.node}: {link.component}" for link in health.links]}


def make_innovations_section(health: Health, drawings: Mapping[str, bytes]) -> Section:
    """Return the section of a run's page with tests and pictures of innovations, and what they say of each output.

    A page without a true state can judge filters only by their innovations. `health`: the diagnosis of the run, with
    the innovations of each filter. `drawings`: each figure as SVG, by its name; missing figures are named in a text.
    """
    intro = "An innovation is what arrived less what the filter expected. The tests need no true state."
    # Fusions of estimates are not in the table: say where they are tested.
    in_table = {(filter.node, filter.filter) for filter in health.filters}
    fusions = [name for name in health.record.estimates.get(Network.FUSED, {}) if (Network.FUSED, name) not in in_table]
    if fusions:
        intro += (
            f" A fusion of estimates receives nothing itself ({', '.join(map(visible, fusions))}): the filters that it "
            "fuses are tested here, and itself on the live page of `heliograph serve`."
        )
    # Pictures by node; one figure with all filters counts as that of the first one's node.
    figures = {name: filters for name, filters in group_tested_filters_by_figure(health).items() if name in drawings}
    text = (
        f"Innovations in claimed standard deviations, one colour an output (of more than {len(COLOURS)} one for all); "
        f"5 of 100 may lie beyond ±{BAND:g}."
    )
    pictures = {
        filters[0].node: Picture(drawings[name], "Innovations over time in claimed deviations", text)
        for name, filters in figures.items()
    }
    # Filters that were tested but have no figure.
    drawn_nodes = {filter.node for filters in figures.values() for filter in filters}
    not_drawn = [
        f"{filter.node}/{filter.filter}"
        for filter in health.filters
        if filter.white is not None and filter.node not in drawn_nodes
    ]
    return Section(
        "Innovations",
        [
            Text([intro]),
            _make_tests_table(health),
            *choose_picture(pictures),
            *name_undrawn_figures(not_drawn, "Their numbers are in the table."),
            *_make_outputs_table(health),
            *_make_declared_table(health),
        ],
    )


def _make_tests_table(health: Health) -> Table:
    """Return the table of tests of innovations: size, correlation and p-value of each filter, the fused ones first.

    `test` of a filter is None with too few rows, or without a claim: dashes. `power` is the mean square over the claim;
    correlation and standard error are by lag, the first lag at [0]. `health`: the diagnosis of a run, with its filters.
    """
    rows = []
    for judged in _sort_fused_first(health.filters):
        cells = ["–", "–", "–"]
        if (test := judged.test) is not None:
            cells = [
                f"{test.power:.2f} ± {1.96 * test.power_error:.2f}",
                f"{test.correlation[0]:.2f} ± {1.96 * test.standard_error[0]:.2f}",
                "< 0.001" if test.p_value < 0.001 else f"{test.p_value:.3f}",
            ]
        rows.append([visible(f"{judged.node}/{judged.filter}"), judged.claim, *cells])
    caption = (
        "**Size**: mean square of the innovations in units of what the filter claims (normalised innovation squared "
        "per dimension): 1 where the claim holds, above 1 too sure. **Correlation** of innovations one message apart: "
        "0 where the filter uses all that it receives. Both with 95 % intervals; **p**: probability of such a "
        "correlation if there were none."
    )
    return Table(["filter", "claim", "size", "correlation", "p"], rows, caption)


def _sort_fused_first(filters: Iterable[FilterHealth]) -> list[FilterHealth]:
    """Return the filters with those of the fusion centre first; otherwise their order stays."""
    return sorted(filters, key=lambda judged: judged.node != Network.FUSED)


def _make_outputs_table(health: Health) -> list[Table]:
    """Return the table of outputs: bias, size, and how many values weighing filters doubted; [] without outputs.

    `health`: the diagnosis of a run, whose `outputs` have what innovations say of each output.
    """
    caption = (
        "**Down-weighted**: values that counted less than half, and the interval of their share. **Bias**: median "
        "of the innovations in the output's unit, less that of the law of its noise. **Size**: mean square of the "
        "innovations that the filter used over their variance, 1 where the model is right. All with 95 % intervals "
        "that allow for correlated rows. **To blame**: its share lies above that of the filter's other outputs "
        "together, by an interval of the difference. **Stuck**: one value repeats for longer than its noise allows."
    )
    rows = [_make_output_cells(output) for output in health.outputs]
    return [Table(["filter: output", "received", "down-weighted", "bias", "size", ""], rows, caption)] if rows else []


def _make_output_cells(output: OutputHealth) -> list[str]:
    """Return an output's row of the table: name, received, down-weighted, bias, size, remarks.

    Bias and size have two digits of their standard errors. `summary` has counts, bias and share of values that the
    filter weighted down, with intervals; `judged.held` is the run of a stuck value, None if there is none.
    """
    judged, summary = output.judged, output.judged.summary
    doubted = "–"
    if output.weighs:
        low, high = 100 * summary.share.low, 100 * summary.share.high
        doubted = f"{summary.down_weighted} ({low:.2g} to {high:.2g} %)"
    half = (summary.bias_high - summary.bias_low) / 2  # of the 95 % interval, which is 1.96 standard errors
    error = half / 1.96
    bias = f"{round_to(summary.bias, error)} ± {round_to(half, error)}"
    size = f"{round_to(judged.size, judged.size_error)} ± {round_to(1.96 * judged.size_error, judged.size_error)}"
    possible_remarks = (("to blame", judged.to_blame), ("stuck", judged.held is not None))
    remarks = [words for words, holds in possible_remarks if holds]
    received = f"{summary.received} of {summary.expected}"
    return [output.name, received, doubted, bias, size, ", ".join(remarks)]


def _make_declared_table(health: Health) -> list[Table]:
    """Return the table of what innovations say of noise variances that came with the messages; [] if none came.

    Messages with about the same variance form a class, and each class has a row. `health`: the diagnosis of a run,
    whose `filters` have judgements of such links (`declared`).
    """
    rows = []
    for filter in health.filters:
        for judgement in filter.declared:
            name = f"{filter.node}/{filter.filter}"
            if len(filter.declared) > 1:
                name += f": {', '.join(judgement.outputs)}"
            rows += [[visible(name), *cells] for cells in _make_declared_class_rows(judgement)]
    caption = (
        "**Declared**: variances that came with the messages, in classes. **Size**: mean square of the innovations "
        "over the claimed one, and where it lies for true variances in 99 of 100 recordings. **Scale**: the factor of "
        "the declared variances that fits best, with its 95 % interval, where the tests contradict them. A small size "
        "alone is no sign of safety: an error that changes slowly makes one too, and no scale mends it."
    )
    return [Table(["filter", "declared", "values", "size", "scale"], rows, caption)] if rows else []


def _make_declared_class_rows(judgement: DeclaredJudgement) -> list[list[str]]:
    """Return a row of cells for each class of messages that came with about the same variance.

    The cells are the range of variances, the number of values, the size (mean squared innovation over its variance,
    with its interval), and the scale (the best factor of the declared variances, with its interval; "–" without one).
    """
    rows = []
    for one in judgement.classes:
        variances = f"{one.low:.3g}" if one.low == one.high else f"{one.low:.3g} to {one.high:.3g}"
        size = f"{one.nis:.3g} ({one.nis_low:.2f} to {one.nis_high:.2f})"
        has_scale = one.scale_low != one.scale_high
        scale = f"{one.scale:.3g} ({one.scale_low:.3g} to {one.scale_high:.3g})" if has_scale else "–"
        rows.append([variances, f"{one.numbers:,}", size, scale])
    return rows


def choose_picture(pictures: Mapping[str, Picture]) -> list[Picture | PictureChoice]:
    """Return the nodes' pictures one below the other, or if they are more than FEW, a single choice among them."""
    if len(pictures) <= FEW:
        return [*pictures.values()]
    return [PictureChoice("Node", list(map(visible, pictures)), list(pictures.values()))]


def name_undrawn_figures(names: Sequence[str], where: str) -> list[Text]:
    """Return a text with the `names` of what is not drawn for lack of room; [] without names.

    `where` is a sentence on where the numbers are that the figures would show.
    """
    if not names:
        return []
    return [Text([f"Not drawn, for lack of room: {', '.join(map(visible, names))}. {where}"])]


def label_time_axis(record: Record, axes: Axes) -> None:
    """Label the axis of time with its name and its unit, if the record has one; dates are in UTC."""
    if record.time.dtype.kind == "M":
        axes.set_xlabel("time (UTC)")
    else:
        axes.set_xlabel(quote_for_figure(f"time ({record.units['time']})" if "time" in record.units else "time"))
