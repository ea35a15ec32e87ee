"""Errors of filters over a recording whose true state is known."""

from typing import NamedTuple

import numpy as np

from heliograph.model.estimate import weakest
from heliograph.simulation.results.record import Record


class Errors(NamedTuple):
    """Errors of one filter: RMSE by state (NaN where its truth is not known), and NEES per state, 1 for a true claim.

    `claim` is what holds in all rows; `nees` is NaN where nothing is claimed.
    """

    node: str
    filter: str
    claim: str
    rmse: dict[str, float]
    nees: float


def errors_of(record: Record) -> list[Errors]:
    """Compare each filter with the truth; nothing without one."""
    if record.truth is None:
        return []
    known = np.sum(~np.isnan(np.asarray(record.truth)), axis=-1)
    results = []
    for node, estimates in record.estimates.items():
        for name, estimate in estimates.items():
            values = record.nees(node, name)
            judged = ~np.isnan(values)
            size = float(values[judged].sum() / known[judged].sum()) if judged.any() else np.nan
            claim = weakest(np.unique(estimate.claims).tolist())
            results.append(Errors(node, name, claim, record.rmse(node, name), size))
    return results
