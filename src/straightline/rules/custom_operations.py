"""Operations of one's own: a plain function of JAX, which native code computes by another function in its place."""

from collections.abc import Callable, Sequence
from functools import cache, partial, wraps
from typing import Any, NamedTuple, ParamSpec, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, JaxprEqn, Primitive, jaxpr_as_fun
from jax.interpreters import ad, batching, mlir

from straightline.lowering import IN_MEMORY, Lowering, Value, make_placeholder
from straightline.nodes import Unsupported
from straightline.size_limits import MANY_TERMS

P = ParamSpec("P")
R = TypeVar("R")

Axes = tuple[int | None, ...]  # of each argument: 0 where `vmap` maps its first axis, None where all share it

_primitive: Any = Primitive("operation")
_primitive.multiple_results = True


class _OperationProgram(NamedTuple):
    """One operation on arguments of one shape: its plain function as traced, and what native code computes instead."""

    name: str
    plain: ClosedJaxpr
    native: Callable[..., list[Any]]  # of leaves, as `plain`
    x64: bool  # whether JAX's numbers were double where it was traced

    def __hash__(self) -> int:
        """Return a hash by the traced program: the same object is the same operation."""
        return id(self.plain)

    def __eq__(self, other: object) -> bool:
        """Return whether the other is of the same traced program; entries of it are not compared."""
        return isinstance(other, _OperationProgram) and self.plain is other.plain

    def __repr__(self) -> str:
        """Return the plain function's name, by which the texts of two programs of JAX differ."""
        return self.name


def operation(native: Callable[P, R]) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Decorate a function, here called the plain one, for which native code and C compute another one, `native`.

    The two are the same function in two forms: all entries side by side, which suits XLA, and a straight line of
    operations, which suits native code. XLA compiles, `vmap` maps and JAX differentiates the plain one. Native code
    computes `native`, on one item after another where `vmap` maps them, or the plain one where `native` is too long.

    Args:
        native: a function of the same arguments with the same results.

    Returns:
        The decorator of the plain function, whose arguments are trees of arrays.
    """

    def decorate(plain: Callable[P, R]) -> Callable[P, R]:
        """Return the function as one operation (primitive) of JAX, which native code computes by `native`."""

        @cache
        def trace_plain_function(tree: Any, kinds: tuple[Any, ...], x64: bool) -> tuple[_OperationProgram, Any]:
            """Trace the plain function for arguments of these shapes and types (`kinds`).

            Returns the operation's program and the tree of its results. `x64`: whether JAX's numbers are double now,
            on which the trace depends.
            """
            result_tree: list[Any] = []  # filled while it is traced

            def call_on_leaves(function: Callable[..., R], *leaves: Any) -> list[Any]:
                """Return the leaves of the function's results from its arguments' leaves; note the results' tree."""
                args, kwargs = jax.tree.unflatten(tree, leaves)
                results, structure = jax.tree.flatten(function(*args, **kwargs))
                result_tree[:] = [structure]
                return results

            traced = jax.make_jaxpr(partial(call_on_leaves, plain))(*(make_placeholder(*kind) for kind in kinds))
            name = f"{plain.__module__}.{plain.__qualname__}"
            return _OperationProgram(name, traced, partial(call_on_leaves, native), x64), result_tree[0]

        @wraps(plain)
        def call_as_operation(*args: P.args, **kwargs: P.kwargs) -> R:
            """Trace the function once for these shapes, then bind it as one primitive, which `vmap` and others see."""
            leaves, tree = jax.tree.flatten((args, kwargs))
            leaves = [jnp.asarray(leaf) for leaf in leaves]
            kinds = tuple((leaf.shape, leaf.dtype) for leaf in leaves)
            is_x64 = bool(jnp.result_type(float) == np.float64)
            program, result_tree = trace_plain_function(tree, kinds, is_x64)
            flat = _primitive.bind(*leaves, program=program, levels=(), sizes=())  # under no vmap yet
            results: R = jax.tree.unflatten(result_tree, flat)
            return results

        return call_as_operation

    return decorate


def _apply_plain(
    *leaves: Any, program: _OperationProgram, levels: tuple[Axes, ...], sizes: tuple[int, ...]
) -> list[Any]:
    """Return the results of an operation's plain function, mapped by one `vmap` for each of `levels`.

    An operation has two forms: a plain function of JAX, which XLA compiles, and another one for native code. JAX knows
    it as a primitive, whose parameters are `program` (both forms), `levels` and `sizes`. This is what JAX computes, and
    differentiates, for the primitive. A level holds the mapped axis of each argument, None for an argument that is not
    mapped; the innermost level comes first. `sizes`, the lengths of the mapped axes, are not needed here.
    """
    function = jaxpr_as_fun(program.plain)
    for axes in levels:
        function = jax.vmap(function, in_axes=axes)
    return list(function(*leaves))


def _find_result_shapes(
    *_: Any, program: _OperationProgram, levels: tuple[Axes, ...], sizes: tuple[int, ...]
) -> list[Any]:
    """Return the shapes and types of an operation's results.

    The shapes are those of the plain function, led by an axis for each level of `vmap`, whose lengths are `sizes`.
    """
    return [jax.core.ShapedArray((*sizes, *aval.shape), aval.dtype) for aval in program.plain.out_avals]


def _batch_operation(
    leaves: Sequence[Any], axes: Sequence[int | None], *, program: _OperationProgram, levels: tuple[Axes, ...],
    sizes: tuple[int, ...],
) -> tuple[list[Any], list[int]]:  # fmt: skip
    """Return the results of an operation under one more `vmap`, as the same operation with one more batch axis.

    Args:
        leaves: its arguments.
        axes: batch axis of each argument under this `vmap`, None for one without; it is moved to the front.
        program: the operation.
        levels: for each `vmap` inside of this one, innermost first, the batch axis of each argument, 0 or None.
        sizes: size of the batch of each of these, outermost first.

    Returns:
        The results, and the batch axis of each, 0.
    """
    moved = [x if axis is None else jnp.moveaxis(x, axis, 0) for x, axis in zip(leaves, axes, strict=True)]
    level = tuple(None if axis is None else 0 for axis in axes)
    size = next(x.shape[0] for x, axis in zip(moved, level, strict=True) if axis == 0)
    results = _primitive.bind(*moved, program=program, levels=(*levels, level), sizes=(size, *sizes))
    return results, [0] * len(results)


def _differentiate(primals: Sequence[Any], tangents: Sequence[Any], **params: Any) -> tuple[list[Any], list[Any]]:
    """Return the plain function's results and their tangents.

    Only the arguments (primals) whose tangents are not zero are differentiated; the others are held fixed.
    """
    has_tangent = [not isinstance(tangent, ad.Zero) for tangent in tangents]

    def call(*varying: Any) -> list[Any]:
        """Return the plain function's results with `varying` in place of the arguments that have tangents."""
        rest = iter(varying)
        return _apply_plain(*(next(rest) if has else x for has, x in zip(has_tangent, primals, strict=True)), **params)

    values = [x for has, x in zip(has_tangent, primals, strict=True) if has]
    directions = [x for has, x in zip(has_tangent, tangents, strict=True) if has]
    results, slopes = jax.jvp(call, values, directions)
    return results, slopes


def _apply_native(lowering: Lowering, equation: JaxprEqn, inputs: list[Value]) -> list[Value]:
    """Return the results of an operation by its native function, or else by its plain one.

    The plain function is used if native code does not take the native function, or if that has more than MANY_TERMS
    operations. Known zeros in the arguments reduce this count, so it is only known once the function is written out.
    """
    program: _OperationProgram = equation.params["program"]
    try:
        with lowering.graph.limit_new_nodes(MANY_TERMS):
            return lowering.inline_program(_trace_in_loops(lowering, equation, program.native), inputs)
    except Unsupported:
        return lowering.inline_program(_trace_in_loops(lowering, equation, jaxpr_as_fun(program.plain)), inputs)


def _trace_in_loops(lowering: Lowering, equation: JaxprEqn, function: Callable[..., list[Any]]) -> ClosedJaxpr:
    """Return the program of a function of one item, called in one loop for each level of `vmap`.

    `lowering.kernels` keeps the programs, so that equal shapes and types are traced once.
    """
    program, levels = equation.params["program"], equation.params["levels"]
    kinds = tuple((v.aval.shape, v.aval.dtype) for v in equation.invars)  # type: ignore[attr-defined]
    key = program, function is program.native, levels, kinds
    if key not in lowering.kernels:
        for axes in levels:
            function = partial(_apply_one_by_one, function, axes)
        # Trace in the precision that JAX had when the operation was called.
        with jax.enable_x64(program.x64):
            lowering.kernels[key] = jax.make_jaxpr(function)(*(make_placeholder(*kind) for kind in kinds))
    return lowering.kernels[key]


def _apply_one_by_one(function: Callable[..., list[Any]], axes: Axes, *leaves: Any) -> list[Any]:
    """Return a function's results for each entry of a batch, stacked: a `vmap` that is computed in a loop.

    `axes` holds 0 for a leaf with a batch along its first axis, and None for a leaf that all entries share.
    """

    def call(entries: list[Any]) -> list[Any]:
        """Return the function's results for one entry of each leaf with a batch, and the other leaves as they are."""
        rest = iter(entries)
        return function(*(x if axis is None else next(rest) for x, axis in zip(leaves, axes, strict=True)))

    results: list[Any] = jax.lax.map(call, [x for x, axis in zip(leaves, axes, strict=True) if axis == 0])
    return results


_primitive.def_impl(jax.jit(_apply_plain, static_argnames=("program", "levels", "sizes")))
_primitive.def_abstract_eval(_find_result_shapes)
batching.primitive_batchers[_primitive] = _batch_operation
ad.primitive_jvps[_primitive] = _differentiate
mlir.register_lowering(_primitive, mlir.lower_fun(_apply_plain, multiple_results=True))
IN_MEMORY["operation"] = _apply_native
