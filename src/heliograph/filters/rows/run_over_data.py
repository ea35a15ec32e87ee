"""Run a filter over rows of data: one scan, and the estimates and innovations that it returns."""

import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.engine.choice import compile_on_call, scan_rows
from heliograph.engine.size_thresholds import SHORT
from heliograph.filters.rows.chunks import ScanResult, filter_in_chunks
from heliograph.filters.rows.linear_recursion import initial_state_if_linear
from heliograph.model.checks.plant_inputs import check_inputs
from heliograph.model.checks.row_times import find_common_dates, read_row_dates
from heliograph.model.estimate import Claim, Estimate, Innovation
from heliograph.model.forecast_origin import (
    KeptOrigin,
    Origin,
    find_median_spacing,
    find_months_between_rows,
    last_input,
)
from heliograph.numerics.check import fail, instance
from heliograph.numerics.float64 import as_array, quickly_compiled, refuse_forked_process
from heliograph.numerics.linalg import find_not_finite
from heliograph.numerics.module import readable
from heliograph.numerics.numpy_or_jax import is_traced
from heliograph.numerics.times.data_row_checks import check_rows
from heliograph.numerics.trace_settings import KEPT
from heliograph.numerics.types import Array, ArrayLike, Float, PyTree

Rows = np.ndarray  # an entry for each step along the first axis
FEW = 10  # with a lower effective number of particles their mean and covariance say nothing


class SteppedFilter(Protocol):
    """Filter as a scan over rows reads it."""

    @property
    def claim(self) -> Claim:
        """What the filter claims of its covariances."""

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of its inputs."""

    @property
    def received(self) -> int:
        """Length of the filter's measurement z."""

    @property
    def horizon(self) -> int | None:
        """Number of steps that it covers."""

    def init(self) -> PyTree:
        """Return the filter's state before the first row."""

    def predict(self, state: PyTree, u: ArrayLike, k: Array) -> PyTree:
        """Return the state predicted over step k with the input u."""

    def correct(self, state: PyTree, z: ArrayLike, k: Array) -> tuple[PyTree, Innovation]:
        """Return the state corrected with the measurement z of step k, and the innovation."""

    def after_step(self, state: PyTree, k: Array) -> Estimate:
        """Return mean and covariance of the plant's state after step k."""

    def filter_rows(self, z: Array, u: Array, state: PyTree | None = None, begin: Array | int = 0) -> ScanResult | None:
        """Return last state and outputs of rows by native code of the filter's own; None where it has none."""


@readable
@dataclass(frozen=True)
class Filtered:
    """Estimates and innovations of a filter over rows of data: row k is given the rows up to k.

    Args:
        means: posterior means (steps, n).
        covariances: what is claimed of their errors (steps, n, n).
        innovations: z - E[z | earlier rows] (steps, received), NaN for what did not arrive.
        innovation_covariances: (steps, received, received).
        log_likelihoods: log p(z_k | earlier rows) of each row (steps,), in nats.
        claim: what the covariances are: "exact", "upper", "nominal" or "none".
        weights: of each component in its update (steps, received), from 0 (left out) to 1 (in full); None of a filter
            that weighs nothing.
        origin: the state after the last row, from which `hg.forecast` predicts; None where it was not kept.
        modes: probabilities of the modes (steps, M); None of a filter that weighs none.
        effective_numbers: of particles after each row (steps,), 1 / sum of the squared weights; None of a filter
            without particles of the state.
    """

    means: "Rows"
    covariances: "Rows"
    innovations: "Rows"
    innovation_covariances: "Rows"
    log_likelihoods: "Rows"
    claim: "Claim"
    weights: "Array | None" = None
    origin: "KeptOrigin" = field(default=None, compare=False, repr=False)
    modes: "Array | None" = None
    effective_numbers: "Array | None" = None

    @property
    def log_likelihood(self) -> float:
        """log p(z_1, z_2, ...): the sum over the rows."""
        return float(np.sum(self.log_likelihoods))


def scan_inside_jit(
    filter: SteppedFilter,
    z: Float[Array, "steps received"],
    u: Float[Array, "steps inputs"],
    output: Callable[[PyTree, Innovation, jax.Array], PyTree],
) -> PyTree:
    """Step a filter over rows inside a compiled computation, without checks; return the outputs of all rows, stacked.

    The output of row k is output(state after it, innovation, k).
    """
    _, outputs = scan_with_last_state(filter, z, u, output)
    return outputs


def scan_with_last_state(
    filter: SteppedFilter,
    z: Float[Array, "steps received"],
    u: Float[Array, "steps inputs"],
    output: Callable[[PyTree, Innovation, jax.Array], PyTree],
    state: PyTree | None = None,
    begin: Array | int = 0,
) -> tuple[PyTree, PyTree]:
    """Step a filter over rows; return its state after the last row, and the outputs of all rows, stacked.

    Args:
        filter: the filter.
        z: measurements, NaN for what did not arrive.
        u: inputs.
        output: a function that returns what is kept of a row, from the state after it, its innovation and its number k.
        state: the filter's state before the first row; by default that before any data.
        begin: number of the first row.
    """

    # A derivative backwards keeps of each row the state before it, say 17 numbers, and computes the row again. To keep
    # all some 540 numbers of the row takes longer, as they are stored and read. Factors of the noises are kept, which
    # are mostly the same in every row.
    @partial(jax.checkpoint, prevent_cse=False, policy=jax.checkpoint_policies.save_only_these_names(KEPT))
    def step(state: PyTree, row: tuple[jax.Array, ...]) -> tuple[PyTree, PyTree]:
        """Predict and correct over one row (number, measurement, input); return the state after it, and its output.

        For a derivative the step is computed again, and only values with a name in KEPT are kept in memory.
        """
        k, z_k, u_k = row
        prior = filter.predict(state, u_k, k)
        after, innovation = filter.correct(prior, z_k, k)
        return after, output(after, innovation, k)

    start = jax.tree.map(jnp.asarray, filter.init() if state is None else state)
    numbers = jnp.asarray(begin) + jnp.arange(len(z))
    last, outputs = jax.lax.scan(step, start, (numbers, jnp.asarray(z), jnp.asarray(u)))
    return last, outputs


def run_over_data(filter: SteppedFilter, z: ArrayLike, u: ArrayLike | None, after: Filtered | None = None) -> Filtered:
    """Run a filter over rows of data, by native code where the filter has it; return estimates and innovations.

    Args:
        filter: the filter.
        z: measurements (rows, received), an array or a table; NaN for what did not arrive.
        u: inputs (rows, inputs); None of a filter without any.
        after: result of the rows before these, if the filter goes on from its last state; None to begin anew.
    """
    # The state and step number at the end of earlier rows, if there are any.
    before = None if after is None else _find_origin_of_earlier_result(filter, after)
    begin = 0 if before is None else int(before.step)
    rows_z, rows_u = check_data(filter, z, u, begin)
    # Dates of the rows, if the data are tables with a time index; they must go on from the earlier rows.
    dates = find_common_dates(_name_tables(z, u))
    dates = None if dates is None or not len(dates) else dates  # a table without rows says no time
    if before is not None and dates is not None:
        _check_dates_increase(before, dates)
    # The state before the first row: that behind the earlier rows, or of a linear filter its start, which is known.
    state = initial_state_if_linear(filter) if before is None else before.state
    start = () if state is None else (state, np.asarray(begin))
    # Three ways, the fastest first: chunks side by side, the filter's own native code for rows, one scan. The first two
    # return None where they do not apply.
    result = filter_in_chunks(filter, rows_z, rows_u, _collect_row_results, *start)
    result = result or filter.filter_rows(rows_z, rows_u, *start)
    state, outputs = result or step_over_known_rows(filter, rows_z, rows_u, _collect_row_results, start)
    estimate, innovation, counts = outputs
    # Warn of estimates that are no numbers, and of particle filters whose weight is on few particles.
    _warn_of_lost_estimate(filter, estimate.mean, begin)
    if counts is not None:
        _warn_of_few_particles(counts, innovation.log_likelihood, begin)
    return Filtered(
        means=estimate.mean,
        covariances=estimate.covariance,
        innovations=innovation.value,
        innovation_covariances=innovation.covariance,
        log_likelihoods=innovation.log_likelihood,
        claim=filter.claim,
        weights=innovation.weight,
        origin=_make_end_origin(filter, state, begin + len(rows_z), rows_u, dates),
        modes=estimate.modes,
        effective_numbers=counts,
    )


def step_over_known_rows(
    filter: SteppedFilter,
    z: Array,
    u: Array,
    output: Callable[[Any, PyTree, Innovation, Array], PyTree],
    start: tuple[PyTree, Array] | tuple[()] = (),
) -> tuple[PyTree, PyTree]:
    """Step a filter over rows of known numbers (not traced by JAX); return the last state and the outputs, stacked.

    Native code that is compiled once serves any number of rows; XLA scans them if the filter has other operations.

    Args:
        filter: the filter.
        z: measurements (rows, received).
        u: inputs (rows, inputs).
        output: what is kept of a row, a function of a module, of the filter, its state after the row, the innovation
            and the row's number.
        start: the state before the first row, and the number of that row; by default those before any data.
    """
    begin = start[1] if start else 0
    rows = np.asarray(begin + np.arange(len(z))), z, u
    stepped: tuple[PyTree, PyTree] = scan_rows(
        _begin, _step, (filter, output, *start), rows, lambda: _by_xla(filter, output, z, u, *start)
    )
    return stepped


def step_over_row(filter: Any, state: PyTree, z: Array, u: Array, k: Array) -> tuple[PyTree, Estimate]:
    """Predict and correct over row k of data; return state and estimate. This is the body of a filter's `step`.

    A linear filter's step is computed by the code of its runs, if that is short: it has the bits of a run, and after a
    run nothing is compiled.
    """
    if filter.is_linear and not is_traced(filter, state, z, u, k):
        refuse_forked_process()
        fixed, row = (filter, _collect_row_results, jax.tree.map(as_array, state), k), (k[None], z[None], u[None])
        if found := scan_rows(_begin, _step, fixed, row, by_xla=lambda: None, most=SHORT):
            after, (estimate, *_) = found
            return after, jax.tree.map(lambda leaf: leaf[0, ...], estimate)
    return _step_alone(filter, state, z, u, k)


@compile_on_call
def _step_alone(filter: Any, state: PyTree, z: Array, u: Array, k: Array) -> tuple[PyTree, Estimate]:
    """Return state and estimate after row k, compiled for one row."""
    after, _ = filter.correct(filter.predict(state, u, k), z, k)
    return after, filter.after_step(after, k)


def _begin(fixed: tuple[Any, ...]) -> PyTree:
    """Return the state before the first row: the given one, or else the filter's own.

    `fixed` is what is the same for all rows: filter, output function, and perhaps the first state and row number.
    """
    filter, _, *start = fixed
    return jax.tree.map(jnp.asarray, start[0] if start else filter.init())


def _step(fixed: tuple[Any, ...], state: PyTree, row: tuple[Array, ...]) -> tuple[PyTree, PyTree]:
    """Return the state after a row (number, measurement, input), and the row's output.

    `fixed` is what is the same for all rows: filter, output function, and perhaps the first state and row number.
    """
    filter, output, *_ = fixed
    k, z, u = row
    after, innovation = filter.correct(filter.predict(state, u, k), z, k)
    return after, output(filter, after, innovation, k)


def _make_end_origin(filter: SteppedFilter, state: PyTree, end: int, u: Array, dates: np.ndarray | None) -> Origin:
    """Return the end of a run, from which a later run or a forecast goes on: state, step, last inputs, last time.

    Args:
        filter: the filter.
        state: its state after the last row.
        end: number of the row after the last one.
        u: inputs (rows, inputs).
        dates: of the rows; None where they have none, and their numbers are their times.
    """
    if dates is None:
        last_time, spacing, months = float(end - 1), np.nan, 0
    else:
        # 0 months: the spacing is not in calendar months.
        last_time, spacing, months = dates[-1], find_median_spacing(dates), find_months_between_rows(dates)
    return Origin(
        model=filter,
        state=state,
        step=end,
        inputs=last_input(np.asarray(u)),
        time=last_time,
        spacing=spacing,
        months=months,
    )


def _warn_of_lost_estimate(filter: SteppedFilter, mean: np.ndarray, begin: int) -> None:
    """Warn if means (rows, n) are not finite, and say from which row on; `begin` rows were before these.

    `hg.run` judges each value and leaves out what is implausible, but `filter.run` does not.
    """
    is_invalid = find_not_finite(mean, axes=1)
    if is_invalid.any():
        row = begin + int(np.argmax(is_invalid)) + 1
        finding = f"{type(filter).__name__}: the estimate is no finite number from row {row} on"
        warnings.warn(f"{finding}; hg.run leaves out what makes it so, and says which row and why", stacklevel=4)


def _find_origin_of_earlier_result(filter: SteppedFilter, after: Filtered) -> Origin:
    """Return the state and step number at which an earlier result of this filter ended, from which `run` goes on.

    Raises:
        ValueError: a result without them, or one of another kind of filter (another form of its state).
    """
    expected = "what `run` of this filter returned for the rows before"
    origin = instance("after", after, Filtered, expected).origin
    if origin is None:
        raise fail("after", expected, "a result without the state after its last row")
    if not isinstance(origin.model, type(filter)) or not origin.has_form_of(filter.init()):
        raise fail("after", expected, f"one of another filter, {type(origin.model).__name__}")
    return origin


def _check_dates_increase(before: Origin, dates: np.ndarray) -> None:
    """Raise ValueError unless the first date is after that of the last row before, if that row has a date."""
    if isinstance(before.time, np.datetime64) and not dates[0] > before.time:
        raise fail("measurements", f"rows behind {before.time}, the last one before them", str(dates[0]))


def _warn_of_few_particles(counts: Array, log_likelihoods: Array, begin: int) -> None:
    """Warn of rows that no particle explains, and of rows with an effective number of particles below FEW, 10.

    A row that no particle explains has the log-likelihood -inf. `begin` rows were before these rows.
    """
    unused_rows = begin + 1 + np.flatnonzero(np.isneginf(np.asarray(log_likelihoods)))
    rows_of_few = begin + 1 + np.flatnonzero(np.asarray(counts) < FEW)
    if len(unused_rows):
        finding = f"particle_filter: {len(unused_rows)} of the rows are not used, first row {unused_rows[0]}"
        warnings.warn(f"{finding}: no particle explains what arrived, and the state stays as it was", stacklevel=4)
    if len(rows_of_few):
        smallest = float(np.min(np.asarray(counts)))
        affected_rows = f"{len(rows_of_few)} of the rows, first row {rows_of_few[0]}"
        finding = f"particle_filter: fewer than {FEW} particles count after {affected_rows} ({smallest:.2g} at least)"
        warnings.warn(f"{finding}; take more of them", stacklevel=4)


def _compute_rows(
    filter: SteppedFilter,
    output: Callable[[Any, PyTree, Innovation, Array], PyTree],
    z: Array,
    u: Array,
    state: PyTree | None = None,
    begin: Array | int = 0,
) -> PyTree:
    """Compute what `step_over_known_rows` does, in a program of XLA.

    `begin` is the number of the first row, and `state` the state before it (None: that before any data).
    """
    return scan_with_last_state(filter, z, u, partial(output, filter), state, begin)


def _collect_row_results(filter: SteppedFilter, state: PyTree, innovation: Innovation, k: Array) -> PyTree:
    """Return what is kept of a row: the estimate, the innovation, and the effective number of particles or None."""
    return filter.after_step(state, k), innovation, getattr(state, "effective_number", None)


_by_xla = quickly_compiled(_compute_rows)


def check_data(
    filter: SteppedFilter, measurements: ArrayLike, inputs: ArrayLike | None, begin: int = 0
) -> tuple[Float[Array, "steps received"], Float[Array, "steps inputs"]]:
    """Return measurements and inputs of a filter as arrays of rows; without inputs the filter must take none.

    If the rows of a table have dates, these must be in order, be the same in both tables, and have equal steps unless
    there is an input dt. `begin` rows were before these rows.
    """
    read_row_dates(filter.inputs, _name_tables(measurements, inputs))
    z = check_rows("measurements", measurements, None, filter.received or None, missing=True)
    z = z if filter.received else z[:, :0]
    # A filter without inputs gets rows of length 0. For any other filter `check_rows` refuses None.
    rows_of_inputs = np.zeros((len(z), 0)) if inputs is None and not filter.inputs else inputs
    u = check_rows("inputs", rows_of_inputs, len(z), len(filter.inputs), missing=False, names=filter.inputs)
    check_inputs(filter.inputs, u, filter)
    if filter.horizon is not None and begin + len(z) > filter.horizon:
        raise fail("measurements", f"at most {filter.horizon} steps, which the filter covers", begin + len(z))
    return z, u


def _name_tables(measurements: object, inputs: object) -> dict[str, object]:
    """Return the tables of a call by the names that errors use."""
    return {"measurements": measurements, "inputs": inputs}
