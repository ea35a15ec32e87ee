"""All filters of a network over the rows of a recording: in one scan, in chunks side by side, or part after part."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.engine.choice import compute_once
from heliograph.filters.chunks import scan_in_chunks
from heliograph.filters.recursion import Recursion
from heliograph.model.forecast_origin import Origin
from heliograph.numerics.check import fail, instance
from heliograph.numerics.float64 import quickly_compiled, to_numpy
from heliograph.numerics.types import Array, PyTree
from heliograph.simulation.plausible_step import step_plausibly
from heliograph.simulation.results.record import Record
from heliograph.simulation.smoothed import NetworkSmoother
from heliograph.simulation.stepping import AllFilters, initial_states

EXPECTED = "what hg.run of this network returned for the rows before"
ROWS = 128  # of a recording with fusions between neighbours, whose weights are in memory at a time


class Begin(NamedTuple):
    """Where rows begin that go on behind others: the filters' states there, and the number of the first row."""

    states: PyTree
    step: np.ndarray


class FilteringTask(NamedTuple):
    """All that a recording is filtered with but its measurements: filters, smoother, inputs (steps, inputs), arrivals.

    `arrivals`: which reports arrived of each fusion by reports, and which messages of one between neighbours, by name.
    `begin`: of rows behind others; None of the first ones.
    """

    filters: AllFilters
    smoother: NetworkSmoother | None
    u: np.ndarray
    arrivals: dict[str, PyTree]
    begin: Begin | None = None

    def first_states(self) -> PyTree:
        """Return the states before the first of these rows."""
        return self.filters.init() if self.begin is None else jax.tree.map(jnp.asarray, self.begin.states)

    def rows(self, z: tuple[np.ndarray, ...]) -> tuple[PyTree, ...]:
        """Return the rows: their numbers, inputs, measurements, and what arrived."""
        numbers = jnp.arange(len(self.u))
        return numbers if self.begin is None else self.begin.step + numbers, self.u, z, self.arrivals


def origin_behind(filters: AllFilters, after: Record, smooths: bool) -> Origin:
    """Return the states behind earlier rows, of these filters.

    Raises:
        ValueError: no such record; smoothing, which needs all rows; a fusion whose messages may come rows later.
    """
    origin = instance("after", after, Record, EXPECTED).origin
    if origin is None:
        raise fail("after", EXPECTED, "a record without the last states of its filters")
    if smooths:
        raise fail("after", "no smoothing, which needs all rows at once", "smooth")
    if late := [*filters.reporting, *filters.meshes]:
        raise fail("after", "no fusion by reports or between neighbours, which may come rows later", late)
    if not origin.has_form_of(jax.eval_shape(filters.init)):
        raise fail("after", EXPECTED, "one of another network")
    return origin


def join_behind(origin: Origin | None, clock: np.ndarray) -> np.ndarray:
    """Return the times of rows behind that of the last one before them, where there is one.

    Raises:
        ValueError: their first time is before it, or is a date where that is a number, or the reverse.
    """
    if origin is None:  # nothing is before them
        return clock
    last, first = np.asarray(origin.time), clock[0]
    if last.dtype.kind != clock.dtype.kind or first < last:
        raise fail("time", f"rows behind {origin.time}, the last one before them", str(first))
    return np.append(last, clock)


def filter_rows(task: FilteringTask, z: tuple[np.ndarray, ...], judged: bool) -> PyTree:
    """Return what all filters made of a recording's rows, as NumPy arrays: what `AllFilters.step` puts out, by row.

    z are the measurements (steps, node, received) by group; if `judged`, what is implausible is left out. Beside them
    stand "measurements", z, and "state", the last one; with a smoother it is what `NetworkSmoother.smooth_run` returns.
    It is computed in chunks side by side, by native code, or by XLA.
    """
    results = None if judged else _filter_in_chunks(task, z)
    if results is not None:
        return results
    # XLA for a joint covariance: the graph, an argument here, decides where its blocks are stored.
    by_xla = any(mesh.is_long or mesh.needs_joint for mesh in task.filters.meshes.values())
    return _scan_in_parts(task, z, judged) if by_xla else compute_once(_run_filters, _by_xla, (task, z, judged))


class NetworkRecursion(Recursion):
    """Recursion of all filters of a network over rows; each row's output is all that they estimate and judge."""

    filters: AllFilters
    begin: Array

    def step(self, state: PyTree, row: tuple[PyTree, Array], k: Array) -> tuple[PyTree, PyTree]:
        """Step all filters over one row; return their states and what is recorded of them."""
        z, u = row
        return self.filters.step(state, z, jnp.asarray(u), jnp.asarray(self.begin + k), {})


def _filter_in_chunks(task: FilteringTask, z: tuple[np.ndarray, ...]) -> PyTree | None:
    """Return what `filter_rows` does, of rows in chunks side by side; None where that cannot be.

    All filters must be linear, and take each measurement as it is; results are not smoothed, and rows are many.
    """
    if task.smoother is not None or not task.filters.are_linear_and_unfused:
        return None
    begin = task.begin or Begin(initial_states(task.filters), np.asarray(0))
    filtered = scan_in_chunks(NetworkRecursion(task.filters, begin.step), to_numpy(begin.states), (z, task.u))
    return None if filtered is None else _collect_results(None, z, *filtered)


def _scan_in_parts(task: FilteringTask, z: tuple[np.ndarray, ...], judged: bool) -> PyTree:
    """Return what `filter_rows` does, by XLA, some rows at a time, whose weights between neighbours come ahead."""
    filters, smoother, u, arrivals, _ = task  # rows of such a network are behind no others
    # As few parts of at most ROWS rows as there can be, of one size, so that they share a program.
    count = -(-len(u) // ROWS)
    size = -(-len(u) // count)
    rows, states, parts = (np.arange(len(u)), u, z, arrivals), initial_states(filters), []
    for start in range(0, len(u), size):
        # The last part is filled with its last row, which does not count again.
        indices = np.minimum(np.arange(start, start + size), len(u) - 1)
        k, u_k, z_k, drawn = jax.tree.map(lambda leaf, rows=indices: np.asarray(leaf)[rows], rows)
        drawn |= {name: (drawn[name], mesh.compute_weights_ahead(drawn[name])) for name, mesh in filters.meshes.items()}
        counts = np.arange(start, start + size) < len(u)
        states, results = _scanned_by_xla(filters, states, (k, u_k, z_k, drawn), judged, counts)
        parts.append(to_numpy(results))
    all_rows = jax.tree.map(lambda *leaves: np.concatenate(leaves)[: len(u)], *parts)
    return to_numpy(_collect_results(smoother, z, states, all_rows))


def _run_filters(task: FilteringTask, z: tuple[np.ndarray, ...], judged: bool) -> PyTree:
    """Return what `filter_rows` does, of all rows in one scan."""
    return _collect_results(task.smoother, z, *_scan_rows(task.filters, task.first_states(), task.rows(z), judged))


def _scan_rows(
    filters: AllFilters, states: PyTree, rows: tuple[PyTree, ...], judged: bool, counts: np.ndarray | None = None
) -> tuple[PyTree, dict[str, PyTree]]:
    """Step over rows: return the last states, and the results by row; rows that do not count change no state."""

    def step_row(states: PyTree, row: tuple[PyTree, ...]) -> tuple[PyTree, PyTree]:
        (k, u_k, z_k, drawn), row_counts = row
        step = step_plausibly if judged else AllFilters.step
        after, results = step(filters, states, z_k, u_k, k, drawn)
        if row_counts is not None:
            after = jax.tree.map(lambda new, old: jnp.where(row_counts, new, old), after, states)
        return after, results

    states, results = jax.lax.scan(step_row, states, (rows, counts))
    return states, results


def _collect_results(
    smoother: NetworkSmoother | None, z: tuple[np.ndarray, ...], state: PyTree, results: dict[str, PyTree]
) -> PyTree:
    """Return what the filters judged, their last state, and their results, smoothed if there is a smoother."""
    results = {"measurements": z, **results}
    judged = {name: results.pop(name) for name in ("judged", "judged_centrally")}
    return (results if smoother is None else smoother.smooth_run(results)) | judged | {"state": state}


def central_states_before_rows(task: FilteringTask, z: tuple[np.ndarray, ...]) -> PyTree:
    """Return the states of the central filters before each row, by name; z as of `filter_rows`."""
    return compute_once(_collect_central_states, _central_states_by_xla, (task._replace(smoother=None), z))


def _collect_central_states(task: FilteringTask, z: tuple[np.ndarray, ...]) -> PyTree:
    """Return the states of the central filters before each row."""

    def step(states: PyTree, row: tuple[PyTree, ...]) -> tuple[PyTree, PyTree]:
        """Step all filters; the central ones' states before the step are the output."""
        k, u_k, z_k, drawn = row
        return step_plausibly(task.filters, states, z_k, u_k, k, drawn)[0], states[1]

    before: PyTree = jax.lax.scan(step, task.first_states(), task.rows(z))[1]
    return before


_by_xla, _scanned_by_xla = quickly_compiled(_run_filters), quickly_compiled(_scan_rows)
_central_states_by_xla = quickly_compiled(_collect_central_states)
