"""Report of a run over a recording: estimates with bands, innovations, links, and warnings."""

from collections.abc import Mapping
from functools import partial

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from heliograph.disk.quoting import in_figure, visible
from heliograph.report.figures import BLUE, GREEN, VERMILION, WIDTH, legend_above, stacked_panels
from heliograph.report.health import Health
from heliograph.report.innovations import (
    BAND,
    COLOURS,
    LOOK,
    MOST,
    chosen,
    innovations_figure,
    innovations_section,
    not_drawn,
    tested_by_figure,
    time_axis,
)
from heliograph.report.outputs import errors_of, output_numbers, rounded
from heliograph.report.page import Choice, KeyFigure, KeyFigures, Page, Picture, Points, Section, Table, Text
from heliograph.report.results import Json, Results
from heliograph.simulation.network import FUSED
from heliograph.simulation.results.record import Record


def run_results(health: Health, network: str) -> Results:
    """Return the content of the results folder; `network` is the user's name of the network."""
    return Results(run_figures(health), partial(run_page, health, network), run_summary(health), lambda folder: None)


def run_figures(health: Health) -> dict[str, Figure]:
    """Return figures by file name: estimates of each node, innovations of each filter, deliveries of links."""
    drawn: dict[str, Figure] = {}
    for kind, record in _estimated(health):
        drawn |= {f"{kind}_{i}": _estimates(health, record, node) for i, node in enumerate(_nodes(record))}
    drawn |= {name: innovations_figure(health, tested) for name, tested in tested_by_figure(health).items()}
    if health.links:
        drawn["links"] = _links(health)
    return drawn


def _estimated(health: Health) -> list[tuple[str, Record]]:
    """Return the filtered estimates, and the smoothed ones if there are any, by kind."""
    later = health.record.smoothed
    return [("estimates", health.record)] + ([] if later is None else [("smoothed", later)])


def _nodes(record: Record) -> list[str]:
    """Return the nodes that are drawn, the fused estimate first."""
    return _ordered(record)[:MOST]


def _ordered(record: Record) -> list[str]:
    return sorted((node for node, filters in record.estimates.items() if filters), key=lambda node: node != FUSED)


@matplotlib.rc_context(LOOK)
def _estimates(health: Health, record: Record, node: str) -> Figure:
    figure, grid = stacked_panels(len(record.states), 1.7, 0.8)
    record.plot(node, list(record.estimates[node])[: len(COLOURS)], axes=grid, sigmas=BAND)
    legend_above(figure, grid[0])
    time_axis(health.record, grid[-1])
    return figure


@matplotlib.rc_context(LOOK)
def _links(health: Health) -> Figure:
    links = health.links[:MOST]
    figure = Figure(figsize=(WIDTH, 0.8 + 0.28 * len(links)), layout="constrained")
    axes = figure.subplots()
    for row, link in enumerate(links):
        lost = health.record.time[~link.arrived]
        came = health.record.time[link.arrived]
        axes.plot(came, np.full(len(came), row - 0.2), "|", color=BLUE, markersize=6, alpha=0.6)
        axes.plot(lost, np.full(len(lost), row + 0.2), "|", color=VERMILION, markersize=6, alpha=0.6)
    names = [in_figure(f"{link.node}: {link.component} ({link.share:.0%})") for link in links]
    axes.set_yticks(range(len(links)), names)
    axes.set_ylim(len(links) - 0.5, -0.5)
    axes.grid(visible=False)
    time_axis(health.record, axes)
    return figure


def run_page(health: Health, network: str, drawings: Mapping[str, bytes]) -> Page:
    """Return the report; `drawings` holds each figure as SVG."""
    record, doubts = health.record, health.warnings()
    arrived = np.mean([link.share for link in health.links]) if health.links else np.nan
    # Three numbers to remember.
    keys = [
        KeyFigure("rows", f"{len(record.time):,}", _span(record.time), BLUE),
        KeyFigure(
            "arrived", f"{arrived:.1%}", f"of what {_counted(len(record.measurements), 'node')} could receive", GREEN
        ),
        KeyFigure("warnings", f"{len(doubts)}", "see below" if doubts else "nothing to remark", VERMILION),
    ]
    # Warnings are in the title and in the first section.
    return Page(
        kicker="Heliograph run",
        title=f"{_counted(len(doubts), 'doubt')} about the network{_by_name(health)}"
        if doubts
        else "The recording agrees with the network",
        lead=f"The filters of `{visible(network)}` ran over {len(record.time):,} rows, {_span(record.time)}. "
        + _agreement(health, doubts),
        sections=[
            Section("At a glance", [KeyFigures(keys), *_warned(doubts), *_compared(health)]),
            Section(
                "Estimates",
                [
                    *errors_table(record),
                    *_pictures(health, drawings),
                    *not_drawn(_ordered(record)[MOST:], "Their estimates are in the record."),
                ],
            ),
            innovations_section(health, drawings),
            Section("Links", _health(health, drawings)),
        ],
    )


def _pictures(health: Health, drawings: Mapping[str, bytes]) -> list[Picture | Choice]:
    """Return the filtered estimates by node, then the smoothed ones if there are any."""
    pictures: list[Picture | Choice] = []
    for kind, record in _estimated(health):
        added = ", given later data too" if kind == "smoothed" else ""
        pictures += chosen({
            node: Picture(drawings[f"{kind}_{i}"], f"Estimates of {visible(node)} over time with bands{added}",
                          f"{visible(node)}: estimates with bands of {BAND:g} claimed standard deviations on each "
                          f"side{added}.")
            for i, node in enumerate(_nodes(record))
        })  # fmt: skip
    return pictures


def errors_table(record: Record) -> list[Table]:
    """Return the errors of each filter where the recording has the true state."""
    rows = [
        [visible(f"{errors.node}/{errors.filter}"), errors.claim,
         *(rounded(value, errors.rmse_error[state]) for state, value in errors.rmse.items()),
         "–" if np.isnan(errors.nees) else f"{errors.nees:.3g}"]
        for errors in errors_of(record)
    ]  # fmt: skip
    # What the columns are, in words.
    caption = (
        "Root mean square error of each state against the truth in the recording, to two digits of its standard "
        "error. **NEES**: squared error over the claimed one, per state: 1 where the claim holds, above 1 too sure."
    )
    headers = [
        "filter",
        "claim",
        *(visible(f"RMSE of {_headed(state, record.units)}") for state in record.states),
        "NEES",
    ]
    return [Table(headers, rows, caption)] if rows else []


def _headed(state: str, units: Mapping[str, str]) -> str:
    return f"{state} ({units[state]})" if state in units else state


def _agreement(health: Health, doubts: list[str]) -> str:
    if doubts:
        return f"The recording speaks against the network in {_counted(len(doubts), 'way')}."
    tested = any(tested_filter.test is not None for tested_filter in health.filters)
    tests = "the tests of the innovations find nothing" if tested else "there are too few rows to test innovations"
    return f"Nothing is lost that the network says cannot be lost, and {tests}."


def _counted(count: int, what: str) -> str:
    return f"{count} {what}{'' if count == 1 else 's'}"


def _span(time: np.ndarray) -> str:
    if time.dtype.kind == "M":
        return f"{str(time[0])[:19]} to {str(time[-1])[:19]} UTC"
    return f"from {time[0]:g} to {time[-1]:g}"


def _warned(doubts: list[str]) -> list[Points | Text]:
    return [Points([visible(line) for line in doubts])] if doubts else [Text(["No warnings."])]


def _by_name(health: Health) -> str:
    names = [visible(f"{doubted.node}/{doubted.filter}") for doubted in health.doubted()]
    return f": {', '.join(names[:3])}{', ...' if len(names) > 3 else ''}" if names else ""


def _compared(health: Health) -> list[Text | Points]:
    """Return what the recording says of filters that are there to be compared with; it is no doubt of the network."""
    lines = [visible(line) for line in health.remarks()]
    text = "Of filters that are there to be compared with, on which the network does not rely:"
    return [Text([text]), Points(lines)] if lines else []


def _health(health: Health, drawings: Mapping[str, bytes]) -> list[Table | Picture | Text]:
    rows = []
    for link in health.links:
        mean, deviation = _moments(link.values)
        known = "may be lost" if link.loses else "never lost"
        name = visible(f"{link.node}: {link.component}")
        rows.append([name, f"{link.share:.1%}", str(link.longest_gap), known, mean, deviation])
    headers = ["received", "arrived", "longest gap (rows)", "the network says", "mean", "std. deviation"]
    came, lost = any(link.arrived.any() for link in health.links), not all(link.arrived.all() for link in health.links)
    parts = ["arrived (blue, above)"] * came + ["did not (orange, below)" if came else "did not arrive (orange)"] * lost
    caption = f"When each component {' and when it '.join(parts)}." + ("" if lost else " None is missing.")
    picture = [Picture(drawings["links"], caption, caption)] if "links" in drawings else []
    left = [f"{link.node}: {link.component}" for link in health.links[MOST:]]
    missing = not_drawn(left, "Their numbers are in the table.")
    return [Table(headers, rows), *picture, *missing, *shared_text(health.shared)]


def _moments(values: np.ndarray) -> tuple[str, str]:
    """Return mean and deviation of a component, each to two digits of its standard error."""
    if len(values) < 2:
        return (f"{values[0]:.4g}" if len(values) else "–"), "–"
    deviation = float(values.std())
    error = deviation / len(values) ** 0.5
    return rounded(float(values.mean()), error), rounded(deviation, error / 2**0.5)


def shared_text(shared: Mapping[str, tuple[str, ...]]) -> list[Text]:
    """Return what nodes share as a sentence each; nothing where their links are independent."""
    said = [
        f"{', '.join(map(visible, nodes))} share {visible(name)}: their links are in one state at each step."
        for name, nodes in shared.items()
    ]
    return [Text(said)] if said else []


def run_summary(health: Health) -> dict[str, Json]:
    """Return all numbers of the report, by node and filter, and by node and component."""
    filters: dict[str, dict[str, Json]] = {}
    for tested_filter in health.filters:
        results: dict[str, Json] = {"claim": tested_filter.claim}
        if tested_filter.test is not None:
            results |= {
                "size": tested_filter.test.power,
                "size_error": tested_filter.test.power_error,
                "correlation": float(tested_filter.test.correlation[0]),
                "p_value": tested_filter.test.p_value,
            }
        filters.setdefault(tested_filter.node, {})[tested_filter.filter] = results
    # What the innovations say of each output.
    outputs: dict[str, dict[str, dict[str, Json]]] = {}
    for output in health.outputs:
        outputs.setdefault(output.node, {}).setdefault(output.filter, {})[output.output] = output_numbers(output)
    # Errors, where the truth is known.
    errors: dict[str, dict[str, Json]] = {}
    for of_filter in errors_of(health.record):
        size = None if np.isnan(of_filter.nees) else of_filter.nees
        rmse: dict[str, Json] = {state: None if np.isnan(x) else x for state, x in of_filter.rmse.items()}
        errors.setdefault(of_filter.node, {})[of_filter.filter] = {"rmse": rmse, "nees": size}
    # Links, by node and component.
    links: dict[str, dict[str, Json]] = {}
    for link in health.links:
        links.setdefault(link.node, {})[link.component] = {"arrived": link.share, "longest_gap": link.longest_gap}
    return {
        "rows": len(health.record.time),
        "warnings": health.warnings(),
        "remarks": health.remarks(),
        "filters": filters,
        "outputs": outputs,
        "errors": errors,
        "links": links,
        "shared": {name: list(nodes) for name, nodes in health.shared.items()},
    }
