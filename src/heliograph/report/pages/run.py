"""Report of a run over a recording: estimates with bands, innovations, links, and warnings."""

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from urllib.parse import quote

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from heliograph.disk.quoted_text import visible
from heliograph.numerics.check import instance
from heliograph.numerics.times.dates import format_times
from heliograph.report.diagnosis.health import Health
from heliograph.report.diagnosis.sensor_output_health import compute_filter_errors, round_to
from heliograph.report.figures import BLUE, GREEN, VERMILION, make_stacked_panels, place_legend_above
from heliograph.report.forecast_figures import draw_forecasts, make_forecast_tables
from heliograph.report.innovations_section import (
    BAND,
    COLOURS,
    LOOK,
    MOST,
    choose_picture,
    draw_innovations,
    group_tested_filters_by_figure,
    label_time_axis,
    make_innovations_section,
    name_undrawn_figures,
)
from heliograph.report.mode_probability_figures import PREFIX, draw_modes_of_nodes
from heliograph.report.pages.links_section import draw_deliveries, make_links_blocks
from heliograph.report.pages.page import (
    KeyFigure,
    KeyFigures,
    Page,
    Picture,
    PictureChoice,
    Points,
    Section,
    Table,
    Text,
)
from heliograph.report.pages.predictions import draw_predicted_figures, make_predicted_sections
from heliograph.report.pages.run_summary import run_summary
from heliograph.report.position_map import draw_position_map, find_coordinates
from heliograph.report.results_folder import Json, ResultsContent, write_into_folder
from heliograph.simulation.network import Network
from heliograph.simulation.results.record import Record

PAGE = 2_100_000  # bytes of the figures that a page holds, so that it has at most 3 MB
FIRST = ("links", "innovations", "innovations_0", "map", "estimates_0")  # figures that come before others
DOUBTS = 3  # that the page shows; `summary.json` has all


def make_run_results(health: Health, network: str) -> ResultsContent:
    """Return the content of a run's results folder: figures, page and summary.

    `health`: the record of the run with its diagnosis. `network`: the user's name of the network.
    """
    return ResultsContent(
        figures=run_figures(health), page=partial(run_page, health, network), summary=run_summary(health)
    )


def make_results_of_plants(examined: Mapping[str, Health], network: str) -> ResultsContent:
    """Return the results of several plants: an overview, with the most doubted plants first, and a folder for each.

    `examined`: the diagnosis of each plant's run, by the plant's name. `network`: the user's name of the network.
    """
    folders = {plant: f"plant.{quote(plant, safe='')}" for plant in examined}

    def write(folder: Path) -> None:
        """Write the results of each plant in `examined` into a folder of its own, whose name is in `folders`."""
        for plant, health in examined.items():
            subfolder = folder / folders[plant]
            subfolder.mkdir()
            write_into_folder(make_run_results(health, f"{network}, {plant}"), subfolder)

    summary: dict[str, Json] = {plant: run_summary(health) for plant, health in examined.items()}
    return ResultsContent(
        figures={},
        page=lambda drawings: _make_overview(examined, network, folders),
        summary=summary,
        write_data=write,
    )


def _make_overview(examined: Mapping[str, Health], network: str, folders: Mapping[str, str]) -> Page:
    """Return the page of several plants: how many rows each has and what is doubted there, the most doubted first.

    `examined`: the diagnosis of each plant's run. `folders`: the folder of each plant's page.
    """
    doubts = {plant: health.warnings() for plant, health in examined.items()}
    worst = sorted(examined, key=lambda plant: len(doubts[plant]), reverse=True)
    rows = []
    for plant in worst:
        more = f"; and {len(doubts[plant]) - DOUBTS} more" if len(doubts[plant]) > DOUBTS else ""
        sentences = "; ".join(map(visible, doubts[plant][:DOUBTS])) + more
        rows.append([visible(plant) or "(no name)", f"{len(examined[plant].record.time):,}", sentences or "nothing"])
    doubted = sum(map(bool, doubts.values()))
    title = f"{len(examined)} plants, no doubts"
    if doubted:
        title = f"{_count_in_words(len(examined), 'plant')}, {doubted} with doubts"
    links = [f"{quote(folders[plant])}/report.html" for plant in worst]
    lead = f"The filters of `{visible(network)}` ran over each plant by itself. The most doubted come first."
    table = Table(["plant", "rows", "doubts"], rows, wordy=True, links=links)
    return Page(f"Heliograph run: {visible(network)}", title, lead, [Section("Plants", [table])])


def run_figures(health: Health) -> dict[str, Figure]:
    """Return figures by file name: estimates of each node, innovations of each filter, deliveries of links.

    `_collect_estimates` yields ("estimates" or "smoothed", the record of these); only the first nodes of a record are
    drawn (`_choose_nodes_to_draw`), with at most as many filters as there are colours.

    Args:
        health: what `examine` returned: the record of all filters, and a diagnosis of links and filters.

    Raises:
        ValueError: `health` is not what `examine` returns.
    """
    instance("health", health, Health, "what examine returns")
    # A map for each kind of record (filtered, smoothed) if two states are a position in a plane.
    drawn: dict[str, Figure] = {}
    if find_coordinates(health.record.states) is not None:
        for kind, record in _collect_estimates(health):
            node, *_others = _choose_nodes_to_draw(record)
            drawn[_name_position_map(kind)] = draw_position_map(
                record, node, list(record.estimates[node])[: len(COLOURS)]
            )
    # Estimates and mode probabilities of the nodes that are chosen; then innovations, predictions and deliveries.
    for kind, record in _collect_estimates(health):
        drawn |= {
            f"{kind}_{i}": _draw_estimates(health, record, node) for i, node in enumerate(_choose_nodes_to_draw(record))
        }
        drawn |= draw_modes_of_nodes(record, kind, _choose_nodes_to_draw(record))
    drawn |= {name: draw_innovations(health, tested) for name, tested in group_tested_filters_by_figure(health).items()}
    drawn |= draw_predicted_figures(health)
    if health.links:
        drawn["links"] = draw_deliveries(health)
    return drawn


def _name_position_map(kind: str) -> str:
    """Return the file name of the map of estimates of a kind: "map" for "estimates", "map_smoothed" for "smoothed"."""
    return "map" if kind == "estimates" else f"map_{kind}"


def _collect_estimates(health: Health) -> list[tuple[str, Record]]:
    """Return the records to draw with their kinds: ("estimates", record), and ("smoothed", record) if there is one."""
    smoothed = health.record.smoothed
    return [("estimates", health.record)] + ([] if smoothed is None else [("smoothed", smoothed)])


def _choose_nodes_to_draw(record: Record) -> list[str]:
    """Return the first MOST of the nodes that have estimates, the fusion centre first."""
    return _sort_nodes(record)[:MOST]


def _sort_nodes(record: Record) -> list[str]:
    """Return the nodes that have estimates, the fusion centre (Network.FUSED) first."""
    nodes = [node for node, filters in record.estimates.items() if filters]
    return sorted(nodes, key=lambda node: node != Network.FUSED)


@matplotlib.rc_context(LOOK)
def _draw_estimates(health: Health, record: Record, node: str) -> Figure:
    """Draw a node's estimates with bands of BAND deviations, in one panel for each state, and then its forecasts.

    `record` holds the rows to draw. Forecasts are drawn only if these are all rows of `health`. There are at most as
    many filters as COLOURS.
    """
    figure, grid = make_stacked_panels(len(record.states), height=1.7, margin=0.8)
    names = list(record.estimates[node])[: len(COLOURS)]
    record.plot(node, names, axes=grid, sigmas=BAND)
    if record is health.record:
        draw_forecasts(grid, record, node, health.forecasts.get(node, {}), names, BAND)
    place_legend_above(figure, grid[0])
    label_time_axis(health.record, grid[-1])
    return figure


def run_page(health: Health, network: str, drawings: Mapping[str, bytes]) -> Page:
    """Return the report of a run as a page, whose `html()` is one file that needs no other.

    Sections: at a glance (key figures, doubts, remarks), estimates with their errors, forecasts and predictions if
    there are any, innovations, and links.

    Args:
        health: what `examine` returned.
        network: the network's name, for the title.
        drawings: each figure as SVG, by the names of `run_figures`; left out where the page would be too large.

    Raises:
        ValueError: `health` is not what `examine` returns, or `network` is no text.
    """
    instance("health", health, Health, "what examine returns")
    instance("name of the network", network, str, "a text")
    record = health.record
    doubts = health.warnings()
    drawings = limit_size_of_drawings(drawings, PAGE)  # PAGE bytes in all; the others stay files beside the page
    rows = f"{len(record.time):,} rows, {_describe_span(record)}"
    glance = [
        _make_key_figures(health, len(doubts)),
        *_list_doubts(doubts),
        *_list_baseline_remarks(health),
        *_list_filters_of_other_models(health),
        *_describe_overloads(record),
    ]
    forecasts = [Section("Forecasts", make_forecast_tables(record, health.forecasts))] if health.forecasts else []
    return Page(
        kicker=f"Heliograph run: {visible(network)}",
        title=_make_headline(health),
        lead=f"The filters of `{visible(network)}` ran over {rows}. {_describe_number_of_doubts(health, doubts)}",
        sections=[
            Section("At a glance", glance),
            Section("Estimates", [*make_errors_table(record), *_list_pictures(health, drawings)]),
            *forecasts,
            *make_predicted_sections(health, drawings),
            make_innovations_section(health, drawings),
            Section("Links", make_links_blocks(health, drawings)),
        ],
    )


def _make_key_figures(health: Health, doubts: int) -> KeyFigures:
    """Return the key figures: the number of rows, the share of due messages that arrived, and the number of doubts.

    A link's `due` is the number of messages that were due (None: unknown), and `share` the share of them that arrived.
    """
    record = health.record
    shares = [link.share for link in health.links if link.due is not None]
    arrived = f"{np.mean(shares):.1%}" if shares else "–"
    due = f"of what {_count_in_words(len(record.measurements), 'node')} should receive"
    return KeyFigures(
        [
            KeyFigure("rows", f"{len(record.time):,}", _describe_span(record), BLUE),
            KeyFigure("arrived", arrived, due, GREEN),
            KeyFigure("doubts", f"{doubts}", "see below" if doubts else "nothing to remark", VERMILION),
        ]
    )


def limit_size_of_drawings(drawings: Mapping[str, bytes], limit: int) -> dict[str, bytes]:
    """Return the drawings that together have at most `limit` bytes, those named in FIRST before others.

    A drawing that does not fit is left out, and smaller ones after it may fit. As text in a page they take 4/3 of this.
    FIRST has the names of the figures that matter most, such as "links".
    """
    fitting, total = dict[str, bytes](), 0
    for name in sorted(drawings, key=lambda name: name in FIRST, reverse=True):
        size = len(drawings[name])
        if total + size <= limit:
            fitting[name] = drawings[name]
            total += size
    return fitting


def _make_headline(health: Health) -> str:
    """Return the title of a run's page: the last estimate by the first filter that the network relies on.

    It has the first two states, or those of a position, each with a band if the filter claims a covariance.
    """
    record = health.record
    nodes = _choose_nodes_to_draw(record)
    if not nodes:
        return f"{len(record.time):,} rows were read"
    node = nodes[0]
    trusted = {filter.filter for filter in health.filters if filter.trusted and filter.node == node}
    name = next((name for name in record.estimates[node] if name in trusted), next(iter(record.estimates[node])))
    estimate = record.estimates[node][name]
    # Mean and standard deviations of the states in the last row.
    mean = np.asarray(estimate.mean)[-1]
    deviation = np.sqrt(np.maximum(np.diagonal(np.asarray(estimate.covariance)[-1]), 0.0))
    shown_states = find_coordinates(record.states) or tuple(range(min(len(mean), 2)))
    numbers = []
    for i in shown_states:
        band = f" ± {round_to(BAND * deviation[i], deviation[i])}" if estimate.claim != "none" else ""
        state, unit = record.states[i], record.units.get(record.states[i], "")
        numbers.append(f"{visible(state)} {round_to(mean[i], deviation[i])}{band} {visible(unit)}".strip())
    return f"{', '.join(numbers)} at the end, by {visible(name)}"


def _list_pictures(health: Health, drawings: Mapping[str, bytes]) -> list[Picture | PictureChoice | Text]:
    """Return the pictures of the filtered estimates, then of the smoothed ones if there are any.

    For filtered and for smoothed estimates there are: the map of a position if there is one, the estimates and the
    probabilities of modes of each node, and a text that names nodes that are not drawn. `health` holds the record of
    the run with its estimates. `drawings` has each figure as SVG, by its name.
    """
    pictures: list[Picture | PictureChoice | Text] = []
    for kind, record in _collect_estimates(health):
        nodes = _choose_nodes_to_draw(record)  # the first few: estimates of others are in the record alone
        added = ", given later data too" if kind == "smoothed" else ""
        if (name := _name_position_map(kind)) in drawings:
            text = f"The path that {visible(nodes[0])} estimates{added}"
            pictures.append(Picture(drawings[name], text, f"{text}, with ellipses of {BAND:g} claimed deviations."))
        estimates, modes = {}, {}
        for i, node in enumerate(nodes):
            if (name := f"{kind}_{i}") in drawings:
                title = f"Estimates of {visible(node)} over time with bands{added}"
                bands = f"with bands of {BAND:g} claimed standard deviations on each side"
                estimates[node] = Picture(drawings[name], title, f"{visible(node)}: estimates {bands}{added}.")
            if (name := f"{PREFIX}{kind}_{i}") in drawings:
                title = f"Modes at {visible(node)} over time{added}"
                modes[node] = Picture(drawings[name], title, f"{visible(node)}: probability of each mode{added}.")
        pictures += [*choose_picture(estimates), *choose_picture(modes)]
        too_large = [node for node in nodes if node not in estimates]  # to stand in the page, but drawn
        pictures += name_undrawn_figures(too_large, f"Their figures are files beside this page ({kind}_0.svg and on).")
        pictures += name_undrawn_figures(_sort_nodes(record)[MOST:], "Their estimates are in the record.")
    return pictures


def make_errors_table(record: Record) -> list[Table]:
    """Return the table of each filter's errors (RMSE by state, and NEES); [] if the recording has no true states."""

    def show(value: float, error: float) -> str:
        """Return a number to the digits of its standard error, or a dash where no truth is known."""
        return "–" if np.isnan(value) else round_to(value, error)

    rows = [
        [visible(f"{errors.node}/{errors.filter}"), errors.claim,
         *(show(value, errors.rmse_error[state]) for state, value in errors.rmse.items()),
         show(errors.nees, errors.nees_error)]
        for errors in compute_filter_errors(record)
    ]  # fmt: skip
    caption = (
        "Root mean square error of each state against the truth in the recording, to two digits of its standard "
        "error. **NEES**: squared error over the claimed one, per state: 1 where the claim holds, above 1 too sure."
    )
    rmse_headers = [visible(f"RMSE of {_name_with_unit(state, record.units)}") for state in record.states]
    return [Table(["filter", "claim", *rmse_headers, "NEES"], rows, caption)] if rows else []


def _name_with_unit(state: str, units: Mapping[str, str]) -> str:
    """Return the name of a state, with its unit in brackets if it has one."""
    return f"{state} ({units[state]})" if state in units else state


def _describe_number_of_doubts(health: Health, doubts: list[str]) -> str:
    """Return the sentence on how many doubts there are about the network, or that there are none."""
    if doubts:
        return f"There {'is' if len(doubts) == 1 else 'are'} {_count_in_words(len(doubts), 'doubt')} about the network."
    tested = any(tested_filter.test is not None for tested_filter in health.filters)
    tests = "the tests of the innovations find nothing" if tested else "there are too few rows to test innovations"
    return f"Nothing is lost that the network says cannot be lost, and {tests}."


def _count_in_words(count: int, what: str) -> str:
    """Return a number of things, such as "1 node" or "2 nodes"."""
    return f"{count} {what}{'' if count == 1 else 's'}"


def _describe_span(record: Record) -> str:
    """Return the times that the recording covers as text, such as "from 0 to 10 s"."""
    first, last = format_times(record.time[[0, -1]])
    if record.time.dtype.kind == "M":
        return f"{first} to {last} UTC"
    return f"from {first} to {last} {record.units.get('time', '')}".rstrip()


def _list_doubts(doubts: list[str]) -> list[Points | Text]:
    """Return the first DOUBTS (3) of the doubts, the weightiest first, and a line on where the others are."""
    if not doubts:
        return [Text(["No doubts."])]
    first_doubts = Points([visible(line) for line in doubts[:DOUBTS]])
    if len(doubts) <= DOUBTS:
        return [first_doubts]
    others = f"{_count_in_words(len(doubts) - DOUBTS, 'further doubt')} of less weight: `warnings` in `summary.json`."
    return [first_doubts, Text([others])]


def _list_baseline_remarks(health: Health) -> list[Text | Points]:
    """Return a text and the doubts about filters that are there for comparison only; [] if there are none.

    They are no doubts about the network, which does not rely on these filters.
    """
    lines = [visible(line) for line in health.remarks()]
    text = "Of filters that are there to be compared with, on which the network does not rely:"
    return [Text([text]), Points(lines)] if lines else []


def _list_filters_of_other_models(health: Health) -> list[Text | Points]:
    """Return a paragraph and a list of filters whose assumed model is not that of their node; [] if there are none."""
    text = "These filters were made for another world than that in which they stand, and claim no more than a number:"
    return [Text([text]), Points([visible(line) for line in health.beliefs])] if health.beliefs else []


def _describe_overloads(record: Record) -> list[Text | Points]:
    """Return sentences on how often words (quantised measurements) will be overloaded, as computed before any data.

    A word is overloaded if the measured value lies beyond the ends of its range.
    """
    lines = [
        visible(overload.describe(node, name))
        for node, by_filter in record.overloads.items()
        for name, overload in by_filter.items()
    ]
    return [Text(["Of words, whose range has ends, before any data:"]), Points(lines)] if lines else []
