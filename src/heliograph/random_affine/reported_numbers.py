"""Memories whose state is drawn anew at each step and reported to the receiver with each message."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.numerics.check import fail, scalar
from heliograph.numerics.types import Array, Float
from heliograph.random_affine.laws.gain_given_reading import require_density
from heliograph.random_affine.laws.law import AbstractLaw
from heliograph.random_affine.markov_chain_and_autoregression import AbstractMemory, MemoryStates, identify_memory
from heliograph.random_affine.noises.noise import AbstractNoise


class AbstractFreshDraw(AbstractMemory):
    """Numbers that are drawn independently at each step, and reported to the receiver with each message."""

    def move(self, state: jax.Array, key: jax.Array) -> jax.Array:
        """Draw the next state by the law of the first one: it does not depend on the last `state`."""
        return self.begin(key)

    def nodes(self, degree: int) -> MemoryStates:
        """Raise ValueError: the reported numbers are no finite set of hidden modes that a filter could weigh.

        A filter of modes asks a memory for its states with their probabilities. The numbers of this one are drawn anew
        at each step and known to the receiver, so that a filter takes them from the message instead.
        """
        expected = "a filter that takes what a message tells, such as linear_filter or extended_filter"
        raise fail("link whose gain or noise is told", expected, "what takes it for a mode that nobody is told")


class FreshNumbers(AbstractFreshDraw):
    """Numbers that are drawn anew at each step, all of which each message reports to the receiver.

    Args:
        law: law of the numbers, of a gain for one of them; None where nobody knows it, and nothing can be simulated.
        count: how many.
        name: name by which links share the numbers; None for numbers of one link.
    """

    law: AbstractLaw | AbstractNoise | None
    count: int = eqx.field(static=True)
    name: str | None = eqx.field(static=True)
    identity: str = eqx.field(static=True)

    def __init__(self, law: AbstractLaw | AbstractNoise | None, count: int, name: str | None = None):
        """Hold the joint law of `count` numbers and the name under which links share them."""
        self.law, self.count, self.name, self.identity = law, count, name, identify_memory(name)

    @property
    def announced(self) -> int:
        """Number of values that each message reports: all `count` of them."""
        return self.count

    def announce(self, state: int | float | jax.Array | np.ndarray) -> jax.Array | np.ndarray:
        """Return the numbers (count,) that a message reports of this state: the state itself."""
        return jnp.asarray(state)

    def begin(self, key: jax.Array) -> jax.Array:
        """Draw the first numbers (count,) from their law; raise ValueError if there is none."""
        if self.law is None:
            raise fail("simulating what a message tells", "a law of the numbers: told(..., law=...)", "none")
        return jnp.reshape(self.law.sample(key), (self.count,))


class FreshReading(AbstractFreshDraw):
    """A gain g that is drawn anew at each step, and its reading a = g + e; a message reports only the reading.

    Args:
        law: law of the gain g.
        variance: of the error e of the reading, positive.
    """

    law: AbstractLaw
    variance: Float[Array, ""]
    name: str | None = eqx.field(static=True)
    identity: str = eqx.field(static=True)

    def __init__(self, law: AbstractLaw, variance: Float[Array, ""]):
        """Hold the law of the gain g and the variance of the reading error e."""
        self.law = require_density(law)
        self.variance = scalar("noise of a pilot", variance, np.finfo(float).tiny)
        self.name, self.identity = None, identify_memory(name=None)

    def announce(self, state: int | float | jax.Array | np.ndarray) -> jax.Array | np.ndarray:
        """Return the reported reading a (1,), from the state (g, a)."""
        return jnp.asarray(state)[1:]

    def begin(self, key: jax.Array) -> jax.Array:
        """Draw (g, a) (2,), a gain g and its reading a = g + e, where the error e has the variance `variance`."""
        gain_key, error_key = jax.random.split(key)
        gain = self.law.sample(gain_key)
        error = jax.random.normal(error_key, dtype=float)
        return jnp.stack([gain, gain + jnp.sqrt(self.variance) * error])
