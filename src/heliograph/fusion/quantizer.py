"""Quantizers on the uplinks from filters to a fusion centre: what arrives, and how far it can be off."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.model.estimate import Claim, weakest
from heliograph.model.over_time import OverTime
from heliograph.numerics.check import array, check_count, fail
from heliograph.numerics.float64 import in_float64


class Quantized(NamedTuple):
    """What a quantizer delivers of a value x, by component.

    value; error, a guaranteed bound on |value - x| (to rounding), NaN where nothing is guaranteed; saturated, whether x
    was beyond the reach; symbols, how many were sent.

    Shapes: each (n,).
    """

    value: jax.Array | np.ndarray
    error: jax.Array | np.ndarray
    saturated: jax.Array | np.ndarray
    symbols: jax.Array | np.ndarray


class AbstractQuantizer(eqx.Module):
    """A quantizer of vectors: `init(n)` gives the state before any value, `step` the next state and what arrives.

    Deterministic. Parameters are numbers, or (n,) for each component its own. A value that is NaN arrives as NaN and
    leaves the state alone.
    """

    def init(self, n: int) -> Any:
        """State before the first value, for values of n components."""
        raise NotImplementedError

    def step(self, state: Any, value: Any) -> tuple[Any, Quantized]:
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

    levels: np.ndarray
    amplitude: np.ndarray
    scale: np.ndarray

    def __init__(self, levels: int, amplitude: Any, scale: Any = 1.0):
        self.levels = _levels(levels)
        self.amplitude, self.scale = _positive("amplitude", amplitude), _positive("scale", scale)

    def init(self, n: int) -> Any:
        """There is none."""
        return ()

    @in_float64
    def step(self, state: Any, value: Any) -> tuple[Any, Quantized]:
        """Quantize with the one amplitude."""
        return state, _published(jnp.asarray(value, dtype=float), self.amplitude, self.levels, self.scale)

    def claim(self, claim: Claim) -> Claim:
        """At most "upper"."""
        return weakest([claim, "upper"])


class ZoomQuantizer(AbstractQuantizer):
    """A uniform quantizer whose amplitude follows the square of what it is given: d+ = decay d + growth x^2.

    As published: driven by the unquantized x, which a fusion centre does not know, so nobody there can decode it; and d
    saturates for every constant |x| below (1 - decay) / (growth scale), since it tends to growth x^2 / (1 - decay).
    `EscapeQuantizer` has neither fault.

    Raises:
        ValueError: fewer than two levels, amplitude or scale not positive, decay outside (0, 1), negative growth.
    Source: H-infinity quantized fusion over amplify-and-forward relays, equations (10) to (13).
    """

    levels: np.ndarray
    amplitude: np.ndarray
    decay: np.ndarray
    growth: np.ndarray
    scale: np.ndarray

    def __init__(self, levels: int, amplitude: Any, decay: Any, growth: Any, scale: Any = 1.0):
        self.levels = _levels(levels)
        self.amplitude, self.scale = _positive("amplitude", amplitude), _positive("scale", scale)
        self.decay, self.growth = _decay(decay), _growth(growth)

    @in_float64
    def init(self, n: int) -> jax.Array:
        """The first amplitude (n,)."""
        return jnp.broadcast_to(jnp.asarray(self.amplitude), (n,))

    @in_float64
    def step(self, state: Any, value: Any) -> tuple[Any, Quantized]:
        """Quantize with the present amplitude; the next one follows x."""
        x = jnp.asarray(value, dtype=float)
        following = jnp.where(jnp.isfinite(x), self.decay * state + self.growth * x**2, state)
        return following, _published(x, state, self.levels, self.scale)

    def claim(self, claim: Claim) -> Claim:
        """At most "nominal": the amplitude depends on the data, and may be small where errors are large."""
        return weakest([claim, "nominal"])


class Symbols(NamedTuple):
    """What goes over the link: how many escapes, then the segment from 0; -1 says that there is no number.

    Shapes: each (n,), whole numbers.
    """

    escapes: jax.Array | np.ndarray
    segment: jax.Array | np.ndarray


class EscapeQuantizer(AbstractQuantizer):
    """A quantizer that the receiver can decode and that does not saturate, driven by nothing but what was sent.

    Where x is outside [-d, d], an escape symbol doubles the amplitude, as often as needed: m = ceil(log2(|x| / d)).
    Then the segment is sent, so |error| <= d 2^m / levels always, and both ends go on with
    d+ = max(smallest, decay d 2^m + growth |sent|). Levels are odd, so that zero is one.

    Raises:
        ValueError: an even number of levels or fewer than three, amplitude or smallest amplitude not positive, decay
            outside (0, 1), negative growth.
    """

    levels: np.ndarray
    amplitude: np.ndarray
    decay: np.ndarray
    growth: np.ndarray
    smallest: np.ndarray

    def __init__(self, levels: int, amplitude: Any, decay: Any, growth: Any, smallest: Any):
        self.levels = _levels(levels)
        if levels % 2 == 0:
            raise fail("levels", "an odd number, so that zero is a level", levels)
        self.amplitude, self.smallest = _positive("amplitude", amplitude), _positive("smallest amplitude", smallest)
        self.decay, self.growth = _decay(decay), _growth(growth)

    @in_float64
    def init(self, n: int) -> jax.Array:
        """The first amplitude (n,), known to both ends."""
        return jnp.broadcast_to(jnp.asarray(self.amplitude), (n,))

    @in_float64
    def step(self, state: Any, value: Any) -> tuple[Any, Quantized]:
        """What the receiver decodes of what the sender encodes."""
        return self.decode(state, self.encode(state, value))

    @in_float64
    def encode(self, state: Any, value: Any) -> Symbols:
        """The sender: symbols of a value (n,), from the amplitude (n,) that both ends know."""
        x = jnp.asarray(value, dtype=float)
        (x_fraction, x_power), (fraction, power) = jnp.frexp(x), jnp.frexp(state)
        doublings = x_power - power + (jnp.abs(x_fraction) > fraction)  # smallest m with |x| <= d 2^m, exactly
        escapes = jnp.where(jnp.isfinite(x) & (x != 0), jnp.maximum(doublings, 0), 0)
        used = jnp.ldexp(state, escapes)
        known = jnp.isfinite(x) & jnp.isfinite(used)
        segment = jnp.where(known, _segment(x, used, self.levels), -1)
        return Symbols(jnp.where(known, escapes, 0).astype(int), segment.astype(int))

    @in_float64
    def decode(self, state: Any, symbols: Symbols) -> tuple[Any, Quantized]:
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


def widen(bound: jax.Array, error: jax.Array) -> jax.Array:
    """Bound on the covariance of x - q from one, P, of x - xhat, where |q - xhat| <= D by component.

    With q - xhat = mu: mu mu' <= s diag(D), s = sum D (Cauchy), the smallest trace of all such diagonal bounds. So
    E[(x - q)(x - q)'] <= (1 + t) P + (1 + 1/t) s diag(D) for every t > 0, with the smallest trace (r + s)^2 at
    t = s / r, r = sqrt(tr P): then it is (1 + s / r) P + (r + s) diag(D). NaN where D is.

    Shapes: (n, n), (n,) -> (n, n).
    """
    s, r = jnp.sum(error), jnp.sqrt(jnp.trace(bound))
    share = jnp.where(r == 0, 0.0, s / jnp.where(r == 0, 1.0, r))  # P = 0: only the quantizer's error is left
    return (1 + share) * bound + (r + s) * jnp.diag(error)


def _published(x: jax.Array, amplitude: Any, levels: Any, scale: Any) -> Quantized:
    """Equations (10), (11) and (13), with d for values from d on and -d for values below -d."""
    scaled = x / scale
    inside = _midpoint(_segment(scaled, amplitude, levels), amplitude, levels)
    value = jnp.where(scaled >= amplitude, amplitude, jnp.where(scaled < -amplitude, -amplitude, inside))
    saturated = jnp.abs(scaled) > amplitude
    error = jnp.where(saturated | ~jnp.isfinite(x), jnp.nan, scale * amplitude / levels)
    return Quantized(scale * value, error, saturated, jnp.ones(x.shape, dtype=int))


def _segment(x: jax.Array, amplitude: Any, levels: Any) -> jax.Array:
    """Which of the equal segments of [-amplitude, amplitude] holds x, from 0."""
    return jnp.clip(jnp.floor((x / amplitude + 1) * levels / 2), 0, levels - 1)


def _midpoint(segment: jax.Array, amplitude: Any, levels: Any) -> jax.Array:
    """The middle of a segment; exactly zero for the middle one of an odd number."""
    return jnp.asarray((2 * segment + 1 - levels) * amplitude / levels)


def _levels(value: Any) -> np.ndarray:
    check_count("levels", value, 2)
    return np.asarray(value, dtype=np.float64)


def _parameter(name: str, value: Any) -> Any:
    several = isinstance(value, Sequence) or np.ndim(value) > 0
    return array(name, value, (None,) if several else ())


def _positive(name: str, value: Any) -> Any:
    result = _parameter(name, value)
    if not isinstance(result, jax.Array) and np.any(result <= 0):
        raise fail(name, "positive numbers", value)
    return result


def _decay(value: Any) -> Any:
    result = _parameter("decay", value)
    if not isinstance(result, jax.Array) and np.any((result <= 0) | (result >= 1)):
        raise fail("decay", "numbers between 0 and 1", value)
    return result


def _growth(value: Any) -> Any:
    result = _parameter("growth", value)
    if not isinstance(result, jax.Array) and np.any(result < 0):
        raise fail("growth", "no negative number", value)
    return result
