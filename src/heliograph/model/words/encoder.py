"""Words of finite length: the encoder at a sender's side, and the words on their way as bits or as numbers."""

from typing import Literal, NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.model.trigger import read_choice
from heliograph.numerics.check import array, check_count, fail, rank, scalar, text
from heliograph.numerics.module import Module, readable
from heliograph.numerics.numpy_or_jax import library
from heliograph.numerics.types import ArrayLike, Float

Dither = Literal["none", "triangular", "subtracted", "stochastic"]
MOST_BITS = 24  # of a word
ROUNDING = 1e-9  # of a step: what a span of words may lack to its end


@readable
class Words(Module):
    """A sender that rounds its measurement to words of `bits` bits: q = low + i D, i = 0, ..., 2^bits - 1.

    Each component of y, plus its dither, is rounded to the nearest word; beyond low - D/2 and high + D/2 it is the end
    word, an overload. i is sent in natural binary. D = (high - low) / (2^bits - 1).

    `dither`: "none"; "triangular", the sum of two uniform numbers of width D, which makes the rounding's mean 0 and
    its variance D^2/4 whatever y is; "stochastic", one uniform number of width D (mean 0, variance D^2 f (1 - f), f the
    place between two words); "subtracted", one uniform number that both ends draw and the receiver takes off (mean 0,
    variance D^2/12). Subtracted dithers are received behind all else, one for each word; those of a sender that draws
    them by `dithers` are computed from the numbers of its messages.

    Args:
        bits: of a word, from 1 to 24; or `resolution`.
        low: the lowest word, of all components or for each.
        high: the highest word.
        dither: "none" by default.
        resolution: D, from which follow the bits: the fewest with which words from `low` on reach `high`.

    Raises:
        ValueError: a range that is none, bits that are none, both or none of bits and resolution, an unknown dither.

    Source: Lipshitz, Wannamaker and Vanderkooy, Quantization and dither: a theoretical survey (1992).
    """

    low: Float[np.ndarray, "..."]
    high: Float[np.ndarray, "..."]
    bits: int = eqx.field(static=True)
    dither: Dither = eqx.field(static=True)

    def __init__(
        self,
        bits: int | None = None,
        low: ArrayLike = -1.0,
        high: ArrayLike = 1.0,
        dither: Dither = "none",
        resolution: "Float[ArrayLike, ''] | None" = None,
    ):
        """Check and hold the lowest and highest word, the bits of a word, and the kind of dither.

        A word (codeword) is a quantised value: 2^bits of them lie at equal distances D from `low` to `high`, which are
        numbers or arrays of one number for each output. If D (`resolution`) is given in place of `bits`, the bits are
        the fewest with which words low, low + D, ... reach `high`. The highest word is then low + (2^bits - 1) D, and
        may be above `high`. A dither is a random number that is added before rounding.
        """
        self.low, self.high = (np.asarray(_read_range_end(name, v)) for name, v in (("low", low), ("high", high)))
        if not np.all(self.high > self.low):
            raise fail("range of words", "low below high", f"{self.low.tolist()} and {self.high.tolist()}")
        if (bits is None) == (resolution is None):
            raise fail("encoder", "bits or resolution, one of them", "both" if bits is not None else "none")
        # The fewest bits with which words from `low` on reach `high`: 2^bits - 1 >= span / D, but for rounding.
        if resolution is not None:
            step = float(scalar("resolution", resolution, np.finfo(float).tiny))
            spans = (self.high - self.low) / step
            bits = max(1, int(np.ceil(np.log2(np.max(spans) - ROUNDING + 1))))
            self.high = self.low + step * (2.0**bits - 1)
        self.bits = check_count("bits of a word", bits)
        if self.bits > MOST_BITS:
            raise fail("bits of a word", f"at most {MOST_BITS}", self.bits)
        self.dither = read_choice("dither", dither, Dither)

    @property
    def step(self) -> Float[np.ndarray, "..."]:
        """D, the distance of two words."""
        return cast(np.ndarray, (self.high - self.low) / (2.0**self.bits - 1))

    @property
    def centre(self) -> Float[np.ndarray, "..."]:
        """The middle c of the range."""
        return cast(np.ndarray, (self.high + self.low) / 2)

    @property
    def power(self) -> Float[np.ndarray, "..."]:
        """U = D^2 (4^bits - 1) / 12, the variance of a word of which all values are equally likely."""
        return cast(np.ndarray, self.step**2 * (4.0**self.bits - 1) / 12)

    @property
    def subtracts(self) -> bool:
        """True if the receiver takes the dither off, and so has to know it."""
        return self.dither == "subtracted"

    @property
    def carried(self) -> int:
        """How many numbers stand for a word in a simulated channel: its bits, and its dither if it is subtracted.

        A receiver that subtracts the dither has to know it, so that it is simulated as one more number.
        """
        return self.bits + (1 if self.subtracts else 0)

    def check_outputs(self, outputs: int) -> None:
        """Raise ValueError unless low and high are one number each, or one for each component."""
        for name, end in (("low", self.low), ("high", self.high)):
            if np.ndim(end) and np.shape(end) != (outputs,):
                raise fail(f"{name} of the words", f"one number, or {outputs}", f"shape {np.shape(end)}")

    def each(self, values: Float[np.ndarray, "..."], outputs: int) -> Float[np.ndarray, " outputs"]:
        """Return an array (outputs,) of one number for each component, from one number for all or one for each."""
        values_of_outputs: np.ndarray = library(values).broadcast_to(values, (outputs,))
        return values_of_outputs

    def draw_dither(self, key: jax.Array, outputs: int) -> Float[jax.Array, " outputs"]:
        """Draw the dither of one message: noise that is added to each of the outputs before it is rounded to a word.

        With the distance D of two words (`self.step`) it is 0 for "none"; D (u_1 + u_2 - 1) for "triangular", with u_1
        and u_2 uniform from 0 to 1; and D (u_1 - 1/2) for "stochastic" and "subtracted".
        """
        uniform = jax.random.uniform(key, (2, outputs), dtype=float)  # two numbers from 0 to 1 for each output
        match self.dither:
            case "none":
                return jnp.zeros(outputs)
            case "triangular":
                return jnp.asarray(self.step) * (uniform[0] + uniform[1] - 1)
            case _:
                return jnp.asarray(self.step) * (uniform[0] - 0.5)

    def index(self, y: jax.Array) -> jax.Array:
        """Return the number i of the word nearest to each component of y, a whole number as a float.

        Beyond the range it is that of the end word.
        """
        place = jnp.floor((y - jnp.asarray(self.low)) / jnp.asarray(self.step) + 0.5)
        return jnp.clip(place, 0.0, 2.0**self.bits - 1)

    def word(self, index: jax.Array) -> jax.Array:
        """Return the word q = low + i D of each component from its number i."""
        return jnp.asarray(self.low) + index * jnp.asarray(self.step)

    def signs(self, index: jax.Array) -> Float[jax.Array, "outputs bits"]:
        """Return the bits of words of given numbers i (outputs,) as signs, the lowest bit first: 1 - 2 b of a bit b."""
        powers = 2.0 ** np.arange(self.bits)
        return 1 - 2 * jnp.mod(jnp.floor(index[:, None] / powers), 2.0)

    def send(self, y: jax.Array, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return the word of each component, and the numbers by which the channel carries it, (outputs * carried,).

        These are its bits as signs, followed by its dither d if the receiver subtracts it.
        """
        d = self.draw_dither(key, len(y))
        index = self.index(y + d)
        bits = self.signs(index)
        numbers = jnp.concatenate([bits, d[:, None]], axis=1) if self.subtracts else bits
        return self.word(index), numbers.reshape(-1)

    def dithers(
        self, node: str, numbers: "Float[ArrayLike, ' messages']", outputs: int = 1
    ) -> Float[np.ndarray, "messages outputs"]:
        """Return the dithers that a sender draws for messages of these numbers, which its receiver draws again.

        A dither d is a random number that is added before rounding, and subtracted by the receiver, so that the error
        of rounding does not depend on the signal. It is a function of node, component and number of the message: with
        h = crc32(node) 2^32 + component, s = h 0x9e3779b97f4a7c15 + (number + 1) 0xbf58476d1ce4e5b9 (modulo 2^64) is
        mixed twice as by splitmix64, and u is the highest 53 bits as a fraction. Then d = D (u - 1/2) with the
        quantiser's step D. So a lost message does not shift the dithers of others, and no two senders or components
        share theirs.

        Args:
            node: name of the sender's node.
            numbers: sequence numbers of the messages, whole numbers from 0.
            outputs: number of components (default 1).

        Raises:
            ValueError: an encoder whose dither is not taken off, numbers that are no sequence numbers.
        """
        if not self.subtracts:
            raise fail("dithers", 'an encoder with dither="subtracted"', repr(self.dither))
        self.check_outputs(check_count("outputs", outputs))
        sequence = array("sequence numbers", numbers, (None,))
        if np.any(sequence < 0) or np.any(sequence != np.round(sequence)):
            raise fail("sequence numbers", "whole numbers from 0", "others")
        source = np.uint64(_checksum_node_name(text("node", node)))
        with np.errstate(over="ignore"):
            stream = (source << np.uint64(32)) + np.arange(outputs, dtype=np.uint64)
            state = stream * np.uint64(0x9E3779B97F4A7C15)
            state = state + (sequence.astype(np.uint64)[:, None] + np.uint64(1)) * np.uint64(0xBF58476D1CE4E5B9)
            mixed = _mix_bits(_mix_bits(state))
        uniform = (mixed >> np.uint64(11)).astype(float) / 2.0**53
        return self.each(self.step, outputs) * (uniform - 0.5)


def _read_range_end(name: str, value: ArrayLike) -> Float[np.ndarray, "..."]:
    """Return the low or high end of the words' range as an array: one number for all components, or one for each."""
    return cast(np.ndarray, array(f"{name} of the words", value, (None,) if rank(name, value) else ()))


def _checksum_node_name(node: str) -> int:
    """Return the CRC-32 of a node's name, which seeds its dither in the same way on every machine."""
    from zlib import crc32

    return crc32(node.encode())


def _mix_bits(state: np.ndarray) -> np.ndarray:
    """Return 64-bit numbers whose bits are mixed by the finalizer of the generator splitmix64, as unsigned integers.

    Numbers that differ in one bit become numbers that look unrelated. Source: Steele, Lea and Flood (2014).
    """
    state = (state ^ (state >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    state = (state ^ (state >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return cast(np.ndarray, state ^ (state >> np.uint64(31)))


class WordReader(NamedTuple):
    """How a receiver reads codewords from received bits.

    components: for each output of the channel the index in y of the component that its codeword stands for; -1 for a
    flag, a number that is no codeword.
    """

    components: tuple[int, ...]

    def read_words(self, encoder: Words, outputs: int, numbers: jax.Array) -> jax.Array:
        """Return the received codewords and flags, in the order of the channel, then dithers that are to be subtracted.

        A codeword is q = low + D i, i = sum_j 2^j b_j, whose bit b_j is received as the sign s_j = 1 - 2 b_j. A flag is
        a number that is no codeword. `components` has for each number of the result the index in y of its codeword, or
        -1 for a flag.

        Args:
            encoder: encoder of the codewords: low, the step D, the number of bits, and whether the receiver subtracts
                the dither, a random shift that was added before rounding.
            outputs: length of y.
            numbers: what the channel delivers: for each codeword its signs, and its dither if the receiver subtracts
                it; for each flag one number.
        """
        low, step = (jnp.asarray(encoder.each(value, outputs)) for value in (encoder.low, encoder.step))
        powers = 2.0 ** np.arange(encoder.bits)
        values, dithers, start = list[jax.Array](), list[jax.Array](), 0
        for component in self.components:
            if component < 0:  # a flag
                values.append(numbers[start])
                start += 1
                continue
            # q = low + D sum_j 2^j (1 - s_j) / 2
            signs = numbers[start : start + encoder.bits]
            values.append(low[component] + step[component] * jnp.sum(powers * (1 - signs)) / 2)
            if encoder.subtracts:
                dithers.append(numbers[start + encoder.bits])
            start += encoder.carried  # the bits, and 1 more with a dither
        return jnp.stack(values + dithers)
