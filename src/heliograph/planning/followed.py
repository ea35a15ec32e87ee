"""What JAX follows through a function that returns a network: compiled once for all designs of the same network.

The gradient of the error is the adjoint's at fixed gains (`modes_told`), pulled back through the moments of channels
and through the powers.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.numerics.check import fail
from heliograph.numerics.float64 import compiled
from heliograph.numerics.same import same
from heliograph.numerics.types import Array, Float
from heliograph.planning.criterion import Error
from heliograph.planning.free_numbers import YOUNG, Build, Numbers
from heliograph.planning.measuring import measured
from heliograph.planning.modes_told import Measured, Settled, touched
from heliograph.simulation.network import Network

UNTRACEABLE = jax.errors.ConcretizationTypeError, jax.errors.TracerArrayConversionError
PROGRAMS = 16  # networks whose programs are kept


class Slopes(NamedTuple):
    """Derivatives of the error, and of what each transmitter sends at each step."""

    error: Float[np.ndarray, "x"]
    powers: Float[np.ndarray, "time hops x"]


@dataclass(frozen=True, eq=False)
class Followed:
    """A function of numbers that returns a network, the error that is asked of it, and what it returned at the start.

    Equal ones share their programs. A function may read numbers that live outside of it; that these are others now is
    seen by what it returns.
    """

    build: Build
    numbers: Numbers
    error: Error
    young: bool
    start: Network

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Followed) and same(
            (self.build, self.start, self._shape()), (other.build, other.start, other._shape())
        )

    def __hash__(self) -> int:
        return hash(self._shape())

    def _shape(self) -> tuple[object, ...]:
        shapes = tuple((name, one.start.shape) for name, one in self.numbers.each.items())
        return shapes, self.error.steps, self.error.horizon is None, self.young

    def measure(self, x: Array) -> Measured:
        """What the error needs at these numbers."""
        values = self.numbers.named(jnp.asarray(x))
        young = values.pop(YOUNG) if self.young else None
        try:
            network = self.build(**values)
        except UNTRACEABLE as error:
            expected = "operations of jax.numpy on its numbers, and no choice by their values"
            raise fail("network of free numbers", expected, type(error).__name__) from None
        return measured(network, self.error, young)

    def differentiate(self, x: Array, fixed: Settled) -> Slopes:
        """Derivatives there, at fixed gains."""
        m, pull = jax.vjp(self.measure, jnp.asarray(x))
        of_error, size = jax.grad(touched)(m, fixed), m.powers.size
        each = jnp.eye(size).reshape(size, *m.powers.shape)
        of_powers = jax.tree.map(lambda part: jnp.zeros((size, *part.shape)), m)._replace(powers=each)
        asked = jax.tree.map(lambda one, rest: jnp.concatenate([one[None], rest]), of_error, of_powers)
        found = jax.vmap(pull)(asked)[0]
        return Slopes(found[0], found[1:].reshape(*m.powers.shape, len(x)))


@lru_cache(PROGRAMS)
def programs(network: Followed) -> tuple[Callable[[Array], Measured], Callable[[Array, Settled], Slopes]]:
    """What the error needs, and derivatives."""
    return compiled(network.measure), compiled(network.differentiate)
