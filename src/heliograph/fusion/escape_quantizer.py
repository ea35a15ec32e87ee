"""Quantizer whose step follows its input: an escape symbol doubles its range until the input lies in it."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.fusion.quantizer import (
    AbstractQuantizer,
    Parameter,
    Quantized,
    check_amplitude,
    check_levels,
    check_parameter,
    check_positive,
    find_segment,
    midpoint,
)
from heliograph.model.estimate import Claim, weakest
from heliograph.numerics.check import check_count, fail
from heliograph.numerics.float64 import in_float64
from heliograph.numerics.masked_arrays import fill_masked
from heliograph.numerics.types import Array, ArrayLike, Bool, Float, Int


class UplinkSymbols(NamedTuple):
    """Symbols sent over the uplink for one value, by component.

    escapes: how many times the amplitude is doubled. segment: index, from 0, of the segment that holds the value, or
    `NOTHING` (-1) for NaN, `ABOVE` or `BELOW` for a value beyond the range of numbers. number: how many values were
    sent before. restart: whether the first amplitude is used.
    """

    escapes: Int[Array, "*n"]
    segment: Int[Array, "*n"]
    number: Int[Array, "*n"]
    restart: Bool[Array, "*n"]


# In place of a segment's index: no value (NaN), a value below or above the range of numbers.
NOTHING, BELOW, ABOVE = -1, -2, -3
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
        """Check and hold the parameters of the class.

        Amplitudes are refused for which neighbouring levels would not differ as numbers, or which overflow.
        """
        self.levels = check_levels(levels)
        if levels % 2 == 0:
            raise fail("levels", "an odd number, so that zero is a level", levels)
        self.amplitude, self.smallest = (
            check_positive("amplitude", amplitude),
            check_positive("smallest amplitude", smallest),
        )
        for name, value in (("amplitude", self.amplitude), ("smallest amplitude", self.smallest)):
            check_amplitude(name, value, np.ones(()), self.levels)
        self.decay = _check_decay(decay)
        self.growth = _check_growth(growth)
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

        With m = ceil(log2(|x| / d)), from 0, x lies in [-d 2^m, d 2^m], which is divided in `levels` segments. d is the
        amplitude that both ends know, or the first one if `restart`. The segment is NOTHING for NaN; ABOVE or BELOW
        where d 2^m is no number.
        """
        x = jnp.asarray(fill_masked(value), dtype=float)
        restarts = jnp.broadcast_to(self._is_restart(state.number) | restart, x.shape)
        amplitude = self._present_amplitude(state, restarts)
        # m by exponents, without rounding: x = x_fraction 2^x_power and d = fraction 2^power.
        x_fraction, x_power = jnp.frexp(x)
        fraction, power = jnp.frexp(amplitude)
        doublings = x_power - power + (jnp.abs(x_fraction) > fraction)  # smallest m with |x| <= d 2^m, exactly
        most_doublings = np.finfo(x.dtype).maxexp - power  # the largest m for which d 2^m is a finite number
        is_value = ~jnp.isnan(x)
        is_beyond = jnp.isinf(x) | (doublings > most_doublings)
        m = jnp.where(is_beyond, most_doublings, doublings)
        escapes = jnp.where(x != 0, jnp.clip(m, 0), 0)  # none where x is within d already
        # The segment of [-d 2^m, d 2^m], or in its place why there is none.
        segment = find_segment(x, jnp.ldexp(amplitude, escapes), self.levels)
        beyond = jnp.where(x > 0, ABOVE, BELOW)
        segment = jnp.where(is_beyond, beyond, jnp.where(is_value, segment, NOTHING))
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
        restarts = restart != 0
        is_sent = segment != NOTHING
        is_beyond = segment <= BELOW
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
        """Return whether the value of this number, counted from 0, uses the first amplitude: every `interval`-th."""
        return number == 0 if self.interval is None else number % self.interval == 0

    def _present_amplitude(self, state: UplinkState, restart: Bool[Array, "*n"]) -> Float[Array, "*n"]:
        """Return the amplitude for the present value: the first one at a restart, else that of the state."""
        return jnp.where(restart, self.amplitude, state.amplitude)

    def claim(self, claim: Claim) -> Claim:
        """Lower a claim to "nominal": the amplitude depends on the data, and may be small where errors are large."""
        return weakest([claim, "nominal"])


def _check_decay(value: ArrayLike) -> Parameter:
    """Return the decay as an array; raise ValueError unless it is in (0, 1) (not checked if JAX traces it)."""
    decay = check_parameter("decay", value)
    if not isinstance(decay, jax.Array) and np.any((decay <= 0) | (decay >= 1)):
        raise fail("decay", "numbers between 0 and 1", value)
    return decay


def _check_growth(value: ArrayLike) -> Parameter:
    """Return the growth as an array; raise ValueError if it is negative (not checked if JAX traces it)."""
    growth = check_parameter("growth", value)
    if not isinstance(growth, jax.Array) and np.any(growth < 0):
        raise fail("growth", "no negative number", value)
    return growth
