"""Rules of programs inside programs: functions that are called, and branches."""

from typing import Any

import jax
import numpy as np
from jax.extend.core import JaxprEqn

from heliograph.codegen.graph import Unsupported
from heliograph.codegen.lowering import IN_MEMORY, RULES, Lowering, Value

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
    """A kernel traced for one run; where it is mapped, over nodes say, once for each of these, which are last axes."""
    params, several = equation.params, equation.params["runs"]
    nodes = [lowering.nodes(x) for x in inputs]
    ndim = [x.ndim - len(several) for x in nodes]
    avals: list[Any] = [v.aval for v in equation.invars]
    examples = [jax.ShapeDtypeStruct(a.shape[:n], a.dtype) for a, n in zip(avals, ndim, strict=True)]
    tree, function = params["tree"], params["kernel"].function
    inner = jax.make_jaxpr(lambda *leaves: jax.tree.leaves(function(*jax.tree.unflatten(tree, leaves))))(*examples)
    results = [np.empty((*shape, *several), dtype=object) for shape, _ in params["told"]]
    for place in np.ndindex(*several):
        given = []
        for x, n in zip(nodes, ndim, strict=True):
            there = tuple(i if size > 1 else 0 for i, size in zip(place, x.shape[n:], strict=True))
            given.append(np.asarray(x[(..., *there)], dtype=object))
        for result, value in zip(results, lowering.inline(inner, given), strict=True):
            result[(..., *place)] = lowering.nodes(value)
    return results


def _platform_index(lowering: Lowering, equation: JaxprEqn, inputs: list[Value]) -> list[Value]:
    """The branch of a program that is meant for processors."""
    platforms = equation.params["platforms"]
    number = next((i for i, names in enumerate(platforms) if names is not None and "cpu" in names), len(platforms) - 1)
    return [lowering.known(np.int32(number))]


IN_MEMORY |= dict.fromkeys(CALLS, _call)
IN_MEMORY |= {"custom_vmap_call": _custom_vmap_call, "runs_last": _runs_last}
RULES |= {"platform_index": _platform_index}
