"""A record as a wide table, and back."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from heliograph.model.estimate import STRENGTH, Claim, Estimate
from heliograph.numerics.check import fail
from heliograph.simulation.centres.uplinks import Uplink

if TYPE_CHECKING:  # an extra
    import pandas as pd

    from heliograph.simulation.results.record import Record

LEVELS = ["node", "filter", "quantity", "component", "other"]
Column = tuple[str, str, str, str, str]
COVARIANCE: dict[str, Claim] = {f"covariance ({claim})": claim for claim in STRENGTH}
SENT = ("saturated", "symbols")


def record_frame(record: "Record") -> "pd.DataFrame":
    """Table of a record: a row for each time, or run and time; columns (node, filter, quantity, component, other)."""
    import pandas as pd

    # Columns: truth, measurements, estimates, uplinks.
    columns: dict[Column, np.ndarray] = {}
    if record.truth is not None:
        columns |= {("", "", "truth", s, ""): record.truth[..., i] for i, s in enumerate(record.states)}
    for node, z in record.measurements.items():
        columns |= {(node, "", "measurement", f"z{i}", ""): z[..., i] for i in range(z.shape[-1])}
    for node, filters in record.estimates.items():
        for name, estimate in filters.items():
            columns |= _of_estimate(node, name, estimate, record.states)
    for name, uplink in record.uplinks.items():
        for i, node in enumerate(uplink.nodes):
            for quantity in SENT:
                values = getattr(uplink, quantity)
                columns |= {(node, name, quantity, s, ""): values[..., i, j] for j, s in enumerate(record.states)}
    # Rows: runs one after another.
    index = pd.Index(record.time, name="time")
    if record.runs is not None:
        index = pd.MultiIndex.from_product([range(record.runs), index], names=["run", "time"])
    frame = pd.DataFrame({i: values.reshape(-1) for i, values in enumerate(columns.values())}, index=index)
    frame.columns = _labels(list(columns))
    return frame


def record_fields(frame: "pd.DataFrame") -> dict[str, Any]:
    """Fields of the record of such a table.

    Raises:
        ValueError: no such table.
    """
    if list(getattr(getattr(frame, "columns", None), "names", ())) != LEVELS:
        raise fail("table", f"columns {LEVELS}, as Record.to_pandas makes them", type(frame).__name__)
    # Values by (node, filter, quantity), components along the last axis.
    runs = len(frame.index.unique("run")) if "run" in frame.index.names else None
    steps = len(frame) // (runs or 1)
    lead = (steps,) if runs is None else (runs, steps)
    parts: dict[tuple[str, str, str], dict[tuple[str, str], np.ndarray]] = {}
    for i, (node, name, quantity, component, other) in enumerate(frame.columns):
        values = frame.iloc[:, i].to_numpy().reshape(lead)
        parts.setdefault((node, name, quantity), {})[component, other] = values
    joined = {key: np.stack(list(part.values()), axis=-1) for key, part in parts.items()}
    # Sort them into truth, measurements, estimates and uplinks.
    states: tuple[str, ...] = ()
    measurements: dict[str, np.ndarray] = {}
    estimates: dict[str, dict[str, Estimate]] = {}
    sent: dict[str, dict[str, list[np.ndarray]]] = {}
    for (node, name, quantity), values in joined.items():
        if quantity in ("truth", "mean"):
            states = tuple(component for component, _ in parts[node, name, quantity])
        elif quantity == "measurement":
            measurements[node] = values
            estimates.setdefault(node, {})
        elif quantity in SENT:
            sent.setdefault(name, {}).setdefault(node, []).append(values)
        else:
            n, mean = len(states), joined[node, name, "mean"]
            covariance = values.reshape(*lead, n, n)
            estimates.setdefault(node, {})[name] = Estimate(mean, covariance, COVARIANCE[quantity])
    uplinks = {
        name: Uplink(tuple(item), *(np.stack(item, axis=-2) for item in zip(*item.values(), strict=True)))
        for name, item in sent.items()
    }
    time = np.asarray(frame.index.get_level_values("time"))[:steps]
    return {
        "time": time,
        "states": states,
        "truth": joined.get(("", "", "truth")),
        "measurements": measurements,
        "estimates": estimates,
        "uplinks": uplinks,
    }


def _labels(columns: Sequence[Column]) -> Any:
    """Column labels as they are: none is converted to a number or to a missing value."""
    import pandas as pd

    levels = [list(dict.fromkeys(column[i] for column in columns)) for i in range(len(LEVELS))]
    codes = [[level.index(column[i]) for column in columns] for i, level in enumerate(levels)]
    return pd.MultiIndex([pd.Index(level, dtype=object) for level in levels], codes, names=LEVELS)


def _of_estimate(node: str, name: str, estimate: Estimate, states: Sequence[str]) -> dict[Column, np.ndarray]:
    mean, covariance = np.asarray(estimate.mean), np.asarray(estimate.covariance)
    results: dict[Column, np.ndarray] = {(node, name, "mean", s, ""): mean[..., i] for i, s in enumerate(states)}
    for i, state in enumerate(states):
        for j, other in enumerate(states):
            results[node, name, f"covariance ({estimate.claim})", state, other] = covariance[..., i, j]
    return results
