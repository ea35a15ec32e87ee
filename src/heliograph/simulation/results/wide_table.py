"""Records as wide tables: a row for each time, a column for each number, labelled by node, filter and quantity."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from heliograph.model.estimate import STRENGTH, Claim, Estimate
from heliograph.numerics.check import fail
from heliograph.simulation.centres.uplinks import Uplink

if TYPE_CHECKING:
    import pandas as pd
from heliograph.simulation.results.labelled import SENT

LEVELS = ["node", "filter", "quantity", "component", "other"]  # of a table's columns


Column = tuple[str, str, str, str, str]


COVARIANCE: dict[str, Claim] = {f"covariance ({claim})": claim for claim in STRENGTH}


MODES = "mode probability"


def record_frame(fields: Mapping[str, Any], runs: int | None) -> "pd.DataFrame":
    """Return the table of a record's fields: a row for each time, or run and time; columns as in LEVELS."""
    import pandas as pd

    # Columns: truth, measurements, estimates, uplinks.
    columns: dict[Column, np.ndarray] = {}
    if fields["truth"] is not None:
        columns |= {("", "", "truth", s, ""): fields["truth"][..., i] for i, s in enumerate(fields["states"])}
    for node, z in fields["measurements"].items():
        columns |= {(node, "", "measurement", f"z{i}", ""): z[..., i] for i in range(z.shape[-1])}
    for node, filters in fields["estimates"].items():
        for name, estimate in filters.items():
            columns |= _label_estimate(node, name, estimate, fields["states"])
    for name, uplink in fields["uplinks"].items():
        for i, node in enumerate(uplink.nodes):
            for quantity in SENT:
                values = getattr(uplink, quantity)
                columns |= {(node, name, quantity, s, ""): values[..., i, j] for j, s in enumerate(fields["states"])}
    # Rows: runs one after another.
    index = pd.Index(fields["time"], name="time")
    if runs is not None:
        index = pd.MultiIndex.from_product([range(runs), index], names=["run", "time"])
    frame = pd.DataFrame({i: values.reshape(-1) for i, values in enumerate(columns.values())}, index=index)
    frame.columns = _keep_labels(list(columns))
    return frame


def record_fields(frame: "pd.DataFrame") -> dict[str, Any]:
    """Return the fields of the record of such a table.

    Raises:
        ValueError: no such table.
    """
    if list(getattr(getattr(frame, "columns", None), "names", ())) != LEVELS:
        raise fail("table", f"columns {LEVELS}, as Record.to_pandas makes them", type(frame).__name__)
    # Values by (node, filter, quantity), components along the last axis.
    runs = len(frame.index.unique("run")) if "run" in frame.index.names else None
    steps = len(frame) // (runs or 1)
    lead = (steps,) if runs is None else (runs, steps)
    columns: dict[tuple[str, str, str], list[int]] = {}
    for i, column in enumerate(frame.columns):
        columns.setdefault(column[:3], []).append(i)
    values = {key: frame.iloc[:, places].to_numpy().reshape(*lead, -1) for key, places in columns.items()}
    # States as the truth, else the first mean, has them.
    named = next((places for (_, _, quantity), places in columns.items() if quantity in ("truth", "mean")), [])
    states = tuple(frame.columns[i][3] for i in named)
    measurements = {node: z for (node, _, quantity), z in values.items() if quantity == "measurement"}
    estimates: dict[str, dict[str, Estimate]] = {node: {} for node in measurements}
    uplinks: dict[str, list[str]] = {}
    for (node, name, quantity), value in values.items():
        if quantity in COVARIANCE:
            # The last level numbers the states of attitudes.
            order = [frame.columns[i][4] for i in columns[node, name, "mean"]]
            attitude = tuple(order.index(str(i)) for i in range(len(order) - order.count("")))
            moments = values[node, name, "mean"], value.reshape(*lead, len(states), len(states))
            modes = values.get((node, name, MODES))
            estimate = Estimate(*moments, COVARIANCE[quantity], modes, attitude=attitude)
            estimates.setdefault(node, {})[name] = estimate
        elif quantity == SENT[0]:
            uplinks.setdefault(name, []).append(node)
    return {
        "time": np.asarray(frame.index.get_level_values("time"))[:steps],
        "states": states,
        "truth": values.get(("", "", "truth")),
        "measurements": measurements,
        "estimates": estimates,
        # Uplinks with their nodes side by side.
        "uplinks": {
            name: Uplink(tuple(nodes), *(np.stack([values[n, name, q] for n in nodes], axis=-2) for q in SENT))
            for name, nodes in uplinks.items()
        },
    }


def _keep_labels(columns: Sequence[Column]) -> Any:
    """Return the column labels as they are: none is converted to a number or to a missing value."""
    import pandas as pd

    levels = [list(dict.fromkeys(column[i] for column in columns)) for i in range(len(LEVELS))]
    codes = [[level.index(column[i]) for column in columns] for i, level in enumerate(levels)]
    return pd.MultiIndex([pd.Index(level, dtype=object) for level in levels], codes, names=LEVELS)


def _label_estimate(node: str, name: str, estimate: Estimate, states: Sequence[str]) -> dict[Column, np.ndarray]:
    """Return the columns of an estimate: means, covariances with their claim, and probabilities of modes."""
    mean, covariance = np.asarray(estimate.mean), np.asarray(estimate.covariance)
    # Of an attitude's numbers, which one: "0", "1", "2" of the first, and so on.
    order = {place: str(i) for i, place in enumerate(estimate.attitude)}
    results: dict[Column, np.ndarray] = {
        (node, name, "mean", s, order.get(i, "")): mean[..., i] for i, s in enumerate(states)
    }
    for i, state in enumerate(states):
        for j, other in enumerate(states):
            results[node, name, f"covariance ({estimate.claim})", state, other] = covariance[..., i, j]
    if estimate.modes is not None:
        modes = np.asarray(estimate.modes)
        results |= {(node, name, MODES, str(i), ""): modes[..., i] for i in range(modes.shape[-1])}
    return results
