"""All filters of a network over the rows of a recording: in one scan, in chunks side by side, or part after part."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.engine.choice import compute_once, scan_rows
from heliograph.filters.rows.chunks import scan_in_chunks
from heliograph.filters.rows.linear_recursion import Recursion
from heliograph.model.forecast_origin import Origin
from heliograph.numerics.check import fail, instance
from heliograph.numerics.float64 import quickly_compiled, to_numpy
from heliograph.numerics.types import Array, PyTree
from heliograph.simulation.network_filters import AllFilters, initial_states
from heliograph.simulation.recordings.implausible_data import step_plausibly
from heliograph.simulation.recordings.smoothed import NetworkSmoother
from heliograph.simulation.results.record import Record

EXPECTED = "what hg.run of this network returned for the rows before"
ROWS = 128  # of a recording with fusions between neighbours, whose weights are in memory at a time


class RecordingStart(NamedTuple):
    """Where rows begin that go on behind others: the filters' states there, and the number of the first row (step)."""

    states: PyTree
    step: np.ndarray


class FilteringTask(NamedTuple):
    """All that a recording is filtered with but its measurements.

    Args:
        filters: of the network.
        smoother: of their estimates; None where they are not smoothed.
        u: inputs of the plant (steps, inputs).
        arrivals: which reports arrived of each fusion by reports, and which messages of one between neighbours, by
            name.
        begin: of rows behind others; None of the first ones.
    """

    filters: AllFilters
    smoother: NetworkSmoother | None
    u: np.ndarray
    arrivals: dict[str, PyTree]
    begin: RecordingStart | None = None

    def first_states(self) -> PyTree:
        """Return the states before the first of these rows."""
        return _begin((self.filters, None if self.begin is None else self.begin.states))

    def rows(self, z: tuple[np.ndarray, ...]) -> tuple[PyTree, ...]:
        """Return the rows, with a leading axis of steps: step numbers, inputs, measurements z, and what arrived.

        Step numbers begin at 0, or continue those of an earlier recording (`self.begin`). What arrived
        (`self.arrivals`) are the reports to a centre and the messages between neighbours.
        """
        numbers: Array = jnp.arange(len(self.u))
        if self.begin is not None:
            numbers = self.begin.step + numbers
        return numbers, self.u, z, self.arrivals

    def number_rows(self) -> np.ndarray:
        """Return the numbers of the rows, as `rows` has them, outside of a trace."""
        return np.arange(len(self.u)) + (0 if self.begin is None else self.begin.step)


def read_recording_start(filters: AllFilters, after: Record, smooths: bool) -> Origin:
    """Return where the rows of a record ended: the time, the step and the states of these filters.

    Args:
        filters: the filters of the network.
        after: the record of the earlier rows.
        smooths: True if estimates are to be smoothed.

    Raises:
        ValueError: a record without the states, or of another network; smoothing, which needs all rows; a fusion
            whose messages may come rows later.
    """
    origin = instance("after", after, Record, EXPECTED).origin
    if origin is None:
        raise fail("after", EXPECTED, "a record without the last states of its filters")
    if smooths:
        raise fail("after", "no smoothing, which needs all rows at once", "smooth")
    if fusions_with_delays := [*filters.reporting, *filters.meshes]:
        raise fail(
            "after", "no fusion by reports or between neighbours, which may come rows later", fusions_with_delays
        )
    if not origin.has_form_of(jax.eval_shape(filters.init)):
        raise fail("after", EXPECTED, "one of another network")
    return origin


def continue_times(origin: Origin | None, clock: np.ndarray) -> np.ndarray:
    """Return the times of the rows (`clock`), with the time of the last earlier row before them if there is one.

    Raises:
        ValueError: the first time is before that row, or only one of both is a date.
    """
    if origin is None:  # there are no earlier rows
        return clock
    last_time, first_time = np.asarray(origin.time), clock[0]
    are_date_and_number = last_time.dtype.kind != clock.dtype.kind
    if are_date_and_number or first_time < last_time:
        raise fail("time", f"rows behind {origin.time}, the last one before them", str(first_time))
    return np.append(last_time, clock)


def filter_rows(task: FilteringTask, z: tuple[np.ndarray, ...], judged: bool) -> PyTree:
    """Return the outputs of `AllFilters.step` for all rows of a recording, as NumPy arrays.

    A row has the measurements of one time. With a smoother, the results are those of `NetworkSmoother.smooth_run`. Two
    entries are added: "measurements", z, and "state", the filters' last states. There are three ways to compute the
    same: chunks of rows side by side, native code row after row, or XLA.

    Args:
        task: the filters, the smoother, inputs, which messages arrive between nodes, and the states before the rows.
        z: measurements (steps, node, received) for each group of nodes of one structure.
        judged: True to leave out measurements that filters judge implausible.
    """
    # Chunks side by side need linear filters, no fusion, no smoother and many rows; else `results` is None.
    results = None if judged else _filter_in_chunks(task, z)
    if results is not None:
        return results
    # Native code lays arrays out when it is compiled. A joint covariance between neighbours is indexed by their graph,
    # which is data here. So such networks, and steps of very many operations, are left to XLA.
    by_xla = any(mesh.has_long_step or mesh.needs_joint for mesh in task.filters.meshes.values())
    if by_xla:
        return _scan_in_parts(task, z, judged)
    if task.smoother is not None:  # it goes back over all rows
        return compute_once(_scan_all_rows, _by_xla, (task, z, judged))
    fixed = task.filters, None if task.begin is None else task.begin.states
    rows, step = (task.number_rows(), task.u, z, task.arrivals), _step_judged if judged else _step_unjudged
    scanned = scan_rows(_begin, step, fixed, rows, lambda: _scanned_by_xla(task, z, judged))
    return _collect_results(None, z, *scanned)


def _begin(fixed: tuple[AllFilters, PyTree]) -> PyTree:
    """Return the states of filters before the first row: those that are given with them, or else their own."""
    filters, states = fixed
    return filters.init() if states is None else jax.tree.map(jnp.asarray, states)


def _step_unjudged(fixed: tuple[AllFilters, PyTree], states: PyTree, row: tuple[PyTree, ...]) -> tuple[PyTree, PyTree]:
    """Return the states of all filters after one row, and their outputs; all data are used.

    `fixed`: (filters, states before the first row or None), of which the filters are used here. `row`: number of the
    step, inputs, measurements, and what arrived of reports.
    """
    filters, _ = fixed
    k, u, z, arrivals = row
    return filters.step(states, z, u, k, arrivals)


def _step_judged(fixed: tuple[AllFilters, PyTree], states: PyTree, row: tuple[PyTree, ...]) -> tuple[PyTree, PyTree]:
    """Return the states of all filters after one row, and their outputs; what is implausible is left out.

    `fixed` and `row`: as of `_step_unjudged`.
    """
    filters, _ = fixed
    k, u, z, arrivals = row
    return step_plausibly(filters, states, z, u, k, arrivals)


class NetworkRecursion(Recursion):
    """Recursion of all filters of a network over rows, of which `begin` is the number of the first.

    Each row's output is all that they estimate and judge.
    """

    filters: AllFilters
    begin: Array

    def step(self, state: PyTree, row: tuple[PyTree, Array], k: Array) -> tuple[PyTree, PyTree]:
        """Step all filters over one row; return their states and what is recorded of them."""
        z, u = row
        return self.filters.step(state, z, jnp.asarray(u), jnp.asarray(self.begin + k), {})


def _filter_in_chunks(task: FilteringTask, z: tuple[np.ndarray, ...]) -> PyTree | None:
    """Return the outputs of all filters for all rows, computed in chunks of rows side by side; None if that can't be.

    It needs linear filters whose estimates are not fused, no smoothing, and many rows. `z`: measurements (steps, node,
    received) by group.
    """
    if task.smoother is not None or not task.filters.are_linear_and_unfused:
        return None
    # Rows that continue a recording begin at its last states and step.
    begin = task.begin or RecordingStart(initial_states(task.filters), np.asarray(0))
    recursion = NetworkRecursion(task.filters, begin.step)
    filtered = scan_in_chunks(recursion, to_numpy(begin.states), (z, task.u))
    return None if filtered is None else _collect_results(None, z, *filtered)


def _scan_in_parts(task: FilteringTask, z: tuple[np.ndarray, ...], judged: bool) -> PyTree:
    """Return the outputs of all filters for all rows, smoothed if the task has a smoother, by XLA some rows at a time.

    It serves networks whose fusions between neighbours native code cannot compile. There each node weighs its
    neighbours' messages; weights that depend only on which messages arrive are computed for the rows of a part at once.

    Returns a tree of arrays with a leading axis of rows, as `_collect_results` makes it of the filters' last states and
    of all rows' outputs.

    Args:
        task: the filters, the smoother or None, inputs (steps, inputs), and which messages arrive, by fusion. The rows
            begin the recording: the filters start from their initial states.
        z: measurements (steps, node, received) by group.
        judged: True to leave out measurements that filters judge implausible.
    """
    filters, smoother, u, arrivals, _ = task
    # As few parts of at most ROWS rows as there can be, of one size, so that they share a program.
    count = -(-len(u) // ROWS)  # -(-a // b) is a / b, rounded up
    size = -(-len(u) // count)
    rows, states, parts = (np.arange(len(u)), u, z, arrivals), initial_states(filters), []
    for start in range(0, len(u), size):
        # The last part is filled with its last row, which does not count again.
        indices = np.minimum(np.arange(start, start + size), len(u) - 1)
        k, u_k, z_k, arrivals_k = jax.tree.map(lambda leaf, rows=indices: np.asarray(leaf)[rows], rows)
        # Of fusions between neighbours: which messages arrive, and the weights that follow from this.
        arrivals_k |= {
            name: (arrivals_k[name], mesh.compute_weights_of_steps(arrivals_k[name]))
            for name, mesh in filters.meshes.items()
        }
        is_counted = np.arange(start, start + size) < len(u)
        # The filters' states go on from part to part; rows that only fill up the last part change nothing.
        states, results = _part_by_xla(filters, states, (k, u_k, z_k, arrivals_k), judged, is_counted)
        parts.append(to_numpy(results))
    all_rows = jax.tree.map(lambda *leaves: np.concatenate(leaves)[: len(u)], *parts)
    return to_numpy(_collect_results(smoother, z, states, all_rows))


def _scan_all_rows(task: FilteringTask, z: tuple[np.ndarray, ...], judged: bool) -> PyTree:
    """Return the outputs of all filters for all rows by one scan over these, smoothed if the task has a smoother.

    `z`: measurements (steps, node, received) by group. `judged`: leave out measurements that are judged implausible.
    """
    return _collect_results(task.smoother, z, *_scan_to_the_end(task, z, judged))


def _scan_to_the_end(task: FilteringTask, z: tuple[np.ndarray, ...], judged: bool) -> tuple[PyTree, dict[str, PyTree]]:
    """Step over all rows of a recording: return the last states, and the results by row."""
    return _scan_rows(task.filters, task.first_states(), task.rows(z), judged)


def _scan_rows(
    filters: AllFilters, states: PyTree, rows: tuple[PyTree, ...], judged: bool, is_counted: np.ndarray | None = None
) -> tuple[PyTree, dict[str, PyTree]]:
    """Step over rows: return the last states, and the results by row.

    Args:
        filters: all filters of the network.
        states: their states before the first row.
        rows: (step numbers, inputs, measurements, arrivals), each with a leading axis of rows, as `FilteringTask.rows`
            returns them.
        judged: whether filters leave out measurements that they judge implausible.
        is_counted: flag of each row (rows,); False for a row that only fills up the scan and must change no state. None
            if all rows count.
    """

    def step_row(states: PyTree, row: tuple[PyTree, ...]) -> tuple[PyTree, PyTree]:
        """Return the states of all filters after one row, and their outputs.

        The row holds the step, inputs, measurements, what arrived of reports, and a flag. If the flag is False, the
        states stay as they are, as for rows that only fill up a scan. If it is None, all rows count. `judged`: True to
        leave out measurements that are judged implausible.
        """
        (k, u_k, z_k, arrivals), row_is_counted = row
        step = _step_judged if judged else _step_unjudged
        after, results = step((filters, None), states, (k, u_k, z_k, arrivals))
        if row_is_counted is not None:
            after = jax.tree.map(lambda new, old: jnp.where(row_is_counted, new, old), after, states)
        return after, results

    states, results = jax.lax.scan(step_row, states, (rows, is_counted))
    return states, results


def _collect_results(
    smoother: NetworkSmoother | None, z: tuple[np.ndarray, ...], state: PyTree, results: dict[str, PyTree]
) -> PyTree:
    """Return the filters' `results` by row, smoothed if there is a smoother, with measurements z and the last `state`.

    Judgements of measurements ("judged") are not smoothed: they stay as they are.
    """
    results = {"measurements": z, **results}
    judgements = {name: results.pop(name) for name in ("judged", "judged_centrally")}
    smoothed = results if smoother is None else smoother.smooth_run(results)
    return smoothed | judgements | {"state": state}


def find_central_states_before_rows(task: FilteringTask, z: tuple[np.ndarray, ...]) -> PyTree:
    """Return the states of the central filters before each row (steps, ...), by name of the filter.

    `z`: measurements (steps, node, received) by group of nodes.
    """
    rows = task.number_rows(), task.u, z, task.arrivals
    fixed = task.filters, None if task.begin is None else task.begin.states
    # Native code, or XLA where that refuses.
    _, central_states = scan_rows(_begin, _step_central, fixed, rows, lambda: _central_states_by_xla(fixed, rows))
    return central_states


def _step_central(fixed: tuple[AllFilters, PyTree], states: PyTree, row: tuple[PyTree, ...]) -> tuple[PyTree, PyTree]:
    """Return the states of all filters after a row, and the states of the central filters before it."""
    after, _ = _step_judged(fixed, states, row)
    _, central, *_ = states
    return after, central


def _collect_central_states(fixed: tuple[AllFilters, PyTree], rows: tuple[PyTree, ...]) -> tuple[PyTree, PyTree]:
    """Return the last states, and the states of the central filters, those of all measurements, before each row."""
    return jax.lax.scan(partial(_step_central, fixed), _begin(fixed), rows)


_by_xla, _scanned_by_xla = quickly_compiled(_scan_all_rows), quickly_compiled(_scan_to_the_end)
_part_by_xla = quickly_compiled(_scan_rows)
_central_states_by_xla = quickly_compiled(_collect_central_states)
