"""Part of a run's report on its links: when each component arrived and when it was lost, and how often."""

from collections.abc import Mapping

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from heliograph.disk.quoted_text import quote_for_figure, visible
from heliograph.model.checks.refusal_reasons import WORDS
from heliograph.report.diagnosis.arrivals import Arrivals
from heliograph.report.diagnosis.health import Health
from heliograph.report.diagnosis.sensor_output_health import round_to
from heliograph.report.figures import BLUE, VERMILION, WIDTH
from heliograph.report.innovations_section import LOOK, MOST, label_time_axis, name_undrawn_figures
from heliograph.report.pages.page import Picture, Table, Text
from heliograph.simulation.network import Network


@matplotlib.rc_context(LOOK)
def draw_deliveries(health: Health) -> Figure:
    """Draw when each component arrived (blue marks) and when it was lost (orange, below), a row for each component.

    `health`: the diagnosis of a run; a link is a received number of a node.
    """
    links = health.links[:MOST]
    figure = Figure(figsize=(WIDTH, 0.8 + 0.28 * len(links)), layout="constrained")
    axes = figure.subplots()
    for row, link in enumerate(links):
        lost = link.lost_times
        arrived = link.time[link.arrived]
        axes.plot(arrived, np.full(len(arrived), row - 0.2), "|", color=BLUE, markersize=6, alpha=0.6)
        axes.plot(lost, np.full(len(lost), row + 0.2), "|", color=VERMILION, markersize=6, alpha=0.6)
    names = [quote_for_figure(f"{link.node}: {link.component}{_format_share(link, ' ({:.0%})', '')}") for link in links]
    axes.set_yticks(range(len(links)), names)
    axes.set_ylim(len(links) - 0.5, -0.5)
    axes.grid(visible=False)
    label_time_axis(health.record, axes)
    return figure


def make_links_blocks(health: Health, drawings: Mapping[str, bytes]) -> list[Table | Picture | Text]:
    """Return the table of links, their figure, what was refused, and what nodes share.

    The table says of each link (a received number of a node): when it is due, how much arrived, its longest gap, and
    mean and deviation of its values.

    Args:
        health: the record of a recording with the diagnosis of its links and filters.
        drawings: figures as SVG, by name.
    """
    # The unit of time, and the explanation of "due" if some link is not due in each row.
    unit = health.record.units.get("time", "s" if health.record.time.dtype.kind == "M" else "the unit of time")
    explained = (
        f"**Due**: a sender that is slower than the rows is due at its own regular intervals (in {unit}), declared or "
        "found. One that is due in some of so many rows or intervals is so by a pattern that losses would not leave. "
        "Where each row is a message of some node, nobody knows when another without such an interval is due. A "
        "**gap** counts what was due and did not come."
    )
    needs_words = any(link.due_in != "each row" for link in health.links)
    caption = _caption_deliveries(health)
    picture = [Picture(drawings["links"], caption, caption)] if "links" in drawings else []
    not_drawn = [f"{link.node}: {link.component}" for link in health.links[MOST:]]
    # The column on timeouts is there if a sender has one and was silent for longer.
    past = ["past its timeout"] if health.silences else []
    headers = ["received", "due", "arrived", "longest gap", *past, "the network says", "mean", "std. deviation"]
    return [
        Table(headers, [_make_link_cells(health, link) for link in health.links], explained if needs_words else ""),
        *picture,
        *name_undrawn_figures(not_drawn, "Their numbers are in the table."),
        *_list_refused(health),
        *describe_shared_links(health.shared),
    ]


def _make_link_cells(health: Health, link: Arrivals) -> list[str]:
    """Return a link's cells in the table: name, when due, share arrived, longest gap, silences, statement, values.

    `health.silences` holds for each node the rows in which it was silent past its timeout. The table has a column of
    silences only if there are any. `health`: the diagnosis of the run. `link`: a received number of a node, with its
    times, values, and when it was due.
    """
    mean, deviation = _format_mean_and_deviation(link.values)
    name = visible(f"{link.node}: {link.component}")
    gap = "–" if link.due is None else str(link.longest_gap)
    silence_cells: list[str] = []  # no cell if no sender was silent past its timeout
    if health.silences:
        silences = health.silences.get(link.node)
        silence_cells = ["–" if silences is None else f"{len(silences.rows)}, up to {silences.lengths.max():g}"]
    statement = "may be lost" if link.may_be_lost else "never lost"
    share = _format_share(link, "{:.1%}", "–")
    return [name, link.due_in, share, gap, *silence_cells, statement, mean, deviation]


def _list_refused(health: Health) -> list[Table]:
    """Return a table of refusals by reason: single readings by limits or filters, and whole messages; [] if none.

    A refusal has node, filter ("" for the node's own limits), component, reason, count and first row; WORDS has words
    for each reason. `refused_messages` counts whole messages by node and reason.
    """
    rows = []
    names = {
        node: [link.component for link in health.links if link.node == node] for node in health.record.measurements
    }
    # Outputs of central filters are those of all nodes, and named with their node.
    names[Network.FUSED] = [f"{link.node}: {link.component}" for link in health.links]
    for refusal in health.record.refusals:
        component = names[refusal.node][refusal.component]
        name = component if refusal.node == Network.FUSED else f"{refusal.node}: {component}"
        by = f"{refusal.node}/{refusal.filter}" if refusal.filter else refusal.node
        rows.append([visible(name), f"{refusal.count:,}", WORDS[refusal.reason], visible(by), f"{refusal.row + 1:,}"])
    for node, counts in health.refused_messages.items():
        for reason, count in counts.items():
            words = WORDS[reason].removeprefix("of ")
            rows.append([visible(node), f"{count:,}", words, visible(node), "–"])
    headers = ["refused", "how many", "reason", "by", "first in row"]
    caption = "What came and was not used: single readings, and messages as a whole, which are none of the rows."
    return [Table(headers, rows, caption, wordy=True)] if rows else []


def _caption_deliveries(health: Health) -> str:
    """Return the caption of the figure of deliveries; it explains only the marks that the figure has.

    `health`: the diagnosis of a run; a link is a received number of a node, with the mask of rows in which it arrived
    and the times at which it was lost.
    """
    arrived = any(link.arrived.any() for link in health.links)
    lost = any(len(link.lost_times) for link in health.links)
    if arrived and lost:
        return "When each component arrived (blue, above) and when it did not (orange, below)."
    if lost:
        return "When each component did not arrive (orange)."
    if arrived:
        return "When each component arrived (blue, above). None is missing."
    return "Nothing arrived, and nobody knows when it was due."


def _format_share(link: Arrivals, form: str, unknown: str) -> str:
    """Return the share of a link's due messages that arrived, in the format `form`; `unknown` if it is not known."""
    return unknown if link.due is None else form.format(link.share)


def _format_mean_and_deviation(values: np.ndarray) -> tuple[str, str]:
    """Return the mean and the standard deviation of values, each to two digits of its standard error; "–" if unknown.

    For N independent normal values, the standard error of the mean is s / sqrt(N), and that of their deviation s is
    s / sqrt(2 N).
    """
    if len(values) == 0:
        return "–", "–"
    if len(values) == 1:
        return f"{values[0]:.4g}", "–"
    deviation = float(values.std())
    error_of_mean = deviation / len(values) ** 0.5
    error_of_deviation = error_of_mean / 2**0.5
    return round_to(float(values.mean()), error_of_mean), round_to(deviation, error_of_deviation)


def describe_shared_links(shared: Mapping[str, tuple[str, ...]]) -> list[Text]:
    """Return a sentence for each random state that several nodes' links share, such as fading; [] if none is shared.

    `shared`: {name of the state: nodes that share it}.
    """
    sentences = [
        f"{', '.join(map(visible, nodes))} share {visible(name)}: their links are in one state at each step."
        for name, nodes in shared.items()
    ]
    return [Text(sentences)] if sentences else []
