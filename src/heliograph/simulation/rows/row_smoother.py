"""Smoothed estimates after a row, given the rows after it: a sweep back over the history of the rows.

Where the plant has a time step dt as input, a row is one step of it; where time counts steps, there may be steps
without measurements between rows.
"""

from collections.abc import Callable
from functools import lru_cache
from typing import TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.engine.choice import choose_code, map_arrays, read_forced_engine
from heliograph.filters.base import AbstractFilter
from heliograph.filters.smoother_step import SmootherStep
from heliograph.fusion.network_fusion import Fusion
from heliograph.model.estimate import Claim, Estimate, lower_unsound_claim
from heliograph.numerics.check import InputError, fail, instance, is_whole, show_value
from heliograph.numerics.float64 import to_numpy, understood
from heliograph.numerics.module import Module, readable
from heliograph.numerics.trees.tree_structure import Static, split_structure
from heliograph.numerics.types import PyTree
from heliograph.simulation.centres.fusions import StackedFusions
from heliograph.simulation.network import Network
from heliograph.simulation.network_filters import AllFilters
from heliograph.simulation.recordings.implausible_data import read_refusal_reasons
from heliograph.simulation.rows.row_history import RowHistory
from heliograph.simulation.rows.row_step import NetworkStep

NetworkSmootherStep: TypeAlias = "tuple[dict[int, SmootherStep], dict[str, SmootherStep]]"  # by stack, and by name


class BackwardSweep(Module):
    """What a sweep back over rows computes with.

    Args:
        network_step: step of the network's filters that can be smoothed.
        fusions: of their estimates.
        stacks: numbers of the stacks that can be smoothed.
    """

    network_step: NetworkStep
    fusions: tuple[StackedFusions, ...]
    stacks: tuple[int, ...] = eqx.field(static=True)

    def step(
        self, history: RowHistory, row: jax.Array, state: PyTree, received: jax.Array, u: jax.Array, k: jax.Array
    ) -> tuple[PyTree, NetworkSmootherStep]:
        """Step all filters by step k, at or before a row, without measurements that they refused in this row.

        Args:
            history: the rows, with the filters' states and outputs after each.
            row: number of the row.
            state: states of the filters before the step.
            received: measurements of all nodes at step k.
            u: inputs of the plant over the step.
            k: number of the step: the row's own, or an earlier one.

        Returns:
            The filters' states after the step, and their smoother steps.
        """
        # Refuse again the measurements that were refused when the row was filtered. Reasons are by stack of the nodes'
        # filters (a stack of one structure), and by name of central ones.
        by_stack, central = read_refusal_reasons(jax.tree.map(lambda leaf: leaf[row], history.outputs))
        skip = by_stack, {name: central[name] for name in self.network_step.filters.central}
        z = self.network_step.group_measurements(received)
        after, outputs = self.network_step.filters.step(state, z, u, k, skip=skip)
        steps_by_stack = {stack: outputs["smoother_steps"][stack] for stack in self.stacks}
        return after, (steps_by_stack, outputs["central_steps"])

    def states_after(self, history: RowHistory, row: jax.Array) -> PyTree:
        """Return the states after a row of the filters that can be smoothed, in the form in which a step takes them.

        That is a tuple of six: states of the nodes' filters by stack (filters of one structure), and of central ones by
        name; the states of quantizers, centres, fusions by message, and fused estimates under test are empty, since
        nothing is fused here.
        """
        by_stack, central, *_ = history.state_after(row)
        central_states = {name: central[name] for name in self.network_step.filters.central}
        quantizers, centres, exchanges, tested = (), (), dict[str, PyTree](), dict[str, PyTree]()
        return by_stack, central_states, quantizers, centres, exchanges, tested

    def make_estimates(
        self, steps: NetworkSmootherStep, later: PyTree
    ) -> tuple[dict[int, Estimate], dict[str, Estimate]]:
        """Return the smoothed estimates after a step, those of nodes by stack, central and fused ones by name.

        `steps`: the smoother steps into it, which hold what each filter's backward pass needs. `later`: for each
        filter, the Gaussian law of the state given all data, in the same form.
        """
        by_stack, central = _map_filters(lambda step, later: step.estimate_from(later), steps, later)
        # Fusions find estimates by the number of the stack. Stacks that cannot be smoothed are None, and are not fused.
        estimates_by_stack = [by_stack.get(stack) for stack in range(max(self.stacks, default=-1) + 1)]
        for fusion in self.fusions:
            no_state, step_number = (), jnp.asarray(0)
            _, fused, _ = fusion.step(no_state, estimates_by_stack, step_number)
            central |= fused
        return by_stack, central


def _map_filters(function: Callable[..., object], steps: NetworkSmootherStep, *rest: PyTree) -> PyTree:
    """Return function(smoother step, ...) of every filter, as a pair: nodes' filters by stack, central ones by name.

    Results of a stack have leading axes (filter, node). `rest`: further arguments of the function, each a pair like
    `steps`.

    A stack has filters that differ in numbers alone. A smoother step is what the backward pass needs of a filter's
    step.
    """
    steps_by_stack, central_steps = steps
    function_of_stack = jax.vmap(jax.vmap(function))  # over filters and nodes
    by_stack = {}
    for stack, step in steps_by_stack.items():
        by_stack[stack] = function_of_stack(step, *(rest_by_stack[stack] for rest_by_stack, _ in rest))
    central = {}
    for name, step in central_steps.items():
        central[name] = function(step, *(rest_by_name[name] for _, rest_by_name in rest))
    return by_stack, central


StepOfRow: TypeAlias = "tuple[jax.Array, jax.Array]"  # a row, and a step at it or before it
StepInto: TypeAlias = "Callable[[BackwardSweep, RowHistory, StepOfRow], NetworkSmootherStep]"


@lru_cache
def make_backward_sweep(static: Static, dt: int | None) -> tuple[Callable[..., PyTree], Callable[..., PyTree]]:
    """Return the function that smooths rows, and XLA's program of it.

    It takes the arrays of a `BackwardSweep`, the history, and (begin, stop), and returns the estimates after row
    `begin` > 0 given the rows after it, up to `stop`. The smoother's terms of a step are computed again from the state
    before it, and so are the steps between rows where time counts steps.

    Args:
        static: all of a `BackwardSweep` but its arrays.
        dt: place of the time step among the inputs; None where time counts steps.
    """
    # Continuous time: one step per row. Discrete time: also the steps between the rows.
    step_into: StepInto = _compute_step_into_k if dt is None else _make_step_into_row(dt)
    find_earlier = _find_earlier_step if dt is None else _find_earlier_row

    def run(numbers: list[jax.Array], history: RowHistory, span: jax.Array) -> PyTree:
        """Smooth rows from the last one back; return the estimates after the first. `span`: (begin, stop).

        `numbers`: the arrays of the `BackwardSweep`. `history`: the rows, with the states after each.
        """
        sweep: BackwardSweep = static.with_arrays(numbers)
        begin, stop = span
        last_row = stop - 1, history.step[stop - 1]
        # How many steps lead from the last row back to row `begin`.
        count = stop - 1 - begin if dt is not None else history.step[stop - 1] - history.step[begin]
        # The loop begins with zeros in the shapes of a smoother step, which are found without computing one.
        shapes = jax.eval_shape(lambda: step_into(sweep, history, last_row))
        zeros = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)

        def step_back(
            i: jax.Array, carry: tuple[StepOfRow, NetworkSmootherStep, PyTree]
        ) -> tuple[StepOfRow, NetworkSmootherStep, PyTree]:
            """Go one step back: return x_k|N, from x_(k+1)|N and the smoother step into k + 1.

            `i` counts steps back from 0; at i = 0 the result is x_N|N, the filters' own estimates. The carry holds the
            step k + 1 (row and number), the smoother step into it, and x_(k+1)|N of each filter.
            """
            place, steps_after, later = carry
            steps = step_into(sweep, history, place)
            # Smooth with the later estimate, except at the last row, where the filter's own estimate has all data.
            smoothed = _map_filters(lambda step, later: step.back(later), steps_after, later)
            filtered = _map_filters(lambda step: step.end, steps)
            later = jax.tree.map(lambda last, back: jnp.where(i == 0, last, back), filtered, smoothed)
            return find_earlier(history, place), steps, later

        start = last_row, zeros, _map_filters(lambda step: step.end, zeros)
        _, steps, later = jax.lax.fori_loop(0, count + 1, step_back, start)
        return sweep.make_estimates(steps, later)

    return run, jax.jit(run, compiler_options=understood())


def _make_step_into_row(dt: int) -> StepInto:
    """Return the function that computes the terms of the backward pass for the step that ends at a row.

    It is for plants whose steps are of any length: one step leads from each row to the next. `dt`: index among the
    inputs of that length.
    """

    def step_into_row(sweep: BackwardSweep, history: RowHistory, step_of_row: StepOfRow) -> NetworkSmootherStep:
        """Filter one row again from the states after the row before, and return the terms of the backward pass.

        `step_of_row`: the row, and the number of its step, which is not needed here. The terms are, for each filter,
        what a smoother needs of the step to go back over it.
        """
        row, _ = step_of_row
        state = sweep.states_after(history, row - 1)
        received, _, _ = history.read_row(row)
        u = history.inputs_into_row(row, dt)
        _, smoother_steps = sweep.step(history, row, state, received, u, history.step[row])
        return smoother_steps

    return step_into_row


def _find_earlier_row(history: RowHistory, step_of_row: StepOfRow) -> StepOfRow:
    """Return the row before, with the number of its step."""
    row, _ = step_of_row
    return row - 1, history.step[row - 1]


def _compute_step_into_k(sweep: BackwardSweep, history: RowHistory, step_of_row: StepOfRow) -> NetworkSmootherStep:
    """Return the terms of the backward pass for step k, of a plant whose time counts steps.

    Between two rows there may be many steps, in which nothing was measured. The filters' states are known after rows
    alone, so all steps after the previous row are filtered again, up to k.

    `step_of_row`: (row, k), the first row whose step is k or later, and k.
    """
    row, k = step_of_row

    def filter_step_j(j: jax.Array, state: PyTree) -> PyTree:
        """Return the filters' states after step j, in which nothing was measured."""
        after, _ = sweep.step(history, row, state, *history.read_step(row, j), j)
        return after

    first_step = history.step[row - 1] + 1  # after the previous row
    state = jax.lax.fori_loop(first_step, k, filter_step_j, sweep.states_after(history, row - 1))
    _, smoother_steps = sweep.step(history, row, state, *history.read_step(row, k), k)
    return smoother_steps


def _find_earlier_step(history: RowHistory, step_of_row: StepOfRow) -> StepOfRow:
    """Return (row, k - 1) from (row, k): the first row whose step is k - 1 or later, and that step."""
    row, k = step_of_row
    is_step_of_previous_row = k - 1 == history.step[row - 1]
    return jnp.where(is_step_of_previous_row, row - 1, row), k - 1


@readable
class RowSmoother:
    """A network's smoothed estimates after a row, given later ones: a pure function of the rows' history.

    Filters that keep no covariance are left out. One program serves all histories of one length.

    Args:
        network: the network.
        dt: place of the time step among the inputs; None where time counts steps.

    Raises:
        ValueError: no network, no place of an input, no filter that can be smoothed.
    """

    def __init__(self, network: Network, dt: int | None):
        """Prepare the backward sweep of the network's filters as arrays and code; `dt`: index of the time step in u.

        The sweep smooths a history of rows from the last to the first, the filters of all nodes side by side. A stack
        has filters that differ in numbers alone; a central filter uses the measurements of all nodes.
        """
        instance("network", network, Network, "a Network")
        if dt is not None and not (is_whole(dt) and 0 <= dt < len(network.inputs)):
            raise fail("dt", f"the place of one of {len(network.inputs)} inputs, or None", show_value(dt))
        self.network = network
        # Filters that can be smoothed: numbers of the stacks of the nodes' filters, and central filters by name.
        stacks = tuple(
            k for k, stack in enumerate(network.stacks) if _can_smooth(_get_filter(network, k, stack.filters[0]))
        )
        all_central = {name: fusion for name, fusion in network.fused.items() if isinstance(fusion, AbstractFilter)}
        central = {name: filter for name, filter in all_central.items() if _can_smooth(filter)}
        if not stacks and not central:
            raise fail(
                "smoothing", "a filter that keeps its covariance and says how its state moves", "none in the network"
            )
        # The network's filters without its fusions, which have no state to sweep back: they fuse smoothed estimates.
        alone = Network(network.plant, network.nodes, central, network.relays, network.common)
        fusions = tuple(fusion for fusion in AllFilters(network).fusions if self._fuses(fusion, stacks))
        # The sweep as a function of its arrays, compiled when a history's length is known.
        with jax.enable_x64(True):
            self.sweep = BackwardSweep(NetworkStep(network, AllFilters(alone, stacks)), fusions, stacks)
            self._numbers, static = split_structure(self.sweep)
        self._run, self._by_xla = make_backward_sweep(static, dt)
        self._programs = dict[tuple[int, str], Callable[[RowHistory, np.ndarray], PyTree]]()

    def _fuses(self, fusion: StackedFusions, stacks: tuple[int, ...]) -> bool:
        """Return whether a fusion takes nothing but estimates of these stacks, as they are."""
        return fusion.quantizers is None and all(stack in stacks for source in fusion.sources for stack, _ in source)

    def _find_program(self, history: RowHistory) -> Callable[[RowHistory, np.ndarray], PyTree]:
        """Return the program for histories of this length: native code, or XLA if native code refuses it.

        Programs are kept by length. `self._numbers`: the arrays of the sweep, which are the program's first arguments.
        """
        key = len(history.rows), read_forced_engine()
        if key not in self._programs:
            # `span`: first and last row. No argument has an axis of runs, since there is only one run.
            span = np.zeros(2, dtype=np.int32)
            choice = choose_code(self._run, (self._numbers, history, span), differs_by_run=[False] * 3)
            if choice.code is None:
                self._programs[key] = lambda *arguments: to_numpy(self._by_xla(self._numbers, *arguments))
            else:
                code = choice.code.with_first_arguments(*self._numbers)
                self._programs[key] = lambda *arguments: _take_only_run(code(*jax.tree.leaves(arguments)))
        return self._programs[key]

    def estimates(self, history: RowHistory, begin: int, stop: int) -> dict[str, dict[str, Estimate]]:
        """Return the estimates after row `begin` given the rows after it, up to `stop`, by node and filter.

        Args:
            history: the rows.
            begin: number of the row, from 1.
            stop: number after that of the last row that is used.
        """
        with jax.enable_x64(True):
            by_stack, fused = self._find_program(history)(history, np.array([begin, stop], dtype=np.int32))
        network = self.network
        # Estimates of a stack are (filter, node, ...): filters of one structure at the nodes of one group.
        results: dict[str, dict[str, Estimate]] = {name: {} for name in network.names}
        for number, outputs in by_stack.items():
            stack = network.stacks[number]
            for f, name in enumerate(stack.filters):
                for i, node in enumerate(network.groups[stack.group]):
                    results[node][name] = _take_estimate(outputs, outputs.claim, index=(f, i))
        # Fused ones; a rule's claim follows from those of what it fuses.
        claims = {node: {name: outputs.claim for name, outputs in filters.items()} for node, filters in results.items()}
        for name, outputs in fused.items():
            fusion, claim = network.fused[name], outputs.claim
            if isinstance(fusion, Fusion):
                claim = fusion.claim([claims[node][fusion.filter] for node in network.nodes_with(fusion.filter)])
            results.setdefault(Network.FUSED, {})[name] = _take_estimate(outputs, claim, index=())
        return {node: filters for node, filters in results.items() if filters}


def _take_only_run(results: PyTree) -> PyTree:
    """Return the results of a single run without their axis of runs."""
    return map_arrays(lambda leaf: leaf[0, ...], results)


def _take_estimate(outputs: Estimate, claim: Claim, index: tuple[int, ...]) -> Estimate:
    """Return one estimate of stacked ones, by its index (filter, node), with this claim of its covariance.

    If the mean is not finite, or the matrix is no covariance (not positive semidefinite), it claims "none".
    """
    mean, covariance = np.asarray(outputs.mean)[index], np.asarray(outputs.covariance)[index]
    modes = None if outputs.modes is None else np.asarray(outputs.modes)[index]
    return lower_unsound_claim(Estimate(mean, covariance, claim, modes, attitude=outputs.attitude))


def _get_filter(network: Network, stack: int, name: str) -> AbstractFilter:
    """Return the filter `name` of a stack at the first node of its group, which stands for all of the stack."""
    return network.nodes[network.groups[network.stacks[stack].group][0]].filters[name]


def _can_smooth(filter: AbstractFilter) -> bool:
    """Return whether a filter's steps can return what a backward pass over the data needs.

    Only the shapes of a step's result are computed, which raises InputError if the filter cannot be smoothed.
    """
    u, z = np.zeros(len(filter.inputs)), np.zeros(filter.received)
    try:
        with jax.enable_x64(True):
            state = jax.tree.map(np.asarray, filter.init())
            eqx.filter_eval_shape(lambda filter, state: filter.step_with_smoother(state, z, u, k=0), filter, state)
    except InputError:
        return False
    return True
