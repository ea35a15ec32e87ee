"""Forecasts of live plants start from a row: its filters' states, the inputs held there, and its estimates."""

import numpy as np

from heliograph.live.fleet import Fleet
from heliograph.live.network_program import NetworkProgram
from heliograph.model.estimate import Estimate, lower_unsound_claim
from heliograph.model.origin import Origin
from heliograph.model.over_time import first


def make_row_origin(fleet: Fleet, slot: int, time: float) -> Origin:
    """Return where forecasts from the row in a slot start; the pool stays as it is.

    Args:
        fleet: the plants, whose pool has the row.
        slot: of the row.
        time: of the row, in steps or in the unit of dt.
    """
    pool, program = fleet.pool, fleet.program
    row = pool.table[slot].copy()
    inputs = row[pool.held] if program.dt is None else np.insert(row[pool.held], program.dt, np.nan)
    spacing = float("nan") if program.dt is not None else 1.0
    state, estimates = program.step_rows.state.tree(row[pool.state]), estimates_by_name(program, row[pool.outputs])
    return Origin(program.network, state, int(row[pool.at.start]) + 1, inputs, time, spacing, estimates)


def estimates_by_name(program: NetworkProgram, outputs: np.ndarray) -> dict[str, dict[str, Estimate]]:
    """Arrange the outputs of a row, or of rows, by node and filter."""
    n, attitude = len(program.network.states), first(program.network.plant).manifold.rotations
    estimates: dict[str, dict[str, Estimate]] = {node: {} for node in program.claims}
    for place in program.places:
        mean = outputs[..., place.mean : place.mean + n]
        covariance = outputs[..., place.covariance : place.covariance + n * n].reshape(*outputs.shape[:-1], n, n)
        modes = place.probabilities(outputs)
        estimate = Estimate(mean, covariance, place.claim, modes, attitude=attitude)
        estimates[place.node][place.filter] = lower_unsound_claim(estimate)
    return estimates
