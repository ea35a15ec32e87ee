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
        record: estimates by node and filter, and the truth and measurements if they were simulated.
        complete: names of simulated nodes at which nothing is ever lost, so that a NaN is the sensor's.
        stacklevel: which caller a warning names, as for `warnings.warn`, counted from the caller of this function.
    """
    # What was simulated; then each filter's means, and covariances where it states some (claim other than "none").
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
