"""Weighted moments of particles, in two passes of sums over them: a part of the particles has a part of each sum."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.numerics.angles.angle import Angles
from heliograph.numerics.types import Array, PyTree


class FirstSums(NamedTuple):
    """Sums of w, of w^2, of w x (n,), and of w sin x and w cos x of the angles (angles,) of x."""

    weight: jax.Array
    square: jax.Array
    value: jax.Array
    sine: jax.Array
    cosine: jax.Array

    def mean(self, angles: Angles) -> jax.Array:
        """Return the weighted mean (n,); for an angle it is the direction of the sums of cosine and sine."""
        mean = jnp.asarray(self.value) / self.weight
        for i, sine, cosine in zip(angles, self.sine, self.cosine, strict=True):
            mean = mean.at[i].set(jnp.arctan2(sine, cosine))
        return mean


class StateSums(NamedTuple):
    """Sums over particles, from which their mean follows, and the sum of weights in each mode (M,).

    `modes` is None where there is only one mode.
    """

    first: FirstSums
    modes: jax.Array | None


def first_sums(weight: jax.Array, x: jax.Array, angles: Angles) -> FirstSums:
    """Return sums over N particles x (N, n) with weights w (N,), from which their weighted mean follows.

    They are the sums of w, w^2, w x, and of w sin x and w cos x of the components that are angles. The weights need not
    sum to 1, and the sums of several groups of particles add up.
    """
    angle_columns = x[:, list(angles)]
    sum_of_squares = jnp.sum(weight**2)
    sine, cosine = weight @ jnp.sin(angle_columns), weight @ jnp.cos(angle_columns)
    return FirstSums(jnp.sum(weight), sum_of_squares, weight @ x, sine, cosine)


def second_sums(weight: jax.Array, differences: jax.Array) -> jax.Array:
    """Return the sum of w d d' (n, n) of differences d (N, n) from one point, by weights w (N,)."""
    return (differences * weight[:, None]).T @ differences


def pack_sums(sums: PyTree) -> jax.Array:
    """Return a tree of sums as one vector: native code adds up groups of particles in vectors."""
    return jnp.concatenate([jnp.ravel(leaf) for leaf in jax.tree.leaves(sums)])


def unpack_sums(vector: Array, function: Callable[..., PyTree], *arguments: Any) -> Any:
    """Return the sums that `pack_sums` joined in one vector, with the tree and shapes of function(*arguments).

    The function is not computed: only the shapes of its result are needed.
    """
    leaves, structure = jax.tree.flatten(jax.eval_shape(function, *arguments))
    ends = np.cumsum([math.prod(leaf.shape) for leaf in leaves])[:-1].tolist()
    pieces = jnp.split(jnp.asarray(vector), ends)
    return jax.tree.unflatten(structure, [x.reshape(leaf.shape) for x, leaf in zip(pieces, leaves, strict=True)])
