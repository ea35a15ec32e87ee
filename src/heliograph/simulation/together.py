"""Like kernels of one step as one, side by side: compiled once, however many kinds of filters use it.

A cubature and an extended filter predict in different ways and then correct by the same arithmetic. Operations keep
their order but for kernels, each of which waits until all others like it can be computed too. What is joined is copied,
which costs some of each step's time: a program of few kernels is compiled soon enough as it is.
"""

from collections.abc import Container, Iterable, Iterator
from typing import Any

import jax
from jax.extend.core import ClosedJaxpr, JaxprEqn, Literal, Var

from heliograph.numerics.over_runs import is_kernel, likeness, side_by_side
from heliograph.simulation.part import part_of

MANY = 24  # kernels of one step: four kinds of filters over a channel each have 14, the published fusion networks 48


def together(program: ClosedJaxpr, marked: Container[Var], many: int = MANY) -> ClosedJaxpr:
    """A program of many kernels with like ones as one; those that make what is marked stay apart from the others."""
    jaxpr = program.jaxpr
    if sum(map(is_kernel, jaxpr.eqns)) < many:
        return program
    groups = list(_in_groups(jaxpr.eqns, {*jaxpr.constvars, *jaxpr.invars}, marked))

    def call(*args: jax.Array) -> list[jax.Array]:
        values = dict(zip((*jaxpr.constvars, *jaxpr.invars), (*program.consts, *args), strict=True))

        def read(items: Iterable[Var | Literal]) -> list[jax.Array]:
            return [item.val if isinstance(item, Literal) else values[item] for item in items]

        for group in groups:
            if is_kernel(group[0]) and len(group) > 1:
                found = side_by_side([read(one.invars) for one in group], [one.params for one in group])
                for one, results in zip(group, found, strict=True):
                    values |= zip(one.outvars, results, strict=True)
            else:
                part = part_of(jaxpr, group)
                values |= zip(part.made, part.function(*read(part.used)), strict=True)
        return read(jaxpr.outvars)

    shapes: list[Any] = [v.aval for v in jaxpr.invars]
    return jax.make_jaxpr(call)(*shapes)


def _in_groups(operations: list[JaxprEqn], known: set[Var], marked: Container[Var]) -> Iterator[list[JaxprEqn]]:
    """All operations in an order in which each comes after what it uses: others in a row, or like kernels."""
    waiting = operations
    while waiting:
        others, kernels, later = _sorted(waiting, known)
        if others:
            yield others
        blocked = {_kind(one, marked) for one in later if is_kernel(one)}
        like: dict[Any, list[JaxprEqn]] = {}
        for one in kernels:
            like.setdefault(_kind(one, marked), []).append(one)
        free = [kind for kind in like if kind not in blocked] or list(like)[:1]  # kinds may wait for each other
        for kind in free:
            yield like[kind]
            known.update(v for one in like[kind] for v in one.outvars)
        waiting = [one for kind, group in like.items() if kind not in free for one in group] + later


def _sorted(operations: list[JaxprEqn], known: set[Var]) -> tuple[list[JaxprEqn], list[JaxprEqn], list[JaxprEqn]]:
    """Which can be computed from what is known, which then is known too; which kernels can be; and the rest."""
    others, kernels, later = [], [], []
    for one in operations:
        if not all(isinstance(v, Literal) or v in known for v in one.invars):
            later.append(one)
        elif is_kernel(one):
            kernels.append(one)
        else:
            others.append(one)
            known.update(one.outvars)
    return others, kernels, later


def _kind(operation: JaxprEqn, marked: Container[Var]) -> Any:
    return likeness(operation), any(v in marked for v in operation.outvars)
