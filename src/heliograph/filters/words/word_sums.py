"""Sums over the words of a number y: likelihoods of words, products over their bits; the grid of words; the prior."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

REACH = 8.5  # deviations to each side, beyond which 2e-17 lies
FINE = 0.25  # of a deviation: finer words are merged


class LikelihoodSums(NamedTuple):
    """Sums M = E L, E[t L] and E[t^2 L] of a likelihood L of y, over the prior of t = (y - mean) / deviation."""

    mass: jax.Array
    first: jax.Array
    second: jax.Array

    def plus(self, other: "LikelihoodSums") -> "LikelihoodSums":
        """Return the sums over these words and others: sums over separate parts of y add up."""
        return LikelihoodSums(self.mass + other.mass, self.first + other.first, self.second + other.second)


class WordGrid(NamedTuple):
    """The codewords of one component: the values low + i step, i = 0, ..., 2^bits - 1; `bits` 0: without end."""

    low: jax.Array
    step: jax.Array
    bits: int


class SignalPrior(NamedTuple):
    """Mean and standard deviation of the Gaussian law of y before its codeword is received."""

    mean: jax.Array
    deviation: jax.Array


def multiply_bits(pairs: jax.Array, numbers: jax.Array) -> jax.Array:
    """Return the likelihoods of words by their numbers, products over their bits; 0 for a number beyond all words.

    Args:
        pairs: likelihoods of a zero and a one of each bit, the lowest first, (bits, 2).
        numbers: whole numbers from 0 (...,).
    """
    quotient, likelihood = numbers, jnp.ones(numbers.shape)
    for if_zero, if_one in pairs:
        # The lowest binary digit is 1 where the quotient is odd.
        half = jnp.floor(quotient / 2)
        likelihood = likelihood * jnp.where(quotient > 2 * half, if_one, if_zero)
        quotient = half
    return jnp.where(quotient > 0, 0.0, likelihood)


def tabulate_likelihoods(pair: jax.Array) -> jax.Array:
    """Return the likelihoods of all words, the product of those of their bits (2^bits,).

    `pair` (bits, 2) holds the likelihoods of a zero and a one for each bit, the lowest bit first.
    """
    table = jnp.ones(1)
    for bit in range(len(pair)):
        table = jnp.concatenate([table * pair[bit, 0], table * pair[bit, 1]])
    return table
