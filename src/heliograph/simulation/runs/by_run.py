"""Runs side by side under XLA, each number once: what all runs share has no axis of runs.

It is found in the traced step: a result that does not depend on the key is common to all runs.
"""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
from jax.extend.core import ClosedJaxpr, Literal, Var, jaxpr_as_fun
from jax.interpreters.partial_eval import dce_jaxpr
from jaxtyping import PyTree


def trajectories(
    init: Callable[[jax.Array], PyTree], step: Callable[..., tuple[PyTree, PyTree]], keys: jax.Array, rows: PyTree
) -> PyTree:
    """What `step(carry, key, row)` gives from `init(key)` on, (run, time, ...); (1, time, ...) if common to all runs.

    The runs are the last axis of everything on the way: a processor works through them without a jump.
    """
    start, varies, tree = _start(init, keys)
    example = jax.tree.map(lambda leaf: leaf[0], rows)
    item = [leaf[..., 0] if v else leaf for leaf, v in zip(start, varies, strict=True)]
    traced, shape = jax.make_jaxpr(
        lambda carry, key, row: step(jax.tree.unflatten(tree, carry), key, row), return_shape=True
    )(item, keys[0], example)
    body = _needed(traced)
    known = [False] * len(jax.tree.leaves(example))
    spread = _unchanging(lambda marks: _dependent(body, [*marks, True, *known])[: len(item)], varies)
    differ = _dependent(body, [*spread, True, *known])[len(item) :]
    row_axes: list[int | None] = [None] * len(known)
    advance = jax.vmap(jaxpr_as_fun(body), in_axes=[*_axes(spread), 0, *row_axes], out_axes=_axes([*spread, *differ]))

    def scanned(carry: list[jax.Array], row: PyTree) -> tuple[list[jax.Array], list[jax.Array]]:
        results = advance(*carry, keys, *jax.tree.leaves(row))
        return results[: len(item)], results[len(item) :]

    begin = [_with_runs(leaf, len(keys)) if s and not v else leaf
             for leaf, v, s in zip(start, varies, spread, strict=True)]  # fmt: skip
    outcome = jax.lax.scan(scanned, begin, rows)[1]
    result = [jnp.moveaxis(leaf, -1, 0) if d else leaf[None] for leaf, d in zip(outcome, differ, strict=True)]
    return jax.tree.unflatten(jax.tree.structure(shape[1]), result)


def each_run(function: Callable[[PyTree], PyTree], values: PyTree) -> PyTree:
    """A function of one run's values for all runs: (run, ...), or (1, ...) where they share it, given and told.

    A result of which no run's own value has a part is computed once.
    """
    leaves, tree = jax.tree.flatten(values)
    runs = max(len(leaf) for leaf in leaves)
    varies = [len(leaf) == runs for leaf in leaves]
    item = [leaf[0] for leaf in leaves]
    traced, shape = jax.make_jaxpr(lambda *leaves: function(jax.tree.unflatten(tree, leaves)), return_shape=True)(*item)
    expected = range(len(traced.jaxpr.outvars))
    tells = [_any_of(varies, dce_jaxpr(traced.jaxpr, [i == j for j in expected])[1]) for i in expected]
    over = jax.vmap(
        jaxpr_as_fun(traced), in_axes=_axes(varies), out_axes=_axes(tells), axis_size=runs
    )  # runs last, as everywhere
    given = [jnp.moveaxis(leaf, 0, -1) if v else leaf[0] for leaf, v in zip(leaves, varies, strict=True)]
    outputs = [jnp.moveaxis(leaf, -1, 0) if t else leaf[None] for leaf, t in zip(over(*given), tells, strict=True)]
    return jax.tree.unflatten(jax.tree.structure(shape), outputs)


def _any_of(varies: Sequence[bool], used: Sequence[bool]) -> bool:
    return any(v and u for v, u in zip(varies, used, strict=True))


def _start(init: Callable[[jax.Array], PyTree], keys: jax.Array) -> tuple[list[jax.Array], list[bool], PyTree]:
    traced, shape = jax.make_jaxpr(init, return_shape=True)(keys[0])
    varies = _dependent(traced, [True])
    start = jax.vmap(jaxpr_as_fun(traced), out_axes=_axes(varies))(keys)
    return start, varies, jax.tree.structure(shape)


def _needed(program: ClosedJaxpr) -> ClosedJaxpr:
    """A program without what none of its results needs, such as likelihoods that nobody asks for."""
    jaxpr, _ = dce_jaxpr(program.jaxpr, [True] * len(program.jaxpr.outvars), instantiate=True)
    return ClosedJaxpr(jaxpr, program.consts)


def _marked(program: ClosedJaxpr, inputs: Sequence[bool]) -> set[Var]:
    """What depends on the marked inputs; each operation is taken to use all that it is given."""
    marked = {v for v, mark in zip(program.jaxpr.invars, inputs, strict=True) if mark}
    for operation in program.jaxpr.eqns:
        if any(v in marked for v in operation.invars if not isinstance(v, Literal)):
            marked.update(operation.outvars)
    return marked


def _dependent(program: ClosedJaxpr, inputs: Sequence[bool]) -> list[bool]:
    """Which results depend on the marked inputs."""
    marked = _marked(program, inputs)
    return [not isinstance(v, Literal) and v in marked for v in program.jaxpr.outvars]


def _unchanging(following: Callable[[list[bool]], list[bool]], marks: list[bool]) -> list[bool]:
    """The marks of a carry that following ones add nothing to."""
    more = [a or b for a, b in zip(marks, following(marks), strict=True)]
    return marks if more == marks else _unchanging(following, more)


def _axes(varies: Sequence[bool]) -> list[int | None]:
    return [-1 if v else None for v in varies]


def _with_runs(leaf: jax.Array, runs: int) -> jax.Array:
    return jnp.broadcast_to(leaf[..., None], (*leaf.shape, runs))
