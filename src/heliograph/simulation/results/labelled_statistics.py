"""Conversion of statistics to labelled arrays, and back: figures for people, and the sums that they come from."""

from typing import TYPE_CHECKING, cast

import numpy as np

from heliograph.model.estimate import Claim
from heliograph.numerics.check import fail
from heliograph.simulation.network import FUSED
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
from heliograph.simulation.results.statistics import ErrorStatistics, matrices

if TYPE_CHECKING:  # an extra
    import xarray as xr

    from heliograph.simulation.results.statistics_by_name import StatisticsByName

STATISTICS = "heliograph statistics"  # the title of a dataset that holds them


def statistics_dataset(result: "StatisticsByName") -> "xr.Dataset":
    """Dataset of statistics with dimensions time, node, filter, state and other, and the sums by batch."""
    # Statistics with their places.
    nodes = list(result)
    filters = list(dict.fromkeys(name for item in result.values() for name in item))
    every = [
        ((nodes.index(node), filters.index(name)), single)
        for node, item in result.items()
        for name, single in item.items()
    ]
    if not every:
        raise fail("statistics", "those of one filter at least", "none")
    sizes, n, first = (len(nodes), len(filters)), len(result.states), every[0][1]
    batch, steps = (len(first.count), first.nees.shape[1]), first.nees.shape[1]

    def of(name: str) -> np.ndarray:
        """Return sums of pairs i <= j as symmetric matrices."""
        return filled(batch, sizes, (n, n), [(place, matrices(getattr(item, name))) for place, item in every])

    # Figures over time: squared errors, claimed variances, NEES, failures.
    squares = [(place, np.diagonal(item.actual(), axis1=-2, axis2=-1)) for place, item in every]
    claimed = [(place, np.diagonal(item.claimed(), axis1=-2, axis2=-1)) for place, item in every]
    distances = [(place, item.nees.sum(axis=0) / item.runs / n) for place, item in every]
    by_step = [(place, np.full(steps, np.nan) if item.failed is None else item.failed) for place, item in every]
    failed = [(place, np.array(item.failed_runs)) for place, item in every]
    filters_of = ["node", "filter"]
    uplinks = {name: item.uplink for name, item in result.get(FUSED, {}).items() if item.uplink}
    # Sums by batch, from which the statistics can be restored, then figures.
    variables = {
        "runs": (["batch"], first.count),
        "errors": (["batch", TIME, *filters_of, "state", "other"], of("pairs")),
        "claimed": (["batch", TIME, *filters_of, "state", "other"], of("claimed_pairs")),
        "nees": (["batch", TIME, *filters_of], filled(batch, sizes, (), [(place, item.nees) for place, item in every])),
        "claim": (filters_of, claims_of(sizes, every)),
        "failed": ([TIME, *filters_of], filled((steps,), sizes, (), by_step)),
        "failed_runs": (filters_of, filled((), sizes, (), failed)),
        "rmse": ([TIME, *filters_of, "state"], np.sqrt(filled((steps,), sizes, (n,), squares))),
        "deviation": ([TIME, *filters_of, "state"], _root(filled((steps,), sizes, (n,), claimed))),
        "nees_per_dimension": ([TIME, *filters_of], filled((steps,), sizes, (), distances)),
        **uplink_variables(uplinks, [TIME], n),
    }  # fmt: skip
    labels = {"node": nodes, "filter": filters, "state": result.states, "other": result.states}
    time = np.arange(1.0, steps + 1)
    return dataset_of(STATISTICS, variables, labels, time, result.units, claims_text(result))


def statistics_from(dataset: "xr.Dataset") -> "StatisticsByName":
    """Statistics from a dataset that `statistics_dataset` made.

    Raises:
        ValueError: no such dataset.
    """
    from heliograph.simulation.results.statistics_by_name import StatisticsByName

    check_title(dataset, STATISTICS)
    nodes, filters, states = (names_of(dataset, axis) for axis in ("node", "filter", "state"))
    batch, of = ["batch", TIME, "node", "filter"], ["node", "filter"]
    # Sums by batch; of symmetric matrices the pairs i <= j.
    upper = np.triu_indices(len(states))
    errors, claimed = (
        values_of(dataset, name, [*batch, "state", "other"])[..., *upper] for name in ("errors", "claimed")
    )
    nees, claim, failed = (
        values_of(dataset, name, axes) for name, axes in (("nees", batch), ("claim", of), ("failed", [TIME, *of]))
    )
    failed_runs, count = values_of(dataset, "failed_runs", of), values_of(dataset, "runs", ["batch"])
    uplinks = uplinks_from(dataset, [TIME])
    # Back to nodes and filters by name.
    results: dict[str, dict[str, ErrorStatistics]] = {node: {} for node in nodes}
    for i, j in zip(*np.nonzero(claim != ""), strict=True):
        by_step = None if np.isnan(failed[:, i, j]).any() else failed[:, i, j].copy()
        results[nodes[i]][filters[j]] = ErrorStatistics(
            count=count.copy(),
            pairs=errors[:, :, i, j].copy(),
            claimed_pairs=claimed[:, :, i, j].copy(),
            nees=nees[:, :, i, j].copy(),
            claim=cast(Claim, str(claim[i, j])),
            uplink=uplinks.get(filters[j]) if nodes[i] == FUSED else None,
            failed=by_step,
            failed_runs=int(failed_runs[i, j]),
        )
    return StatisticsByName(results, tuple(states), units_of(dataset))


def _root(variance: np.ndarray) -> np.ndarray:
    return np.sqrt(np.where(variance >= 0, variance, np.nan))
