"""Recordings: every filter of a network over recorded measurements."""

import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import jax
import numpy as np
from typing_extensions import TypeAliasType

from heliograph.model.checks.refusal_reasons import number_of_reason
from heliograph.model.checks.row_times import find_common_dates, warn_of_unequal_steps
from heliograph.model.forecast_origin import Origin, find_median_spacing, find_months_between_rows, last_input
from heliograph.model.plant import TIME_STEP
from heliograph.numerics.check import array, check_columns, fail, instance, rank, table
from heliograph.numerics.float64 import refuse_forked_process
from heliograph.numerics.times.row_times import check_times
from heliograph.numerics.types import ArrayLike, PyTree, units_in
from heliograph.simulation.arguments import read_measurements, read_plant_inputs
from heliograph.simulation.centres.uplinks import SentReports
from heliograph.simulation.description.angle_doubts import doubt_angles_beyond_a_turn, doubt_wide_angles_in_rows
from heliograph.simulation.description.doubtful_estimates import doubt_estimates
from heliograph.simulation.description.filter_remarks import describe_remarks
from heliograph.simulation.network import FUSED, Network
from heliograph.simulation.network_filters import AllFilters
from heliograph.simulation.recordings.implausible_data import (
    JudgementReader,
    any_implausible,
    describe_doubts,
    find_refused_rows,
)
from heliograph.simulation.recordings.scan_recording import (
    FilteringTask,
    RecordingStart,
    continue_times,
    filter_rows,
    find_central_states_before_rows,
    read_recording_start,
)
from heliograph.simulation.recordings.screened_recording import leave_out_values
from heliograph.simulation.recordings.smoothed import (
    SmoothingPlan,
    add_truth,
    make_smoothed_record,
    select_smoothed_part,
)
from heliograph.simulation.results.non_finite_warnings import warn_of_non_finite_numbers
from heliograph.simulation.results.record import Record
from heliograph.simulation.results.reducer import trajectories_record
from heliograph.simulation.rows.implausible_node import blame_nodes_for_implausible_rows
from heliograph.simulation.transmission.shared_dithers import refuse_shared_dithers
from heliograph.smoothing.fixed_interval_lag_point import AbstractSmoothing

Reports = TypeAliasType("Reports", Mapping[str, Mapping[str, SentReports | ArrayLike]])  # by fusion and node


def run(
    network: "Network",
    measurements: "Mapping[str, ArrayLike]",
    inputs: "ArrayLike | None" = None,
    time: "ArrayLike | None" = None,
    truth: "ArrayLike | None" = None,
    smooth: "AbstractSmoothing | None" = None,
    reports: "Reports | None" = None,
    after: "Record | None" = None,
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
        truth: true states (steps, n) where they are known, NaN where they are not; no filter sees them. Angles of
            estimates are then within half a turn of them, and else between -pi and pi. None by default.
        smooth: smoothing as in `monte_carlo`; None by default.
        reports: for each fusion by `AllReports` and each of its nodes the received values of the report that was sent
            at each step, (steps, received), NaN where it never arrived; `SentReports` where delays differ. For each
            fusion between neighbours and each of its nodes, (steps, rounds times neighbours), NaN where a neighbour's
            message did not arrive. They may be left out where the links are deterministic (default none).
        after: what this returned for the rows before these, from which the filters go on: so a recording too long to be
            held is run in blocks. Warnings count rows from the first of these. None (default): nothing is before them.

    Returns:
        The record, with the truth that was given: `record.rmse(node, filter)`, `record.nees(node, filter)`.

    Raises:
        ValueError: a node without measurements or the reverse, shapes that do not fit, times that go backwards, dates
            of rows that differ between nodes, two senders of words with the same dithers, a filter or fusion that
            cannot be smoothed; `after` of another network or of later rows, or with what needs rows of both: smoothing,
            a fusion whose messages may be late.
    """
    refuse_forked_process()
    instance("network", network, Network, "a Network")
    example = f"arrays of nodes, such as {{{next(iter(network.nodes))!r}: z}},"
    measured = table("measurements", measurements, example)
    network, steps = network.restricted_to(measured), _count_rows(next(iter(measured.values())))
    # Measurements, filters, and where they go on behind earlier rows.
    z = {name: read_measurements(name, measurements[name], steps, node) for name, node in network.nodes.items()}
    smoothing = None if smooth is None else select_smoothed_part(network, smooth, steps)
    filters = AllFilters(network, None if smoothing is None else smoothing.stacks, judges=True)
    before = None if after is None else read_recording_start(filters, after, smooths=smooth is not None)
    first = 0 if before is None else int(before.step)
    network.check_horizon(first + steps)
    u = read_plant_inputs(network, inputs, steps)
    check_columns("truth", truth, network.states)
    true = None if truth is None else array("truth", truth, (steps, len(network.states)), missing=True)
    times = _find_times(measured, {"inputs": inputs, "truth": truth}, time, steps)
    clock = first + np.arange(steps, dtype=np.float64) if times is None else times
    joined = continue_times(before, clock)
    warn_of_unequal_steps(network.inputs, None if times is None else joined)
    refuse_shared_dithers(network, z)
    # Readings that the nodes refuse count as not arrived.
    z, refused, said, repeats = network.screen_readings(z, u, {} if before is None else before.repeats)
    _warn_of_each((*said, *doubt_angles_beyond_a_turn(network, z)))
    # Filters, on what is left without implausible data.
    begin = None if before is None else RecordingStart(before.state, np.asarray(first))
    with jax.enable_x64(True):
        arrivals = _collect_arrivals(filters, {} if reports is None else reports, steps)
        smoother = None if smoothing is None else smoothing.smoother(filters)
        task = FilteringTask(filters, smoother, u, arrivals, begin)
        outputs = _filter_without_implausible_data(network, z, refused, task)
    state = outputs.pop("state")
    record = _make_record(network, smoothing, outputs, clock)
    record = record if time is None else _add_unit_of_time(record, network.inputs)
    _warn_of_record(network, record, state)
    # Where the rows end, for forecasts and later rows. Rows without times are all as far apart as the first two.
    spacing = find_median_spacing(clock if times is not None else clock[:2])
    origin = _make_forecast_origin(network, record, state, u, spacing)
    record = record if true is None else add_truth(record, network.plant, true, smooth)
    return record.with_origin(replace(origin, step=first + steps, repeats=repeats)).with_refused(refused)


def _warn_of_record(network: Network, record: Record, state: PyTree) -> None:
    """Warn of doubtful things in a record: numbers that are not finite, wide angles, data left out, and remarks.

    `state`: states of all filters after the last row.
    """
    warn_of_non_finite_numbers(record)
    lines = [*doubt_wide_angles_in_rows(network, record), *doubt_estimates(network, record)]
    lines += [*_describe_left_out(network, record), *describe_remarks(network, state)]
    _warn_of_each(lines)


def _make_record(network: Network, smoothing: SmoothingPlan | None, outputs: PyTree, clock: np.ndarray) -> Record:
    """Return the record of all filters' outputs for the rows, with a smoothed part if there is a smoothing plan.

    `clock`: times of the rows.
    """
    if smoothing is None:  # the truth of a recording is not known
        return trajectories_record(network, {"truth": None, **outputs}, clock)
    return make_smoothed_record(network, smoothing, outputs, clock)


def _add_unit_of_time(record: Record, inputs: Sequence[str]) -> Record:
    """Return the record with the unit of its times, which is that of the plant's time step, where this has one."""
    unit = units_in(inputs).get(TIME_STEP)
    return replace(record, units=record.units | {"time": unit}) if unit else record


def _warn_of_each(lines: Sequence[str]) -> None:
    """Warn of each line, at the place from which `run` was called."""
    for line in lines:
        warnings.warn(line, stacklevel=3)


def _count_rows(measurements: ArrayLike) -> int:
    """Return the number of rows of a node's measurements; raise ValueError if it is 0. A single number is 1 row."""
    steps = len(measurements) if rank("measurements", measurements) else 1  # type: ignore[arg-type]
    if steps == 0:
        raise fail("measurements", "at least one row", "none")
    return steps


def _make_forecast_origin(network: Network, record: Record, state: PyTree, u: np.ndarray, spacing: float) -> Origin:
    """Return where forecasts start, behind the last row.

    Args:
        network: the network.
        record: estimates and times of all rows.
        state: states of all filters after the last row.
        u: inputs of the plant (steps, inputs).
        spacing: usual time between rows; a plant with the input dt takes the median of that instead.
    """
    # Estimates by node and filter, only the last of each; then the median step, without the first row, which has none.
    last_estimates = {
        node: {name: jax.tree.map(lambda leaf: np.asarray(leaf)[-1], e) for name, e in by_filter.items()}
        for node, by_filter in record.estimates.items()
    }
    if TIME_STEP in network.inputs and len(u) > 1:
        spacing = float(np.median(u[1:, network.inputs.index(TIME_STEP)]))
    return Origin(
        model=network,
        state=state,
        step=len(u),
        inputs=last_input(u),
        time=record.time[-1],
        spacing=spacing,
        estimates=last_estimates,
        months=find_months_between_rows(record.time),
    )


def _find_times(
    measured: Mapping[str, ArrayLike], other_tables: Mapping[str, object], time: ArrayLike | None, steps: int
) -> np.ndarray | None:
    """Return the times of the rows: `time`, or else the dates that the tables have; None if there are neither.

    A table of pandas or xarray may have a date for each row. Tables whose dates differ are an error.

    Args:
        measured: tables of measurements by node.
        other_tables: further tables by name.
        time: numbers or dates of the rows; None where none are given.
        steps: number of rows.
    """
    if time is not None:
        return check_times("time", time, steps)
    tables = {f"measurements of node {name!r}": z for name, z in measured.items()}
    return find_common_dates({**tables, **other_tables})


def _describe_left_out(network: Network, record: Record) -> Iterator[str]:
    """Yield a line for each output that a filter mostly left out.

    Only filters that weigh what arrives leave out any. FUSED is the name of filters of all nodes' measurements.
    """
    for node, filters in record.weighed.items():
        if node == FUSED:
            names = [
                f"{node_name}: {name}"
                for node_name in record.measurements
                for name in network.nodes[node_name].received_names
            ]
        else:
            names = list(network.nodes[node].received_names)
        for filter in filters:
            for name, summary in zip(names, record.outputs(node, filter), strict=True):
                yield from summary.describe_left_out(f"{node}/{filter}", name)


def _collect_arrivals(filters: AllFilters, reports: Reports, steps: int) -> dict[str, PyTree]:
    """Return what arrived in each step, for each fusion at a centre or between neighbours, from recorded `reports`.

    `steps`: number of rows. Messages that cannot get lost need not be recorded: they are taken to arrive.
    """
    reports = table("reports", reports, "reports by fusion")
    centre_arrivals: dict[str, PyTree] = {
        name: centre.uplinks.read_recorded(name, centre.nodes, reports.get(name), steps)
        for name, centre in filters.reporting.items()
    }
    mesh_arrivals = {
        name: mesh.edges.read_recorded(name, mesh.nodes, reports.get(name), steps)
        for name, mesh in filters.meshes.items()
    }
    return centre_arrivals | mesh_arrivals


def _filter_without_implausible_data(
    network: Network, z: dict[str, np.ndarray], left_out: dict[str, np.ndarray], task: FilteringTask
) -> PyTree:
    """Return the results of filtering a recording without implausible data, and warn of these.

    Data are implausible if they are too far from a filter's prediction to be right. If there are any, the recording is
    filtered first with judgements: at each step a filter leaves out the values that it finds implausible. The rows that
    all filters of a node refuse are then taken out, and the rest is filtered again as a recording that never had them,
    until no new row is refused. If central filters refuse a row, one node is to blame, and the other nodes' values are
    judged again without it.

    Args:
        network: the network.
        z: measurements by node (steps, received); refused rows are taken out.
        left_out: number of the reason why a reading does not count, by node (steps, received), 0 if it does; reasons of
            refused readings are added.
        task: all that the recording is filtered with but measurements: filters, a smoother if any, and inputs.
    """

    def group_measurements() -> tuple[np.ndarray, ...]:
        """Return the measurements as they are now, (steps, node, received) by group."""
        return tuple(np.stack([z[name] for name in names], axis=1) for names in network.groups)

    # Usually nothing is implausible.
    outputs = filter_rows(task, group_measurements(), judged=False)
    if not any_implausible(outputs):
        doubts = describe_doubts(network, outputs, {}, task.u)
    else:
        # Find all rows that are, then filter again without them.
        outputs = first_time = filter_rows(task, group_measurements(), judged=True)
        refused = dict[str, dict[int, str]]()
        while new := _find_refused_rows(network, outputs, z, group_measurements(), task, refused):
            for name, reasons_by_row in new.items():
                refused[name] = dict(sorted((refused.get(name, {}) | reasons_by_row).items()))
                # Out of a copy of the measurements, since they are the caller's.
                rows = list(reasons_by_row)
                z[name] = z[name].copy()
                left_out[name][rows] += ~np.isnan(z[name][rows]) * np.int8(number_of_reason("implausible"))
                z[name][rows] = leave_out_values(network.nodes[name], z[name][rows])
            again = filter_rows(task, group_measurements(), judged=False)
            outputs = filter_rows(task, group_measurements(), judged=True) if any_implausible(again) else again
        doubts = describe_doubts(network, first_time, refused, task.u)
    for line in doubts:
        warnings.warn(line, stacklevel=3)
    return {name: values for name, values in outputs.items() if not name.startswith("judged")}


def _find_refused_rows(
    network: Network, outputs: PyTree, z: dict[str, np.ndarray], z_by_group: tuple[np.ndarray, ...],
    task: FilteringTask, before: dict[str, dict[int, str]],
) -> dict[str, dict[int, str]]:  # fmt: skip
    """Return, by node, the rows that its filters refuse as implausible and that were not refused `before`.

    A row is implausible if the measurement cannot be true by the filter's model. The nodes' own filters judge their
    node. A central filter judges the row of all nodes' measurements; the row is then refused of one node alone, which
    is to blame: one that no filter of its own judges, and without whose values the central filters find the row
    plausible.

    Args:
        network: the network.
        outputs: results of filtering with judgements, by row.
        z: {node: measurements (steps, received)}.
        z_by_group: the same (steps, node, received) by group.
        task: what the recording is filtered with: filters, inputs, and all else.
        before: rows that were refused already: {node: {row: reason}}.

    Returns:
        {node: {row: reason}}.
    """
    # {node: {row: reason}} by the nodes' own filters, and {row: reason} by the central ones.
    refused, refused_centrally = find_refused_rows(network, outputs)
    if refused_centrally:
        # Try without one node's values at a time, from the central filters' states before the row. Nodes that can be
        # blamed have no filter of their own, so that no entry of `refused` is replaced.
        central_states = find_central_states_before_rows(task, z_by_group)
        z_in_order = {name: z[name] for name in network.names}
        nodes_to_blame = JudgementReader(network).nodes_without_judge
        refused |= blame_nodes_for_implausible_rows(
            task.filters.central, central_states, z_in_order, task.u, refused_centrally, nodes_to_blame
        )
    # Leave out rows that were refused before.
    new_rows = {
        name: {k: reason for k, reason in rows.items() if k not in before.get(name, ())}
        for name, rows in refused.items()
    }
    return {name: rows for name, rows in new_rows.items() if rows}
