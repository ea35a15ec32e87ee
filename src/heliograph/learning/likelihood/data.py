"""Recordings of a fit, gathered and checked against the network."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from heliograph.model.checks.inputs import check_inputs
from heliograph.model.checks.row_times import judge_dates, warn_of_unequal_steps
from heliograph.numerics.check import array, check_columns, fail, show_value
from heliograph.numerics.masked import fill_masked
from heliograph.numerics.times.data_rows import check_rows
from heliograph.numerics.types import Float
from heliograph.simulation.network import Network

FEWEST = 10  # numbers that arrived for each free one


class LikelihoodData(NamedTuple):
    """Recordings of one network, joined over its nodes and filled up with rows in which nothing arrived.

    Shapes: measurements (recordings, steps, received), inputs (recordings, steps, inputs), lengths (recordings,);
    truth (recordings, steps, n), the true states where these are learned from, NaN where they are not known.
    """

    measurements: Float[np.ndarray, "recordings steps received"]
    inputs: Float[np.ndarray, "recordings steps inputs"]
    lengths: tuple[int, ...]
    truth: Float[np.ndarray, "recordings steps n"] | None = None


def gather_data(network: Network, recording: object, inputs: Any, free: int, truth: Any = False) -> LikelihoodData:
    """Gather all recordings, checked against the network, as `LikelihoodData`; with true states if they are needed.

    Raises:
        ValueError: recordings of other shapes, too short, or without any change.
    """
    several: Sequence[object] = [recording]
    if isinstance(recording, list | tuple) and not hasattr(recording, "measurements"):  # a Recording is a tuple too
        several = recording
    if not len(several):
        raise fail("recordings", "at least one", "none")
    # Every run of every recording, then all filled up to the longest.
    parts = [
        run
        for i, single in enumerate(several)
        for run in _split_runs(network, single, _pick_inputs(inputs, i, several))
    ]
    for z, _ in parts:
        network.check_horizon(len(z))
    longest = max(len(z) for z, _ in parts)
    true = [] if truth is False else _split_truth(network, several, truth, [len(z) for z, _ in parts])
    data = LikelihoodData(
        measurements=np.stack([_pad_rows(z, longest, np.nan) for z, _ in parts]),
        inputs=np.stack([_pad_rows(u, longest, None) for _, u in parts]),
        lengths=tuple(len(z) for z, _ in parts),
        truth=np.stack([_pad_rows(x, longest, np.nan) for x in true]) if true else None,
    )
    _check_enough_data(data, free)
    return data


def _pick_inputs(inputs: object, index: int, several: Sequence[object]) -> object:
    """Return the inputs of one recording of several: those in its place in a list, or the common ones."""
    if not isinstance(inputs, list | tuple):
        return inputs
    if len(inputs) != len(several):
        raise fail("inputs", f"those of each of the {len(several)} recordings", f"{len(inputs)} of them")
    return inputs[index]


def _split_truth(network: Network, several: Sequence[object], truth: Any, steps: list[int]) -> list[np.ndarray]:
    """Return the true states (steps, n) of each run of each recording, NaN where they are not known.

    `truth`: True for those that the recordings hold, else the states, or a list of them; `steps`: length of each run.

    Raises:
        ValueError: recordings without them, other shapes.
    """
    held = [getattr(single, "truth", None) for single in several] if truth is True else truth
    listed = held if isinstance(held, list | tuple) and len(held) == len(several) else [held]
    if len(listed) != len(several) or any(single is None for single in listed):
        got = "none" if truth is True else f"{len(listed)} of them"
        raise fail("truth", f"the true states of each of the {len(several)} recordings", got)
    runs = [
        run
        for states in (np.asarray(fill_masked(part)) for part in listed)
        for run in (states if states.ndim == 3 else [states])
    ]
    if len(runs) != len(steps):
        raise fail("truth", f"the true states of each of the {len(steps)} runs", f"{len(runs)} of them")
    return [array("truth", run, (count, len(network.states)), missing=True)
            for run, count in zip(runs, steps, strict=True)]  # fmt: skip


def _split_runs(network: Network, recording: Any, inputs: Any) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the measurements (steps, received) and inputs (steps, inputs) of each run of a recording.

    The same inputs led to every run; those of the recording count unless others are given.
    """
    held = getattr(recording, "measurements", recording)
    given_inputs = getattr(recording, "inputs", None) if inputs is None else inputs
    # Measurements by node.
    if not isinstance(held, Mapping):
        if len(network.names) > 1:
            raise fail("recording", f"measurements by node, of {list(network.names)}", show_value(recording))
        held = {network.names[0]: held}
    if set(held) != set(network.names):
        raise fail("recording", f"measurements of the nodes {list(network.names)}", list(held))
    # Times of its rows: those that it holds, or the dates in the index of its tables.
    clock = getattr(recording, "time", None)
    if isinstance(clock, np.ndarray):
        warn_of_unequal_steps(network.inputs, clock)
    else:
        tables = {f"measurements of {name!r}": z for name, z in held.items()} | {"inputs": given_inputs}
        judge_dates(network.inputs, tables)
    # Each run: the nodes' columns side by side, and the inputs.
    for name, z in held.items():
        check_columns(f"measurements of {name!r}", z, network.nodes[name].received_names)
    runs = _list_runs([np.asarray(fill_masked(held[name])) for name in network.names])
    results = []
    for run in runs:
        columns: list[np.ndarray] = []
        for name, z in zip(network.names, run, strict=True):
            length = len(columns[0]) if columns else None  # that of the first node
            measured = check_rows(f"measurements of {name!r}", z, length, network.nodes[name].received, missing=True)
            columns.append(np.asarray(measured))
        steps, count = len(columns[0]), len(network.inputs)
        if given_inputs is None and count:
            raise fail("inputs", f"an array ({steps}, {count}) of {list(network.inputs)}", "none")
        u = np.zeros((steps, 0))
        if given_inputs is not None:
            u = np.array(check_rows("inputs", given_inputs, steps, count, False, network.inputs))
        check_inputs(network.inputs, u, (network.plant, network.nodes, network.fused))
        results.append((np.concatenate(columns, axis=1), u))
    return results


def _list_runs(values: list[np.ndarray]) -> list[list[np.ndarray]]:
    """Return the arrays of all nodes by run: (runs, steps, received) are cut into runs, a recording is one run."""
    if all(value.ndim == 3 for value in values):
        return [list(run) for run in zip(*values, strict=True)]
    return [values]


def _pad_rows(values: np.ndarray, length: int, filler: float | None) -> np.ndarray:
    """Return the array with rows added up to a length: of a filler, or copies of the last one."""
    more = length - len(values)
    end = values[-1:] if filler is None else np.full((1, values.shape[1]), filler)
    return np.concatenate([values, np.repeat(end, more, axis=0)]) if more else values


def _check_enough_data(data: LikelihoodData, free: int) -> None:
    """Raise ValueError if recordings have fewer than FEWEST numbers for each free one, or nothing in them varies."""
    z = data.measurements if data.truth is None else data.truth
    count = int(np.count_nonzero(~np.isnan(z)))
    if count < FEWEST * free:
        known = "that arrived" if data.truth is None else "of the truth"
        raise fail("recording", f"at least {FEWEST * free} numbers {known} for {free} free ones", count)
    z = data.measurements
    flat = z.reshape(-1, z.shape[-1])
    received = [column[~np.isnan(column)] for column in flat.T]
    constant = [i for i, column in enumerate(received) if len(column) and np.ptp(column) == 0]
    if constant and len(constant) == sum(len(column) > 0 for column in received):
        value = array("m", received[constant[0]], (None,))[0]
        raise fail("recording", "measurements that vary", f"{value:g} throughout")
