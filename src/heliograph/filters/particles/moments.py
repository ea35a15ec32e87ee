"""Weighted moments of particles, in two passes of sums over them: a part of the particles has a part of each sum."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from heliograph.numerics.angle import Angles


class FirstSums(NamedTuple):
    """Sums of w, of w^2, of w x (n,), and of w sin x and w cos x of the angles (angles,) of x."""

    weight: jax.Array
    square: jax.Array
    value: jax.Array
    sine: jax.Array
    cosine: jax.Array

    def mean(self, angles: Angles) -> jax.Array:
        """Return the weighted mean (n,), of an angle the mean direction."""
        mean = jnp.asarray(self.value) / self.weight
        for place, i in enumerate(angles):
            # of weighted sums of sine and cosine
            mean = mean.at[i].set(jnp.arctan2(self.sine[place], self.cosine[place]))
        return mean


class StateSums(NamedTuple):
    """First sums of the states of particles, and of the weights of modes (modes,), without any where there is one."""

    first: FirstSums
    modes: jax.Array | None


def first_sums(weight: jax.Array, x: jax.Array, angles: Angles) -> FirstSums:
    """Return the first sums of numbers x (N, n) by weights (N,), which need not sum to 1.

    They are of the weights, their squares and x, and of sine and cosine of the components that are angles.
    """
    of_angles = x[:, list(angles)]
    square, around = jnp.sum(weight**2), (weight @ jnp.sin(of_angles), weight @ jnp.cos(of_angles))
    return FirstSums(jnp.sum(weight), square, weight @ x, *around)


def second_sums(weight: jax.Array, apart: jax.Array) -> jax.Array:
    """Return the sum of w d d' (n, n) of differences d (N, n) from one place, by weights (N,)."""
    return (apart * weight[:, None]).T @ apart
