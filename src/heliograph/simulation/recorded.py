"""Recordings: every filter of a network over recorded measurements."""

import warnings
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from typing_extensions import TypeAliasType

from heliograph.engine.choice import compute_once
from heliograph.filters.chunks import scan_in_chunks
from heliograph.filters.recursion import Recursion
from heliograph.model.checks.row_times import common_dates, warn_of_unequal_steps
from heliograph.model.limits import Limits
from heliograph.model.origin import Origin, last_input, usual_months, usual_spacing
from heliograph.model.plant import TIME_STEP
from heliograph.model.stuck import Repeats
from heliograph.model.timeouts import find_long_silences
from heliograph.numerics.check import array, check_columns, fail, instance, rank, table
from heliograph.numerics.float64 import check_process, quickly_compiled, to_numpy
from heliograph.numerics.times.row_times import check_times
from heliograph.numerics.types import Array, ArrayLike, Float, PyTree, units_in
from heliograph.simulation.arguments import inputs_of, measurement_of
from heliograph.simulation.centres.blame import refuse_centrally
from heliograph.simulation.centres.uplinks import Drawn, SentReports
from heliograph.simulation.description.possible import doubt_estimates
from heliograph.simulation.description.remarks import say_remarks
from heliograph.simulation.description.wide_angles import warn_beyond_a_turn, warn_wide_in_rows
from heliograph.simulation.network import FUSED, Network
from heliograph.simulation.node import Node, ReceivingNode
from heliograph.simulation.plausible_step import (
    Judges,
    any_implausible,
    describe_doubts,
    find_refused_rows,
    forbidden_rows,
    step_plausibly,
)
from heliograph.simulation.results.record import Record, warn_of_no_numbers
from heliograph.simulation.smoothed import Smoother, add_truth, make_record, select_smoothed_part
from heliograph.simulation.stepping import AllFilters, initial_states
from heliograph.simulation.transmission.shared_dithers import refuse_shared_dithers
from heliograph.smoothing.fixed_interval_lag_point import AbstractSmoothing


class Rest(NamedTuple):
    """What a recording's measurements are filtered with: filters, a smoother, inputs, and what arrived by fusion."""

    filters: AllFilters
    later: Smoother | None
    u: np.ndarray
    arrivals: dict[str, PyTree]


ROWS = 128  # of a recording with fusions between neighbours, whose weights are in memory at a time

Reports = TypeAliasType("Reports", Mapping[str, Mapping[str, SentReports | ArrayLike]])  # by fusion and node


def run(
    network: "Network",
    measurements: "Mapping[str, ArrayLike]",
    inputs: "Float[ArrayLike, 'steps inputs'] | None" = None,
    time: "ArrayLike | None" = None,
    truth: "Float[ArrayLike, 'steps n'] | None" = None,
    smooth: "AbstractSmoothing | None" = None,
    reports: "Reports | None" = None,
) -> "Record":
    """Run every filter of the network over recorded measurements.

    Values beyond a node's limits, those that are stuck, and those that are implausible for all filters of a node
    (`heliograph.filters.plausibility`), count as not arrived; each is warned of, with its rows from 1.
    A value that the rule of its sender forbids is warned of and used, and a node is warned of that is silent for longer
    than its timeout. Filters that left out most of what arrived,
    such as one with a gate about a wrong start, are warned of, and an extended filter that ends where no sensor shows
    a state any more, or a filter with limits that lies at one in most rows.

    Args:
        network: the network.
        measurements: for each node an array (steps, received), NaN where a component did not arrive. Those of relays
            may be left out, and with them their filters.
        inputs: (steps, inputs), the input that led to each row; by default a plant without inputs is assumed.
        time: (steps,), numbers or dates (datetime64, datetimes, texts of ISO 8601, periods of pandas), stored in the
            record; by default the dates by which the rows of the measurements are known (the index of pandas, the
            coordinate of xarray), else 0, 1, ... Where steps differ and the plant has no input dt, there is a warning.
        truth: true states (steps, n) where they are known, NaN where they are not; no filter sees them. None by
            default.
        smooth: smoothing as in `monte_carlo`; None by default.
        reports: for each fusion by `AllReports` and each of its nodes the received values of the report that was sent
            at each step, (steps, received), NaN where it never arrived; `SentReports` where delays differ. For each
            fusion between neighbours and each of its nodes, (steps, rounds times neighbours), NaN where a neighbour's
            message did not arrive. They may be left out where the links are deterministic (default none).

    Returns:
        The record, with the truth that was given: `record.rmse(node, filter)`, `record.nees(node, filter)`.

    Raises:
        ValueError: a node without measurements or the reverse, shapes that do not fit, times that go backwards, dates
            of rows that differ between nodes, two senders of words with the same dithers, a filter or fusion that
            cannot be smoothed.
    """
    check_process()
    instance("network", network, Network, "a Network")
    name = next(iter(network.nodes))
    measured = table("measurements", measurements, f"arrays of nodes, such as {{{name!r}: z}},")
    network = network.restricted_to(measured)
    steps = _count_rows(next(iter(measured.values())))
    # Measurements, inputs and times of one length.
    z = {name: measurement_of(name, measurements[name], steps, node) for name, node in network.nodes.items()}
    network.check_horizon(steps)
    u = inputs_of(network, inputs, steps)
    check_columns("truth", truth, network.states)
    true = None if truth is None else array("truth", truth, (steps, len(network.states)), missing=True)
    times = _find_times(measured, {"inputs": inputs, "truth": truth}, time, steps)
    warn_of_unequal_steps(network.inputs, times)
    clock = np.arange(steps, dtype=np.float64) if times is None else times
    refuse_shared_dithers(network, z)
    z, said = _screen_measurements(network, z, u)
    for line in (*said, *warn_beyond_a_turn(network, z)):
        warnings.warn(line, stacklevel=2)
    # Filters, on what a recording without implausible data has.
    smoothing = None if smooth is None else select_smoothed_part(network, smooth, steps)
    filters = AllFilters(network, None if smoothing is None else smoothing.kinds, judges=True)
    with jax.enable_x64(True):
        sent = {} if reports is None else table("reports", reports, "reports by fusion")
        arrivals = _collect_arrivals(filters, sent, steps)
        smoother = None if smoothing is None else smoothing.smoother(filters)
        outputs = _filter_plausible(network, z, Rest(filters, smoother, u, arrivals))
    state = outputs.pop("state")
    record = make_record(network, smoothing, outputs, clock)
    if time is not None and (unit := units_in(network.inputs).get(TIME_STEP)):
        record = replace(record, units=record.units | {"time": unit})
    warn_of_no_numbers(record)
    doubts = *warn_wide_in_rows(network, record), *doubt_estimates(network, record)
    for line in (*doubts, *_describe_left_out(network, record), *say_remarks(network, state)):
        warnings.warn(line, stacklevel=2)
    # Row numbers are one apart: two of them say so.
    origin = _make_origin(network, record, state, u, usual_spacing(clock if times is not None else clock[:2]))
    return (record if true is None else add_truth(record, network.plant, true, smooth)).with_origin(origin)


def _count_rows(measurements: ArrayLike) -> int:
    """Return the number of rows of a node's measurements, one of a scalar; raise where there is none."""
    steps = len(measurements) if rank("measurements", measurements) else 1  # type: ignore[arg-type]
    if steps == 0:
        raise fail("measurements", "at least one row", "none")
    return steps


def _make_origin(network: Network, record: Record, state: PyTree, u: np.ndarray, spacing: float) -> Origin:
    """Return where forecasts start: behind the last row, whose time between rows is dt where the plant has it."""
    last_estimates = {
        node: {name: jax.tree.map(lambda leaf: np.asarray(leaf)[-1], e) for name, e in by_filter.items()}
        for node, by_filter in record.estimates.items()
    }
    if TIME_STEP in network.inputs and len(u) > 1:
        spacing = float(np.median(u[1:, network.inputs.index(TIME_STEP)]))
    months = usual_months(record.time)
    return Origin(network, state, len(u), last_input(u), record.time[-1], spacing, last_estimates, months)


def _find_times(
    measured: Mapping[str, ArrayLike], others: Mapping[str, object], time: ArrayLike | None, steps: int
) -> np.ndarray | None:
    """Return the times of the rows: those given, else the dates by which the tables know them; None where neither."""
    if time is not None:
        return check_times("time", time, steps)
    return common_dates({**{f"measurements of node {name!r}": z for name, z in measured.items()}, **others})


def _screen_measurements(
    network: Network, z: dict[str, np.ndarray], u: np.ndarray
) -> tuple[dict[str, np.ndarray], list[str]]:
    """Return the measurements without values that are beyond their node's limits, or stuck; and lines that say so.

    A line is said too of values that the rule of their sender forbids, which stay, and of silences that are longer
    than the node's timeout.
    """
    kept, said = dict[str, np.ndarray](), list[str]()
    for name, node in network.nodes.items():
        kept[name], lines = (z[name], []) if node.limits is None else _drop_beyond(node.limits, z[name], node)
        if rows := forbidden_rows(node, kept[name]):
            lines.append(
                f"{len(rows)} values came that the rule of their sender forbids; row {rows[0] + 1}: "
                "within delta of the value before, and no heartbeat due"
            )
        said += [f"node {name!r}: {line}" for line in lines]
    timeouts = {name: node.timeout for name, node in network.nodes.items()}
    silences = find_long_silences(timeouts, kept, u, network.inputs)
    said += [f"node {name!r}: {found.describe()}" for name, found in silences.items()]
    return kept, said


def _drop_beyond(
    limits: Limits, z: Float[np.ndarray, "steps m"], node: Node | ReceivingNode
) -> tuple[Float[np.ndarray, "steps m"], list[str]]:
    """Return the values that are neither beyond limits nor stuck, NaN for others; and a line on each of the two."""
    screened, came = limits.screen(z, Repeats()), int(np.count_nonzero(~np.isnan(z)))
    none_stuck, lines = np.zeros_like(screened.stuck[0]), list[str]()
    for dropped, stuck in ((screened.outside, none_stuck), (screened.stuck, screened.stuck)):
        if dropped.any():
            row = int(np.argmax(dropped.any(axis=1)))
            at_row = np.where(dropped[row], z[row], np.nan)
            why = limits.why(at_row, node.received_names, np.broadcast_to(stuck, dropped.shape)[row])
            lines.append(f"{int(dropped.sum())} of {came} values count as not arrived; row {row + 1}: {why}")
    return screened.values, lines


def _describe_left_out(network: Network, record: Record) -> Iterator[str]:
    """Yield a line for each output of which a filter that weighs what arrives left out most."""
    for node, filters in record.weighed.items():
        if node == FUSED:
            names = [f"{each}: {name}" for each in record.measurements for name in network.nodes[each].received_names]
        else:
            names = list(network.nodes[node].received_names)
        for filter in filters:
            for name, summary in zip(names, record.outputs(node, filter), strict=True):
                yield from summary.describe_left_out(f"{node}/{filter}", name)


def _collect_arrivals(filters: AllFilters, reports: Reports, steps: int) -> dict[str, PyTree]:
    """Return what arrived of reports and between neighbours, by fusion."""
    centre_arrivals: dict[str, PyTree] = {
        name: centre.uplinks.recorded(name, centre.nodes, reports.get(name), steps)
        for name, centre in filters.reporting.items()
    }
    mesh_arrivals = {
        name: mesh.edges.recorded(name, mesh.nodes, reports.get(name), steps) for name, mesh in filters.meshes.items()
    }
    return centre_arrivals | mesh_arrivals


def _filter_plausible(network: Network, z: dict[str, np.ndarray], rest: Rest) -> PyTree:
    """Return the results of filtering a recording without implausible data, and warn of these.

    If there are any, the recording is first filtered step by step without them to find all rows; then, without those
    that all filters of a node refuse, once again as a recording that never had them. Of what central filters refuse
    one node is to blame in each row, and the others' values are judged again without it.
    """

    def group_measurements() -> tuple[np.ndarray, ...]:
        """Return the measurements as they are now, (steps, node, received) by group."""
        return tuple(np.stack([z[name] for name in names], axis=1) for names in network.groups)

    # Usually nothing is implausible.
    outputs = _filter_rows(*rest, group_measurements(), False)
    if not any_implausible(outputs):
        doubts = describe_doubts(network, outputs, {}, rest.u)
    else:
        # Find all rows that are, then filter again without them.
        outputs = first_time = _filter_rows(*rest, group_measurements(), True)
        refused = dict[str, dict[int, str]]()
        while new := _find_refused(network, outputs, z, group_measurements(), rest, refused):
            for name, rows in new.items():
                refused[name] = dict(sorted((refused.get(name, {}) | rows).items()))
                z[name] = z[name].copy()
                z[name][list(rows)] = np.nan
            again = _filter_rows(*rest, group_measurements(), False)
            outputs = _filter_rows(*rest, group_measurements(), True) if any_implausible(again) else again
        doubts = describe_doubts(network, first_time, refused, rest.u)
    for line in doubts:
        warnings.warn(line, stacklevel=3)
    return {name: values for name, values in outputs.items() if not name.startswith("judged")}


def _find_refused(
    network: Network, outputs: PyTree, z: dict[str, np.ndarray], grouped: tuple[np.ndarray, ...], rest: Rest,
    before: dict[str, dict[int, str]],
) -> dict[str, dict[int, str]]:  # fmt: skip
    """Return, by node, the rows that its filters refuse and that were not refused `before`, with the reason.

    Rows that the central filters refuse are those of the node to blame.
    """
    refused, centrally = find_refused_rows(network, outputs)
    filters, u = rest.filters, rest.u
    if centrally:
        states = compute_once(_collect_central_states, _central_states_by_xla, (filters, u, rest.arrivals, grouped))
        in_order = {name: z[name] for name in network.names}
        nodes = Judges(network).without_own
        refused |= refuse_centrally(filters.central, states, in_order, u, centrally, nodes)
    new = {name: {k: why for k, why in rows.items() if k not in before.get(name, ())} for name, rows in refused.items()}
    return {name: rows for name, rows in new.items() if rows}


def _collect_central_states(
    filters: AllFilters, u: np.ndarray, arrivals: dict[str, Drawn], z: tuple[np.ndarray, ...]
) -> PyTree:
    """Return the states of the central filters before each row."""

    def step(states: PyTree, row: tuple[PyTree, ...]) -> tuple[PyTree, PyTree]:
        """Step all filters; the central ones' states before the step are the output."""
        k, u_k, z_k, drawn = row
        return step_plausibly(filters, states, z_k, u_k, k, drawn)[0], states[1]

    before: PyTree = jax.lax.scan(step, filters.init(), (jnp.arange(len(u)), u, z, arrivals))[1]
    return before


def _filter_rows(*arguments: PyTree) -> PyTree:
    """Return what `_run_filters` does, as NumPy arrays: in chunks side by side, by native code, or by XLA."""
    results = _filter_in_chunks(*arguments)
    if results is not None:
        return results
    # XLA for a joint covariance: the graph, an argument here, decides where its blocks are stored.
    filters, *_ = arguments
    by_xla = any(mesh.is_long or mesh.needs_joint for mesh in filters.meshes.values())
    return _scan_in_parts(*arguments) if by_xla else compute_once(_run_filters, _by_xla, arguments)


class NetworkRows(Recursion):
    """Recursion of all filters of a network over rows; each row's output is all that they estimate and judge."""

    filters: AllFilters

    def step(self, state: PyTree, row: tuple[PyTree, Array], k: Array) -> tuple[PyTree, PyTree]:
        """Step all filters over one row; return their states and what is recorded of them."""
        z, u = row
        return self.filters.step(state, z, jnp.asarray(u), jnp.asarray(k), {})


def _filter_in_chunks(
    filters: AllFilters, later: Smoother | None, u: np.ndarray, arrivals: dict[str, Drawn], z: tuple[np.ndarray, ...],
    judged: bool,
) -> PyTree | None:  # fmt: skip
    """Filter rows in chunks side by side; None where that cannot be. Arguments as of `_run_filters`.

    All filters must be linear, and take each measurement as it is; results are not smoothed, and rows are many.
    """
    if judged or later is not None or not filters.are_linear:
        return None
    whole = scan_in_chunks(NetworkRows(filters), to_numpy(initial_states(filters)), (z, u))
    return None if whole is None else _collect_results(later, z, *whole)


def _scan_in_parts(
    filters: AllFilters, later: Smoother | None, u: np.ndarray, arrivals: dict[str, Drawn], z: tuple[np.ndarray, ...],
    judged: bool,
) -> PyTree:  # fmt: skip
    """Run `_run_filters` by XLA, some rows at a time, whose weights between neighbours are computed ahead."""
    # As few parts of at most ROWS rows as there can be, of one size, so that they share a program.
    count = -(-len(u) // ROWS)
    size = -(-len(u) // count)
    rows, states, parts = (np.arange(len(u)), u, z, arrivals), initial_states(filters), []
    for start in range(0, len(u), size):
        # The last part is filled with its last row, which does not count again.
        indices = np.minimum(np.arange(start, start + size), len(u) - 1)
        k, u_k, z_k, drawn = jax.tree.map(lambda leaf, rows=indices: np.asarray(leaf)[rows], rows)
        drawn |= {name: (drawn[name], mesh.ahead(drawn[name])) for name, mesh in filters.meshes.items()}
        counts = np.arange(start, start + size) < len(u)
        states, results = _scanned_by_xla(filters, states, (k, u_k, z_k, drawn), judged, counts)
        parts.append(to_numpy(results))
    all_rows = jax.tree.map(lambda *leaves: np.concatenate(leaves)[: len(u)], *parts)
    return to_numpy(_collect_results(later, z, states, all_rows))


def _run_filters(
    filters: AllFilters, later: Smoother | None, u: np.ndarray, arrivals: dict[str, Drawn], z: tuple[np.ndarray, ...],
    judged: bool,
) -> PyTree:  # fmt: skip
    """Filter all rows in one scan: filters, smoother, inputs and what arrived as in `Rest`.

    z are the measurements (steps, node, received) by group; if `judged`, what is implausible is left out.
    """
    return _collect_results(later, z, *_scan(filters, filters.init(), (jnp.arange(len(u)), u, z, arrivals), judged))


def _scan(
    filters: AllFilters, states: PyTree, rows: tuple[PyTree, ...], judged: bool, counts: np.ndarray | None = None
) -> tuple[PyTree, dict[str, PyTree]]:
    """Step over rows: return the last states, and the results by row; rows that do not count change no state."""

    def step_row(states: PyTree, row: tuple[PyTree, ...]) -> tuple[PyTree, PyTree]:
        (k, u_k, z_k, drawn), row_counts = row
        step = step_plausibly if judged else AllFilters.step
        after, results = step(filters, states, z_k, u_k, k, drawn)
        if row_counts is not None:
            after = jax.tree.map(lambda new, old: jnp.where(row_counts, new, old), after, states)
        return after, results

    states, results = jax.lax.scan(step_row, states, (rows, counts))
    return states, results


def _collect_results(
    later: Smoother | None, z: tuple[np.ndarray, ...], state: PyTree, results: dict[str, PyTree]
) -> PyTree:
    """Return what the filters judged, their last state, and their results, smoothed if there is a smoother."""
    results = {"measurements": z, **results}
    judged = {name: results.pop(name) for name in ("judged", "judged_centrally")}
    return (results if later is None else later.smooth_run(results)) | judged | {"state": state}


_by_xla, _scanned_by_xla = quickly_compiled(_run_filters), quickly_compiled(_scan)
_central_states_by_xla = quickly_compiled(_collect_central_states)
