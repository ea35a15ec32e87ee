"""Traced programs with keys of another hash than those they were traced with."""

from collections.abc import Callable, Iterable, Sequence

import jax
import jax.numpy as jnp
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal, Var

from heliograph.simulation.part import part_of
from heliograph.simulation.threefry import WRITTEN_OUT


def written_out(keys: jax.Array, programs: Sequence[ClosedJaxpr]) -> jax.Array:
    """The keys with the written-out hash where all programs can take them, else as they are."""
    ordinary = str(jax.random.key_impl(keys)) == "threefry2x32" and jax.threefry_partitionable.value
    if not (ordinary and all(_takes_any_key(program.jaxpr) for program in programs)):
        return keys
    wrapped: jax.Array = jax.random.wrap_key_data(jax.random.key_data(keys), impl=WRITTEN_OUT)
    return wrapped


def evaluated(program: ClosedJaxpr) -> Callable[..., list[jax.Array]]:
    """A traced program as a function that takes keys of another hash than those it was traced with."""

    def call(*args: jax.Array) -> list[jax.Array]:
        return _evaluate(program.jaxpr, program.consts, args)

    return call


def _evaluate(jaxpr: Jaxpr, consts: Sequence[jax.Array], args: Sequence[jax.Array]) -> list[jax.Array]:
    values = dict(zip((*jaxpr.constvars, *jaxpr.invars), (*consts, *args), strict=True))

    def read(items: Sequence[Var | Literal]) -> list[jax.Array]:
        return [item.val if isinstance(item, Literal) else values[item] for item in items]

    for operations in _stretches(jaxpr.eqns):
        first = operations[0]
        if len(operations) == 1 and first.primitive.name == "jit" and _of_keys(first):
            inner = first.params["jaxpr"]
            made, results = first.outvars, _evaluate(inner.jaxpr, inner.consts, read(first.invars))
        else:
            used, made, function = part_of(jaxpr, operations)
            results = function(*read(used))
        values |= zip(made, results, strict=True)
    return read(jaxpr.outvars)


def _stretches(operations: Sequence[JaxprEqn]) -> list[list[JaxprEqn]]:
    """Operations in order: what has to do with keys one by one, what lies between together."""
    result: list[list[JaxprEqn]] = []
    last = True
    for operation in operations:
        alone = _of_keys(operation)
        if alone or last:
            result.append([operation])
        else:
            result[-1].append(operation)
        last = alone
    return result


def _takes_any_key(jaxpr: Jaxpr) -> bool:
    """Whether no key is made, kept, or used in a loop or a branch, whose types are those of ordinary keys."""
    return not any(_is_key(item) for item in jaxpr.outvars) and all(
        _takes_any_key(operation.params["jaxpr"].jaxpr)
        if operation.primitive.name == "jit"
        else not _holds_programs(operation) and operation.primitive.name not in ("random_wrap", "random_seed")
        for operation in jaxpr.eqns
        if _of_keys(operation)
    )


def _of_keys(operation: JaxprEqn) -> bool:
    return any(_is_key(item) for item in (*operation.invars, *operation.outvars))


def _is_key(item: Var | Literal) -> bool:
    return jnp.issubdtype(item.aval.dtype, jax.dtypes.prng_key)  # type: ignore[attr-defined]


def _holds_programs(operation: JaxprEqn) -> bool:
    def parts(value: object) -> Iterable[object]:
        return value if isinstance(value, tuple | list) else (value,)

    return any(
        hasattr(part, "eqns") or hasattr(part, "jaxpr") for value in operation.params.values() for part in parts(value)
    )
