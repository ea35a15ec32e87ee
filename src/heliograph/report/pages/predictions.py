"""Part of a run's report on its predictions: what each filter expected of each row, beside what arrived."""

from collections.abc import Mapping

import matplotlib
import numpy as np
from matplotlib.figure import Figure

import heliograph
from heliograph.disk.quoted_text import quote_for_figure, visible
from heliograph.numerics.angles.angle import find_wraps, insert_gaps
from heliograph.report.diagnosis.health import Health
from heliograph.report.figures import INK, make_stacked_panels, place_legend_above
from heliograph.report.innovations_section import (
    BAND,
    COLOURS,
    LOOK,
    MOST,
    choose_picture,
    label_time_axis,
    name_undrawn_figures,
)
from heliograph.report.pages.page import Picture, Section, Text

PANELS = 12  # numbers of a node that are drawn; the table of estimates has all


def draw_predicted_figures(health: Health) -> dict[str, Figure]:
    """Return {file name: figure} of predictions by node and of residuals by filter; {} if there are no predictions.

    Each row is predicted from the rows before it; residuals are measurements minus predictions, in units of the claimed
    deviation. At most MOST figures of each kind are drawn. A file name is "predicted_i" or "residuals_i", with the
    place of node or filter in its list.
    """
    nodes = _list_predicting_nodes(health)[:MOST]
    figures = {f"predicted_{i}": _draw_predicted(health, node) for i, node in enumerate(nodes)}
    for i, (_, judged) in enumerate(_list_residuals(health)[:MOST]):
        figures[f"residuals_{i}"] = judged.figure(health.record.time)
    return figures


def make_predicted_sections(health: Health, drawings: Mapping[str, bytes]) -> list[Section]:
    """Return the sections of a run's page on predictions and residuals; none unless predictions were asked for.

    `health`: the diagnosis of the run, with the one-step predictions of its filters. `drawings`: each figure as SVG, by
    the names of `draw_predicted_figures`, "predicted_0" and so on by node.
    """
    if not health.predicted:
        return []
    intro = (
        "What each filter expected of a row, given the rows before it: also where nothing arrived. Of what arrived, "
        "95 of 100 should lie in the band of a filter whose claim is exact."
    )
    # A picture for each of the first MOST nodes; the others, and figures that are missing, are named in a text.
    nodes = _list_predicting_nodes(health)
    pictures = {}
    for i, node in enumerate(nodes[:MOST]):
        if (name := f"predicted_{i}") in drawings:
            caption = (
                f"{visible(node)}: predictions of what arrives, with bands of {BAND:g} claimed deviations on each "
                "side, and the data."
            )
            title = f"What filters of {visible(node)} predicted, and what arrived"
            pictures[node] = Picture(drawings[name], title, caption)
    not_drawn = [node for node in nodes if node not in pictures]
    missing = name_undrawn_figures(not_drawn, "Their predictions are in the table of estimates.")
    return [
        Section("Predictions", [Text([intro]), *choose_picture(pictures), *missing]),
        *_make_residual_sections(health, drawings),
    ]


def _list_residuals(health: Health) -> "list[tuple[str, heliograph.forecasting.Residuals]]":
    """Return ("node/filter", its residuals (z - E z) / deviation with tests) of each filter."""
    return [(f"{node}/{name}", one) for node, filters in health.residuals.items() for name, one in filters.items()]


def _make_residual_sections(health: Health, drawings: Mapping[str, bytes]) -> list[Section]:
    """Return the section on residuals: what speaks against each filter's predictions, and their pictures.

    `_list_residuals` returns for each filter its name, "node/filter", and the tests of its residuals, whose `doubts()`
    are sentences. `drawings`: each figure as SVG, by its name. [] without residuals.
    """
    every = _list_residuals(health)
    pictures = {
        name: Picture(drawings[f"residuals_{i}"], f"Residuals of {visible(name)} over time and by size",
                      f"{visible(name)}: in units of the claimed deviation, over time; autocorrelations with the band "
                      "of 95 %; in order, beside the quantiles of a normal law.")
        for i, (name, _) in enumerate(every) if f"residuals_{i}" in drawings
    }  # fmt: skip
    doubts = [f"{visible(name)}: {visible(line)}." for name, one in every for line in one.doubts()]
    sentences = doubts or ["Nothing speaks against them: no correlation, no other law, no variance that changes."]
    text = (
        "What was not predicted: of a right model independent from row to row, normal, of variance 1. Tested, with the "
        "number of tests in mind, by Ljung and Box, by Jarque and Bera, and by the variances of first and last third."
    )
    return [Section("Residuals", [Text([text]), Text(sentences), *choose_picture(pictures)])] if every else []


def _list_predicting_nodes(health: Health) -> list[str]:
    """Return the names of nodes with a filter that predicts what arrives, and not only states."""
    return [
        node
        for node, filters in health.predicted.items()
        if any(forecast.received is not None for forecast in filters.values())
    ]


@matplotlib.rc_context(LOOK)
def _draw_predicted(health: Health, node: str) -> Figure:
    """Draw what filters of a node predicted of each number that arrives, with bands and the data, a panel each.

    `health`: the diagnosis of a run, with the record and the one-step predictions by node and filter.
    """
    record, filters = health.record, health.predicted[node]
    # By filter mean and deviation of each number that arrives (rows, numbers); and the data (rows, numbers). The fusion
    # centre, which is no key of the measurements, receives the numbers of all nodes.
    laws = {name: forecast.received for name, forecast in filters.items() if forecast.received is not None}
    names = next(iter(laws.values())).names
    z = record.measurements.get(node)
    data = np.concatenate(list(record.measurements.values()), axis=1) if z is None else z
    figure, panels = make_stacked_panels(min(len(names), PANELS), height=1.7, margin=0.8)
    for i, panel in enumerate(panels):
        for (name, law), colour in zip(laws.items(), COLOURS, strict=False):
            mean, band = law.mean[:, i], BAND * law.deviation[:, i]
            # An angle that jumps by a turn leaves a gap in the line.
            time, mean, band = insert_gaps(record.time, find_wraps(mean, np.pi), mean, band)
            panel.plot(time, mean, color=colour, linewidth=1.2, label=quote_for_figure(name))
            panel.fill_between(time, mean - band, mean + band, color=colour, alpha=0.2, linewidth=0)
        panel.plot(record.time, data[:, i], ".", markersize=3, color=INK, label="data")
        panel.set_ylabel(quote_for_figure(names[i]))
    place_legend_above(figure, panels[0])
    label_time_axis(record, panels[-1])
    return figure
