"""Records as wide tables: a row for each time, a column for each number, labelled by node, filter and quantity."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from heliograph.model.estimate import STRENGTH, Claim, Estimate
from heliograph.numerics.check import fail
from heliograph.simulation.centres.uplinks import Uplink

if TYPE_CHECKING:
    import pandas as pd
from heliograph.simulation.results.labelled_datasets import SENT

LEVELS = ["node", "filter", "quantity", "component", "other"]  # of a table's columns; "" where one does not apply
Column = tuple[str, str, str, str, str]  # labels of a column, one for each of LEVELS
COVARIANCE: dict[str, Claim] = {f"covariance ({claim})": claim for claim in STRENGTH}  # claims by quantity
MODES = "mode probability"  # a quantity
_Key = tuple[str, str, str]  # node, filter, quantity
_Places = dict[_Key, list[int]]  # of columns


def make_frame(fields: Mapping[str, Any], runs: int | None) -> "pd.DataFrame":
    """Return the table of a record: a row for each time, or run and time; columns labelled as in LEVELS.

    The labels of a column are node, filter, quantity, component and another one, "" where one does not apply.

    Args:
        fields: the record's fields by name: truth (runs, times, states), measurements by node, estimates by node and
            filter, uplinks by name of the fusion, names of the states, and the times.
        runs: number of runs; None for a record of one run, whose arrays have no axis of runs.
    """
    import pandas as pd

    # Columns (run, time) by label: truth, measurements, estimates, and for uplinks what quantizers sent of each state.
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
    # Columns are numbered at first, since pandas would convert some labels to numbers or to missing values.
    frame = pd.DataFrame({i: values.reshape(-1) for i, values in enumerate(columns.values())}, index=index)
    frame.columns = _keep_labels(list(columns))
    return frame


def read_frame(frame: "pd.DataFrame") -> dict[str, Any]:
    """Return the fields of a record, by name, from a table that `make_frame` made.

    Raises:
        ValueError: no such table.
    """
    if list(getattr(getattr(frame, "columns", None), "names", ())) != LEVELS:
        raise fail("table", f"columns {LEVELS}, as Record.to_pandas makes them", type(frame).__name__)
    # Places of the columns, and values (run, time, component), by (node, filter, quantity).
    runs = len(frame.index.unique("run")) if "run" in frame.index.names else None
    steps = len(frame) // (runs or 1)
    leading_axes = (steps,) if runs is None else (runs, steps)
    if runs is not None:
        _check_rows_of_runs(frame, runs, steps)
    indices: _Places = {}
    for i, (node, name, quantity, _, _) in enumerate(frame.columns):
        indices.setdefault((node, name, quantity), []).append(i)
    _sort_indices(frame, indices)
    values = {key: frame.iloc[:, columns].to_numpy().reshape(*leading_axes, -1) for key, columns in indices.items()}
    # Names of the states: the components of the truth, else of the first mean.
    named = next((columns for (_, _, quantity), columns in indices.items() if quantity in ("truth", "mean")), [])
    measurements = {node: z for (node, _, quantity), z in values.items() if quantity == "measurement"}
    estimates: dict[str, dict[str, Estimate]] = {node: {} for node in measurements}
    for node, name, quantity in values:
        if quantity in COVARIANCE:
            estimates.setdefault(node, {})[name] = _read_estimate(frame, indices, values, (node, name, quantity))
    return {
        "time": np.asarray(frame.index.get_level_values("time"))[:steps],
        "states": tuple(frame.columns[i][LEVELS.index("component")] for i in named),
        "truth": values.get(("", "", "truth")),
        "measurements": measurements,
        "estimates": estimates,
        "uplinks": _read_uplinks(values),
    }


def _check_rows_of_runs(frame: "pd.DataFrame", runs: int, steps: int) -> None:
    """Raise ValueError unless the rows of each run follow one another, and every run has the same times in order."""
    is_whole = len(frame) == runs * steps
    if is_whole:
        # One row for each run: its number must be the same at all steps, and its times those of the first run.
        run = np.asarray(frame.index.get_level_values("run")).reshape(runs, steps)
        time = np.asarray(frame.index.get_level_values("time")).reshape(runs, steps)
        is_whole = bool((run == run[:, :1]).all() and (time == time[:1]).all())
    if not is_whole:
        expected = "the same times of each run, one run after another (sort_index)"
        raise fail("table, rows", expected, f"{len(frame)} of {runs} runs, some in another order or missing")


def _sort_indices(frame: "pd.DataFrame", indices: _Places) -> None:
    """Put the columns of each quantity into the order of the states, which is that of the first truth or mean.

    A table may have been sorted by its labels. Components that are no states are numbered, "z0" or "0": by number.

    Args:
        frame: the table, whose columns are labelled as in LEVELS.
        indices: of each key (node, filter, quantity), the indices of its columns; each list is sorted in place.

    Raises:
        ValueError: a quantity without some of the states.
    """
    # Of each column the component, and of a covariance E[e_i e_j] the other state j.
    components = [str(column[LEVELS.index("component")]) for column in frame.columns]
    others = [str(column[LEVELS.index("other")]) for column in frame.columns]
    columns_of_states = next((found for (*_, kind), found in indices.items() if kind in ("truth", "mean")), [])
    states = [components[i] for i in columns_of_states]
    for (node, name, quantity), found in indices.items():
        if quantity in ("measurement", MODES):
            found.sort(key=lambda i: int(components[i].removeprefix("z")))
            continue
        is_covariance = quantity in COVARIANCE
        column_of_label = {(components[i], others[i] if is_covariance else ""): i for i in found}
        labels = [(state, other) for state in states for other in (states if is_covariance else [""])]
        if len(found) != len(labels) or not set(labels) <= column_of_label.keys():
            expected = f"a column for each of {', '.join(states)}"
            raise fail(f"table, {quantity} of {node}/{name}", expected, sorted(column_of_label))
        found[:] = [column_of_label[label] for label in labels]


def _read_estimate(frame: "pd.DataFrame", indices: _Places, values: Mapping[_Key, np.ndarray], key: _Key) -> Estimate:
    """Return the estimate of a node's filter from a table.

    A key is (node, filter, quantity). `key`: the key of the covariance, whose quantity says the claim. `indices`: of
    each key, the indices of its columns. `values`: arrays (run, time, component) by key.
    """
    node, name, quantity = key
    mean, covariance = values[node, name, "mean"], values[key]
    # The last level of a mean's columns numbers the states of attitudes "0", "1" and so on. For others it is "".
    numbers = [frame.columns[i][LEVELS.index("other")] for i in indices[node, name, "mean"]]
    attitude_states = len(numbers) - numbers.count("")
    return Estimate(
        mean=mean,
        covariance=covariance.reshape(*mean.shape, mean.shape[-1]),
        claim=COVARIANCE[quantity],
        modes=values.get((node, name, MODES)),
        attitude=tuple(numbers.index(str(i)) for i in range(attitude_states)),
    )


def _read_uplinks(values: Mapping[_Key, np.ndarray]) -> dict[str, Uplink]:
    """Return what quantizers sent to each fusion, with its nodes side by side.

    `values`: arrays (run, time, component) by key (node, fusion, quantity). SENT: the two quantities, whether a
    quantizer saturated and how many symbols it sent.
    """
    nodes_of: dict[str, list[str]] = {}
    for node, name, quantity in values:
        if quantity == SENT[0]:
            nodes_of.setdefault(name, []).append(node)
    uplinks = {}
    for name, nodes in nodes_of.items():
        sent = [np.stack([values[node, name, quantity] for node in nodes], axis=-2) for quantity in SENT]
        uplinks[name] = Uplink(tuple(nodes), *sent)
    return uplinks


def _keep_labels(columns: Sequence[Column]) -> Any:
    """Return the column labels as a pandas index that keeps them as they are.

    With levels of objects, pandas makes no label a number or a missing value. LEVELS: names of the parts of a label.
    """
    import pandas as pd

    # pandas stores for each part of a label its distinct values (level), and which of them each column has (codes).
    levels = [list(dict.fromkeys(column[part] for column in columns)) for part in range(len(LEVELS))]
    codes = [[level.index(column[part]) for column in columns] for part, level in enumerate(levels)]
    return pd.MultiIndex([pd.Index(level, dtype=object) for level in levels], codes, names=LEVELS)


def _label_estimate(node: str, name: str, estimate: Estimate, states: Sequence[str]) -> dict[Column, np.ndarray]:
    """Return the columns (run, time) of an estimate by label: means, covariances with their claim, modes.

    A label: (node, filter, quantity, component, other); MODES is the quantity of the modes' probabilities.
    """
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
