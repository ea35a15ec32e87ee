"""Diagnosis of a network from a recording: reliability of its links, and tests of its filters' claims.

A filter claims what its covariance is: exact, an upper bound, nominal (without a guarantee), or nothing ("none"). Its
innovations are white in units of that claim where it is right: of variance 1, and independent over time. An output is
held, or stuck, if it repeats one value for longer than its noise allows.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from heliograph.model.plant import TIME_STEP
from heliograph.model.readings.timeouts import find_long_silences
from heliograph.numerics.check import array, fail, instance
from heliograph.numerics.types import ArrayLike
from heliograph.report.diagnosis.arrivals import list_arrivals
from heliograph.report.diagnosis.constant_sensor_error import ConstantError, find_constant_error
from heliograph.report.diagnosis.disagreeing_nodes import find_constant_error_between_nodes
from heliograph.report.diagnosis.expected_squared_innovations import compute_expected_squares, scale_size_to_expected
from heliograph.report.diagnosis.health import FALSE, FilterHealth, Health
from heliograph.report.diagnosis.innovation_tests import (
    find_memory,
    subtract_mean,
)
from heliograph.report.diagnosis.sensor_output_health import (
    FilterWithMeasurements,
    judge_outputs_of_filter,
    weighs,
    yield_filters_with_measurements,
)
from heliograph.report.diagnosis.wrong_time_unit import describe_wrong_time_unit
from heliograph.simulation.declared_noise.judgement import judge_declared_links
from heliograph.simulation.description.doubtful_estimates import doubt_estimates
from heliograph.simulation.network import Network
from heliograph.simulation.results.record import Record
from heliograph.simulation.results.whiteness import score_innovations

MOST = 0.5  # share of what is too large, from which one constant error explains it


def examine(
    network: Network,
    record: Record,
    inputs: ArrayLike | None = None,
    advance: Callable[[str], object] = lambda what: None,
) -> Health:
    """Diagnose links and filters of a recording that was run through the network.

    Args:
        network: the network.
        record: what `run` of this network returned.
        inputs: inputs of the plant, as they were given to `run`. Shape (steps, inputs); None for a plant without.
        advance: called with a few words before each filter is tested; nothing is called by default.

    Returns:
        The diagnosis; its `warnings()` are one line for each reason to doubt the network.

    Raises:
        ValueError: no network, no record of one recording run through it, inputs of another shape.
    """
    _check_record(network, record)
    shape = len(record.time), len(network.inputs)
    # Inputs (time, inputs), without columns for a plant without inputs.
    u: np.ndarray = array("inputs", np.zeros((shape[0], 0)) if inputs is None else inputs, shape)
    filters, outputs = [], []
    # Filters: innovations e in units of their claimed covariance S, S^(-1/2) e, their correlations over time, and the
    # health of each sensor output.
    for listener in yield_filters_with_measurements(network, record):
        advance(f"testing {listener.node}/{listener.name}")
        filters.append(_examine_filter(network, listener, record, u))
        if filters[-1].white is not None:
            outputs += judge_outputs_of_filter(network, listener, record, u)
    # Links, and what the network itself says of filters and estimates.
    beliefs = tuple(belief.words for belief in network.beliefs())
    timeouts = {node: network.nodes[node].timeout for node in network.names}
    silences = find_long_silences(timeouts, record.measurements, u, network.inputs)
    health = Health(
        record=record,
        links=list_arrivals(network, record.time, record.measurements),
        filters=filters,
        outputs=outputs,
        shared=network.shared,
        beliefs=beliefs,
        doubtful_estimates=doubt_estimates(network, record),
        silences=silences,
    )
    return _explain_doubts(network, health, u)


def _explain_doubts(network: Network, health: Health, inputs: np.ndarray) -> Health:
    """Return the diagnosis with what may explain doubts: a constant error of an output or node, another unit of time.

    A stuck output makes nodes disagree, too; then no constant error between nodes is looked for. `list_doubted_filters`
    are the trusted ones whose claims the recording contradicts; keys of the errors are (node, filter). FALSE:
    probability with which a right network may be doubted.
    """
    errors = {
        (filter.node, filter.filter): _find_constant_error(network, health, filter, inputs)
        for filter in health.list_doubted_filters()
    }
    is_stuck = bool(health.describe_stuck_outputs())
    between = None if is_stuck else find_constant_error_between_nodes(network, health.record, inputs, FALSE)
    known = {name: error for name, error in errors.items() if error is not None}
    health = replace(health, constant_errors=known, error_between_nodes=between)
    return replace(health, time_unit=_doubt_time_unit(network, health, inputs))


def _examine_filter(
    network: Network, listener: FilterWithMeasurements, record: Record, inputs: np.ndarray
) -> FilterHealth:
    """Return one filter's innovations scaled to covariance I by its claim (`white`), and what tests say of them.

    `white` (time, m): innovations L^-1 (z - E z), with L L' the claimed covariance. If the claim (what the covariance
    is said to be) holds they have variance 1 and no correlation over time, which `test` examines. Both are None for a
    filter that claims no covariance, or receives nothing. `expected`: mean square of `white` that the model expects in
    this recording, which random gains may move from 1. `declared`: tests of noise variances reported with messages.
    `listener`: the filter, its names, and the measurements that it received. `record`: the run. `inputs` (time,
    inputs).
    """
    node = listener.node
    name = listener.name
    filter = listener.filter
    z = listener.measurements
    # Without a claim there is nothing to test; 1 is the mean square that a true claim gives.
    white, test, expected = None, None, np.ones(1)
    if filter.claim != "none" and filter.received:
        # Whiten the innovations, test their correlation over time (of a filter that weighs outliers down, about their
        # mean), and compare their size with the expected one.
        # `scores` are the innovations L^-1 (z - E z); the log densities before them are not needed.
        _, scores = score_innovations(filter, z, inputs)
        white = np.asarray(scores)
        test = find_memory(subtract_mean(white) if weighs(filter) else white)
        expected = compute_expected_squares(filter, z, inputs)
        test = None if test is None else scale_size_to_expected(test, white, expected)
    # Whether the filter lost its claim in some row: then it has none for the recording.
    lost_claim = np.any(record.estimates[node][name].claims == "none")
    return FilterHealth(
        node=node,
        filter=name,
        claim="none" if lost_claim else filter.claim,
        white=white,
        test=test,
        trusted=listener.trusted,
        declared=() if test is None else judge_declared_links(filter, z, inputs),
        unit=_name_time_unit(record) if TIME_STEP in network.inputs else "steps",
        expected=float(np.nanmean(expected)),
    )


def _doubt_time_unit(network: Network, health: Health, inputs: np.ndarray) -> str:
    """Return the sentence that times seem to be in another unit, judged by the first doubted filter, or "".

    Filters with enough rows for a test count. `_find_judged_filter` returns the filter itself, its name and node, and
    the measurements that it received.
    """
    tested = [judged for judged in health.list_doubted_filters() if judged.test is not None]
    if not tested:
        return ""
    first = _find_judged_filter(network, health.record, tested[0])
    name = f"{first.node}/{first.name}"
    return describe_wrong_time_unit(name, first.filter, first.measurements, inputs, network.inputs)


def _find_judged_filter(network: Network, record: Record, judged: FilterHealth) -> FilterWithMeasurements:
    """Return the filter whose innovations were judged, with its measurements."""
    listeners = yield_filters_with_measurements(network, record)
    return next(one for one in listeners if (one.node, one.name) == (judged.node, judged.filter))


def _find_constant_error(
    network: Network, health: Health, judged: FilterHealth, inputs: np.ndarray
) -> ConstantError | None:
    """Return the constant error of an output that explains all or MOST of a filter's doubts, or None.

    `explained` is the share of the excess of squared innovations that the error explains; `nothing_else` says that the
    innovations without its effect are as claimed. None too without a test of the filter's innovations. `judged`: the
    filter whose innovations are doubted; `health`: the diagnosis so far.
    """
    if judged.test is None:
        return None
    tested = _find_judged_filter(network, health.record, judged)
    error = find_constant_error(tested.outputs, tested.filter, tested.measurements, inputs)
    if error is None:
        return None
    error = error._replace(nothing_else=health.explains_all_innovations(judged, error))
    return error if error.nothing_else or error.explained > MOST else None


def _name_time_unit(record: Record) -> str:
    """Return the name of the unit of a record's times: that of the column, "s" for dates, else a general phrase."""
    return record.units.get("time", "s" if record.time.dtype.kind == "M" else "of the unit of time")


def _check_record(network: Network, record: Record) -> None:
    """Raise ValueError if a record lacks filters of the network, or is of several runs."""
    instance("network", network, Network, "a Network")
    instance("record", record, Record, "a Record")
    filters = {node: set(network.nodes[node].filters) for node in network.names}
    if any(not names <= set(record.estimates.get(node, ())) for node, names in filters.items()):
        raise fail("record", "the run of this network", f"one of the nodes {', '.join(record.estimates)}")
    for estimates_of_node in record.estimates.values():
        for estimate in estimates_of_node.values():
            if estimate.mean.ndim != 2:  # means of one run have shape (rows, n)
                raise fail("record", "the run over one recording", f"estimates of shape {estimate.mean.shape}")
