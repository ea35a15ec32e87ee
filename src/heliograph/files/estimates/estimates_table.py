"""Estimates in files: a table of means, deviations and covariances, a row for each of the recording."""

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from heliograph.files.tables.table import TIME, write_table
from heliograph.model.estimate import Estimate, mask_sound_estimates
from heliograph.model.over_time import first
from heliograph.numerics.angles.angle import Angles, wrap_angles
from heliograph.numerics.angles.rotation_vectors import quaternion_of
from heliograph.numerics.check import fail, instance, show_value
from heliograph.numerics.types import units_in
from heliograph.simulation.network import Network
from heliograph.simulation.results.record import Record

if TYPE_CHECKING:
    import heliograph

Predicted = Mapping[str, "Mapping[str, heliograph.forecasting.Forecast]"]  # by node and filter


def estimate_columns(record: Record, predicted: Predicted | None = None) -> dict[str, np.ndarray]:
    """Return {header: column (rows,)} of all estimates of a recording: filtered, smoothed and predicted states.

    `predicted`: by node and filter the prediction of each row from the rows before it; None for no such columns. Angles
    are written between -pi and pi, although the record may have others (nearest to a known truth).
    """
    columns, angles = [(TIME, record.time)], _find_angles(record)
    # Node and filter are part of a name where there are several of them.
    has_several_nodes = len(record.estimates) > 1
    has_several_filters = any(len(filters) > 1 for filters in record.estimates.values())
    for node, filters in record.estimates.items():
        for name, estimate in filters.items():
            prefix = (f"{node}." if has_several_nodes else "") + (f"{name}." if has_several_filters else "")
            # Filtered, smoothed and predicted states of one filter. Smoothed ones (an Estimate by node and filter, as
            # the filtered ones) may cover only the last rows; the rows before them are filled up.
            parts = _make_columns(record.states, record.units, estimate, angles)
            columns += [(prefix + key, values) for key, values in parts]
            smoothed = {} if record.smoothed is None else record.smoothed.estimates.get(node, {})
            if name in smoothed:
                parts = _make_columns(record.states, record.units, smoothed[name], angles)
                columns += [
                    (f"{prefix}smoothed.{key}", _pad_rows_before(values, len(record.time))) for key, values in parts
                ]
            if predicted is not None and name in predicted.get(node, {}):
                parts = _make_predicted_columns(predicted[node][name], record)
                columns += [(f"{prefix}predicted.{key}", values) for key, values in parts]
    # Names of nodes and states may combine to the same text.
    twice = [name for name, count in Counter(name for name, _ in columns).items() if count > 1]
    if twice:
        raise fail("columns of the estimates", "distinct names", f"{twice[0]!r} more than once")
    return dict(columns)


def write_estimates(record: Record, path: str | Path, predicted: Predicted | None = None) -> None:
    """Write `estimate_columns` to a CSV or Parquet file, as a whole or not at all.

    In CSV the column `valid` is 1 or 0.

    Args:
        record: the result of `run`.
        path: the file, ending in .csv or .parquet.
        predicted: what `hg.forecasting.predict_record` returned for the record: predictions of each row from the rows
            before it. They become columns predicted.STATE and predicted.output.OUTPUT with deviations (.sd). None by
            default.

    Raises:
        ValueError: the format is another one, the folder cannot be written, or the predictions are of other rows.
        ModuleNotFoundError: Parquet without pyarrow (extra "tables").
    """
    instance("record", record, Record, "a Record")
    if predicted is not None and not (
        isinstance(predicted, Mapping) and all(isinstance(filters, Mapping) for filters in predicted.values())
    ):
        raise fail("predicted", "what predict_record returns, by node and filter", show_value(predicted))
    write_table(estimate_columns(record, predicted), path)


def make_column_header(name: str, unit: str | None) -> str:
    """Return the header of a column, "NAME (UNIT)", or the name alone if there is no unit."""
    return f"{name} ({unit})" if unit else str(name)


def _find_angles(record: Record) -> Angles:
    """Return the indices of the states that are angles, by the plant of the network that was run; () if it is unknown.

    `record.origin` of what `run` returns holds the network as `model`; of a record that was read from a file it is
    None. A plant that varies over time is taken at its first step (`first`).
    """
    network = getattr(record.origin, "model", None)
    return first(network.plant).angles if isinstance(network, Network) else ()


def _make_columns(
    states: Sequence[str], units: Mapping[str, str], estimate: Estimate, angles: Angles
) -> list[tuple[str, np.ndarray]]:
    """Return the columns (header, values) that show an estimate: means, standard deviations, covariances, validity.

    Args:
        states: names of the n states.
        units: units by name of the state; "" or none for states without.
        estimate: mean (rows, n) and covariance (rows, n, n); without covariances (claim "none") only means are shown.
        angles: indices of the states that are angles, shown between -pi and pi.
    """
    mean = wrap_angles(np.asarray(estimate.mean), angles)
    covariance = np.asarray(estimate.covariance)
    if mean.ndim != 2:
        raise fail("record", "the run over one recording", f"estimates of shape {mean.shape}")
    columns = []
    for i, state in enumerate(states):
        columns.append((make_column_header(state, units.get(state)), mean[:, i]))
        if estimate.claim != "none":
            # Rounding may make a variance negative: its deviation is NaN.
            variance = covariance[:, i, i]
            deviation = np.sqrt(np.where(variance >= 0, variance, np.nan))
            columns.append((make_column_header(f"{state}.sd", units.get(state)), deviation))
    # Each attitude is three states, a rotation vector: as a unit quaternion too, named after the first of them.
    for k in range(0, len(estimate.attitude), 3):
        axes = estimate.attitude[k : k + 3]
        quaternions = quaternion_of(mean[:, list(axes)])
        columns += [(f"{states[axes[0]]}.q{part}", quaternions[:, j]) for j, part in enumerate("wxyz")]
    # Covariances of two states have the product of their units.
    if estimate.claim != "none":
        for i, first in enumerate(states):
            for j, second in enumerate(states[i + 1 :], i + 1):
                unit = " ".join(units[name] for name in (first, second) if name in units)
                columns.append((make_column_header(f"cov.{first}.{second}", unit), covariance[:, i, j]))
    # Probabilities of the modes of a Markov chain, (rows, modes).
    if estimate.modes is not None:
        columns += [(f"mode.{m}", values) for m, values in enumerate(np.asarray(estimate.modes).T)]
    return [*columns, ("valid", mask_sound_estimates(estimate))]


def _make_predicted_columns(
    predicted: "heliograph.forecasting.Forecast", record: Record
) -> list[tuple[str, np.ndarray]]:
    """Return columns (header, values) of predictions of each row: means, and standard deviations if they are claimed.

    Those of states are named as the states, those of sensors' outputs begin with "output.". `make_column_header` puts
    the unit behind a name. A prediction has names, means and deviations (rows, numbers), and a claim, "none" without
    deviations.
    """
    # (beginning of the names, predicted quantities, {name: unit})
    parts = [("", predicted.states, record.units)]
    if predicted.outputs is not None:
        parts.append(("output.", predicted.outputs, units_in(predicted.outputs.names)))
    columns = []
    for prefix, law, units in parts:
        if len(law.mean) != len(record.time):
            raise fail("predicted", f"{len(record.time)} rows, as the record has", f"{len(law.mean)} rows")
        for i, name in enumerate(law.names):
            columns.append((prefix + make_column_header(name, units.get(name)), law.mean[:, i]))
            if law.claim != "none":
                columns.append((prefix + make_column_header(f"{name}.sd", units.get(name)), law.deviation[:, i]))
    return columns


def _pad_rows_before(values: np.ndarray, rows: int) -> np.ndarray:
    """Return a column extended at its start by NaN, or false, to a number of rows."""
    padding = np.full(rows - len(values), np.nan if values.dtype.kind == "f" else False)
    return np.concatenate([padding.astype(values.dtype), values])
