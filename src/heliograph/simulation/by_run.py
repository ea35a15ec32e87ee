"""Runs side by side, each number once: what all runs share has no axis of runs, what no past changes is drawn ahead.

Both are found in the traced step: a result that does not depend on the key is common to all runs, and one that does
not depend on what is carried is drawn for many steps at once, since a step's random numbers alone are mostly waiting.
"""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal, Var, jaxpr_as_fun
from jax.interpreters.partial_eval import dce_jaxpr
from jaxtyping import PyTree

from heliograph.simulation.hashing import evaluated, written_out
from heliograph.simulation.together import together

AHEAD = 2**18  # bytes drawn ahead: more than fills the processor between two steps, less than its cache


def trajectories(
    init: Callable[[jax.Array], PyTree], step: Callable[..., tuple[PyTree, PyTree]], keys: jax.Array, rows: PyTree
) -> PyTree:
    """What `step(carry, key, row)` tells from `init(key)` on, (run, time, ...); (1, time, ...) if common to all runs.

    The runs are the last axis of everything on the way: a processor works through them without a jump.
    """
    start, varies, tree = _start(init, keys)
    example, steps = jax.tree.map(lambda leaf: leaf[0], rows), len(jax.tree.leaves(rows)[0])
    one = [leaf[..., 0] if v else leaf for leaf, v in zip(start, varies, strict=True)]
    traced, shape = jax.make_jaxpr(
        lambda carry, key, row: step(jax.tree.unflatten(tree, carry), key, row), return_shape=True
    )(one, keys[0], example)
    body = _needed(traced)
    row_axes: list[int | None] = [None] * len(jax.tree.leaves(example))
    known = [False] * len(row_axes)
    spread = _settled(lambda marks: _dependent(body, [*marks, True, *known])[: len(one)], varies)
    tells = _dependent(body, [*spread, True, *known])[len(one) :]
    ahead, rest, drawn = _split(body, len(one))
    rest = together(rest, _marked(rest, [*spread, True, *known, *[True] * len(drawn)]))
    keys = written_out(keys, (ahead, rest))
    draw = jax.vmap(evaluated(ahead), in_axes=[0, *row_axes], out_axes=-1)
    draw = jax.vmap(draw, in_axes=[None, *[0] * len(row_axes)])
    out_axes = _axes([*spread, *tells])
    advance = jax.vmap(evaluated(rest), in_axes=[*_axes(spread), 0, *row_axes, *[-1] * len(drawn)], out_axes=out_axes)

    def several(carry: list[jax.Array], rows: list[jax.Array]) -> tuple[list[jax.Array], list[jax.Array]]:
        def scanned(carry: list[jax.Array], item: PyTree) -> tuple[list[jax.Array], list[jax.Array]]:
            results = advance(*carry, keys, *item[0], *item[1])
            return results[: len(one)], results[len(one) :]

        return jax.lax.scan(scanned, carry, (rows, draw(keys, *rows)))

    avals: list[PyTree] = [v.aval for v in drawn]
    parts = -(-steps * len(keys) * sum(a.size * a.dtype.itemsize for a in avals) // AHEAD)
    width = -(-steps // min(max(parts, 1), steps))
    dealt = [_dealt(leaf, width) for leaf in jax.tree.leaves(rows)]
    begin = [_with_runs(leaf, len(keys)) if s and not v else leaf
             for leaf, v, s in zip(start, varies, spread, strict=True)]  # fmt: skip
    kept = [
        leaf.reshape(leaf.shape[0] * width, *leaf.shape[2:])[:steps] for leaf in jax.lax.scan(several, begin, dealt)[1]
    ]
    told = [jnp.moveaxis(leaf, -1, 0) if t else leaf[None] for leaf, t in zip(kept, tells, strict=True)]
    return jax.tree.unflatten(jax.tree.structure(shape[1]), told)


def each_run(function: Callable[[PyTree], PyTree], values: PyTree) -> PyTree:
    """A function of one run's values for all runs: (run, ...), or (1, ...) where they share it, given and told.

    A result of which no run's own value has a part is computed once.
    """
    leaves, tree = jax.tree.flatten(values)
    runs = max(len(leaf) for leaf in leaves)
    varies = [len(leaf) == runs for leaf in leaves]
    one = [leaf[0] for leaf in leaves]
    traced, shape = jax.make_jaxpr(lambda *leaves: function(jax.tree.unflatten(tree, leaves)), return_shape=True)(*one)
    wanted = range(len(traced.jaxpr.outvars))
    tells = [_any_of(varies, dce_jaxpr(traced.jaxpr, [i == j for j in wanted])[1]) for i in wanted]
    over = jax.vmap(
        jaxpr_as_fun(traced), in_axes=_axes(varies), out_axes=_axes(tells), axis_size=runs
    )  # runs last, as everywhere
    given = [jnp.moveaxis(leaf, 0, -1) if v else leaf[0] for leaf, v in zip(leaves, varies, strict=True)]
    told = [jnp.moveaxis(leaf, -1, 0) if t else leaf[None] for leaf, t in zip(over(*given), tells, strict=True)]
    return jax.tree.unflatten(jax.tree.structure(shape), told)


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


def _split(program: ClosedJaxpr, carried: int) -> tuple[ClosedJaxpr, ClosedJaxpr, list[Var]]:
    """A step (carry, key, row) as what is drawn, without the carry, and the rest, which is given what was drawn too."""
    whole: Jaxpr = program.jaxpr
    by_carry = _marked(program, [True] * carried + [False] * (len(whole.invars) - carried))
    by_key = _marked(program, [i == carried for i in range(len(whole.invars))])
    early = [e for e in whole.eqns if not any(v in by_carry for v in e.outvars)]
    late = [e for e in whole.eqns if any(v in by_carry for v in e.outvars) or not any(v in by_key for v in e.outvars)]
    made = {v for e in early for v in e.outvars} & by_key
    used = [v for e in late for v in e.invars] + whole.outvars
    drawn = list(dict.fromkeys(v for v in used if not isinstance(v, Literal) and v in made))
    unnamed = whole.debug_info.with_unknown_names()

    def part(eqns: list[JaxprEqn], invars: list[Var], outvars: Sequence[Var | Literal]) -> Jaxpr:
        made: Jaxpr = whole.replace(eqns=eqns, invars=invars, outvars=outvars, debug_info=unnamed)  # type: ignore[no-untyped-call]
        return made

    ahead = part(early, whole.invars[carried:], drawn)
    rest = part(late, [*whole.invars, *drawn], whole.outvars)
    return ClosedJaxpr(ahead, program.consts), ClosedJaxpr(rest, program.consts), drawn


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


def _settled(following: Callable[[list[bool]], list[bool]], marks: list[bool]) -> list[bool]:
    """The marks of a carry that following ones add nothing to."""
    more = [a or b for a, b in zip(marks, following(marks), strict=True)]
    return marks if more == marks else _settled(following, more)


def _axes(varies: Sequence[bool]) -> list[int | None]:
    return [-1 if v else None for v in varies]


def _dealt(leaf: jax.Array, width: int) -> jax.Array:
    """Rows (time, ...) as (part, width, ...), filled up with the last one, whose results are cut off."""
    missing = -len(leaf) % width
    whole = jnp.concatenate([leaf, jnp.repeat(leaf[-1:], missing, axis=0)])
    return whole.reshape(len(whole) // width, width, *leaf.shape[1:])


def _with_runs(leaf: jax.Array, runs: int) -> jax.Array:
    return jnp.broadcast_to(leaf[..., None], (*leaf.shape, runs))
