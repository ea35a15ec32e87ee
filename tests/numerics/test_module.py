"""Modules of ours: trees of arrays that bind methods as Python does."""

from types import MethodType

import jax
import jax.numpy as jnp

import heliograph as hg


class Scaled(hg.random_affine.AbstractLaw):
    """A number to multiply by, held by a law."""

    factor: jax.Array

    def of(self, x: jax.Array) -> jax.Array:
        """The product."""
        return self.factor * x

    def sample(self, key: jax.Array) -> jax.Array:
        """Draw the number."""
        return self.factor

    def moment(self, order: int) -> jax.Array:
        """Its power."""
        return self.factor**order


def test_methods_are_bound_as_python_does():
    """A module for each bound method would take apart all that the object holds, at each call."""
    for method in (Scaled(jnp.ones(2)).of, hg.hop(1.0, 0.1).sample):
        assert type(method) is MethodType


def test_they_can_be_transformed_all_the_same():
    """Bound or as an argument, the arrays of a module are traced."""
    single = Scaled(jnp.array([2.0, 3.0]))
    assert jnp.array_equal(jax.vmap(single.of)(jnp.ones((4, 2))), jnp.tile(single.factor, (4, 1)))
    slope = jax.grad(lambda item: item.of(jnp.ones(2)).sum())(single)
    assert jnp.array_equal(slope.factor, jnp.ones(2))
    assert jnp.array_equal(jax.jit(single.of)(jnp.ones(2)), single.factor)
