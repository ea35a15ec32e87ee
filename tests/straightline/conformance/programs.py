"""Cases of inner programs, of random numbers and of what passes numbers on."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.ad_checkpoint import checkpoint_name

from straightline import operation, present
from tests.straightline.conformance.case import Case

X = np.array([0.0, -0.0, 1.5, -2.0, np.nan, np.inf, 40.0])
WHICH = np.array([-(2**31), -1, 0, 1, 2, 3, 2**31 - 1], np.int32)
WORDS = np.array([[0, 0], [1, 2], [2**32 - 1, 2**31], [5, 6]], np.uint32)
SEEDS = np.array([0, 1, -1, 2**31 - 1, -(2**63), 2**63 - 1], np.int64)


@jax.custom_jvp
def softened(x: jax.Array) -> jax.Array:
    """A function with a derivative of its own."""
    return jnp.where(x > 0, x, 0.5 * x)


softened.defjvp(lambda primal, tangent: (softened(*primal), tangent[0]))


@jax.custom_vjp
def doubled(x: jax.Array) -> jax.Array:
    """Another."""
    return 2 * x


doubled.defvjp(lambda x: (2 * x, None), lambda _, g: (g,))


@jax.custom_batching.custom_vmap
def tripled(x: jax.Array) -> jax.Array:
    """A function with a rule of its own under vmap."""
    return 3 * x


tripled.def_vmap(lambda size, batched, x: (3 * x, batched[0]))


@operation(lambda x: (x + x) + (x + x))
def quadrupled(x: jax.Array) -> jax.Array:
    """A function with another one in its place in native code."""
    return 4 * x


def _dear(x: jax.Array) -> jax.Array:
    for _ in range(120):
        x = 0.5 * x + jnp.abs(x - 1)
    return x


def _branches(k: jax.Array, x: jax.Array) -> Any:
    both = lax.switch(k, [lambda v: v, lambda v: -v, _dear], x)
    return both, lax.cond(x > 0, _dear, lambda v: v - 1, x), lax.cond(True, lambda v: v, jnp.sqrt, x)


def _while(x: jax.Array) -> Any:
    count = lax.while_loop(lambda s: (s[0] > 1) & (s[1] < 90), lambda s: (s[0] / 2, s[1] + 1), (x, jnp.int32(0)))
    nested = lax.while_loop(
        lambda s: s[1] < 3, lambda s: (lax.while_loop(lambda v: v < 5, lambda v: v + 1, s[0]), s[1] + 1), (x, 0)
    )
    return count, nested, lax.fori_loop(3, 3, lambda i, v: v + 1, x), lax.fori_loop(5, 2, lambda i, v: v + 1, x)


def _scan(x: jax.Array) -> Any:
    def turn(c, r):
        return ((r - 0.5 * c[0], c[1] + 1), c[0])

    start = (x, jnp.int32(0))
    return [lax.scan(turn, start, x * jnp.ones(n), reverse=back) for n in (0, 1, 3, 300) for back in (False, True)]


def _keyed(function: Callable[[jax.Array], Any]) -> list[Case]:
    return [Case(lambda w: function(jax.random.wrap_key_data(w)), (WORDS,), 8.0)]


def _of(function: Callable[[jax.Array], Any]) -> list[Case]:
    return [Case(function, (X,))]


data = jax.random.key_data
CALLS = _of(jax.jit(lambda x: (x, -x)))
CASES: dict[str, list[Case]] = {
    "cond": [Case(_branches, (np.repeat(WHICH, len(X)), np.tile(X, len(WHICH))))],
    "while": _of(_while),
    "scan": _of(_scan),
    "jit": CALLS,
    "pjit": CALLS,
    "closed_call": CALLS,
    "core_call": CALLS,
    "custom_jvp_call": _of(softened),
    "custom_vjp_call": _of(doubled),
    "custom_vjp_call_jaxpr": _of(doubled),
    "custom_vmap_call": _of(tripled),
    "operation": _of(lambda x: (quadrupled(x), jax.vmap(quadrupled)(x * jnp.arange(40.0)))),
    "checkpoint": _of(jax.checkpoint(lambda x: x + 1)),
    "remat": _of(jax.checkpoint(lambda x: x + 1)),
    "remat2": _of(jax.checkpoint(lambda x: x + 1)),
    "call_hi_primitive": _of(lambda x: jnp.frexp(x)[0]),
    "platform_index": _of(lambda x: lax.platform_dependent(x, cpu=lambda v: v + 1, default=lambda v: v - 1)),
    "present": _of(present),
    "copy": _of(jnp.copy),
    "copy_p": _of(jnp.copy),
    "stop_gradient": _of(lax.stop_gradient),
    "optimization_barrier": _of(lax.optimization_barrier),
    "name": _of(lambda x: checkpoint_name(x, "kept")),
    "polynomial": _of(lambda x: jnp.polyval(jnp.array([1.0, 2.0]), x)),
    "empty": _of(lambda x: x),
    "empty2": _of(lambda x: x),
    "random_wrap": _keyed(data),
    "random_unwrap": _keyed(data),
    "random_clone": _keyed(lambda k: data(jax.random.clone(k))),
    "random_split": _keyed(lambda k: data(jax.random.split(k, 3))),
    "random_fold_in": [
        Case(
            lambda w, n: data(jax.random.fold_in(jax.random.wrap_key_data(w), n)),
            (WORDS, np.array([0, 1, 2**31, 2**32 - 1], np.uint32)),
        )
    ],
    "random_seed": [
        Case(lambda s: data(jax.random.key(s)), (SEEDS,)),
        Case(lambda s: data(jax.random.key(s)), (SEEDS[:4].astype(np.int32),)),
    ],
    "random_bits": _keyed(
        lambda k: (
            jax.random.bits(k, (3,), np.uint32),
            jax.random.bits(k, (2,), np.uint64),
            jax.random.uniform(k),
            jax.random.normal(k),
            jax.random.choice(k, jnp.arange(5.0)),
            jax.random.choice(k, 4, (2,)),
            jax.random.choice(k, jnp.arange(3.0), p=jnp.array([0.2, 0.5, 0.3])),
            jax.random.randint(k, (3,), -5, 7),
            jax.random.categorical(k, jnp.array([0.1, 0.9, -1.0])),
            jax.random.bernoulli(k, 0.3),
        )
    ),
    "random_gamma": _keyed(lambda k: jax.random.gamma(k, 1.7)),
    "threefry2x32": _keyed(
        lambda k: data(k) ^ jax.extend.random.threefry_2x32(data(k), jnp.arange(4, dtype=np.uint32))[:2]
    ),
}
