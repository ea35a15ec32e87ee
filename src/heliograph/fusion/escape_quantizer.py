"""Quantizer that doubles its amplitude for a value outside it: encoder and decoder."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.fusion.quantizer import AbstractQuantizer, Quantized
from heliograph.fusion.uniform_quantizer import (
    Parameter,
    check_range,
    levels_of,
    midpoint,
    parameter,
    positive,
    segment_of,
)
from heliograph.model.estimate import Claim, weakest
from heliograph.numerics.check import check_count, fail
from heliograph.numerics.float64 import in_float64
from heliograph.numerics.types import Array, ArrayLike, Bool, Float, Int


class Symbols(NamedTuple):
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
        """True where the end knows the amplitude."""
        return self.number >= 0


class EscapeQuantizer(AbstractQuantizer):
    """A decodable quantizer that does not saturate, driven by nothing but what was sent.

    Where x is outside [-d, d], an escape symbol doubles the amplitude, as often as needed: m = ceil(log2(|x| / d)).
    Then the segment is sent, so |error| <= d 2^m / levels always, and both ends go on with
    d+ = max(smallest, decay d 2^m + growth |sent|). Levels are odd, so that zero is one. Only a value whose d 2^m would
    be no number saturates.

    A value that is lost on the way leaves the receiver with a wrong d. It detects that from the number of the next one:
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
        self.levels = levels_of(levels)
        if levels % 2 == 0:
            raise fail("levels", "an odd number, so that zero is a level", levels)
        self.amplitude, self.smallest = positive("amplitude", amplitude), positive("smallest amplitude", smallest)
        for name, value in (("amplitude", self.amplitude), ("smallest amplitude", self.smallest)):
            check_range(name, value, np.ones(()), self.levels)
        self.decay, self.growth = _decay(decay), _growth(growth)
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
    def encode(self, state: UplinkState, value: ArrayLike, restart: bool = False) -> Symbols:
        """Encode a value (n,), from the amplitude that both ends know, or from the first one."""
        x = jnp.asarray(value, dtype=float)
        anew = jnp.broadcast_to(self._restarts(state.number) | restart, x.shape)
        amplitude = self._amplitude(state, anew)
        # m = ceil(log2(|x| / d)) by exponents, without rounding.
        (x_fraction, x_power), (fraction, power) = jnp.frexp(x), jnp.frexp(amplitude)
        doublings = x_power - power + (jnp.abs(x_fraction) > fraction)  # smallest m with |x| <= d 2^m, exactly
        most = np.finfo(x.dtype).maxexp - power  # the largest that leaves d 2^m a number
        known, beyond = ~jnp.isnan(x), jnp.isinf(x) | (doublings > most)
        escapes = jnp.where(x != 0, jnp.clip(jnp.where(beyond, most, doublings), 0), 0)
        segment = segment_of(x, jnp.ldexp(amplitude, escapes), self.levels)
        segment = jnp.where(beyond, jnp.where(x > 0, ABOVE, BELOW), jnp.where(known, segment, NOTHING))
        numbers = jnp.broadcast_to(state.number, x.shape)
        return Symbols(jnp.where(known, escapes, 0).astype(int), segment.astype(int), numbers, anew & known)

    @in_float64
    def decode(self, state: UplinkState, symbols: Symbols) -> tuple[UplinkState, Quantized]:
        """Decode at the receiver: next state and value, from the present state and the symbols alone."""
        escapes, segment, number, restart = (jnp.asarray(part) for part in symbols)
        restart, there, beyond = restart != 0, segment != NOTHING, segment <= BELOW
        # A missed number means a wrong amplitude, until a restart.
        synchronised = restart | (state.number == number)
        # Midpoint of the segment at the doubled amplitude d 2^m.
        used = jnp.ldexp(self._amplitude(state, restart), escapes)
        inside = midpoint(segment, used, self.levels)
        sent = jnp.where(beyond, jnp.where(segment == ABOVE, used, -used), inside)
        largest = np.finfo(used.dtype).max
        # Next amplitude max(smallest, decay d 2^m + growth |sent|).
        following = jnp.clip(self.decay * used + self.growth * jnp.abs(sent), self.smallest, largest)
        known = there & synchronised
        value = jnp.where(known, sent, jnp.nan)
        error = jnp.where(known & ~beyond, used / self.levels, jnp.nan)
        after = UplinkState(
            jnp.where(known, following, state.amplitude),
            jnp.where(there, jnp.where(synchronised, number + 1, LOST), state.number),
        )
        return after, Quantized(value, error, known & beyond, escapes + 1)

    def _restarts(self, number: Int[Array, "*n"]) -> Bool[Array, "*n"]:
        return number == 0 if self.interval is None else number % self.interval == 0

    def _amplitude(self, state: UplinkState, restart: Bool[Array, "*n"]) -> Float[Array, "*n"]:
        return jnp.where(restart, self.amplitude, state.amplitude)

    def claim(self, claim: Claim) -> Claim:
        """Lower a claim to "nominal": the amplitude depends on the data, and may be small where errors are large."""
        return weakest([claim, "nominal"])


def _decay(value: ArrayLike) -> Parameter:
    result = parameter("decay", value)
    if not isinstance(result, jax.Array) and np.any((result <= 0) | (result >= 1)):
        raise fail("decay", "numbers between 0 and 1", value)
    return result


def _growth(value: ArrayLike) -> Parameter:
    result = parameter("growth", value)
    if not isinstance(result, jax.Array) and np.any(result < 0):
        raise fail("growth", "no negative number", value)
    return result
