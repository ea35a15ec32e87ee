"""Conversion of a record to labelled arrays, and back without loss."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, cast

import numpy as np

from heliograph.model.estimate import Claim, Estimate
from heliograph.simulation.results.labelled import (
    TIME,
    check_title,
    claims_of,
    claims_text,
    dataset_of,
    filled,
    names_of,
    units_of,
    uplink_variables,
    uplinks_from,
    values_of,
)

if TYPE_CHECKING:  # an extra
    import xarray as xr

    from heliograph.simulation.results.record import Record

RECORD = "heliograph record"  # the title of a dataset that holds one


def record_dataset(record: "Record") -> "xr.Dataset":
    """Dataset of a record with dimensions run (of Monte Carlo runs), time, node, filter, state and other.

    `other` is a state too. A filter that a node does not have is NaN, and its `claim` is empty.
    """
    nodes = list(dict.fromkeys([*record.measurements, *record.estimates]))
    filters = list(dict.fromkeys(name for estimate in record.estimates.values() for name in estimate))
    lead, axes = _lead(record), [] if record.runs is None else ["run"]
    n, sizes = len(record.states), (len(nodes), len(filters))
    # Estimates and measurements with their places.
    results = [
        ((nodes.index(node), filters.index(name)), estimate)
        for node, estimate_ in record.estimates.items()
        for name, estimate in estimate_.items()
    ]
    received = [((nodes.index(node),), z) for node, z in record.measurements.items()]
    most = max((z.shape[-1] for _, z in received), default=0)
    # Variables, NaN where a node has no such filter or component.
    variables = {
        "measurement": ([*axes, TIME, "node", "received"], filled(lead, (len(nodes),), (most,), received)),
        "length": (["node"], _per_node(nodes, {node: z.shape[-1] for node, z in record.measurements.items()})),
        "estimated": (["node"], np.array([node in record.estimates for node in nodes], dtype=bool)),
        "claim": (["node", "filter"], claims_of(sizes, results)),
        "mean": (
            [*axes, TIME, "node", "filter", "state"],
            filled(lead, sizes, (n,), [(place, np.asarray(e.mean)) for place, e in results]),
        ),
        "covariance": (
            [*axes, TIME, "node", "filter", "state", "other"],
            filled(lead, sizes, (n, n), [(place, np.asarray(e.covariance)) for place, e in results]),
        ),
        **uplink_variables(record.uplinks, [*axes, TIME], n),
    }
    if record.truth is not None:
        variables["truth"] = ([*axes, TIME, "state"], record.truth)
    labels = {"node": nodes, "filter": filters, "state": record.states, "other": record.states}
    return dataset_of(RECORD, variables, labels, record.time, record.units, claims_text(record))


def record_from(dataset: "xr.Dataset") -> "Record":
    """Record from a dataset that `record_dataset` made.

    Raises:
        ValueError: no such dataset.
    """
    from heliograph.simulation.results.record import Record

    check_title(dataset, RECORD)
    lead = ["run", TIME] if "run" in dataset.dims else [TIME]
    nodes, filters = names_of(dataset, "node"), names_of(dataset, "filter")
    # Variables with their axes in order.
    measurement = values_of(dataset, "measurement", [*lead, "node", "received"])
    mean = values_of(dataset, "mean", [*lead, "node", "filter", "state"])
    covariance = values_of(dataset, "covariance", [*lead, "node", "filter", "state", "other"])
    claim = values_of(dataset, "claim", ["node", "filter"])
    length, estimated = values_of(dataset, "length", ["node"]), values_of(dataset, "estimated", ["node"])
    # Back to nodes and filters by name.
    estimates: dict[str, dict[str, Estimate]] = {node: {} for node, item in zip(nodes, estimated, strict=True) if item}
    for i, j in zip(*np.nonzero(claim != ""), strict=True):
        value = Estimate(mean[..., i, j, :].copy(), covariance[..., i, j, :, :].copy(), cast(Claim, str(claim[i, j])))
        estimates[nodes[i]][filters[j]] = value
    return Record(
        time=np.asarray(dataset[TIME].values),
        states=tuple(names_of(dataset, "state")),
        truth=values_of(dataset, "truth", [*lead, "state"]) if "truth" in dataset else None,
        measurements={
            node: measurement[..., i, : length[i]].copy() for i, node in enumerate(nodes) if length[i] >= 0
        },
        estimates=estimates,
        uplinks=uplinks_from(dataset, lead),
        units=units_of(dataset),
    )  # fmt: skip


def _lead(record: "Record") -> tuple[int, ...]:
    return (len(record.time),) if record.runs is None else (record.runs, len(record.time))


def _per_node(nodes: Sequence[str], values: Mapping[str, int]) -> np.ndarray:
    return np.array([values.get(node, -1) for node in nodes], dtype=np.int64)
