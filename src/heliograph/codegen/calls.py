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
    """A kernel over runs, traced for one run."""
    params = equation.params
    if params["runs"]:
        raise Unsupported("a kernel over several runs")
    avals: list[Any] = [v.aval for v in equation.invars]
    examples = [jax.ShapeDtypeStruct(a.shape, a.dtype) for a in avals]
    tree, function = params["tree"], params["kernel"].function
    inner = jax.make_jaxpr(lambda *leaves: jax.tree.leaves(function(*jax.tree.unflatten(tree, leaves))))(*examples)
    results = lowering.inline(inner, inputs)
    shapes: list[Any] = [v.aval for v in equation.outvars]
    return [np.broadcast_to(lowering.nodes(x), s.shape) for x, s in zip(results, shapes, strict=True)]


def _platform_index(lowering: Lowering, equation: JaxprEqn, inputs: list[Value]) -> list[Value]:
    """The branch of a program that is meant for processors."""
    platforms = equation.params["platforms"]
    number = next((i for i, names in enumerate(platforms) if names is not None and "cpu" in names), len(platforms) - 1)
    return [lowering.known(np.int32(number))]


IN_MEMORY |= dict.fromkeys(CALLS, _call)
IN_MEMORY |= {"custom_vmap_call": _custom_vmap_call, "runs_last": _runs_last}
RULES |= {"platform_index": _platform_index}
