"""Quantizers on the uplinks from filters to a fusion centre: received values and their error bounds."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from typing_extensions import TypeAliasType

from heliograph.model.estimate import Claim
from heliograph.model.over_time import OverTime
from heliograph.numerics.check import fail
from heliograph.numerics.module import Module, readable
from heliograph.numerics.types import Array, ArrayLike, Bool, Float, Int, PyTree

Numbers = TypeAliasType("Numbers", Float[Array, "*n"])
Flags = TypeAliasType("Flags", Bool[Array, "*n"])
Counts = TypeAliasType("Counts", Int[Array, "*n"])


@readable
class Quantized(NamedTuple):
    """Quantized value of x, by component.

    value; error, a guaranteed bound on |value - x| (to rounding), NaN where nothing is guaranteed; saturated, whether x
    was beyond the amplitude; symbols, how many were sent.
    """

    value: Numbers
    error: Numbers
    saturated: Flags
    symbols: Counts


@readable
class AbstractQuantizer(Module):
    """A quantizer of vectors: `init(n)` gives the state before any value, `step` the next state and what arrives.

    Deterministic, and by component: values of further axes (run, time) go through alike. Parameters are numbers, or
    (n,), one per component. A value that is NaN arrives as NaN and leaves the state alone.
    """

    @property
    def silent(self) -> bool:
        """True if a value may not arrive."""
        return False

    def init(self, n: int) -> PyTree:
        """Return the state before the first value, for values of n components."""
        raise NotImplementedError

    def step(self, state: PyTree, value: ArrayLike) -> tuple[PyTree, Quantized]:
        """Return the next state, and what arrives of a value (n,)."""
        raise NotImplementedError

    def claim(self, claim: Claim) -> Claim:
        """Claim of the widened covariance of a quantized estimate, from the claim of the estimate."""
        raise NotImplementedError

    def error(self, n: int) -> Float[Array, " n"]:
        """Bound on |what arrives - x| by component that holds whatever the data, where anything arrives.

        Raises:
            ValueError: there is none.
        """
        raise fail(
            f"reports through {type(self).__name__}", "a quantizer whose error is bounded before any data", "none"
        )

    def check(self, n: int) -> None:
        """Raise ValueError unless the parameters fit values of n components."""
        for leaf in jax.tree.leaves(self):
            if np.shape(leaf) not in ((), (n,)):
                raise fail("quantizer", f"numbers or shape ({n},) for each parameter", f"shape {np.shape(leaf)}")


Quantizer = TypeAliasType("Quantizer", AbstractQuantizer | OverTime)  # an OverTime holds one quantizer per step


def widen(covariance: Float[Array, "n n"], error: Float[Array, "n"]) -> Float[jax.Array, "n n"]:
    """Bound on the covariance of x - q, from that of x - xhat (or a bound) P, where |q - xhat| <= D by component.

    With q - xhat = mu: mu mu' <= s diag(D), s = sum D (Cauchy), the smallest trace of all such diagonal bounds. So
    E[(x - q)(x - q)'] <= (1 + t) P + (1 + 1/t) s diag(D) for every t > 0, with the smallest trace (r + s)^2 at
    t = s / r, r = sqrt(tr P): then it is (1 + s / r) P + (r + s) diag(D). NaN where D is.
    """
    s, r = jnp.sum(error), jnp.sqrt(jnp.trace(covariance))
    share = jnp.where(r == 0, 0.0, s / jnp.where(r == 0, 1.0, r))  # P = 0: only the quantizer's error is left
    return (1 + share) * covariance + (r + s) * jnp.diag(error)
