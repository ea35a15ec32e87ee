"""Operations of one's own: a primitive of JAX that native code computes by a function in its place."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.extend.core import JaxprEqn, Primitive

from straightline.lowering import IN_MEMORY, NAMED, RULES, Lowering, Value, like
from straightline.memory import LONG, InMemory
from straightline.nodes import Node
from straightline.rules.loops import in_memory, repeated
from straightline.rules.shapes import FEW
from straightline.rules.views import joined


class Native(NamedTuple):
    """The function in a primitive's place, for one equation: its parameters, sorted, and the types of its arrays."""

    name: str
    function: Callable[..., Sequence[Any]]
    params: tuple[tuple[str, Any], ...]
    types: tuple[Any, ...]


def operation(primitive: Primitive, native: Callable[..., Sequence[Any]], mapped: str = "") -> None:
    """Say how native code, and C, compute a primitive of one's own: by a function in its place.

    So an operation that others compute by a call of a library, or in a form that suits XLA, has one that is written out
    entry by entry; and what is costly to trace is traced once for equal shapes.

    Args:
        primitive: a primitive of JAX with a name of its own, and with parameters that can be hashed.
        native: a function of JAX, from the primitive's arrays and its parameters as keywords to a list of its results.
        mapped: the parameter that has the sizes of axes that `vmap` has added, which come last in each array (1 in one
            that does not differ); `native` is of arrays without them. By default the primitive has no such axes.

    Raises:
        ValueError: a primitive that native code computes already.
    """
    name = primitive.name
    if name in RULES or (name in IN_MEMORY and name not in NAMED):
        raise ValueError(f"operation: expected a primitive with a name of its own, got {name!r}, which is JAX's")

    def rule(lowering: Lowering, equation: JaxprEqn, inputs: list[Value]) -> list[Value]:
        params, avals = equation.params, [v.aval for v in equation.outvars]
        types = tuple(v.aval.dtype for v in equation.invars)  # type: ignore[attr-defined]
        sizes: tuple[int, ...] = params[mapped] if mapped else ()
        rest = tuple(sorted((key, value) for key, value in params.items() if key != mapped))
        shapes = [a.shape[: a.ndim - len(sizes)] for a in avals]  # type: ignore[attr-defined]
        return _over(lowering, Native(name, native, rest, types), inputs, sizes, shapes)

    IN_MEMORY[name] = rule
    NAMED.add(name)


def _over(
    lowering: Lowering, one: Native, inputs: list[Value], sizes: tuple[int, ...], shapes: list[tuple[int, ...]]
) -> list[Value]:
    """Repeat over the last axis: few are written out, many become a loop."""
    if not sizes:
        results = zip(_one(lowering, one, inputs), shapes, strict=True)
        return [x if x.shape == s else np.broadcast_to(lowering.nodes(x), s) for x, s in results]
    count, rest = sizes[-1], sizes[:-1]
    # A few are written out.
    if count <= FEW:
        items = [_over(lowering, one, [_run(x, k) for x in inputs], rest, shapes) for k in range(count)]
        return [_together(lowering, list(results)) for results in zip(*items, strict=True)]
    # Of many, a loop takes apart what differs between them; what they share stays whole.
    differs = [x.shape[-1] > 1 for x in inputs]
    rows = [in_memory(lowering, x) if d else _run(x, 0) for x, d in zip(inputs, differs, strict=True)]

    def turn(index: Node, carry: list[np.ndarray]) -> tuple[list[np.ndarray], list[np.ndarray]]:
        row = [_run(x, index) if d else x for x, d in zip(rows, differs, strict=True)]
        return [], [lowering.nodes(x) for x in _over(lowering, one, row, rest, shapes)]

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


def _one(lowering: Lowering, one: Native, inputs: list[Value]) -> list[Value]:
    """Inline the function for one run, traced once for equal parameters, shapes and types."""
    kinds = tuple((x.shape, dtype) for x, dtype in zip(inputs, one.types, strict=True))
    key = one.name, one.params, kinds
    if key not in lowering.kernels:
        lowering.kernels[key] = jax.make_jaxpr(partial(one.function, **dict(one.params)))(*(like(*k) for k in kinds))
    return lowering.inline(lowering.kernels[key], inputs)


def _run(x: Value, index: Node | int) -> Value:
    """Return one run's part of an argument whose last axis is that of runs, or a number shared by all."""
    if isinstance(x, InMemory):
        last = x.view([x.shape[-1], *x.shape[:-1]], [x.strides[-1], *x.strides[:-1]])
        return last.row(0 if x.shape[-1] == 1 else index)
    flat = x.reshape(-1, x.shape[-1])
    return flat[:, min(int(index), x.shape[-1] - 1)].reshape(x.shape[:-1])  # type: ignore[arg-type]
