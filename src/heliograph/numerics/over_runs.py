"""One matrix's arithmetic over many runs: vmap's axis goes last, and costly cases are computed where needed."""

from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, Protocol, TypeVar

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap

from heliograph.numerics.types import Array, PyTree

P = ParamSpec("P")
R = TypeVar("R")


def runs_last(kernel: Callable[P, R], differentiable_as: Callable[P, R] | None = None) -> Callable[P, R]:
    """Have vmap put its axis last in every argument and result of a kernel; derivatives are those of its arithmetic.

    Or of other arithmetic for the same: that of a kernel which branches on all runs at once, `where_any`, cannot be
    mapped over runs.
    """
    source = kernel if differentiable_as is None else differentiable_as
    traced = jax.jit(kernel)  # once per shapes, however many filters use it
    batched = custom_vmap(lambda *args: jax.lax.platform_dependent(*args, cpu=_alone(traced), default=traced))

    @batched.def_vmap
    def rule(size: int, is_batched: PyTree, *args: PyTree) -> tuple[PyTree, PyTree]:
        moved = jax.tree.map(_to_last, args, tuple(is_batched))
        results = jax.tree.map(lambda x: _to_first(x, size), batched(*moved))
        return results, jax.tree.map(lambda _: True, results)

    differentiable = jax.custom_jvp(batched)
    differentiable.defjvp(lambda primals, tangents: jax.jvp(source, primals, tangents))
    return wraps(kernel)(differentiable)


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


class Pick(Protocol):
    """`where_any` or `where_each`."""

    def __call__(self, needed: jax.Array, costly: Callable[[], R], cheap: Callable[[], R]) -> R:
        """One array or several, with the runs last."""


def where_any(needed: jax.Array, costly: Callable[[], R], cheap: Callable[[], R]) -> R:
    """`costly` for runs that need it and `cheap` for the others; `costly` is computed only where any run needs it."""
    result: R = jax.lax.cond(jnp.any(needed), lambda: where_each(needed, costly, cheap), cheap)
    return result


def where_each(needed: jax.Array, costly: Callable[[], R], cheap: Callable[[], R]) -> R:
    """The same by computing both."""
    result: R = jax.tree.map(lambda a, b: jnp.where(needed, a, b), costly(), cheap())
    return result


def _to_last(x: Array, is_batched: bool) -> jax.Array:
    x = jnp.asarray(x)
    return jax.lax.transpose(x, (*range(1, x.ndim), 0)) if is_batched else jax.lax.expand_dims(x, (x.ndim,))


def _to_first(x: jax.Array, size: int) -> jax.Array:
    x = jnp.broadcast_to(x, (*x.shape[:-1], size))
    return jax.lax.transpose(x, (x.ndim - 1, *range(x.ndim - 1)))
