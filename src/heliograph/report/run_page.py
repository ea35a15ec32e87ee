"""Report of a run over a recording: estimates with bands, innovations, links, and warnings."""

from collections.abc import Mapping, Sequence
from functools import partial

import matplotlib
import numpy as np
from cycler import cycler
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from heliograph.disk.quoting import in_figure, visible
from heliograph.report.figures import AMBER, BLUE, GREEN, MUTED, PURPLE, STYLE, VERMILION, WIDTH, legend_above
from heliograph.report.health import FilterHealth, Health
from heliograph.report.outputs import errors_of, output_numbers
from heliograph.report.page import Choice, KeyFigure, KeyFigures, Page, Picture, Points, Section, Table, Text
from heliograph.report.results import Json, Results
from heliograph.simulation.network import FUSED
from heliograph.simulation.results.record import Record

COLOURS = (BLUE, VERMILION, GREEN, PURPLE, AMBER)
FEW = 8  # pictures one below the other; of more, one is chosen from a list
MOST = 64  # nodes and links that are drawn; tables and summary hold all
BAND = 2.0  # deviations
LOOK = STYLE | {"axes.prop_cycle": cycler(color=COLOURS), "date.converter": "concise"}


def run_results(health: Health, network: str) -> Results:
    """Return the content of the results folder; `network` is the user's name of the network."""
    return Results(run_figures(health), partial(run_page, health, network), run_summary(health), lambda folder: None)


def run_figures(health: Health) -> dict[str, Figure]:
    """Return figures by file name: estimates of each node, innovations of each filter, deliveries of links."""
    drawn: dict[str, Figure] = {}
    for kind, record in _estimated(health):
        drawn |= {f"{kind}_{i}": _estimates(health, record, node) for i, node in enumerate(_nodes(record))}
    drawn |= {name: _innovations(health, tested) for name, tested in _tested(health).items()}
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


def _tested(health: Health) -> dict[str, list[FilterHealth]]:
    """Return the filters in each figure of innovations: one of all, or one of each node where there are many."""
    tested = sorted(
        (filter for filter in health.filters if filter.white is not None),
        key=lambda tested_filter: tested_filter.node != FUSED,
    )
    if len(tested) <= FEW:
        return {"innovations": tested} if tested else {}
    nodes: dict[str, list[FilterHealth]] = {}
    for tested_filter in tested:
        nodes.setdefault(tested_filter.node, []).append(tested_filter)
    return {f"innovations_{i}": filters for i, filters in enumerate(list(nodes.values())[:MOST])}


def _chosen(pictures: Mapping[str, Picture]) -> list[Picture | Choice]:
    """Return pictures by node one below the other, or as a choice where there are many."""
    return (
        [*pictures.values()]
        if len(pictures) <= FEW
        else [Choice("Node", list(map(visible, pictures)), list(pictures.values()))]
    )


def _not_drawn(names: Sequence[str], where: str) -> list[Text]:
    """Return what a figure leaves out for lack of room, by name, and where its numbers are."""
    if not names:
        return []
    return [Text([f"Not drawn, for lack of room: {', '.join(map(visible, names))}. {where}"])]


@matplotlib.rc_context(LOOK)
def _estimates(health: Health, record: Record, node: str) -> Figure:
    figure = Figure(figsize=(WIDTH, 0.8 + 1.7 * len(record.states)), layout="constrained")
    grid = figure.subplots(len(record.states), 1, squeeze=False, sharex=True)[:, 0]
    record.plot(node, list(record.estimates[node])[: len(COLOURS)], axes=list(grid), sigmas=BAND)
    legend_above(figure, grid[0])
    _time_axis(health, grid[-1])
    return figure


@matplotlib.rc_context(LOOK)
def _innovations(health: Health, tested: list[FilterHealth]) -> Figure:
    figure = Figure(figsize=(WIDTH, 0.6 + 1.5 * len(tested)), layout="constrained")
    grid = figure.subplots(len(tested), 1, squeeze=False, sharex=True)[:, 0]
    names = _components(health)
    for axes, tested_filter in zip(grid, tested, strict=True):
        white = np.asarray(tested_filter.white)
        # A colour for each output; of more outputs than colours, such as a centre's, one for all.
        alike = white.shape[1] > len(COLOURS)
        for i, component in enumerate(white.T):
            name, colour = ("outputs", BLUE) if alike else (names[tested_filter.node][i], COLOURS[i])
            label = None if alike and i else in_figure(f"{white.shape[1]} {name}" if alike else name)
            axes.plot(health.record.time, component, ".", markersize=3, color=colour, label=label)
        for level in (-BAND, BAND):
            axes.axhline(level, color=MUTED, linewidth=0.8, linestyle=(0, (4, 1.6)))
        axes.set_title(in_figure(f"{tested_filter.node}/{tested_filter.filter}"))
        axes.set_ylabel("in deviations")
        axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False, markerscale=2)
    _time_axis(health, grid[-1])
    return figure


def _components(health: Health) -> dict[str, list[str]]:
    """Return the names of the measurement's components by node; of a central filter those of all nodes."""
    names: dict[str, list[str]] = {}
    for link in health.links:
        names.setdefault(link.node, []).append(link.component)
    return names | {FUSED: [f"{link.node}: {link.component}" for link in health.links]}


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
    _time_axis(health, axes)
    return figure


def _time_axis(health: Health, axes: Axes) -> None:
    units, dated = health.record.units, health.record.time.dtype.kind == "M"
    axes.set_xlabel("time (UTC)" if dated else in_figure(f"time ({units['time']})" if "time" in units else "time"))


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
    # Filtered estimates, then smoothed ones if there are any.
    estimates: list[Picture | Choice] = []
    for kind, record_of_kind in _estimated(health):
        added = ", given later data too" if kind == "smoothed" else ""
        estimates += _chosen({
            node: Picture(drawings[f"{kind}_{i}"], f"Estimates of {visible(node)} over time with bands{added}",
                          f"{visible(node)}: estimates with bands of {BAND:g} claimed standard deviations on each "
                          f"side{added}.")
            for i, node in enumerate(_nodes(record_of_kind))
        })  # fmt: skip
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
                    *estimates,
                    *_not_drawn(_ordered(record)[MOST:], "Their estimates are in the record."),
                ],
            ),
            Section("Innovations", [*_tests(health, drawings), *outputs_table(health)]),
            Section("Links", _health(health, drawings)),
        ],
    )


def errors_table(record: Record) -> list[Table]:
    """Return the errors of each filter where the recording has the true state."""
    rows = [
        [visible(f"{errors.node}/{errors.filter}"), errors.claim, *(f"{value:.4g}" for value in errors.rmse.values()),
         "–" if np.isnan(errors.nees) else f"{errors.nees:.3g}"]
        for errors in errors_of(record)
    ]  # fmt: skip
    # What the columns are, in words.
    caption = (
        "Root mean square error of each state against the truth in the recording. **NEES**: squared error over the "
        "claimed one, per state: 1 where the claim holds, above 1 too sure."
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


def _tests(health: Health, drawings: Mapping[str, bytes]) -> list[Text | Table | Picture | Choice]:
    # One row for each filter, fused ones first: size, correlation and p-value of its innovations.
    rows = []
    for tested_filter in sorted(health.filters, key=lambda judged: judged.node != FUSED):
        test, name = tested_filter.test, visible(f"{tested_filter.node}/{tested_filter.filter}")
        if test is None:
            rows.append([name, tested_filter.claim, "–", "–", "–"])
        else:
            size = f"{test.power:.2f} ± {1.96 * test.power_error:.2f}"
            rows.append(
                [
                    name,
                    tested_filter.claim,
                    size,
                    f"{test.correlation[0]:.2f} ± {1.96 * test.standard_error[0]:.2f}",
                    "< 0.001" if test.p_value < 0.001 else f"{test.p_value:.3f}",
                ]
            )
    caption = (
        "**Size**: mean square of the innovations in units of what the filter claims (normalised innovation squared "
        "per dimension): 1 where the claim holds, above 1 too sure. **Correlation** of innovations "
        "one row apart: 0 where the filter uses all that it receives. Both with 95 % intervals; **p**: probability of "
        "such a correlation if there were none."
    )
    text = "An innovation is what arrived less what the filter expected. The tests need no true state."
    # The innovations themselves, if any filter has some.
    tested = _tested(health)
    pictures = {
        filters[0].node: Picture(drawings[name], "Innovations over time in claimed deviations",
                                 f"Innovations in claimed standard deviations, one colour an output (of more than "
                                 f"{len(COLOURS)} one for all); 5 of 100 may lie beyond ±{BAND:g}.")
        for name, filters in tested.items()
    }  # fmt: skip
    drawn = {filter.node for filters in tested.values() for filter in filters}
    left = [
        f"{judged.node}/{judged.filter}"
        for judged in health.filters
        if judged.white is not None and judged.node not in drawn
    ]
    table = Table(["filter", "claim", "size", "correlation", "p"], rows, caption)
    # Fusions of estimates, which are in no row.
    listed = {(judged.node, judged.filter) for judged in health.filters}
    fusions = [name for name in health.record.estimates.get(FUSED, {}) if (FUSED, name) not in listed]
    if fusions:
        text += (
            f" A fusion of estimates receives nothing itself ({', '.join(map(visible, fusions))}): the filters that it "
            "fuses are tested here, and itself on the live page of `heliograph serve`."
        )
    return [Text([text]), table, *_chosen(pictures), *_not_drawn(left, "Their numbers are in the table.")]


def outputs_table(health: Health) -> list[Table]:
    """Return what the innovations of each output say of it; of filters that weigh, how many values they doubted."""
    rows = []
    for output in health.outputs:
        # Numbers of the summary; the bias to the digits that its interval holds.
        s = output.summary
        doubted = f"{s.down_weighted} ({100 * s.share.low:.2g} to {100 * s.share.high:.2g} %)" if output.weighs else "–"
        half = (s.bias_high - s.bias_low) / 2
        name = visible(f"{output.node}/{output.filter}: {output.output}")
        bias = f"{rounded(s.bias, half / 1.96)} ± {half:.1g}"
        rows.append([name, f"{s.received} of {s.expected}", doubted, bias, f"{s.squared:.2f}",
                     "to blame" if output.to_blame else ""])  # fmt: skip
    caption = (
        "**Down-weighted**: values that counted less than half, and the interval of their share. **Bias**: median "
        "of the innovations in the output's unit. **d²**: mean square of an innovation over its variance, 1 where the "
        "model is right. All with 95 % intervals that allow for correlated rows. **To blame**: its share "
        "lies above that of the filter's other outputs together, by an interval of the difference."
    )
    return [Table(["filter: output", "received", "down-weighted", "bias", "d²", ""], rows, caption)] if rows else []


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
    not_drawn = _not_drawn(left, "Their numbers are in the table.")
    return [Table(headers, rows), *picture, *not_drawn, *shared_text(health.shared)]


def _moments(values: np.ndarray) -> tuple[str, str]:
    """Return mean and deviation of a component, each to two digits of its standard error."""
    if len(values) < 2:
        return (f"{values[0]:.4g}" if len(values) else "–"), "–"
    deviation = float(values.std())
    error = deviation / len(values) ** 0.5
    return rounded(float(values.mean()), error), rounded(deviation, error / 2**0.5)


def rounded(value: float, error: float) -> str:
    """Return a number to two digits of its standard error; to four of its own without one."""
    if not (np.isfinite(value) and 0 < error < np.inf):
        return f"{value:.4g}"
    places = 1 - int(np.floor(np.log10(error)))
    return f"{value:.4g}" if not -6 <= places <= 9 else f"{round(value, places):.{max(places, 0)}f}"


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
