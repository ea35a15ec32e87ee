"""All numbers of the report of a run, as they stand in its summary.json."""

import numpy as np

from heliograph.numerics.check import instance
from heliograph.report.diagnosis.arrivals import Arrivals
from heliograph.report.diagnosis.health import FilterHealth, Health
from heliograph.report.diagnosis.sensor_output_health import compute_filter_errors, summarise_output
from heliograph.report.results_folder import Json
from heliograph.simulation.results.record import Record


def run_summary(health: Health) -> dict[str, Json]:
    """Return all numbers of the report of a run by name, as summary.json holds them.

    Numbers of filters and outputs are by node and filter, those of links by node and received component. A link's
    numbers are of its losses. Overloads are the probabilities that a signal is beyond the range of its codewords.

    Args:
        health: what `examine` returned: tests of a run's filters, outputs and links, with their verdicts.

    Raises:
        ValueError: `health` is not what `examine` returns.
    """
    instance("health", health, Health, "what examine returns")
    filters: dict[str, dict[str, Json]] = {}
    for tested in health.filters:
        filters.setdefault(tested.node, {})[tested.filter] = _list_filter_numbers(tested)
    outputs: dict[str, dict[str, dict[str, Json]]] = {}
    for output in health.outputs:
        by_output = outputs.setdefault(output.node, {}).setdefault(output.filter, {})
        by_output[output.judged.output] = summarise_output(output)
    links: dict[str, dict[str, Json]] = {}
    for link in health.links:
        links.setdefault(link.node, {})[link.component] = _list_link_numbers(link)
    overloads: dict[str, dict[str, Json]] = {
        node: {name: _list_overload_numbers(*overload) for name, overload in by_filter.items()}
        for node, by_filter in health.record.overloads.items()
    }
    return {
        "rows": len(health.record.time),
        "warnings": health.warnings(),
        "remarks": health.remarks(),
        "filters": filters,
        "outputs": outputs,
        "errors": _list_error_numbers(health.record),
        "links": links,
        "refused": _list_refused(health),
        "overloads": overloads,
        "shared": {name: list(nodes) for name, nodes in health.shared.items()},
    }


def _list_refused(health: Health) -> list[Json]:
    """Return what arrived and was refused, with reasons and counts: values by component, then messages by node.

    `health`: the diagnosis of a run.
    """
    readings: list[Json] = [dict(vars(refusal)) for refusal in health.record.refusals]
    return readings + [
        {"node": node, "reason": reason, "count": count}
        for node, counts in health.refused_messages.items()
        for reason, count in counts.items()
    ]


def _list_filter_numbers(tested: FilterHealth) -> dict[str, Json]:
    """Return the numbers on one filter by name: its claim, and tests of its innovations.

    size: mean of innovation^2 / variance, 1 if the covariance holds. correlation: of successive innovations. declared:
    tests of noise variances that are reported with messages, one for each class of messages. `test` is None with too
    few rows or without a claim; `power` is the size, and the correlation is by lag, lag 1 first. `tested`: the filter
    with the tests of its innovations.
    """
    numbers: dict[str, Json] = {"claim": tested.claim}
    if tested.test is not None:
        numbers |= {
            "size": tested.test.power,
            "size_error": tested.test.power_error,
            "correlation": float(tested.test.correlation[0]),
            "p_value": tested.test.p_value,
        }
    if tested.declared:
        numbers["declared"] = [
            dict(of_class._asdict()) for judgement in tested.declared for of_class in judgement.classes
        ]
    return numbers


def _list_error_numbers(record: Record) -> dict[str, dict[str, Json]]:
    """Return {node: {filter: its RMSE by state, and its NEES}}, or {} if the truth is not known.

    `record`: the estimates of a run, with true states if they are known.
    """
    errors: dict[str, dict[str, Json]] = {}
    for of_filter in compute_filter_errors(record):
        nees = None if np.isnan(of_filter.nees) else of_filter.nees
        rmse: dict[str, Json] = {state: None if np.isnan(error) else error for state, error in of_filter.rmse.items()}
        errors.setdefault(of_filter.node, {})[of_filter.filter] = {"rmse": rmse, "nees": nees}
    return errors


def _list_overload_numbers(probability: np.ndarray, bound: np.ndarray) -> dict[str, Json]:
    """Return by name how probably each component's words overload, and the bound on the claim (None if infinite)."""
    return {"probability": probability.tolist(), "bound": float(bound) if np.isfinite(bound) else None}


def _list_link_numbers(link: Arrivals) -> dict[str, Json]:
    """Return numbers on a component's messages: the share that arrived, the longest gap, and when they are due.

    `period` and `due` are there only if the sender is slower than the rows, or is due in a pattern of rows. `link`: a
    received number of a node, with its times, and when it was due (`due` None if unknown).
    """
    numbers: dict[str, Json] = {"arrived": None if link.due is None else link.share, "longest_gap": link.longest_gap}
    if link.period is not None:
        numbers["period"] = link.period
    if link.pattern is not None:
        numbers["due"] = link.due_in
    return numbers
