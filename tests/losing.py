"""A filter that loses its covariance, for what is said of it."""

import equinox as eqx
import jax.numpy as jnp

import heliograph as h


class Losing(h.filters.AbstractFilter):
    """A filter whose covariance is indefinite from its third step."""

    claim: str = eqx.field(static=True, default="nominal")
    states: tuple[str, ...] = eqx.field(static=True, default=("p", "v"))
    inputs: tuple[str, ...] = eqx.field(static=True, default=())
    received: int = eqx.field(static=True, default=1)

    def init(self):
        return jnp.ones(2)

    def predict(self, state, u=(), k=0):
        return jnp.stack([1.0, jnp.where(k >= 2, -1.0, 1.0)])

    def correct(self, state, z, k=0):
        return state, h.model.Innovation(z, jnp.eye(1), 0.0)

    def estimate(self, state):
        return h.model.Estimate(0 * state, jnp.diag(state), self.claim)


class Tied(Losing):
    """A filter whose covariance has a correlation of 2 from its third step, though no variance is negative."""

    def estimate(self, state):
        tied = jnp.eye(2) + (1 - state[1]) * jnp.array([[0.0, 1.0], [1.0, 0.0]])
        return h.model.Estimate(0 * state, tied, self.claim)
