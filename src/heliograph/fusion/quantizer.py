"""Quantizers on the uplinks from filters to a fusion centre: received values and their error bounds."""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
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
        """Raise ValueError unless the parameters fit values of n components."""
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


Parameter = Float[Array, "..."]  # of all components, or of each


def find_segment(x: Float[jax.Array, "*n"], amplitude: Parameter, levels: Float[Array, ""]) -> Float[jax.Array, "*n"]:
    """Return the index, from 0, of the segment of [-amplitude, amplitude] that holds x."""
    return jnp.clip(jnp.floor((x / amplitude + 1) * levels / 2), 0, levels - 1)


def midpoint(segment: Array, amplitude: Parameter, levels: Float[Array, ""]) -> Float[jax.Array, "*n"]:
    """Return the midpoint of a segment; exactly zero for the middle one of an odd number.

    The quotient comes first: the product with many levels could overflow.
    """
    return jnp.asarray((2 * segment + 1 - levels) / levels * amplitude)


def check_levels(value: int) -> Float[np.ndarray, ""]:
    """Return the number of segments, at least two, as a float."""
    check_count("levels", value, 2)
    return np.asarray(value, dtype=np.float64)


def check_parameter(name: str, value: ArrayLike) -> Parameter:
    """Return a parameter as a number, or as one number per component."""
    is_list = isinstance(value, Sequence) or rank(name, value) > 0
    numbers: Parameter = array(name, value, (None,) if is_list else ())
    return numbers


def check_positive(name: str, value: ArrayLike) -> Parameter:
    """Return a parameter that must be positive."""
    numbers = check_parameter(name, value)
    if not isinstance(numbers, jax.Array) and np.any(numbers <= 0):
        raise fail(name, "positive numbers", value)
    return numbers


def check_amplitude(name: str, amplitude: Parameter, scale: Parameter, levels: Float[Array, ""]) -> None:
    """Raise ValueError unless amplitude times scale is finite, and a level's error has full precision."""
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
        """Keep the number of segments, the amplitude of what is quantized, and the scale that divides it."""
        self.levels = check_levels(levels)
        self.amplitude, self.scale = check_positive("amplitude", amplitude), check_positive("scale", scale)
        check_amplitude("amplitude times scale", self.amplitude, self.scale, self.levels)

    def init(self, n: int) -> tuple[()]:
        """Return the empty state: a fixed amplitude remembers nothing."""
        return ()

    @in_float64
    def step(self, state: PyTree, value: ArrayLike) -> tuple[PyTree, Quantized]:
        """Quantize with the fixed amplitude."""
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


class UplinkSymbols(NamedTuple):
    """Symbols sent over the uplink for one value, by component.

    How many escapes, then the segment from 0: -1 for NaN, `ABOVE` and `BELOW` for a value beyond the range of numbers.
    `number` counts the values that were sent; `restart` says that the first amplitude is used.
    """

    escapes: Int[Array, "*n"]
    segment: Int[Array, "*n"]
    number: Int[Array, "*n"]
    restart: Bool[Array, "*n"]


NOTHING, BELOW, ABOVE = -1, -2, -3  # segments that are none
LOST = -1  # the number of the next value for a receiver that has missed one


class UplinkState(NamedTuple):
    """State of one end of an uplink, by component: the next amplitude, and the number of the next value.

    A receiver that has missed a value does not know the amplitude: `number` is negative then.
    """

    amplitude: Float[Array, "*n"]
    number: Int[Array, "*n"]

    @property
    def synchronised(self) -> Bool[Array, "*n"]:
        """True where this end knows the amplitude; a receiver that missed a value has a negative `number`."""
        return self.number >= 0


class EscapeQuantizer(AbstractQuantizer):
    """Dynamic (zooming) quantizer: zooms out by escape symbols, in by `decay`, driven by what was sent alone.

    Where x is outside [-d, d], an escape symbol doubles the amplitude, as often as needed: m = ceil(log2(|x| / d)).
    Then the segment is sent, so |error| <= d 2^m / levels always, and both ends go on with
    d+ = max(smallest, decay d 2^m + growth |sent|). Levels are odd, so that zero is one. Only a value whose d 2^m would
    be no number saturates. A lost value leaves the receiver with a wrong d, which it sees by the number of the next:
    from then on it delivers NaN, without an error bound, and its state is not `synchronised`, until the sender restarts
    from the first amplitude. That is so with every `interval`-th value, and with any that `encode` restarts with. So
    after a loss the error bound holds again within `interval` values; without either, never.

    Args:
        levels: odd number of segments, at least 3.
        amplitude: first amplitude, a number or (n,).
        decay: factor of the amplitude, in (0, 1); a number or (n,).
        growth: factor of the sent value in the next amplitude, from 0; a number or (n,).
        smallest: least amplitude, a number or (n,).
        interval: number of values between restarts; None, the default, never restarts.

    Raises:
        ValueError: an even number of levels or fewer than three, amplitude or smallest amplitude not positive or beyond
            the range of numbers, decay outside (0, 1), negative growth, an interval below 1.
    """

    levels: Float[Array, ""]
    amplitude: Parameter
    decay: Parameter
    growth: Parameter
    smallest: Parameter
    interval: int | None = eqx.field(static=True)

    def __init__(
        self,
        levels: int,
        amplitude: Float[ArrayLike, "*n"],
        decay: Float[ArrayLike, "*n"],
        growth: Float[ArrayLike, "*n"],
        smallest: Float[ArrayLike, "*n"],
        interval: int | None = None,
    ):
        """Check the parameters; even at the smallest amplitude neighbouring levels must differ as numbers."""
        self.levels = check_levels(levels)
        if levels % 2 == 0:
            raise fail("levels", "an odd number, so that zero is a level", levels)
        self.amplitude, self.smallest = (
            check_positive("amplitude", amplitude),
            check_positive("smallest amplitude", smallest),
        )
        for name, value in (("amplitude", self.amplitude), ("smallest amplitude", self.smallest)):
            check_amplitude(name, value, np.ones(()), self.levels)
        self.decay, self.growth = _check_decay(decay), _check_growth(growth)
        self.interval = None if interval is None else check_count("interval", interval)

    @in_float64
    def init(self, n: int) -> UplinkState:
        """Return the first amplitude, known to both ends."""
        count = check_count("components", n)
        return UplinkState(jnp.broadcast_to(jnp.asarray(self.amplitude), (count,)), jnp.zeros(count, int))

    @in_float64
    def step(self, state: UplinkState, value: ArrayLike) -> tuple[UplinkState, Quantized]:
        """Encode a value at the sender and decode it at the receiver."""
        return self.decode(state, self.encode(state, value))

    @in_float64
    def encode(self, state: UplinkState, value: ArrayLike, restart: bool = False) -> UplinkSymbols:
        """Encode a value x (n,) as m escape symbols, each of which doubles the amplitude d, and the segment of x.

        With m = ceil(log2(|x| / d)), from 0, x lies in [-d 2^m, d 2^m]. d is the amplitude that both ends know, or the
        first one if `restart`. The segment is NOTHING for NaN; ABOVE or BELOW where d 2^m is no number.
        """
        x = jnp.asarray(fill_masked(value), dtype=float)
        restarts = jnp.broadcast_to(self._is_restart(state.number) | restart, x.shape)
        amplitude = self._present_amplitude(state, restarts)
        # m by exponents, without rounding: x = x_fraction 2^x_power and d = fraction 2^power.
        (x_fraction, x_power), (fraction, power) = jnp.frexp(x), jnp.frexp(amplitude)
        doublings = x_power - power + (jnp.abs(x_fraction) > fraction)  # smallest m with |x| <= d 2^m, exactly
        most_doublings = np.finfo(x.dtype).maxexp - power  # the largest m for which d 2^m is a finite number
        is_value, is_beyond = ~jnp.isnan(x), jnp.isinf(x) | (doublings > most_doublings)
        escapes = jnp.where(x != 0, jnp.clip(jnp.where(is_beyond, most_doublings, doublings), 0), 0)
        segment = find_segment(x, jnp.ldexp(amplitude, escapes), self.levels)
        segment = jnp.where(is_beyond, jnp.where(x > 0, ABOVE, BELOW), jnp.where(is_value, segment, NOTHING))
        return UplinkSymbols(
            escapes=jnp.where(is_value, escapes, 0).astype(int),
            segment=segment.astype(int),
            number=jnp.broadcast_to(state.number, x.shape),
            restart=restarts & is_value,
        )

    @in_float64
    def decode(self, state: UplinkState, symbols: UplinkSymbols) -> tuple[UplinkState, Quantized]:
        """Return the receiver's next state and the decoded value, from its present state and the symbols alone.

        The quantizer sends the number of a segment of [-d, d]. The amplitude d adapts to the values: both ends compute
        it from what was sent.

        Args:
            state: the receiver's amplitude d, and the number of the message that it expects next.
            symbols: m escapes, each of which doubles d; the segment of the value, or that it is ABOVE or BELOW all of
                them, or NOTHING was sent; the number of the message; and whether d restarts.
        """
        escapes, segment, number, restart = (jnp.asarray(symbol) for symbol in symbols)
        restarts, is_sent, is_beyond = restart != 0, segment != NOTHING, segment <= BELOW
        # A missed number means a wrong amplitude, until a restart.
        is_synchronised = restarts | (state.number == number)
        # Midpoint of the segment at the doubled amplitude d 2^m; a value beyond all segments counts as +-d 2^m.
        amplitude = jnp.ldexp(self._present_amplitude(state, restarts), escapes)
        inside = midpoint(segment, amplitude, self.levels)
        value = jnp.where(is_beyond, jnp.where(segment == ABOVE, amplitude, -amplitude), inside)
        # Next amplitude max(smallest, decay d 2^m + growth |value|).
        largest = np.finfo(amplitude.dtype).max
        next_amplitude = jnp.clip(self.decay * amplitude + self.growth * jnp.abs(value), self.smallest, largest)
        is_decoded = is_sent & is_synchronised
        next_state = UplinkState(
            amplitude=jnp.where(is_decoded, next_amplitude, state.amplitude),
            number=jnp.where(is_sent, jnp.where(is_synchronised, number + 1, LOST), state.number),
        )
        # The value, and how far off it may be: half a segment, unknown beyond all of them.
        decoded = Quantized(
            value=jnp.where(is_decoded, value, jnp.nan),
            error=jnp.where(is_decoded & ~is_beyond, amplitude / self.levels, jnp.nan),
            saturated=is_decoded & is_beyond,
            symbols=escapes + 1,
        )
        return next_state, decoded

    def _is_restart(self, number: Int[Array, "*n"]) -> Bool[Array, "*n"]:
        """Return whether the value of this number is sent from the first amplitude again."""
        return number == 0 if self.interval is None else number % self.interval == 0

    def _present_amplitude(self, state: UplinkState, restart: Bool[Array, "*n"]) -> Float[Array, "*n"]:
        """Return the amplitude for the present value: the first one at a restart, else that of the state."""
        return jnp.where(restart, self.amplitude, state.amplitude)

    def claim(self, claim: Claim) -> Claim:
        """Lower a claim to "nominal": the amplitude depends on the data, and may be small where errors are large."""
        return weakest([claim, "nominal"])


def _check_decay(value: ArrayLike) -> Parameter:
    """Return the decay of the amplitude, which must lie between 0 and 1."""
    decay = check_parameter("decay", value)
    if not isinstance(decay, jax.Array) and np.any((decay <= 0) | (decay >= 1)):
        raise fail("decay", "numbers between 0 and 1", value)
    return decay


def _check_growth(value: ArrayLike) -> Parameter:
    """Return the growth of the amplitude with the sent value, which must not be negative."""
    growth = check_parameter("growth", value)
    if not isinstance(growth, jax.Array) and np.any(growth < 0):
        raise fail("growth", "no negative number", value)
    return growth
