"""Words of bits on their way: each bit that is decoded and forwarded is flipped with a probability."""

from collections.abc import Sequence
from itertools import product
from math import prod

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.numerics.check import check_count, fail, flag, items, scalar, show_value
from heliograph.numerics.types import Float
from heliograph.random_affine.base import AbstractRandomAffine
from heliograph.random_affine.composite import write_percentage
from heliograph.random_affine.hop import GainAndNoise, known
from heliograph.random_affine.laws.law import AbstractLaw, Constant, Discrete
from heliograph.random_affine.moments.monomials import JointMoments
from heliograph.random_affine.noises.noise import Gaussian
from heliograph.random_affine.series_and_stack import Series, Stack

MOST_ATOMS = 64  # most combinations of the hops' error rates


class Flips(AbstractRandomAffine):
    """A link of words in natural binary, each bit of which is flipped with the probability p, independently.

    What a flipped bit does depends on the words, so that moments are asked of `about_centre`: with g = 1 - 2p a word q
    of centre c arrives as q' with E[q' - c | q] = g (q - c) and Var[q' | q] = U (1 - g^2), U the variance of a word
    all of whose values are equally likely, whatever q is.

    Args:
        error: law of p, `Constant` or `Discrete`.
        dimension: number of words of a message.
        per_message: True if one p is drawn for all words of a message, False if one for each word.
    """

    error: Constant | Discrete
    dimension: int = eqx.field(static=True)
    per_message: bool = eqx.field(static=True)

    @property
    def outputs(self) -> int:
        """Length of z: one number for each word."""
        return self.dimension

    @property
    def inputs(self) -> int:
        """Length of y: one number for each word."""
        return self.dimension

    @property
    def gain(self) -> Constant | Discrete:
        """Law of the gain g = 1 - 2p, p the probability that a bit is flipped."""
        if isinstance(self.error, Constant):
            return Constant(1 - 2 * self.error.value)
        return Discrete(1 - 2 * self.error.values, self.error.probabilities)

    def about_centre(self, power: Float[np.ndarray, " words"]) -> AbstractRandomAffine:
        """Return the random affine map q' - c = g (q - c) + n of received codewords q', with Var n = U (1 - E g^2).

        c is the centre of the words, and g = 1 - 2p with the probability p that a bit is flipped. A word is
        q = c + sum_j s_j w_j / 2, with the sign s_j = +-1 and the weight w_j of bit j. A received sign has the mean
        g s_j and the variance 1 - g^2, independently of the others, and sum_j (w_j / 2)^2 = U. If each word draws a
        gain of its own, the map is a stack of one map for each word.

        Args:
            power: U of each word, the variance that it would have if all its values were equally likely.
        """
        lost_share = 1 - float(self.gain.moment(2))
        if self.per_message or self.dimension == 1 or isinstance(self.error, Constant):
            return GainAndNoise(self.gain, np.eye(self.dimension), Gaussian(lost_share * np.diag(power)))
        rows = np.eye(self.dimension)
        links = [GainAndNoise(self.gain, np.eye(1), Gaussian([[lost_share * variance]])) for variance in power]
        return Stack([Series([known(rows[i : i + 1]), link]) for i, link in enumerate(links)])

    def on_bits(self, bits: int, beside: int) -> "BitFlips":
        """Return the map of words that are each written as `bits` signs -1 or 1, and `beside` more numbers.

        The signs may be flipped. The other numbers, such as a dither, arrive as they are.
        """
        return BitFlips(self.error, self.dimension, self.per_message, bits, beside)

    def moments(self, order: int) -> JointMoments:
        """Refuse moments: what a flipped bit does to a word depends on the word, which only the encoder knows."""
        expected = "a filter that is given the encoder of the words (encoder=...)"
        raise fail("channel of words", expected, "one that is not")

    def sample(self, key: jax.Array) -> jax.Array:
        """Refuse to draw: what a flipped bit does to a word depends on the word, which only the encoder knows."""
        raise fail("channel of words", "a node that has the encoder of the words (encoder=...)", "one that has none")

    def in_words(self) -> str:
        """Return a text with the mean share of flipped bits, such as "words, 1% of bits flipped"."""
        return f"words, {write_percentage(self.error.moment(1))} of bits flipped"


class BitFlips(AbstractRandomAffine):
    """The link of codewords as a link of their bits, signs -1 or 1, each of which is flipped with probability p.

    error: law of p. dimension: number of words of a message. per_message: True if one p is drawn for all of them. y has
    for each word `bits` signs, and behind them `beside` more numbers, such as a dither, that arrive as they are.
    """

    error: Constant | Discrete
    dimension: int = eqx.field(static=True)
    per_message: bool = eqx.field(static=True)
    bits: int = eqx.field(static=True)
    beside: int = eqx.field(static=True)

    @property
    def outputs(self) -> int:
        """Length of z: for each of the `dimension` words its `bits` signs, then `beside` numbers sent with the word."""
        return self.dimension * (self.bits + self.beside)

    @property
    def inputs(self) -> int:
        """Length of y, in the order of z: for each word its signs, then the numbers sent with it."""
        return self.outputs

    def sample(self, key: jax.Array) -> jax.Array:
        """Return a drawn H, a diagonal matrix with -1 for each bit that is flipped, and else 1.

        First the probability p of a flip is drawn, once for the message or once for each codeword, and then each bit's
        flip. A codeword has `bits` signs, and then `beside` numbers that are never flipped. The constant 1 is last.
        """
        rate_key, bit_key = jax.random.split(key)
        if self.per_message:
            error_rate = jnp.full(self.dimension, self.error.sample(rate_key))
        else:
            error_rate = jnp.stack([self.error.sample(k) for k in jax.random.split(rate_key, self.dimension)])
        uniform = jax.random.uniform(bit_key, (self.dimension, self.bits), dtype=float)
        signs = jnp.where(uniform < error_rate[:, None], -1.0, 1.0)
        gains = jnp.concatenate([signs, jnp.ones((self.dimension, self.beside))], axis=1).reshape(-1)
        return jnp.diag(jnp.append(gains, 1.0))


def decode_and_forward(hops: Sequence[object], dimension: int = 1, per_message: bool = False) -> Flips:
    """Return the chain of hops that decode words and forward them, each flipping every bit with its own probability.

    A bit of the chain is flipped with the probability p of g = 1 - 2p = prod_h (1 - 2 p_h). The words are those of the
    node's encoder (`Words`), in natural binary. An error rate that is a `Discrete` law is drawn anew at each step.

    `Series([decode_and_forward([.01]), Stack([decode_and_forward([.02]), decode_and_forward([.005])])])` sends one word
    over two paths behind a common first hop. A packet with a checksum loses what has a flipped bit:
    `erasure(perfect(), (1 - p) ** bits)`.

    Args:
        hops: error rates of the hops in the order of the way: numbers from 0 to 0.5, or `Discrete` laws of them.
        dimension: number of words of a message (default 1).
        per_message: True if the error rate that is drawn is that of all words of a message; False, one for each word,
            unless given.

    Raises:
        ValueError: no hop, what is no error rate, a rate for each bit (then the mean of a word is not affine in the
            word), laws of more than 64 values together.

    Source: natural binary words over binary symmetric channels; E[q' | q] = c + g (q - c).
    """
    rates = items("error rates of hops", hops, "numbers from 0 to 0.5, or Discrete laws of them")
    if not rates:
        raise fail("error rates of hops", "at least one", "none")
    # Each hop's error rate as pairs (value, probability), of which all combinations are listed.
    laws = [_read_error_rate(rate) for rate in rates]
    atoms = [law.list_atoms() for law in laws]
    if prod(len(a) for a in atoms) > MOST_ATOMS:
        raise fail("error rates of hops", f"laws of at most {MOST_ATOMS} values together", [len(a) for a in atoms])
    # Of each combination g = prod_h (1 - 2 p_h), and its probability, as hops are independent.
    gains, shares = list[float](), list[float]()
    for combination in product(*atoms):
        gains.append(prod(1 - 2 * float(p) for _, p in combination))
        shares.append(prod(float(share) for share, _ in combination))
    # p = (1 - g) / 2.
    values = (1 - np.asarray(gains)) / 2
    error = Constant(values[0]) if len(values) == 1 else Discrete(values, np.asarray(shares))
    return Flips(error, check_count("words of a message", dimension), flag("per_message", per_message))


def _read_error_rate(rate: object) -> Constant | Discrete:
    """Return the law of a hop's error rate, the probability of a flipped bit: a number or finitely many values."""
    expected = "one number from 0 to 0.5 for all bits of the word, or a Discrete law of such numbers"
    if isinstance(rate, Discrete):
        values = np.asarray(rate.values)
        if np.any(rate.radius) or values.min() < 0 or values.max() > 0.5:
            raise fail("error rate of a hop", expected, show_value(values.tolist()))
        return rate
    if isinstance(rate, AbstractLaw) and not isinstance(rate, Constant):
        raise fail("error rate of a hop", expected, type(rate).__name__)
    value = rate.value if isinstance(rate, Constant) else rate
    if np.ndim(value):  # type: ignore[arg-type]
        raise fail("error rate of a hop", f"{expected}; with other rates a word's mean is not affine in it", "several")
    return Constant(scalar("error rate of a hop", value, low=0.0, high=0.5))  # type: ignore[arg-type]
