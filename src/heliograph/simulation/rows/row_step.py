"""Step of all filters of a network on rows of doubles: native code for many rows if possible, else XLA."""

from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.engine.choice import choose_code
from heliograph.filters.remark import Remark
from heliograph.numerics.check import fail, instance
from heliograph.numerics.float64 import in_float64, in_haste, understood
from heliograph.numerics.module import Module, readable
from heliograph.numerics.trees.flattened_trees import FlatLayout, flatten_to_row, make_flat_layout
from heliograph.numerics.trees.program_text import write_program_text
from heliograph.numerics.trees.tree_structure import Static, split_structure
from heliograph.numerics.types import Float, PyTree
from heliograph.simulation.description.filter_remarks import find_remarking_filters, yield_remarks
from heliograph.simulation.network import Network
from heliograph.simulation.network_filters import AllFilters, initial_states
from heliograph.simulation.recordings.implausible_data import step_plausibly
from heliograph.simulation.rows.output_columns import find_filter_columns
from heliograph.simulation.rows.row_history import RowHistory

OUTPUTS = "estimates", "fused", "judged", "judged_centrally", "weighed", "weighed_centrally", "tested"
TEXTS = 16  # programs held as text, of up to a megabyte each
TOGETHER = 16  # rows of one iteration of XLA's loop, which fill the vectors of a processor
WIDTH = 512  # rows of one call, at most
NUMBERS_TOGETHER, NUMBERS = 2**14, 2**18  # in the rows of an iteration and of a call: of long rows fewer are taken


class NetworkStep(Module):
    """Step of all filters of a network on one row.

    Args:
        network: the network.
        filters: its filters.

    Field `columns`: by group, the columns of a row that are each node's measurements (node, received).
    """

    filters: AllFilters
    columns: tuple[tuple[tuple[int, ...], ...], ...] = eqx.field(static=True)

    def __init__(self, network: Network, filters: AllFilters):
        """Store the filters and, by group of nodes, the indices of each node's components in the joined measurement."""
        self.filters = filters
        columns_by_group = []
        for names in network.groups:
            columns_by_group.append(tuple(tuple(network.rows[name]) for name in names))
        self.columns = tuple(columns_by_group)

    def step(self, state: PyTree, received: jax.Array, u: jax.Array, k: jax.Array) -> tuple[PyTree, PyTree]:
        """Return all filters' states after step k, without implausible measurements, and the outputs.

        `received`: measurements of all nodes in their order. The outputs are "estimates" by stack of filters and
        "fused" by name, and the judgements of the measurements, "judged" by stack and "judged_centrally" by name.
        Filters that weigh also have "weighed" by stack and "weighed_centrally" by name.
        """
        z = self.group_measurements(received)
        after, outputs = step_plausibly(self.filters, state, z, u, k)
        return after, {name: outputs[name] for name in OUTPUTS}

    def group_measurements(self, received: jax.Array) -> list[jax.Array]:
        """Return the measurements (node, received) of each group, from those of all nodes in their order."""
        return [received[np.array(columns, dtype=int)] for columns in self.columns]  # of nodes without a sensor none


class RowLayout(NamedTuple):
    """Structure of a network's step, and the columns of its rows: (state, received, inputs, step number).

    Args:
        static: all of a `NetworkStep` but its arrays.
        state: how the filters' states stand in the first columns.
        received: how many measurements follow.
        inputs: how many inputs follow these.
    """

    static: Static
    state: FlatLayout
    received: int
    inputs: int

    @property
    def size(self) -> int:
        """Length of a row before a step."""
        return self.state.size + self.received + self.inputs + 1

    def split_row(self, row: jax.Array) -> tuple[PyTree, jax.Array, jax.Array, jax.Array]:
        """Return the states of all filters, the measurements of all nodes, the inputs and the step number of a row.

        They stand side by side in it: `self.received` measurements, `self.inputs` inputs.
        """
        state, data_of_row = row[: self.state.size], row[self.state.size :]
        z, u = data_of_row[: self.received], data_of_row[self.received : self.received + self.inputs]
        k = data_of_row[-1].astype(np.int64)
        return self.state.tree(state), z, u, k


@readable
class RowStep:
    """A network's step as a pure function of rows, (state, received, inputs, step number) to (state, outputs).

    Each row is a world of its own: no bit of a result depends on the other rows of a call. The outputs are the
    estimates and each filter's judgement of what it received; a filter leaves out the measurements that it finds
    implausible. `start` is the state before the first step; `state` and `outputs` say how the two are laid out, and
    `columns` where each filter's estimate stands among the outputs.

    Args:
        network: the network; `received` are the measurements of its nodes in their order, NaN where nothing arrived.

    Raises:
        ValueError: what is no network; a fusion whose reports get lost by chance on their way to the centre.
    """

    @in_float64
    def __init__(self, network: Network):
        """Lay out state, measurement and outputs of one step of the network's filters in rows; compile the step.

        A row is an array of doubles: the states of all filters, the measurements of all nodes, the inputs and the
        step's number. One call steps many rows, such as those of many plants. Filters also judge whether measurements
        are plausible, and fused estimates are tested by what arrives after them.
        """
        instance("network", network, Network, "a Network")
        self._network = network
        received, inputs = sum(node.received for node in network.nodes.values()), len(network.inputs)
        filters = AllFilters(network, judges=True, tests=True)
        _check_reports(filters)
        start = initial_states(filters)
        # The step's arrays are arguments of the compiled program; all else of it, `static`, is part of the program.
        numbers, static = split_structure(NetworkStep(network, filters))
        self._shapes = tuple(_make_shape(leaf.shape, leaf.dtype) for leaf in numbers)
        self.state = make_flat_layout(start)
        self._layout = RowLayout(static, self.state, received, inputs)
        self.start = np.concatenate([np.zeros(0), *(np.ravel(leaf).astype(float) for leaf in jax.tree.leaves(start))])
        # A row of the result: the states, flattened to doubles, then the outputs.
        _, output_shapes = _trace_step(self._layout, self._shapes).out_info
        self.outputs = make_flat_layout(output_shapes)
        self.columns = find_filter_columns(network, self.outputs)
        # Native code (by `straightline`) with the network's numbers filled in; None if that cannot compile the step.
        self._numbers = [np.asarray(leaf) for leaf in numbers]
        row = np.zeros((1, self._layout.size))
        self._choice = choose_code(_make_row_function(self._layout), (self._numbers, row), differs_by_run=(False, True))
        code = self._choice.code
        self._code = None if code is None else code.with_first_arguments(*self._numbers)

    @property
    def engine(self) -> str:
        """Return which engine steps the filters, and why."""
        return self._choice.explanation

    @property
    def is_native(self) -> bool:
        """Return whether native code steps the filters, whose bits are the same for one row and for many."""
        return self._code is not None

    @property
    def _rows_of_call_and_iteration(self) -> tuple[int, int]:
        """Return how many rows one call of XLA's program takes, and how many one iteration of its loop.

        The length of a row alone decides, so that a result does not depend on the number of rows. An iteration steps at
        most TOGETHER rows in parallel, of at most NUMBERS_TOGETHER numbers in all; a call steps at most WIDTH rows, of
        at most NUMBERS numbers. Both are at least one row.
        """
        row_length = max(self._layout.size, self.state.size + self.outputs.size)  # before or after a step
        together = min(max(NUMBERS_TOGETHER // row_length, 1), TOGETHER)
        iterations = min(max(NUMBERS // (together * row_length), 1), WIDTH // together)
        return iterations * together, together

    @cached_property
    def remarking(self) -> tuple[tuple[str, str], ...]:
        """Return node and name of each filter that may say what happened to its state."""
        return find_remarking_filters(self._network)

    def read_remarks(self, state: Float[np.ndarray, " state"]) -> dict[tuple[str, str], Remark]:
        """Return what each of these filters says of its state, by node and name.

        Args:
            state: the states after a row, as they are laid out.
        """
        return dict(yield_remarks(self._network, self.state.tree(state)))

    @cached_property
    def program(self) -> str:
        """Return the step as text, which two processes compare to see that they compute the same."""
        return _write_step_text(self._layout, self._shapes)

    def history(
        self,
        rows: Float[np.ndarray, "row column"],
        state: Float[np.ndarray, "row state"],
        held: Float[np.ndarray, "row given"],
        step: Float[np.ndarray, " row"],
        outputs: Float[np.ndarray, "row output"],
    ) -> RowHistory:
        """Return the history of rows that a `RowSmoother` reads, with states and outputs as trees instead of rows.

        Args:
            rows: measurements of all nodes, inputs, and the time, one row after another in time.
            state: the filters' states after each row.
            held: inputs that apply from each row to the next.
            step: number of each row's step.
            outputs: the outputs after each row, as this step returned them.
        """
        return RowHistory(rows, self.state.tree(state), held, step.astype(int), self.outputs.tree(outputs))

    def for_one(self) -> "OneRowStep":
        """Return the step of one row at a time, which has memory of its own."""
        return OneRowStep(self, None if self._code is None else self._code.make_in_place_code(1))

    def __call__(self, rows: Float[np.ndarray, "row column"], alone: bool = False) -> Float[np.ndarray, "row column"]:
        """Return the states and outputs after each row of (state, received, inputs, step number), one below the other.

        Native code computes them, or XLA if there is none (`self._code` is None). The next call overwrites the result
        of native code. `alone`: rows come one at a time, so that XLA's program is one of a single row.
        """
        if self._code is not None:
            stepped: np.ndarray = self._code(rows)
            return stepped
        # XLA steps blocks of `width` rows, `together` rows in each iteration of a loop. The last block may have fewer
        # rows: then the loop ends after the iterations that have some.
        width, together = (1, 1) if alone else self._rows_of_call_and_iteration
        is_long = self._rows_of_call_and_iteration[1] == 1
        run = _compile_xla(self._layout, self.outputs, width, together, is_long)
        done, block = np.empty((len(rows), self.state.size + self.outputs.size)), np.zeros((width, rows.shape[1]))
        for begin in range(0, len(rows), width):
            count = min(width, len(rows) - begin)
            block[:count] = rows[begin : begin + count]
            iterations = np.int32(-(-count // together))
            with jax.enable_x64(True):
                stepped = run(self._numbers, block, iterations)
            done[begin : begin + count] = np.asarray(stepped)[:count]
        return done


class OneRowStep:
    """A network's step of one row at a time, in memory of its own where native code has it: the bits of `RowStep`.

    Args:
        steps: the step of many rows.
        code: native code for one run, None where XLA steps the filters.
    """

    def __init__(self, steps: RowStep, code: Any):
        """Hold the step of many rows and the native code for one; None where XLA runs it."""
        self._steps, self._code = steps, code

    def __call__(self, *parts: Float[np.ndarray, "1 columns"]) -> Float[np.ndarray, "1 column"]:
        """Return the states and outputs after one row, whose columns are those of `parts`, one part after another.

        Native code computes them, or XLA where there is none (`_code` is None). The next call overwrites the result.
        """
        if self._code is None:
            return self._steps(np.concatenate(parts, axis=1), alone=True)
        np.concatenate(parts, axis=1, out=self._code.inputs[0])
        self._code()
        stepped: np.ndarray = self._code.outputs[0]
        return stepped


def _check_reports(filters: AllFilters) -> None:
    """Raise ValueError if nodes report to a centre over random links.

    A report is an estimate that a node sends to a centre. A row says what a node measured, but not which report
    arrived: that could only be known of links without channels (`uplinks.groups` is empty).
    """
    for name, by_report in filters.reporting.items():
        if by_report.uplinks.groups:
            expected = "reports that arrive as they are sent, or the fusion as a filter (centre_filter)"
            raise fail(f"timeline: fusion {name!r}", expected, "links that chance has a part in")


def _make_shape(shape: tuple[int, ...], dtype: Any) -> Any:
    """Return a placeholder for an array of this shape and type, for JAX to trace with."""
    return jax.ShapeDtypeStruct(shape, dtype)  # type: ignore[no-untyped-call]


@lru_cache
def _make_step(layout: RowLayout) -> Any:
    """Return the compiled function (numbers, row) -> (states after the row, outputs) for networks of one structure.

    `numbers` are the arrays of a network's step. Networks that differ only in these share the function. Its trace
    serves the layout of the outputs, the native code and the program's text. `layout.static`: everything else of the
    step.
    """

    def step(numbers: list[jax.Array], row: jax.Array) -> tuple[PyTree, PyTree]:
        """Return states and outputs after a row, of the network whose step has these numbers as its arrays."""
        network_step = layout.static.with_arrays(numbers)  # the structure with these arrays put back into it
        stepped: tuple[PyTree, PyTree] = network_step.step(*layout.split_row(row))
        return stepped

    return jax.jit(step, inline=True)


@lru_cache
def _make_row_function(layout: RowLayout) -> Any:
    """Return the function (numbers, row) -> row of states and outputs; equal layouts get the same function.

    It is `_make_step` of this layout, with its results side by side in one array, as compiled code puts them out.
    `numbers` are the arrays of a network's step, such as its models' matrices. `layout`: everything else of the step,
    and where states, measurements, inputs and the step's number stand in a row.
    """

    def step(numbers: list[jax.Array], row: jax.Array) -> jax.Array:
        """Step a row; return states and outputs side by side."""
        states, outputs = _make_step(layout)(numbers, row)
        return jnp.concatenate([flatten_to_row(states), flatten_to_row(outputs)])

    return step


def _trace_step(layout: RowLayout, numbers: tuple[jax.ShapeDtypeStruct, ...]) -> Any:
    """Return the step of a row as JAX traces it; JAX keeps the trace for networks that differ only in numbers.

    `numbers`: shapes and types of the step's arrays. `layout`: everything else of it, and the length of a row.
    """
    with jax.enable_x64(True):
        return _make_step(layout).trace(list(numbers), _make_shape((layout.size,), np.float64))


@lru_cache(TEXTS)
def _write_step_text(layout: RowLayout, numbers: tuple[jax.ShapeDtypeStruct, ...]) -> str:
    """Return the step as text, once for networks that differ in numbers alone."""
    return write_program_text(_trace_step(layout, numbers).jaxpr)


@lru_cache
def _compile_xla(layout: RowLayout, outputs: FlatLayout, width: int, together: int, is_long: bool) -> PyTree:
    """Return XLA's program (numbers, rows, iterations) -> stepped rows, a loop that steps `together` rows at once.

    Each row of the table is stepped by itself: it holds states, measurements and inputs of one plant. The number of
    iterations is an argument, so that one program serves any number of rows up to `width`.

    Args:
        layout: the structure of the step, and where state, measurements and inputs stand in a row.
        outputs: how the outputs stand in a row.
        width: number of rows of an array that is passed.
        together: rows that each iteration steps in parallel.
        is_long: whether rows are so long that each is stepped alone: to optimise their program would take longer than
            all steps to come, so it is compiled quickly.
    """
    step = _make_row_function(layout)

    def run(numbers: list[jax.Array], rows: jax.Array, iterations: jax.Array) -> jax.Array:
        """Return (states, outputs) after each of the first `iterations` * `together` rows, zeros for the others.

        `numbers`: the arrays of a network's step.
        """

        def step_rows(i: jax.Array, done: jax.Array) -> jax.Array:
            """Return `done` with the `together` rows of iteration i stepped, in parallel, where they stand."""
            rows_of_iteration = jax.lax.dynamic_slice_in_dim(rows, i * together, together)
            stepped = jax.vmap(lambda row: step(numbers, row))(rows_of_iteration)
            return jax.lax.dynamic_update_slice_in_dim(done, stepped, i * together, axis=0)

        columns = layout.state.size + outputs.size
        stepped: jax.Array = jax.lax.fori_loop(0, iterations, step_rows, jnp.zeros((width, columns)))
        return stepped

    # `in_haste`: options of XLA that compile quickly, to slower code.
    return jax.jit(run, compiler_options=in_haste() if is_long else understood())
