"""One matrix's arithmetic over many runs: vmap's axes go last.

A kernel is an operation of its own in what JAX traces: a level of vmap adds an axis to it and looks into nothing, so
that its arithmetic is traced for one matrix, whose shapes are those of its results, and once more for all, as compiled.
"""

from collections.abc import Callable, Sequence
from functools import partial, wraps
from typing import Any, ParamSpec, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from heliograph.numerics.types import PyTree
from straightline import operation

P = ParamSpec("P")
R = TypeVar("R")

_kernel: Any = Primitive("runs_last")
_kernel.multiple_results = True


class _Kernel:
    """Arithmetic of one kernel and that of its derivatives; compared by identity."""

    def __init__(self, function: Callable[..., PyTree], written: Callable[..., PyTree] | None):
        # Traced once per shapes, however many filters use it, for the shapes of results, for XLA and for native code.
        self.function = jax.jit(lambda args, kwargs: function(*args, **kwargs))
        self.source = function
        self.sloped = jax.jit(partial(_sloped, function), static_argnums=(0, 1), inline=True)
        self.written = self.function if written is None else jax.jit(lambda args, kwargs: written(*args, **kwargs))

    def __repr__(self) -> str:
        """Return the name of the arithmetic, by which the texts of two programs differ."""
        function = self.source.func if isinstance(self.source, partial) else self.source
        return f"{function.__module__}.{function.__qualname__}"


Shapes = Callable[..., PyTree]  # a kernel's arguments -> the shape of its result, or of each in a tuple


def runs_last(
    kernel: Callable[P, R],
    shapes: Shapes | None = None,
    written: Callable[P, R] | None = None,
) -> Callable[P, R]:
    """Return a kernel for which vmap puts its axis last in every argument and result.

    Args:
        kernel: arithmetic whose arrays carry the mapped axis last.
        shapes: shapes of the results as a function of the arguments; without it the kernel is traced to find them.
        written: the same arithmetic entry by entry, for native code; the kernel unless given.
    """
    this = _Kernel(kernel, written)

    @wraps(kernel)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        leaves, tree = jax.tree.flatten((args, kwargs))
        leaves = [jnp.asarray(leaf) for leaf in leaves]
        # Shapes and types of the results, by tracing where they are not stated.
        if shapes is None:
            like = jax.eval_shape(this.function, *jax.tree.unflatten(tree, leaves))
        else:
            like = _said(shapes(*args, **kwargs), leaves)
        declared, form = jax.tree.flatten(like)
        sizes = tuple((x.shape, x.dtype) for x in declared)
        x64 = bool(jnp.result_type(float) == np.float64)
        # One primitive, so that its batching rule can move the mapped axis last.
        results = _kernel.bind(*leaves, kernel=this, tree=tree, declared=sizes, x64=x64, runs=())
        arranged: R = jax.tree.unflatten(form, results)
        return arranged

    return call


def runs_last_of(shapes: Shapes) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """`runs_last` of a kernel that takes long to trace, whose results have these shapes."""
    return lambda kernel: runs_last(kernel, shapes=shapes)


def _said(shapes: PyTree, leaves: Sequence[jax.Array]) -> PyTree:
    """Results of these shapes, numbers of the type that arithmetic with all arguments has."""
    numbers = [leaf for leaf in leaves if jnp.issubdtype(leaf.dtype, jnp.floating)]
    struct = partial(jax.ShapeDtypeStruct, dtype=jnp.result_type(*numbers))
    return jax.tree.map(struct, shapes, is_leaf=lambda s: isinstance(s, tuple) and all(isinstance(i, int) for i in s))


def _shapes(*_: Any, declared: tuple[Any, ...], runs: tuple[int, ...], **rest: Any) -> list[jax.core.ShapedArray]:
    return [jax.core.ShapedArray((*shape, *runs), dtype) for shape, dtype in declared]


def _computed(
    *leaves: jax.Array,
    kernel: _Kernel,
    tree: Any,
    declared: tuple[Any, ...],
    x64: bool,
    runs: tuple[int, ...],
    alone: bool = False,
) -> list[jax.Array]:
    """The results of all runs, in the precision of the call: what is compiled is traced after its context has ended."""
    function = _alone(kernel.function) if alone else kernel.function
    with jax.enable_x64(x64):
        results = jax.tree.leaves(function(*jax.tree.unflatten(tree, leaves)))
        return _for_each(results, declared, runs)


def _for_each(results: Sequence[jax.Array], declared: tuple[Any, ...], runs: tuple[int, ...]) -> list[jax.Array]:
    """Results that no run's own argument has a part in come with an axis of 1."""
    return [jnp.broadcast_to(x, (*shape, *runs)) for x, (shape, _) in zip(results, declared, strict=True)]


def _over_one_more(
    leaves: Sequence[jax.Array], axes: Sequence[int | None], *, runs: tuple[int, ...], **rest: Any
) -> tuple[list[jax.Array], list[int]]:
    size = next(x.shape[axis] for x, axis in zip(leaves, axes, strict=True) if axis is not None)
    moved = [
        jnp.expand_dims(x, jnp.ndim(x)) if axis is None else jnp.moveaxis(x, axis, -1)
        for x, axis in zip(leaves, axes, strict=True)
    ]
    results = _kernel.bind(*moved, runs=(*runs, size), **rest)
    return results, [x.ndim - 1 for x in results]


def _with_tangents(
    primals: Sequence[jax.Array],
    tangents: Sequence[Any],
    *,
    kernel: _Kernel,
    tree: Any,
    declared: tuple[Any, ...],
    runs: tuple[int, ...],
    **rest: Any,
) -> tuple[list[jax.Array], list[jax.Array]]:
    """Derivatives in what has tangents; of the rest nothing is computed."""
    moves = tuple(not isinstance(t, ad.Zero) for t in tangents)
    at, along = (tuple(x for m, x in zip(moves, values, strict=True) if m) for values in (primals, tangents))
    fixed = tuple(x for m, x in zip(moves, primals, strict=True) if not m)
    results, slopes = kernel.sloped(tree, moves, at, along, fixed)
    return _for_each(results, declared, runs), _for_each(slopes, declared, runs)


def _sloped(
    source: Callable[..., PyTree],
    tree: Any,
    moves: tuple[bool, ...],
    at: tuple[jax.Array, ...],
    along: tuple[jax.Array, ...],
    fixed: tuple[jax.Array, ...],
) -> tuple[list[jax.Array], list[jax.Array]]:
    """Results and derivatives of a kernel's arithmetic, traced once per shapes and arguments that move."""

    @wraps(source)
    def of_moving(*moving: jax.Array) -> list[jax.Array]:
        items, others = iter(moving), iter(fixed)
        args, kwargs = jax.tree.unflatten(tree, [next(items if m else others) for m in moves])
        return jax.tree.leaves(source(*args, **kwargs))

    results, slopes = jax.jvp(of_moving, at, along)
    return results, slopes


def _written(*leaves: jax.Array, kernel: _Kernel, tree: Any, **rest: Any) -> list[jax.Array]:
    """The results of one run, entry by entry: what native code computes."""
    results: list[jax.Array] = jax.tree.leaves(kernel.written(*jax.tree.unflatten(tree, leaves)))
    return results


operation(_kernel, _written, mapped="runs")
_kernel.def_impl(_computed)
_kernel.def_abstract_eval(_shapes)
batching.primitive_batchers[_kernel] = _over_one_more
ad.primitive_jvps[_kernel] = _with_tangents
mlir.register_lowering(_kernel, mlir.lower_fun(_computed, multiple_results=True))
mlir.register_lowering(_kernel, mlir.lower_fun(partial(_computed, alone=True), multiple_results=True), platform="cpu")


def _alone(kernel: Callable[..., PyTree]) -> Callable[..., PyTree]:
    """The kernel as the branch of a conditional that is always taken, since the compiler fuses nothing across it.

    Without it (barriers are dropped for processors) a covariance is computed again inside each of its uses. The
    condition hangs on the data, or the compiler would see through it: a number's bits with the last one set are not 0.
    """

    def call(*args: PyTree) -> PyTree:
        number = next(leaf for leaf in jax.tree.leaves(args) if jnp.issubdtype(jnp.result_type(leaf), jnp.floating))
        taken = jnp.any((jnp.ravel(number)[:1].view(jnp.uint32) | 1) != 0)
        shapes = jax.eval_shape(kernel, *args)
        return jax.lax.cond(
            taken, kernel, lambda *_: jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), shapes), *args
        )

    return call
