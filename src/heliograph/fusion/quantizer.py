"""Quantizers on the uplinks from filters to a fusion centre: what arrives, and how far it can be off."""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.model.estimate import Claim, weakest
from heliograph.model.over_time import OverTime
from heliograph.numerics.check import array, check_count, fail
from heliograph.numerics.float64 import in_float64
from heliograph.numerics.types import Array, ArrayLike, Bool, Float, Int, PyTree

Parameter = Float[Array, "..."]  # of all components, or of each


class Quantized(NamedTuple):
    """What a quantizer delivers of a value x, by component.

    value; error, a guaranteed bound on |value - x| (to rounding), NaN where nothing is guaranteed; saturated, whether x
    was beyond the reach; symbols, how many were sent.
    """

    value: Float[Array, "*n"]
    error: Float[Array, "*n"]
    saturated: Bool[Array, "*n"]
    symbols: Int[Array, "*n"]


class AbstractQuantizer(eqx.Module):
    """A quantizer of vectors: `init(n)` gives the state before any value, `step` the next state and what arrives.

    Deterministic, and by component: values of further axes (run, time) go through alike. Parameters are numbers, or
    (n,) for each component its own. A value that is NaN arrives as NaN and
    leaves the state alone.
    """

    def init(self, n: int) -> PyTree:
        """State before the first value, for values of n components."""
        raise NotImplementedError

    def step(self, state: PyTree, value: ArrayLike) -> tuple[PyTree, Quantized]:
        """Next state, and what arrives of a value (n,)."""
        raise NotImplementedError

    def claim(self, claim: Claim) -> Claim:
        """What the widened covariance of a quantized estimate claims, from what the estimate's own claims."""
        raise NotImplementedError

    def check(self, n: int) -> None:
        """Raise ValueError unless the parameters fit values of n components."""
        for leaf in jax.tree.leaves(self):
            if np.shape(leaf) not in ((), (n,)):
                raise fail("quantizer", f"numbers or shape ({n},) for each parameter", f"shape {np.shape(leaf)}")


Quantizer = AbstractQuantizer | OverTime  # an OverTime holds one quantizer per step


class UniformQuantizer(AbstractQuantizer):
    """Midpoints of `levels` equal segments of [-amplitude, amplitude], its ends outside: u q(x / u), u = scale.

    |error| <= scale amplitude / levels where x / u lies within the amplitude; outside nothing is guaranteed. Errors and
    their bounds do not depend on the data, so what was "upper" stays so.

    Raises:
        ValueError: fewer than two levels, an amplitude or scale that is not positive.
    Source: H-infinity quantized fusion over amplify-and-forward relays, equations (10), (11) and (13).
    """

    levels: Float[Array, ""]
    amplitude: Parameter
    scale: Parameter

    def __init__(self, levels: int, amplitude: ArrayLike, scale: ArrayLike = 1.0):
        self.levels = _levels(levels)
        self.amplitude, self.scale = _positive("amplitude", amplitude), _positive("scale", scale)

    def init(self, n: int) -> tuple[()]:
        """There is none."""
        return ()

    @in_float64
    def step(self, state: PyTree, value: ArrayLike) -> tuple[PyTree, Quantized]:
        """Quantize with the one amplitude."""
        return state, _published(jnp.asarray(value, dtype=float), self.amplitude, self.levels, self.scale)

    def claim(self, claim: Claim) -> Claim:
        """At most "upper"."""
        return weakest([claim, "upper"])


class Symbols(NamedTuple):
    """What goes over the uplink: how many escapes, then the segment from 0; -1 says that there is no number."""

    escapes: Int[Array, "*n"]
    segment: Int[Array, "*n"]


class EscapeQuantizer(AbstractQuantizer):
    """A quantizer that the receiver can decode and that does not saturate, driven by nothing but what was sent.

    Where x is outside [-d, d], an escape symbol doubles the amplitude, as often as needed: m = ceil(log2(|x| / d)).
    Then the segment is sent, so |error| <= d 2^m / levels always, and both ends go on with
    d+ = max(smallest, decay d 2^m + growth |sent|). Levels are odd, so that zero is one.

    Raises:
        ValueError: an even number of levels or fewer than three, amplitude or smallest amplitude not positive, decay
            outside (0, 1), negative growth.
    """

    levels: Float[Array, ""]
    amplitude: Parameter
    decay: Parameter
    growth: Parameter
    smallest: Parameter

    def __init__(self, levels: int, amplitude: ArrayLike, decay: ArrayLike, growth: ArrayLike, smallest: ArrayLike):
        self.levels = _levels(levels)
        if levels % 2 == 0:
            raise fail("levels", "an odd number, so that zero is a level", levels)
        self.amplitude, self.smallest = _positive("amplitude", amplitude), _positive("smallest amplitude", smallest)
        self.decay, self.growth = _decay(decay), _growth(growth)

    @in_float64
    def init(self, n: int) -> Float[Array, "n"]:
        """The first amplitude, known to both ends."""
        return jnp.broadcast_to(jnp.asarray(self.amplitude), (n,))

    @in_float64
    def step(self, state: Float[Array, "*n"], value: ArrayLike) -> tuple[Float[Array, "*n"], Quantized]:
        """What the receiver decodes of what the sender encodes."""
        return self.decode(state, self.encode(state, value))

    @in_float64
    def encode(self, state: Float[Array, "*n"], value: ArrayLike) -> Symbols:
        """The sender: symbols of a value (n,), from the amplitude that both ends know."""
        x = jnp.asarray(value, dtype=float)
        (x_fraction, x_power), (fraction, power) = jnp.frexp(x), jnp.frexp(state)
        doublings = x_power - power + (jnp.abs(x_fraction) > fraction)  # smallest m with |x| <= d 2^m, exactly
        escapes = jnp.where(jnp.isfinite(x) & (x != 0), jnp.maximum(doublings, 0), 0)
        used = jnp.ldexp(state, escapes)
        known = jnp.isfinite(x) & jnp.isfinite(used)
        segment = jnp.where(known, _segment(x, used, self.levels), -1)
        return Symbols(jnp.where(known, escapes, 0).astype(int), segment.astype(int))

    @in_float64
    def decode(self, state: Float[Array, "*n"], symbols: Symbols) -> tuple[Float[Array, "*n"], Quantized]:
        """The receiver: next amplitude and value, from the present amplitude and the symbols alone."""
        escapes, segment = jnp.asarray(symbols.escapes), jnp.asarray(symbols.segment)
        used, known = jnp.ldexp(state, escapes), segment >= 0
        sent = _midpoint(segment, used, self.levels)
        following = jnp.maximum(self.smallest, self.decay * used + self.growth * jnp.abs(sent))
        value, error = jnp.where(known, sent, jnp.nan), jnp.where(known, used / self.levels, jnp.nan)
        return jnp.where(known, following, state), Quantized(value, error, jnp.zeros_like(known), escapes + 1)

    def claim(self, claim: Claim) -> Claim:
        """At most "nominal": the amplitude depends on the data, and may be small where errors are large."""
        return weakest([claim, "nominal"])


def widen(covariance: Float[Array, "n n"], error: Float[Array, "n"]) -> Float[jax.Array, "n n"]:
    """Bound on the covariance of x - q from that, P, of x - xhat (or a bound), where |q - xhat| <= D by component.

    With q - xhat = mu: mu mu' <= s diag(D), s = sum D (Cauchy), the smallest trace of all such diagonal bounds. So
    E[(x - q)(x - q)'] <= (1 + t) P + (1 + 1/t) s diag(D) for every t > 0, with the smallest trace (r + s)^2 at
    t = s / r, r = sqrt(tr P): then it is (1 + s / r) P + (r + s) diag(D). NaN where D is.
    """
    s, r = jnp.sum(error), jnp.sqrt(jnp.trace(covariance))
    share = jnp.where(r == 0, 0.0, s / jnp.where(r == 0, 1.0, r))  # P = 0: only the quantizer's error is left
    return (1 + share) * covariance + (r + s) * jnp.diag(error)


def _published(
    x: Float[jax.Array, "*n"], amplitude: Parameter, levels: Float[Array, ""], scale: Parameter
) -> Quantized:
    """Equations (10), (11) and (13), with d for values from d on and -d for values below -d."""
    scaled = x / scale
    inside = _midpoint(_segment(scaled, amplitude, levels), amplitude, levels)
    value = jnp.where(scaled >= amplitude, amplitude, jnp.where(scaled < -amplitude, -amplitude, inside))
    saturated = jnp.abs(scaled) > amplitude
    error = jnp.where(saturated | ~jnp.isfinite(x), jnp.nan, scale * amplitude / levels)
    return Quantized(scale * value, error, saturated, jnp.ones(x.shape, dtype=int))


def _segment(x: Float[jax.Array, "*n"], amplitude: Parameter, levels: Float[Array, ""]) -> Float[jax.Array, "*n"]:
    """Which of the equal segments of [-amplitude, amplitude] holds x, from 0."""
    return jnp.clip(jnp.floor((x / amplitude + 1) * levels / 2), 0, levels - 1)


def _midpoint(segment: Array, amplitude: Parameter, levels: Float[Array, ""]) -> Float[jax.Array, "*n"]:
    """The middle of a segment; exactly zero for the middle one of an odd number."""
    return jnp.asarray((2 * segment + 1 - levels) * amplitude / levels)


def _levels(value: int) -> Float[np.ndarray, ""]:
    check_count("levels", value, 2)
    return np.asarray(value, dtype=np.float64)


def _parameter(name: str, value: ArrayLike) -> Parameter:
    several = isinstance(value, Sequence) or np.ndim(value) > 0
    result: Parameter = array(name, value, (None,) if several else ())
    return result


def _positive(name: str, value: ArrayLike) -> Parameter:
    result = _parameter(name, value)
    if not isinstance(result, jax.Array) and np.any(result <= 0):
        raise fail(name, "positive numbers", value)
    return result


def _decay(value: ArrayLike) -> Parameter:
    result = _parameter("decay", value)
    if not isinstance(result, jax.Array) and np.any((result <= 0) | (result >= 1)):
        raise fail("decay", "numbers between 0 and 1", value)
    return result


def _growth(value: ArrayLike) -> Parameter:
    result = _parameter("growth", value)
    if not isinstance(result, jax.Array) and np.any(result < 0):
        raise fail("growth", "no negative number", value)
    return result
