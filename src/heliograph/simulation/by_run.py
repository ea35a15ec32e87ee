"""Runs side by side, each number once: what does not depend on the run has no axis of runs."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.core import ClosedJaxpr, Literal, jaxpr_as_fun
from jaxtyping import PyTree


def trajectories(
    init: Callable[[jax.Array], PyTree], step: Callable[..., tuple[PyTree, PyTree]], keys: jax.Array, rows: PyTree
) -> PyTree:
    """What `step(carry, key, row)` tells from `init(key)` on, (run, time, ...); (1, time, ...) if common to all runs.

    The runs are the last axis of everything on the way: a processor works through them without a jump.
    """
    start, varies, tree = _start(init, keys)
    example = jax.tree.map(lambda leaf: leaf[0], rows)
    one = [leaf[..., 0] if v else leaf for leaf, v in zip(start, varies, strict=True)]
    body, shape = jax.make_jaxpr(
        lambda carry, key, row: step(jax.tree.unflatten(tree, carry), key, row), return_shape=True
    )(one, keys[0], example)
    told = jax.tree.structure(shape[1])
    rest = [False] * len(jax.tree.leaves(example))
    varies = _settled(lambda marks: dependent(body, [*marks, True, *rest])[: len(one)], varies)
    tells = dependent(body, [*varies, True, *rest])[len(one) :]
    advance = jax.vmap(
        jaxpr_as_fun(body), in_axes=[*_axes(varies), 0, *_axes(rest)], out_axes=_axes([*varies, *tells])
    )  # fmt: skip

    def scanned(carry: list[jax.Array], row: PyTree) -> tuple[list[jax.Array], list[jax.Array]]:
        results = advance(*carry, keys, *jax.tree.leaves(row))
        return results[: len(one)], results[len(one) :]

    begin = [_spread(leaf, len(keys)) if v and leaf.ndim == s.ndim else leaf
             for leaf, s, v in zip(start, one, varies, strict=True)]  # fmt: skip
    kept = jax.lax.scan(scanned, begin, rows)[1]
    return jax.tree.unflatten(
        told, [jnp.moveaxis(leaf, -1, 0) if t else leaf[None] for leaf, t in zip(kept, tells, strict=True)]
    )


def _start(init: Callable[[jax.Array], PyTree], keys: jax.Array) -> tuple[list[jax.Array], list[bool], Any]:
    traced, shape = jax.make_jaxpr(init, return_shape=True)(keys[0])
    varies = dependent(traced, [True])
    start = jax.vmap(jaxpr_as_fun(traced), out_axes=_axes(varies))(keys)
    return start, varies, jax.tree.structure(shape)


def _settled(following: Callable[[list[bool]], list[bool]], marks: list[bool]) -> list[bool]:
    """The marks of a carry that following ones add nothing to."""
    more = [a or b for a, b in zip(marks, following(marks), strict=True)]
    return marks if more == marks else _settled(following, more)


def dependent(program: ClosedJaxpr, inputs: Sequence[bool]) -> list[bool]:
    """Which results depend on the inputs that are marked; each operation is taken to use all that it is given."""
    marked = {v for v, mark in zip(program.jaxpr.invars, inputs, strict=True) if mark}

    def depends(v: Any) -> bool:
        return not isinstance(v, Literal) and v in marked

    for operation in program.jaxpr.eqns:
        if any(depends(v) for v in operation.invars):
            marked.update(operation.outvars)
    return [depends(v) for v in program.jaxpr.outvars]


def _axes(varies: Sequence[bool]) -> list[int | None]:
    return [-1 if v else None for v in varies]


def _spread(leaf: jax.Array, runs: int) -> jax.Array:
    return jnp.broadcast_to(leaf[..., None], (*leaf.shape, runs))
