"""Forecasts of live plants start from a row: its filters' states, the inputs held there, and its estimates."""

from operator import attrgetter

import numpy as np

from heliograph.live.fleet import Fleet
from heliograph.live.lanes import Lanes
from heliograph.model.estimate import Estimate, lower_unsound_claim
from heliograph.model.origin import Origin
from heliograph.simulation.results.by_name import split_by_name


def row_origin(fleet: Fleet, slot: int, time: float) -> Origin:
    """Return where forecasts from the row in a slot start; the pool stays as it is.

    Args:
        fleet: the plants, whose pool has the row.
        slot: of the row.
        time: of the row, in steps or in the unit of dt.
    """
    pool, lanes = fleet.pool, fleet.lanes
    row = pool.table[slot].copy()
    inputs = row[pool.held] if lanes.dt is None else np.insert(row[pool.held], lanes.dt, np.nan)
    spacing = float("nan") if lanes.dt is not None else 1.0
    state, estimates = lanes.step_rows.state.tree(row[pool.state]), estimates_by_name(lanes, row[pool.outputs])
    return Origin(lanes.network, state, int(row[pool.at.start]) + 1, inputs, time, spacing, estimates)


def estimates_by_name(lanes: Lanes, outputs: np.ndarray) -> dict[str, dict[str, Estimate]]:
    """Arrange the outputs of a row, or of rows, by node and filter."""
    estimates = lanes.step_rows.outputs.tree(outputs)
    mean = split_by_name(lanes.network, estimates, attrgetter("mean"), -3)
    covariance = split_by_name(lanes.network, estimates, attrgetter("covariance"), -4)
    return {
        node: {
            name: lower_unsound_claim(Estimate(mean[node][name], covariance[node][name], claim))
            for name, claim in claims.items()
        }
        for node, claims in lanes.claims.items()
    }
