"""Recordings of a fit, gathered and checked against the network."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, cast

import numpy as np

from heliograph.model.checks.plant_inputs import check_inputs
from heliograph.model.checks.row_times import read_row_dates, warn_of_unequal_steps
from heliograph.numerics.check import array, check_columns, fail, show_value
from heliograph.numerics.masked_arrays import fill_masked
from heliograph.numerics.times.data_row_checks import check_rows
from heliograph.numerics.types import Float
from heliograph.simulation.network import Network

FEWEST = 10  # least count of numbers that arrived for each free number


class LikelihoodData(NamedTuple):
    """Recordings of one network, joined over its nodes and filled up to one length, so that arrays hold them all.

    Args:
        measurements: numbers that the nodes received, side by side (recordings, steps, received); NaN where one did not
            arrive, and in the rows that fill up.
        inputs: inputs of the plant (recordings, steps, inputs); rows that fill up repeat the last ones.
        lengths: number of rows of each recording without those that fill up.
        truth: true states where these are learned from, NaN where they are not known (recordings, steps, n); else None.
    """

    measurements: Float[np.ndarray, "recordings steps received"]
    inputs: Float[np.ndarray, "recordings steps inputs"]
    lengths: tuple[int, ...]
    truth: Float[np.ndarray, "recordings steps n"] | None = None


def gather_data(network: Network, recording: object, inputs: Any, free: int, truth: Any = False) -> LikelihoodData:
    """Return all runs of all recordings, checked against the network and filled up to one length.

    All runs are then evaluated side by side by one compiled likelihood.

    Args:
        network: the network whose nodes received the measurements.
        recording: one recording, or a list of several, as `hg.fit` takes them.
        inputs: inputs of the plant (steps, inputs), or a list of one array for each recording; None for those of the
            recordings themselves.
        free: how many numbers are to be learned, for which there must be data enough.
        truth: the true states (steps, n), or a list of them; True for those in the recordings; False where not needed.

    Raises:
        ValueError: recordings of other shapes, too short, or without any change.
    """
    # One recording, or several: a list of numbers may also be the rows of a single recording.
    several: Sequence[object] = [recording]
    is_list = isinstance(recording, list | tuple) and not hasattr(recording, "measurements")  # a Recording is a tuple
    if is_list and not _are_rows(network, recording):
        several = cast(Sequence[object], recording)
    if not len(several):
        raise fail("recordings", "at least one", "none")
    # Measurements z (steps, received) and inputs u (steps, inputs) of every run of every recording.
    runs = [
        run
        for i, single in enumerate(several)
        for run in _split_runs(network, single, _pick_inputs(inputs, i, several))
    ]
    for z, _ in runs:
        network.check_horizon(len(z))
    lengths = [len(z) for z, _ in runs]
    true_states = [] if truth is False else _split_truth(network, several, truth, lengths)
    # All filled up to the longest: nothing arrives in the rows that are added, the last inputs go on.
    longest = max(lengths)
    data = LikelihoodData(
        measurements=np.stack([_pad_rows(z, longest, filler=np.nan) for z, _ in runs]),
        inputs=np.stack([_pad_rows(u, longest, filler=None) for _, u in runs]),
        lengths=tuple(lengths),
        truth=np.stack([_pad_rows(x, longest, filler=np.nan) for x in true_states]) if true_states else None,
    )
    _check_enough_data(data, free)
    return data


def _are_rows(network: Network, entries: object) -> bool:
    """Return whether the entries of a list are the rows of one recording, rather than recordings.

    They are rows if each is a number, or has as many numbers as the only node receives, as in `array.tolist()`.

    Args:
        network: the network, whose only node says how many numbers a row has.
        entries: the list.
    """
    try:
        values = np.asarray(entries)
    except ValueError:  # entries of different lengths
        return False
    if len(network.names) > 1 or not values.size or values.dtype.kind not in "biuf":
        return False
    return values.ndim == 1 or values.shape[1:] == (network.nodes[network.names[0]].received,)


def _pick_inputs(inputs: object, index: int, several: Sequence[object]) -> object:
    """Return the inputs of recording number `index`: its entry if `inputs` is a list, else those of all recordings.

    Args:
        inputs: inputs for all recordings, or a list with those of each.
        index: number of the recording.
        several: all recordings.
    """
    if not isinstance(inputs, list | tuple):
        return inputs
    if len(inputs) != len(several):
        raise fail("inputs", f"those of each of the {len(several)} recordings", f"{len(inputs)} of them")
    return inputs[index]


def _split_truth(network: Network, several: Sequence[object], truth: Any, steps: list[int]) -> list[np.ndarray]:
    """Return the true states (steps, n) of each run of each recording, NaN where they are not known.

    Args:
        network: the network, for its states.
        several: the recordings.
        truth: True for the states in the recordings, else the states, or a list of them.
        steps: length of each run.

    Raises:
        ValueError: recordings without them, other shapes.
    """
    states = [getattr(single, "truth", None) for single in several] if truth is True else truth
    listed = states if isinstance(states, list | tuple) and len(states) == len(several) else [states]
    if len(listed) != len(several) or any(single is None for single in listed):
        got = "none" if truth is True else f"{len(listed)} of them"
        raise fail("truth", f"the true states of each of the {len(several)} recordings", got)
    # States of a recording are (steps, n), or of several runs (runs, steps, n).
    runs = [
        run
        for of_recording in (np.asarray(fill_masked(single)) for single in listed)
        for run in (of_recording if of_recording.ndim == 3 else [of_recording])
    ]
    if len(runs) != len(steps):
        raise fail("truth", f"the true states of each of the {len(steps)} runs", f"{len(runs)} of them")
    return [array("truth", run, (count, len(network.states)), missing=True)
            for run, count in zip(runs, steps, strict=True)]  # fmt: skip


def _split_runs(network: Network, recording: Any, inputs: Any) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return measurements (steps, received) and inputs (steps, inputs) of each run of a recording, checked.

    Columns of the nodes stand side by side in the network's order. The same inputs led to every run.

    Args:
        network: whose nodes received the measurements.
        recording: measurements by node, or of the only node; or an object with `measurements`, `inputs`, `time`.
        inputs: (steps, inputs); None for those of the recording, if it has any.
    """
    measurements = getattr(recording, "measurements", recording)
    given_inputs = getattr(recording, "inputs", None) if inputs is None else inputs
    by_node = _arrange_by_node(network, recording, measurements)
    # The times of the rows are those that the recording holds, or the dates in the index of its tables.
    clock = getattr(recording, "time", None)
    if isinstance(clock, np.ndarray):
        warn_of_unequal_steps(network.inputs, clock)
    else:
        tables = {f"measurements of {name!r}": z for name, z in by_node.items()} | {"inputs": given_inputs}
        read_row_dates(network.inputs, tables)
    for name, z in by_node.items():
        check_columns(f"measurements of {name!r}", z, network.nodes[name].received_names)
    runs = _list_runs([np.asarray(fill_masked(by_node[name])) for name in network.names])
    return [_join_nodes(network, run, given_inputs) for run in runs]


def _arrange_by_node(network: Network, recording: Any, measurements: Any) -> Mapping[str, Any]:
    """Return a recording's `measurements` as {node: measurements}; a plain array is that of the only node.

    Raises:
        ValueError: an array although there are several nodes, or other nodes than the network's.
    """
    if not isinstance(measurements, Mapping) and len(network.names) > 1:
        raise fail("recording", f"measurements by node, of {list(network.names)}", show_value(recording))
    is_by_node = isinstance(measurements, Mapping)
    by_node: Mapping[str, Any] = measurements if is_by_node else {network.names[0]: measurements}
    if set(by_node) != set(network.names):
        raise fail("recording", f"measurements of the nodes {list(network.names)}", list(by_node))
    return by_node


def _join_nodes(network: Network, run: list[np.ndarray], inputs: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return the nodes' measurements in one run side by side (steps, received), and its inputs (steps, inputs).

    `run`: an array (steps, received by it) for each node, in the network's order; `inputs`: None if there are none.
    """
    measured: dict[str, np.ndarray] = {}
    for name, z in zip(network.names, run, strict=True):
        length = len(measured[network.names[0]]) if measured else None  # that of the first node
        rows = check_rows(f"measurements of {name!r}", z, length, network.nodes[name].received, missing=True)
        measured[name] = np.asarray(rows)
    steps = len(measured[network.names[0]])
    count = len(network.inputs)
    if inputs is None and count:
        raise fail("inputs", f"an array ({steps}, {count}) of {list(network.inputs)}", "none")
    u = np.zeros((steps, 0))
    if inputs is not None:
        u = np.array(check_rows("inputs", inputs, steps, count, missing=False, names=network.inputs))
    check_inputs(network.inputs, u, (network.plant, network.nodes, network.fused))
    # Readings that the nodes refuse, by limits, codes or as stuck, count as not arrived, as where filters run.
    used = network.drop_refused_readings(measured, u)
    return np.concatenate([used[name] for name in network.names], axis=1), u


def _list_runs(values: list[np.ndarray]) -> list[list[np.ndarray]]:
    """Return the arrays of all nodes by run: arrays (runs, steps, received) are cut into runs, others are one."""
    if all(value.ndim == 3 for value in values):
        return [list(run) for run in zip(*values, strict=True)]
    return [values]


def _pad_rows(values: np.ndarray, length: int, filler: float | None) -> np.ndarray:
    """Return the array (rows, columns) padded to a length, with rows of `filler` or, if it is None, of the last row.

    Args:
        values: rows of one run (rows, columns).
        length: number of rows that the result has.
        filler: value of the added rows, or None.
    """
    missing = length - len(values)
    added_row = values[-1:] if filler is None else np.full((1, values.shape[1]), filler)
    return np.concatenate([values, np.repeat(added_row, missing, axis=0)]) if missing else values


def _check_enough_data(data: LikelihoodData, free: int) -> None:
    """Raise ValueError if data have fewer than FEWEST (10) numbers for each free one, or nothing in them varies.

    The numbers counted are the known true states if these are learned from, else the measurements that arrived. `free`:
    how many numbers are free.
    """
    counted = data.measurements if data.truth is None else data.truth
    count = int(np.count_nonzero(~np.isnan(counted)))
    if count < FEWEST * free:
        known = "that arrived" if data.truth is None else "of the truth"
        raise fail("recording", f"at least {FEWEST * free} numbers {known} for {free} free ones", count)
    # For each component of which something arrived, all its values in all recordings.
    components = data.measurements.reshape(-1, data.measurements.shape[-1]).T
    arrived = [values[~np.isnan(values)] for values in components]
    arrived = [values for values in arrived if len(values)]
    is_constant = bool(arrived) and all(np.ptp(values) == 0 for values in arrived)
    if is_constant:
        value = arrived[0][0]
        raise fail("recording", "measurements that vary", f"{value:g} throughout")
