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
    """Return outputs of `step(carry, key, row)` from `init(key)` on, (run, time, ...); (1, time, ...) if common.

    The axis of runs is the last one of every array inside: a processor works through them contiguously.
    """
    start, varies, tree = _start_runs(init, keys)
    example = jax.tree.map(lambda leaf: leaf[0], rows)
    example_carry = [leaf[..., 0] if v else leaf for leaf, v in zip(start, varies, strict=True)]
    # One run's step, without operations that no result needs.
    traced, shape = jax.make_jaxpr(
        lambda carry, key, row: step(jax.tree.unflatten(tree, carry), key, row), return_shape=True
    )(example_carry, keys[0], example)
    body = _drop_unused(traced)
    row_varies = [False] * len(jax.tree.leaves(example))
    # Parts of the carry that depend on the key at some step, as a fixed point; then those of the outputs.
    carry_varies = _find_fixed_point(
        lambda marks: _dependent(body, [*marks, True, *row_varies])[: len(example_carry)], varies
    )
    output_varies = _dependent(body, [*carry_varies, True, *row_varies])[len(example_carry) :]
    # The step for all runs: an axis of runs only where values differ. The arguments are carry, key and row.
    in_axes = [*_axes(carry_varies), 0, *_axes(row_varies)]
    advance = jax.vmap(jaxpr_as_fun(body), in_axes=in_axes, out_axes=_axes([*carry_varies, *output_varies]))

    def step_all(carry: list[jax.Array], row: PyTree) -> tuple[list[jax.Array], list[jax.Array]]:
        """Step all runs."""
        results = advance(*carry, keys, *jax.tree.leaves(row))
        return results[: len(example_carry)], results[len(example_carry) :]

    # What is common at first and differs later begins as copies.
    begin = [jnp.broadcast_to(leaf[..., None], (*leaf.shape, len(keys))) if later and not now else leaf
             for leaf, now, later in zip(start, varies, carry_varies, strict=True)]  # fmt: skip
    outcome = jax.lax.scan(step_all, begin, rows)[1]
    # The axis of runs first again.
    outputs = [jnp.moveaxis(leaf, -1, 0) if v else leaf[None] for leaf, v in zip(outcome, output_varies, strict=True)]
    return jax.tree.unflatten(jax.tree.structure(shape[1]), outputs)


def apply_to_each_run(function: Callable[[PyTree], PyTree], values: PyTree) -> PyTree:
    """Apply a function of one run's values to all runs: (run, ...), or (1, ...) where they share it, in and out.

    A result that depends on no value of single runs is computed once.
    """
    leaves, tree = jax.tree.flatten(values)
    runs = max(len(leaf) for leaf in leaves)
    varies = [len(leaf) == runs for leaf in leaves]
    of_first = [leaf[0] for leaf in leaves]
    # Which results depend on values of single runs: those that, alone, keep an operand that varies.
    traced, shape = jax.make_jaxpr(lambda *leaves: function(jax.tree.unflatten(tree, leaves)), return_shape=True)(
        *of_first
    )
    results = range(len(traced.jaxpr.outvars))
    result_varies = [_any_of(varies, dce_jaxpr(traced.jaxpr, [i == j for j in results])[1]) for i in results]
    # The axis of runs last inside, first outside.
    apply = jax.vmap(jaxpr_as_fun(traced), in_axes=_axes(varies), out_axes=_axes(result_varies), axis_size=runs)
    arguments = [jnp.moveaxis(leaf, 0, -1) if v else leaf[0] for leaf, v in zip(leaves, varies, strict=True)]
    outcome = apply(*arguments)
    outputs = [jnp.moveaxis(leaf, -1, 0) if v else leaf[None] for leaf, v in zip(outcome, result_varies, strict=True)]
    return jax.tree.unflatten(jax.tree.structure(shape), outputs)


def read_by(function: Callable[[PyTree], PyTree], values: PyTree) -> list[PyTree]:
    """Return the leaves of values (or their shapes) that a result of the function depends on."""
    leaves, tree = jax.tree.flatten(values)
    traced = jax.make_jaxpr(lambda *leaves: function(jax.tree.unflatten(tree, leaves)))(*leaves)
    used = dce_jaxpr(traced.jaxpr, [True] * len(traced.jaxpr.outvars))[1]
    return [leaf for leaf, u in zip(leaves, used, strict=True) if u]


def _any_of(varies: Sequence[bool], used: Sequence[bool]) -> bool:
    """Return whether something that varies is used."""
    return any(v and u for v, u in zip(varies, used, strict=True))


def _start_runs(init: Callable[[jax.Array], PyTree], keys: jax.Array) -> tuple[list[jax.Array], list[bool], PyTree]:
    """Return the leaves of each run's first state, which of them differ between runs, and their structure."""
    traced, shape = jax.make_jaxpr(init, return_shape=True)(keys[0])
    varies = _dependent(traced, [True])
    start = jax.vmap(jaxpr_as_fun(traced), out_axes=_axes(varies))(keys)
    return start, varies, jax.tree.structure(shape)


def _drop_unused(program: ClosedJaxpr) -> ClosedJaxpr:
    """Return the program without operations that none of its results needs, such as unused likelihoods."""
    jaxpr, _ = dce_jaxpr(program.jaxpr, [True] * len(program.jaxpr.outvars), instantiate=True)
    return ClosedJaxpr(jaxpr, program.consts)


def _find_dependent(program: ClosedJaxpr, inputs: Sequence[bool]) -> set[Var]:
    """Return the variables that depend on the marked inputs; each operation is assumed to use all its arguments."""
    marked = {v for v, mark in zip(program.jaxpr.invars, inputs, strict=True) if mark}
    for operation in program.jaxpr.eqns:
        if any(v in marked for v in operation.invars if not isinstance(v, Literal)):
            marked.update(operation.outvars)
    return marked


def _dependent(program: ClosedJaxpr, inputs: Sequence[bool]) -> list[bool]:
    """Return the mask of the results that depend on the marked inputs."""
    marked = _find_dependent(program, inputs)
    return [not isinstance(v, Literal) and v in marked for v in program.jaxpr.outvars]


def _find_fixed_point(step: Callable[[list[bool]], list[bool]], marks: list[bool]) -> list[bool]:
    """Return the marks of a carry that steps do not change any more; a step only adds marks."""
    more = [before or after for before, after in zip(marks, step(marks), strict=True)]
    return marks if more == marks else _find_fixed_point(step, more)


def _axes(varies: Sequence[bool]) -> list[int | None]:
    """Return the axis of runs for `jax.vmap`: the last of what varies, none of the rest."""
    return [-1 if v else None for v in varies]
