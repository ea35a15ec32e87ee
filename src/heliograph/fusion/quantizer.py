"""Quantizers on the uplinks from filters to a fusion centre: received values and their error bounds."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from typing_extensions import TypeAliasType

from heliograph.model.estimate import Claim, weakest
from heliograph.model.over_time import OverTime
from heliograph.numerics.check import array, check_count, fail, rank
from heliograph.numerics.float64 import in_float64
from heliograph.numerics.masked_arrays import fill_masked
from heliograph.numerics.module import Module, readable, unwritten
from heliograph.numerics.numpy_or_jax import is_traced, library
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
        """True if there may be steps at which nothing arrives (NaN), as with sending on events; False by default."""
        return False

    @property
    def holds(self) -> bool:
        """True if nothing may be sent at a step, where the receiver holds the last value; False by default."""
        return False

    def init(self, n: int) -> PyTree:
        """Return the state before the first value, for values of n components."""
        raise unwritten(self, "init")

    def step(self, state: PyTree, value: ArrayLike) -> tuple[PyTree, Quantized]:
        """Return the next state, and what arrives of a value (n,)."""
        raise unwritten(self, "step")

    def claim(self, claim: Claim) -> Claim:
        """Return the claim of a quantized estimate's widened covariance, from that of the estimate: at most "nominal".

        A quantizer that has an error bound for every value, known before any data, may claim "upper": that bound does
        not hold for values which are left out where it saturates.
        """
        return weakest([claim, "nominal"])

    def error(self, n: int) -> Float[Array, " n"]:
        """Return a bound (n,) on |what arrives - x| that holds for all data, if anything arrives.

        Raises:
            ValueError: there is no such bound.
        """
        raise fail(
            f"reports through {type(self).__name__}", "a quantizer whose error is bounded before any data", "none"
        )

    def check(self, n: int) -> None:
        """Raise ValueError unless each parameter is one number or has one for each of n components."""
        for leaf in jax.tree.leaves(self):
            if np.shape(leaf) not in ((), (n,)):
                raise fail("quantizer", f"numbers or shape ({n},) for each parameter", f"shape {np.shape(leaf)}")


Quantizer = TypeAliasType("Quantizer", AbstractQuantizer | OverTime)  # an OverTime holds one quantizer per step


def widen_by_quantization(covariance: Float[Array, "n n"], error: Float[Array, "n"]) -> Float[jax.Array, "n n"]:
    """Return a bound on the covariance of x - q, from the covariance P (or a bound) of x - xhat and |q - xhat| <= D.

    q is the quantized estimate, xhat the estimate, and D (n,) bounds the quantizer's error. mu = q - xhat has mu mu' <=
    s diag(D) with s = sum D (Cauchy), which is the diagonal bound of least trace. So E[(x - q)(x - q)'] <= (1 + t) P +
    (1 + 1/t) s diag(D) for every t > 0. Its trace is least, (r + s)^2, at t = s / r with r = sqrt(tr P), where the
    bound is (1 + s / r) P + (r + s) diag(D). It is NaN where D is.
    """
    s, r = jnp.sum(error), jnp.sqrt(jnp.trace(covariance))
    t = jnp.where(r == 0, 0.0, s / jnp.where(r == 0, 1.0, r))  # P = 0: only the quantizer's error is left
    return (1 + t) * covariance + (r + s) * jnp.diag(error)


Parameter = Float[Array, "..."]  # one number for all components, or one for each (n,)


def find_segment(x: Float[jax.Array, "*n"], amplitude: Parameter, levels: Float[Array, ""]) -> Float[jax.Array, "*n"]:
    """Return the index s = 0, ..., levels - 1 of the segment of [-amplitude, amplitude] that holds x.

    The interval is divided in `levels` equal segments. A value outside gets the first or the last one.
    """
    return jnp.clip(jnp.floor((x / amplitude + 1) * levels / 2), 0, levels - 1)


def midpoint(segment: Array, amplitude: Parameter, levels: Float[Array, ""]) -> Float[jax.Array, "*n"]:
    """Return the midpoint (2 s + 1 - L) / L d of segment s = 0, ..., L - 1, of L = `levels` that divide [-d, d].

    d is the `amplitude`. The middle one of an odd number of segments has exactly the midpoint 0.
    """
    # The quotient comes first: the product with many levels could overflow.
    return jnp.asarray((2 * segment + 1 - levels) / levels * amplitude)


def check_levels(value: int) -> Float[np.ndarray, ""]:
    """Return the number of segments as a float array (); raise ValueError unless it is a whole number from 2."""
    check_count("levels", value, 2)
    return np.asarray(value, dtype=np.float64)


def check_parameter(name: str, value: ArrayLike) -> Parameter:
    """Return a parameter as an array: () for one number that all components have, (n,) for one of each component."""
    is_list = isinstance(value, Sequence) or rank(name, value) > 0
    numbers: Parameter = array(name, value, (None,) if is_list else ())
    return numbers


def check_positive(name: str, value: ArrayLike) -> Parameter:
    """Return a parameter as an array; raise ValueError unless it is positive.

    A JAX array may be traced, as in learning, and then has no value to compare: it is taken unchecked.
    """
    numbers = check_parameter(name, value)
    if not isinstance(numbers, jax.Array) and np.any(numbers <= 0):
        raise fail(name, "positive numbers", value)
    return numbers


def check_amplitude(name: str, amplitude: Parameter, scale: Parameter, levels: Float[Array, ""]) -> None:
    """Raise ValueError unless amplitude times scale is finite, and half a level of it is no denormal number.

    `scale` is the unit of what is quantized. Traced parameters have no values to check.
    """
    if is_traced(amplitude, scale):
        return
    with np.errstate(over="ignore", under="ignore"):
        largest = np.asarray(amplitude) * scale  # in the unit of x
        in_range = np.isfinite(largest) & (largest / levels >= np.finfo(np.float64).tiny)
    if not np.all(in_range):
        least = np.finfo(np.float64).tiny * float(levels)
        raise fail(name, f"from {least:.3g} to {np.finfo(np.float64).max:.3g}", largest.tolist())


class UniformQuantizer(AbstractQuantizer):
    """Midpoints of `levels` equal segments of [-amplitude, amplitude], its ends outside: u q(x / u), u = scale.

    |error| <= scale amplitude / levels where x / u lies within the amplitude; outside nothing is guaranteed or used. So
    data select what is used: of errors e with E[e e'] <= P, those with x inside have E[e e'] <= P / p, where p is the
    probability of that, and no less where errors are large just then. What was "upper" is "nominal".

    Args:
        levels: number of segments, at least 2.
        amplitude: positive, a number or (n,).
        scale: unit u of x, positive, a number or (n,); 1 by default.

    Raises:
        ValueError: fewer than two levels, an amplitude or scale that is not positive, or numbers beyond their range.

    Source: H-infinity quantized fusion over amplify-and-forward relays, equations (10), (11) and (13).
    """

    levels: Float[Array, ""]
    amplitude: Parameter
    scale: Parameter

    def __init__(self, levels: int, amplitude: Float[ArrayLike, "*n"], scale: Float[ArrayLike, "*n"] = 1.0):
        """Check and hold the number of segments of [-amplitude, amplitude], and the unit (`scale`) of x."""
        self.levels = check_levels(levels)
        self.amplitude = check_positive("amplitude", amplitude)
        self.scale = check_positive("scale", scale)
        check_amplitude("amplitude times scale", self.amplitude, self.scale, self.levels)

    def init(self, n: int) -> tuple[()]:
        """Return the empty state: a fixed amplitude remembers nothing."""
        return ()

    @in_float64
    def step(self, state: PyTree, value: ArrayLike) -> tuple[PyTree, Quantized]:
        """Return the unchanged state, and the value (n,) rounded to the midpoint of its segment."""
        x = jnp.asarray(fill_masked(value), dtype=float)
        return state, _quantize_uniformly(x, self.amplitude, self.levels, self.scale)

    def error(self, n: int) -> Float[Array, " n"]:
        """Return half of a segment's length for each component: the largest error within the range."""
        half_segment = self.scale * self.amplitude / self.levels
        bound: Float[Array, " n"] = library(half_segment).broadcast_to(half_segment, (n,))
        return bound


def _quantize_uniformly(
    x: Float[jax.Array, "*n"], amplitude: Parameter, levels: Float[Array, ""], scale: Parameter
) -> Quantized:
    """Return the midpoint of the segment that holds x / scale, in the unit of x; beyond the amplitude d it is d or -d.

    A component beyond d is saturated, and its error has no bound (NaN).
    """
    scaled = x / scale
    middle_of_segment = midpoint(find_segment(scaled, amplitude, levels), amplitude, levels)
    value = jnp.where(scaled >= amplitude, amplitude, jnp.where(scaled < -amplitude, -amplitude, middle_of_segment))
    is_saturated = jnp.abs(scaled) > amplitude
    error = jnp.where(is_saturated | ~jnp.isfinite(x), jnp.nan, scale * amplitude / levels)
    return Quantized(scale * value, error, is_saturated, symbols=jnp.ones(x.shape, dtype=int))
