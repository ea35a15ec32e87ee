"""Rules of loops: short ones are written out, long ones stay loops with what they stack in memory."""

from typing import Any

import numpy as np
from jax.extend.core import JaxprEqn

from heliograph.codegen.graph import Unsupported
from heliograph.codegen.lowering import IN_MEMORY, Lowering, Value
from heliograph.codegen.memory import InMemory

WRITTEN_OUT = 3000  # numbers computed by all turns of a loop that is written out


def _scan(lowering: Lowering, equation: JaxprEqn, inputs: list[Value]) -> list[Value]:
    params = equation.params
    if params["length"] * size_of(params["jaxpr"].jaxpr) > WRITTEN_OUT:
        raise Unsupported("a long loop")
    consts, carried = params["num_consts"], params["num_carry"]
    fixed, carry = inputs[:consts], inputs[consts : consts + carried]
    rows = inputs[consts + carried :]
    stacked: list[list[Value]] = []
    turns = range(params["length"])
    for turn in reversed(turns) if params["reverse"] else turns:
        each = [x.row(turn) if isinstance(x, InMemory) else np.asarray(x[turn], dtype=object) for x in rows]
        results = lowering.inline(params["jaxpr"], [*fixed, *carry, *each])
        carry = results[:carried]
        stacked.append([lowering.nodes(x) for x in results[carried:]])
    if params["reverse"]:
        stacked.reverse()
    return [*carry, *(np.stack(each) for each in zip(*stacked, strict=True))]


def size_of(jaxpr: Any) -> int:
    """Numbers that a traced program computes, about."""
    total = 0
    for equation in jaxpr.eqns:
        inner = [size_of(getattr(p, "jaxpr", p)) for p in _programs(equation.params)]
        turns = equation.params.get("length", 1) if equation.primitive.name == "scan" else 1
        total += turns * sum(inner) + sum(int(np.prod(v.aval.shape, dtype=int)) for v in equation.outvars)
    return total


def _programs(params: dict[str, Any]) -> list[Any]:
    values = [x for p in params.values() for x in (p if isinstance(p, tuple) else (p,))]
    return [x for x in values if hasattr(x, "eqns") or hasattr(x, "jaxpr")]


IN_MEMORY |= {"scan": _scan}
