"""Rules of inner programs: called functions, and branches by platform."""

from typing import Any

import jax
import numpy as np
from jax.extend.core import JaxprEqn

from heliograph.codegen.graph import Node
from heliograph.codegen.lowering import IN_MEMORY, RULES, Lowering, Value, like
from heliograph.codegen.memory import LONG, InMemory
from heliograph.codegen.rules.loops import in_memory, repeated
from heliograph.codegen.rules.shapes import FEW
from heliograph.codegen.rules.views import joined

CALLS = (
    "jit", "pjit", "closed_call", "core_call", "custom_jvp_call", "custom_vjp_call", "custom_vjp_call_jaxpr",
    "checkpoint", "remat", "remat2",
)  # fmt: skip


def _call(lowering: Lowering, equation: JaxprEqn, inputs: list[Value]) -> list[Value]:
    params = equation.params
    inner = next(params[name] for name in ("jaxpr", "call_jaxpr", "fun_jaxpr") if name in params)
    return lowering.inline(inner, inputs)


def _custom_vmap_call(lowering: Lowering, equation: JaxprEqn, inputs: list[Value]) -> list[Value]:
    return lowering.inline(equation.params["call"], inputs)


def _runs_last(lowering: Lowering, equation: JaxprEqn, inputs: list[Value]) -> list[Value]:
    """Inline a kernel over runs, traced for one run; several runs in one, such as modes, one after another."""
    avals: list[Any] = [v.aval for v in equation.outvars]
    runs = equation.params["runs"]
    shapes = [a.shape[: a.ndim - len(runs)] for a in avals]
    return _over(lowering, equation, inputs, runs, shapes)


def _over(
    lowering: Lowering, equation: JaxprEqn, inputs: list[Value], runs: tuple[int, ...], shapes: list[tuple[int, ...]]
) -> list[Value]:
    """Repeat over the last axis, that of runs: few are written out, many become a loop."""
    if not runs:
        results = zip(_single(lowering, equation, inputs), shapes, strict=True)
        return [x if x.shape == s else np.broadcast_to(lowering.nodes(x), s) for x, s in results]
    count, rest = runs[-1], runs[:-1]
    if count <= FEW:
        items = [_over(lowering, equation, [_run(x, k) for x in inputs], rest, shapes) for k in range(count)]
        return [_together(lowering, list(results)) for results in zip(*items, strict=True)]
    rows = [in_memory(lowering, x) if x.shape[-1] > 1 else _run(x, 0) for x in inputs]

    def turn(place: Node, carry: list[np.ndarray]) -> tuple[list[np.ndarray], list[np.ndarray]]:
        item = [_run(x, place) if isinstance(x, InMemory) else x for x in rows]
        return [], [lowering.nodes(x) for x in _over(lowering, equation, item, rest, shapes)]

    stacked = repeated(lowering, count, [], turn)[1]
    return [x.view([*x.shape[1:], x.shape[0]], [*x.strides[1:], x.strides[0]]) for x in stacked]


def _together(lowering: Lowering, results: list[Value]) -> Value:
    """Stack results of a few runs along the last axis; in memory if they are long."""
    x = results[0]
    if not isinstance(x, InMemory) or x.size <= LONG:
        return np.stack([lowering.nodes(x) for x in results], axis=-1)
    if len(results) == 1:
        return x.view((*x.shape, 1), (*x.strides, 0))
    whole = joined(lowering, results, (len(results), *x.shape))
    return whole.view([*whole.shape[1:], len(results)], [*whole.strides[1:], whole.strides[0]])


def _single(lowering: Lowering, equation: JaxprEqn, inputs: list[Value]) -> list[Value]:
    params = equation.params
    numbers = [v.aval.dtype for v in equation.invars]  # type: ignore[attr-defined]
    kinds = tuple((x.shape, dtype) for x, dtype in zip(inputs, numbers, strict=True))
    tree, function = params["tree"], params["kernel"].function
    key = (function, tree, kinds)
    if key not in lowering.kernels:
        lowering.kernels[key] = jax.make_jaxpr(
            lambda *leaves: jax.tree.leaves(function(*jax.tree.unflatten(tree, leaves)))
        )(*(like(*kind) for kind in kinds))
    return lowering.inline(lowering.kernels[key], inputs)


def _run(x: Value, place: Node | int) -> Value:
    """Return one run's part of an argument whose last axis is that of runs, or a number shared by all."""
    if isinstance(x, InMemory):
        last = x.view([x.shape[-1], *x.shape[:-1]], [x.strides[-1], *x.strides[:-1]])
        return last.row(0 if x.shape[-1] == 1 else place)
    flat = x.reshape(-1, x.shape[-1])
    return flat[:, min(int(place), x.shape[-1] - 1)].reshape(x.shape[:-1])  # type: ignore[arg-type]


def _platform_index(lowering: Lowering, equation: JaxprEqn, inputs: list[Value]) -> list[Value]:
    """Select the branch of a program for CPUs."""
    platforms = equation.params["platforms"]
    number = next((i for i, names in enumerate(platforms) if names is not None and "cpu" in names), len(platforms) - 1)
    return [lowering.known(np.int32(number))]


IN_MEMORY |= dict.fromkeys(CALLS, _call)
IN_MEMORY |= {"custom_vmap_call": _custom_vmap_call, "runs_last": _runs_last}
RULES |= {"platform_index": _platform_index}
