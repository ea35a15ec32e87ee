"""Some operations of a traced program as a function of their own."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal, Var, jaxpr_as_fun


class Part(NamedTuple):
    """What the operations use from outside, what they make, and the function from the one to the other."""

    used: list[Var]
    made: list[Var]
    function: Callable[..., list[jax.Array]]


def part_of(whole: Jaxpr, operations: Sequence[JaxprEqn]) -> Part:
    """Operations of a program in an order in which each comes after what it uses."""
    made = [item for operation in operations for item in operation.outvars]
    inside = set(made)
    items = [item for operation in operations for item in operation.invars]
    used = list(dict.fromkeys(i for i in items if not isinstance(i, Literal) and i not in inside))
    part: Jaxpr = whole.replace(  # type: ignore[no-untyped-call]
        eqns=list(operations), constvars=[], invars=used, outvars=made,
        debug_info=whole.debug_info.with_unknown_names(),
    )  # fmt: skip
    return Part(used, made, jaxpr_as_fun(ClosedJaxpr(part, ())))
