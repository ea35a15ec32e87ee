"""Warnings of estimates, and of what was simulated, that are no finite numbers."""

import warnings
from collections.abc import Iterable

import numpy as np

from heliograph.numerics.linalg import find_not_finite
from heliograph.simulation.network import FUSED
from heliograph.simulation.results.record import Record, describe_bad_steps


def warn_of_non_finite_numbers(record: Record, complete: Iterable[str] = (), stacklevel: int = 3) -> None:
    """Warn of estimates, and of what was simulated, that are no finite numbers from some step on, a line each.

    Covariances are not judged here, which of many runs takes long; `Record.failures` does.

    Args:
        record: the record.
        complete: names of simulated nodes at which nothing is ever lost, so that a NaN is the sensor's.
        stacklevel: as of `warnings.warn`, of the caller.
    """
    simulated = {} if record.truth is None else {"the true state, which the plant makes": record.truth}
    for name in complete:
        simulated[f"measurements of node {name!r}, where nothing is lost"] = record.measurements[name]
    for what, values in simulated.items():
        for when in describe_bad_steps(~np.isfinite(values).all(axis=-1)):
            warnings.warn(f"{what}: no finite number {when}", stacklevel=stacklevel + 1)
    for node, filters in record.estimates.items():
        for name, estimate in filters.items():
            bad = find_not_finite(np.asarray(estimate.mean), 1)
            # The covariance of a fused estimate may be NaN for good reason: a quantizer that saturates has no bound.
            if estimate.claim != "none" and node != FUSED:
                bad |= find_not_finite(np.asarray(estimate.covariance), 2)
            what = "mean" if estimate.claim == "none" else "covariance"
            for when in describe_bad_steps(bad):
                warnings.warn(f"{node}/{name}: no valid {what} {when}", stacklevel=stacklevel + 1)
