"""A row of a live plant as the start of forecasts: its filters' states, the inputs held there, its estimates."""

import numpy as np

from heliograph.filters.plausibility import Judgement
from heliograph.live.fleet import Fleet
from heliograph.live.network_step_program import NetworkProgram
from heliograph.model.estimate import Estimate, JudgedEstimate, lower_unsound_claim
from heliograph.model.forecast_origin import Origin
from heliograph.model.over_time import first


def make_forecast_origin(fleet: Fleet, slot: int | list[int], time: float | np.ndarray) -> Origin:
    """Return where forecasts from a row start, or from several rows: their states, steps, inputs and estimates.

    A row holds the state of a plant's filters after a measurement. A slot is the row's index in the fleet's table,
    which holds the rows of all live plants and is not changed here.

    Args:
        fleet: the live plants, with the table of their rows.
        slot: slot of the row, or of each row.
        time: time of the row, or of each row (rows,), in steps or in the unit of dt.
    """
    state_table, program = fleet.state_table, fleet.program
    # Numbers of the row (..., columns); `state_table` knows which columns are inputs, state, outputs and step number.
    row = state_table.table[slot].copy()
    latest_inputs, several = row[..., state_table.held_inputs], row.ndim > 1
    # In continuous time the time step dt is one of the inputs, number `program.dt`; it is not known ahead, so NaN.
    inputs = latest_inputs if program.dt is None else np.insert(latest_inputs, program.dt, np.nan, axis=-1)
    spacing = float("nan") if program.dt is not None else 1.0
    # A forecast starts with the step after the row's.
    step = row[..., state_table.step_number.start].astype(int) + 1
    return Origin(
        model=program.network,
        state=program.step_rows.state.tree(row[..., state_table.state]),
        step=step if several else int(step),
        inputs=inputs,
        time=time,
        spacing=spacing,
        estimates=estimates_by_name(program, row[..., state_table.outputs]),
        several=several,
    )


def estimates_by_name(program: NetworkProgram, outputs: np.ndarray) -> dict[str, dict[str, Estimate]]:
    """Return the estimates by node and filter from the outputs (..., outputs) of one or several rows.

    `filter_columns` says for each filter where its mean, covariance and modes' probabilities stand among the outputs. A
    filter whose covariance is not sound gets a weaker claim.
    """
    n, attitude = len(program.network.states), first(program.network.plant).manifold.rotations
    estimates: dict[str, dict[str, Estimate]] = {node: {} for node in program.claims}
    for columns in program.filter_columns:
        mean = outputs[..., columns.mean : columns.mean + n]
        covariance_numbers = outputs[..., columns.covariance : columns.covariance + n * n]
        covariance = covariance_numbers.reshape(*outputs.shape[:-1], n, n)
        modes = columns.probabilities(outputs)
        estimate = Estimate(mean, covariance, columns.claim, modes, attitude=attitude)
        estimates[columns.node][columns.filter] = lower_unsound_claim(estimate)
    return estimates


def judged_estimates_by_name(program: NetworkProgram, outputs: np.ndarray) -> dict[str, dict[str, Estimate]]:
    """Return the estimates of a row by node and filter, each with what its filter made of what arrived there.

    `outputs`: those of the row, (outputs,). A fusion that tests nothing itself has an estimate alone.
    """
    estimates = estimates_by_name(program, outputs)
    for columns in program.filter_columns:
        # Columns of the squared distance (NIS) and of how many numbers arrived: a filter's judgement, a fusion's test.
        tested = columns.judgement or columns.tested
        if tested is None:  # it judges nothing: its estimate stands as it is
            continue
        estimate, nis = estimates[columns.node][columns.filter], float(outputs[tested.distance])
        # Above 0 if the filter did not use what arrived.
        reason = 0.0 if columns.judgement is None else float(outputs[columns.judgement.reason])
        estimates[columns.node][columns.filter] = JudgedEstimate(
            mean=estimate.mean,
            covariance=estimate.covariance,
            claim=estimate.claim,
            modes=estimate.modes,
            attitude=estimate.attitude,
            nis=nis,
            received=int(outputs[tested.arrived]),
            refused=Judgement.describe(reason, nis) if reason > 0 else "",
            weight=None if columns.weighed is None else outputs[list(columns.weighed.weight)],
        )
    return estimates
