"""Runs in parallel under XLA, with values that all runs share computed once, without an axis of runs.

They are found in the traced step: a result that does not depend on the key is common to all runs.
"""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
from jax.extend.core import ClosedJaxpr, Literal, Var, jaxpr_as_fun
from jax.interpreters.partial_eval import dce_jaxpr

from heliograph.numerics.types import PyTree


def simulate_trajectories(
    init: Callable[[jax.Array], PyTree], step: Callable[..., tuple[PyTree, PyTree]], keys: jax.Array, rows: PyTree
) -> PyTree:
    """Return the outputs over time of all runs, (run, time, ...), or (1, time, ...) of what all runs share.

    Numbers that do not depend on a run's random key, such as many covariances, are computed once for all runs. Inside,
    the axis of runs is the last one of every array: a processor works through them contiguously.

    Args:
        init: function from a run's key to its state before the first step.
        step: function from (state, key, row) to the next state and the outputs.
        keys: random keys of the runs (run,).
        rows: data of the steps, common to all runs, with a leading axis of time.
    """
    # Leaves of the first states; `start_varies` marks those that differ between runs.
    start, start_varies, tree = _start_runs(init, keys)
    example_row = jax.tree.map(lambda leaf: leaf[0], rows)
    example_state = [leaf[..., 0] if varies else leaf for leaf, varies in zip(start, start_varies, strict=True)]
    count = len(example_state)  # a step's results are so many leaves of the next state, then those of the outputs
    # One run's step, without operations that no result needs.
    traced, (_, output_shape) = jax.make_jaxpr(
        lambda state, key, row: step(jax.tree.unflatten(tree, state), key, row), return_shape=True
    )(example_state, keys[0], example_row)
    body = _drop_unused(traced)
    row_varies = [False] * len(jax.tree.leaves(example_row))
    # Which leaves of the state differ between runs at some step? What depends on the key (marked True), or on a leaf
    # that differs, differs: marks are passed through the step until no more leaves are marked. Then the same for
    # outputs.
    state_varies = _find_fixed_point(
        lambda marks: _mark_dependent_results(body, [*marks, True, *row_varies])[:count], start_varies
    )
    output_varies = _mark_dependent_results(body, [*state_varies, True, *row_varies])[count:]
    # The step for all runs: an axis of runs only where values differ. The arguments are state, key and row.
    in_axes = [*_list_run_axes(state_varies), 0, *_list_run_axes(row_varies)]
    advance = jax.vmap(jaxpr_as_fun(body), in_axes=in_axes, out_axes=_list_run_axes([*state_varies, *output_varies]))

    def step_all(state: list[jax.Array], row: PyTree) -> tuple[list[jax.Array], list[jax.Array]]:
        """Step all runs: return the leaves of their next states, and those of their outputs."""
        results = advance(*state, keys, *jax.tree.leaves(row))
        return results[:count], results[count:]

    # Leaves that are common at first and differ later begin as copies.
    begin = [jnp.broadcast_to(leaf[..., None], (*leaf.shape, len(keys))) if later and not now else leaf
             for leaf, now, later in zip(start, start_varies, state_varies, strict=True)]  # fmt: skip
    _, outcome = jax.lax.scan(step_all, begin, rows)
    outputs = _put_runs_first(outcome, output_varies)
    return jax.tree.unflatten(jax.tree.structure(output_shape), outputs)


def apply_to_each_run(function: Callable[[PyTree], PyTree], values: PyTree) -> PyTree:
    """Apply a function of one run's values to all runs, and compute once what all runs share.

    Args:
        function: from the values of one run to its results.
        values: arrays with a leading axis of runs, of length `runs`, or of length 1 for a value that all runs share.

    Returns:
        The results, with a leading axis of runs too: of length 1 if a result depends on shared values alone.
    """
    leaves, tree = jax.tree.flatten(values)
    runs = max(len(leaf) for leaf in leaves)
    varies = [len(leaf) == runs for leaf in leaves]

    def apply_to_leaves(*leaves: PyTree) -> PyTree:
        """Return the function's results for one run's values, given as leaves."""
        return function(jax.tree.unflatten(tree, leaves))

    # The function of one run as a jaxpr of flat arguments, and the tree of its results.
    traced, shape = jax.make_jaxpr(apply_to_leaves, return_shape=True)(*(leaf[0] for leaf in leaves))
    # A result differs between runs if it depends on an argument that does. JAX's dead-code elimination tells which
    # arguments are needed for one result alone.
    results = range(len(traced.jaxpr.outvars))
    result_varies = []
    for i in results:
        _, is_needed = dce_jaxpr(traced.jaxpr, [i == j for j in results])
        result_varies.append(any(differs and needed for differs, needed in zip(varies, is_needed, strict=True)))
    # Inside, the axis of runs is the last one, so that numbers of different runs stand side by side in memory.
    in_axes, out_axes = _list_run_axes(varies), _list_run_axes(result_varies)
    apply = jax.vmap(jaxpr_as_fun(traced), in_axes=in_axes, out_axes=out_axes, axis_size=runs)
    arguments = [
        jnp.moveaxis(leaf, 0, -1) if differs else leaf[0] for leaf, differs in zip(leaves, varies, strict=True)
    ]
    outputs = _put_runs_first(apply(*arguments), result_varies)
    return jax.tree.unflatten(jax.tree.structure(shape), outputs)


def list_used_leaves(function: Callable[[PyTree], PyTree], values: PyTree) -> list[PyTree]:
    """Return the leaves of `values` (numbers or their shapes) on which some result of the function depends.

    Other leaves need no memory in a simulation, since XLA does not compute what nothing uses.
    """
    leaves, tree = jax.tree.flatten(values)

    def call_with_leaves(*leaves: PyTree) -> PyTree:
        """Return the function's result for values of these leaves."""
        return function(jax.tree.unflatten(tree, leaves))

    traced = jax.make_jaxpr(call_with_leaves)(*leaves)
    # JAX's dead-code elimination tells which arguments are used.
    _, are_used = dce_jaxpr(traced.jaxpr, [True] * len(traced.jaxpr.outvars))
    return [leaf for leaf, is_used in zip(leaves, are_used, strict=True) if is_used]


def _start_runs(init: Callable[[jax.Array], PyTree], keys: jax.Array) -> tuple[list[jax.Array], list[bool], PyTree]:
    """Return the leaves of all runs' first states, which of them differ between runs, and their structure.

    `init`: makes a run's first state from its key. A leaf that differs between runs is (..., run); others have no axis
    of runs.
    """
    traced, shape = jax.make_jaxpr(init, return_shape=True)(keys[0])
    varies = _mark_dependent_results(traced, [True])
    start = jax.vmap(jaxpr_as_fun(traced), out_axes=_list_run_axes(varies))(keys)
    return start, varies, jax.tree.structure(shape)


def _drop_unused(program: ClosedJaxpr) -> ClosedJaxpr:
    """Return the program without operations that none of its results needs, such as unused likelihoods."""
    jaxpr, _ = dce_jaxpr(program.jaxpr, [True] * len(program.jaxpr.outvars), instantiate=True)
    return ClosedJaxpr(jaxpr, program.consts)


def _find_dependent_variables(program: ClosedJaxpr, inputs: Sequence[bool]) -> set[Var]:
    """Return the variables of a traced program that depend on the inputs marked True.

    Each operation is assumed to use all of its arguments.
    """
    dependent = {variable for variable, is_marked in zip(program.jaxpr.invars, inputs, strict=True) if is_marked}
    for operation in program.jaxpr.eqns:
        if any(v in dependent for v in operation.invars if not isinstance(v, Literal)):
            dependent.update(operation.outvars)
    return dependent


def _mark_dependent_results(program: ClosedJaxpr, inputs: Sequence[bool]) -> list[bool]:
    """Return the mask of the results that depend on the marked inputs."""
    marked = _find_dependent_variables(program, inputs)
    return [not isinstance(v, Literal) and v in marked for v in program.jaxpr.outvars]


def _find_fixed_point(step: Callable[[list[bool]], list[bool]], marks: list[bool]) -> list[bool]:
    """Return the marks that `step` adds nothing to any more: `marks`, with those that `step` adds again and again."""
    while True:
        more = [before or after for before, after in zip(marks, step(marks), strict=True)]
        if more == marks:
            return marks
        marks = more


def _put_runs_first(leaves: Sequence[jax.Array], varies: Sequence[bool]) -> list[jax.Array]:
    """Return leaves (..., run), or (...) of what all runs share, as (run, ...) and (1, ...)."""
    return [jnp.moveaxis(leaf, -1, 0) if differs else leaf[None] for leaf, differs in zip(leaves, varies, strict=True)]


def _list_run_axes(varies: Sequence[bool]) -> list[int | None]:
    """Return the axis of runs for `jax.vmap`: the last of what varies, none of the rest."""
    return [-1 if v else None for v in varies]
