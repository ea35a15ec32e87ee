"""The exact moments of a Gaussian number y of which a word is received, whose bits may have flipped.

With L_i = P(received | word i sent), M = P(received) = E L(y) and t = (y - m)/s, everything follows from the sums M,
E[t L] and E[t^2 L]: E y = m + s E[t L]/M, Var y = s^2 (E[t^2 L]/M - (E[t L]/M)^2). The variance may be larger than s^2.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.filters.event.truncated_normal import truncated_normal
from heliograph.filters.words.likelihood_at_word_edges import ADDED, ROOT_TWO_PI, SMOOTH, Smooth
from heliograph.filters.words.merged_low_bits import sum_merged_words, sum_overloads
from heliograph.filters.words.word_sums import (
    FINE,
    REACH,
    LikelihoodSums,
    SignalPrior,
    WordGrid,
    multiply_bits,
    tabulate_likelihoods,
)

TABLE = 6  # bits of words that are all summed
BLOCK = 3  # bits of neighbouring words whose likelihoods are those of the bits above times one table
WINDOW = 10  # blocks of words that are at least so wide within the reach, the first of which may begin a block earlier
FAR = 30.0  # deviations from which on differences of tails have no digits
NARROW = 1e-3  # of a deviation: the density is linear over a cell of this half width
BEYOND_ALL = 40.0  # deviations beyond which there is no probability
LEAST = 1e-3  # width, in deviations, of the dither by which edges are smoothed: less changes nothing


def sum_by_edges(
    t: jax.Array, jumps: jax.Array, at_zero: jax.Array, width: jax.Array, smooth: Smooth
) -> LikelihoodSums:
    """Return M = E L, E[t L] and E[t^2 L] of a likelihood L(t) that is constant but for jumps, with t standard normal.

    The jump J at an edge is L above it less L below it. With the normal tail Q and density phi, sums over the edges t
    give M = L(0) + sum_{t >= 0} J Q(t) - sum_{t < 0} J Q(-t), E[t L] = sum J phi(t), E[t^2 L] = M + sum J t phi(t).
    `at_zero` is L(0). `width` is that of the dither that smooths the edges, in deviations, and is at least LEAST.

    Shapes: t (edges,), jumps (..., edges), at_zero (...), for several likelihoods at once.
    """
    sign = jnp.where(t < 0, -1.0, 1.0)
    smoothed_step = smooth(jnp.abs(t), jnp.maximum(width, LEAST))
    mass = at_zero + jumps @ (sign * smoothed_step.beyond)
    return LikelihoodSums(mass, jumps @ smoothed_step.density, mass + jumps @ (sign * smoothed_step.slope))


def sum_neighbouring_words(
    pairs: list[jax.Array],
    weights: jax.Array,
    start: jax.Array,
    blocks: int,
    grid: WordGrid,
    prior: SignalPrior,
    dither: str,
) -> LikelihoodSums:
    """Return the sums M, E[t L], E[t^2 L] over blocks of neighbouring words, of which the end ones are half-lines.

    L is the likelihood of the word that y is rounded to, t = (y - m) / s. That of a word is the likelihood of the bits
    above its block times that of those in it, a table for all blocks. L is constant but at the edges between words, so
    that the sums are over the edges (`sum_by_edges`).

    Args:
        pairs: likelihoods of a zero and a one of each bit (bits, 2), for each combination of error rates.
        weights: probabilities of the combinations, (..., combinations) of several likelihoods at once.
        start: number of the first word, with which a block begins.
        blocks: how many.
        grid: the words.
        prior: of y.
        dither: of the encoder.
    """
    tables = jnp.stack([tabulate_likelihoods(pair[:BLOCK]) for pair in pairs])
    size = tables.shape[1]

    def weigh_bits_above(block: jax.Array) -> jax.Array:
        """Return the weighted likelihood of the bits that name a block, for each combination of error rates.

        The weight is the combination's probability.

        Closed over: `pairs`, likelihoods of the bits, `weights`; `start`, the first word's number; `size` of a block.
        """
        return weights * jnp.stack([multiply_bits(pair[BLOCK:], start / size + block) for pair in pairs])

    def add_block(
        carried: tuple[LikelihoodSums, jax.Array], block: jax.Array
    ) -> tuple[tuple[LikelihoodSums, jax.Array], None]:
        """Add the sums over the edges above each word of one block; `above`: the likelihood of the bits above it.

        Closed over: `tables`, likelihoods of a block's words by their low bits; `blocks`, of `size` words each, the
        first word's number being `start`; `grid`, the words; `prior` of y; the encoder's `dither`.
        """
        total, above = carried
        following = weigh_bits_above(block + 1)
        likelihood = above @ tables
        # No edge is beyond the last word, and none before the first.
        after = jnp.where(block < blocks - 1, following @ tables[:, 0], likelihood[..., -1])
        jumps = jnp.concatenate([likelihood[..., 1:], after[..., None]], axis=-1) - likelihood
        edges = start + size * block + np.arange(-0.5, size)
        t = (grid.low + edges * grid.step - prior.mean) / prior.deviation
        # The word that holds t = 0: it begins below and ends above, where the end words have no end.
        begins_below = (t[:-1] < 0) | ((block == 0) & (np.arange(size) == 0))
        ends_below = (t[1:] < 0) & ((block < blocks - 1) | (np.arange(size) < size - 1))
        at_zero = jnp.sum(jnp.where(begins_below & ~ends_below, likelihood, 0.0), axis=-1)
        sums = sum_by_edges(t[1:], jumps, at_zero, grid.step / prior.deviation, SMOOTH[dither])
        return (total.plus(sums), following), None

    zero = LikelihoodSums(*jnp.zeros((3, *weights.shape[:-1])))
    (sums, _), _ = jax.lax.scan(add_block, (zero, weigh_bits_above(jnp.zeros(()))), jnp.arange(blocks, dtype=float))
    return sums


def sum_words_near_prior(
    pairs: list[jax.Array], weights: jax.Array, received: jax.Array, grid: WordGrid, prior: SignalPrior, dither: str
) -> LikelihoodSums:
    """Return the sums M, E[t L], E[t^2 L] over words within the prior's reach, and the one that was received.

    L is the likelihood of the word to which y is rounded, and t = (y - mean) / deviation. Beyond REACH, 8.5 deviations,
    there is no probability, so that WINDOW blocks of 2^BLOCK words are summed. `pairs` holds the likelihoods of each
    bit's 0 and 1 for each combination of error rates, with the probabilities `weights`. `grid` has all words.
    """
    count = WINDOW * 2**BLOCK
    lowest = prior.mean - REACH * prior.deviation
    start = jnp.floor((lowest - grid.low) / (grid.step * 2**BLOCK)) * 2**BLOCK  # of the block that holds it
    start = jnp.clip(start, 0.0, 2.0**grid.bits - count)
    sums = sum_neighbouring_words(pairs, weights, start, blocks=WINDOW, grid=grid, prior=prior, dither=dither)
    # The received word is added if it is not among these.
    is_outside = (received < start) | (received >= start + count)
    likelihood = weights @ jnp.stack([multiply_bits(pair, received) for pair in pairs])
    return sums.plus(sum_one_word(likelihood * is_outside, received, grid, prior, dither))


def sum_one_word(
    likelihood: jax.Array, index: jax.Array, grid: WordGrid, prior: SignalPrior, dither: str
) -> LikelihoodSums:
    """Return the sums M, E[t L], E[t^2 L] of an L that is `likelihood` in the cell of one word, and 0 elsewhere.

    t = (y - mean) / deviation. BEYOND_ALL, 40 deviations, stands for infinity. SMOOTH holds the form of the edges for
    each kind of dither.
    """
    edges = index + jnp.array([-0.5, 0.5])
    t = (grid.low + edges * grid.step - prior.mean) / prior.deviation
    if grid.bits:  # overloads: the first word has no lower edge, the last no upper one
        is_lower, is_upper = jnp.array([True, False]), jnp.array([False, True])
        t = jnp.where(is_lower & (index <= 0), -BEYOND_ALL, t)
        t = jnp.where(is_upper & (index >= 2.0**grid.bits - 1), BEYOND_ALL, t)
    # L jumps up at the lower edge and down at the upper one. L(0) is not 0 only if 0 lies between them.
    jumps = likelihood[..., None] * jnp.array([1.0, -1.0])
    at_zero = likelihood * ((t[0] < 0) & (t[1] >= 0))
    return sum_by_edges(t, jumps, at_zero, grid.step / prior.deviation, SMOOTH[dither])


class WordEffect(NamedTuple):
    """What a word does to y: log M, E y - m in deviations, and Var y over s^2."""

    log_mass: jax.Array
    shift: jax.Array
    ratio: jax.Array


def find_effect_from_sums(sums: LikelihoodSums) -> WordEffect:
    """Return log M, and the mean and variance of t, from the sums M = E L, E[t L], E[t^2 L] of a likelihood L.

    log M is -inf if M is below the smallest normal number.
    """
    is_possible = sums.mass > np.finfo(float).tiny
    mass = jnp.where(is_possible, sums.mass, 1.0)
    mean = sums.first / mass
    log_mass = jnp.where(is_possible, jnp.log(mass), -jnp.inf)
    return WordEffect(log_mass, mean, sums.second / mass - mean**2)


def widen_by_dither(prior: SignalPrior, grid: WordGrid, dither: str) -> tuple[SignalPrior, jax.Array]:
    """Return the law of y + d, taken for Gaussian as the step D is small, and its variance over that of y."""
    wide = 1 + ADDED[dither] * (grid.step / prior.deviation) ** 2
    return SignalPrior(prior.mean, prior.deviation * jnp.sqrt(wide)), wide


def remove_dither(change: WordEffect, wide: jax.Array) -> WordEffect:
    """Return what is known of y from what is known of y + d, whose variance is `wide` times that of y."""
    return WordEffect(change.log_mass, change.shift / jnp.sqrt(wide), 1 - (1 - change.ratio) / wide)


def find_effect_of_cell(index: jax.Array, grid: WordGrid, prior: SignalPrior, dither: str) -> WordEffect:
    """Return what the word of number `index` says of y, if no bit can have flipped.

    ADDED holds the variance of a dither in squared steps, 0 for a dither that is subtracted again. Steps of at least
    FINE deviations are not small. From FAR deviations on the sums over edges have no digits.
    """
    wider, variance_ratio = widen_by_dither(prior, grid, dither)
    by_cell = remove_dither(_cut_to_cell(index, grid, wider), variance_ratio)
    if not ADDED[dither]:
        return by_cell
    # If steps are not small, a dither smooths the edges of the cell. Far away only the cell itself has digits.
    away = jnp.abs((grid.low + index * grid.step - prior.mean) / prior.deviation)
    width = grid.step / prior.deviation
    by_smooth_edges = find_effect_from_sums(sum_one_word(jnp.ones(()), index, grid, prior, dither))
    is_smooth_valid = (width >= FINE) & (away - width < FAR)
    effect: WordEffect = jax.tree.map(lambda a, b: jnp.where(is_smooth_valid, a, b), by_smooth_edges, by_cell)
    return effect


def _cut_to_cell(index: jax.Array, grid: WordGrid, prior: SignalPrior) -> WordEffect:
    """Return what knowing its cell does to y: by the cell's ends, or its centre where their difference loses digits.

    The end cells of words of so many `bits` reach to infinity; bits 0: words without end.
    """
    centre = (grid.low + index * grid.step - prior.mean) / prior.deviation
    half = grid.step / prior.deviation / 2
    lower, upper = centre - half, centre + half
    if grid.bits:
        lower = jnp.where(index <= 0, -jnp.inf, lower)
        upper = jnp.where(index >= 2.0**grid.bits - 1, jnp.inf, upper)
    narrow_cell = (half * (1 + jnp.abs(centre)) < NARROW) & jnp.isfinite(lower) & jnp.isfinite(upper)
    cut = truncated_normal(jnp.where(narrow_cell, -1.0, lower), jnp.where(narrow_cell, 1.0, upper))
    # Of a short cell of half width h about c, the density is linear: mass 2 h phi(c), mean - c = -c h^2 / 3 and
    # variance h^2 / 3.
    log_mass = -(centre**2) / 2 - np.log(ROOT_TWO_PI) + jnp.log(2 * half)
    short = WordEffect(log_mass, centre * (1 - half**2 / 3), half**2 / 3)
    return WordEffect(*(jnp.where(narrow_cell, a, b) for a, b in zip(short, cut, strict=True)))


def _sum_wide_words(
    pairs: list[jax.Array], weights: jax.Array, received: jax.Array, grid: WordGrid, prior: SignalPrior, dither: str
) -> WordEffect:
    """Return the effect of a received word on y by a sum over the words within the prior's reach, 8.5 deviations.

    `pairs` holds the likelihoods of each bit's 0 and 1 for each combination of error rates, with the probabilities
    `weights`. `grid` has all words, `prior` is the law of y, and `dither` the kind of the encoder's dither.
    """
    return find_effect_from_sums(sum_words_near_prior(pairs, weights, received, grid, prior, dither))


def _sum_fine_words(
    pairs: list[jax.Array], weights: jax.Array, received: jax.Array, grid: WordGrid, prior: SignalPrior, dither: str
) -> WordEffect:
    """Return the effect of a received word on y by a sum over cells of several words, and over all beyond the range.

    The dither's variance widens the prior, and is removed afterwards. `pairs` holds the likelihoods of each bit's 0 and
    1 for each combination of error rates, with the probabilities `weights`. `grid` has all words.
    """
    wider, variance_ratio = widen_by_dither(prior, grid, dither)
    sums = [sum_merged_words(pair, received, grid, wider).plus(sum_overloads(pair, grid, wider)) for pair in pairs]
    # Each sum is the mean over the combinations of error rates.
    mean_sums = LikelihoodSums(*(weights @ jnp.stack(terms) for terms in zip(*sums, strict=True)))
    return remove_dither(find_effect_from_sums(mean_sums), variance_ratio)


def find_effect_of_bits(
    pairs: list[jax.Array], weights: jax.Array, received: jax.Array, grid: WordGrid, prior: SignalPrior, dither: str
) -> WordEffect:
    """Return what the received bits of a word say of y: log probability, shift of its mean, ratio of its variances.

    Words of few bits are all summed. Of others those within the prior's reach are summed, or cells of several words if
    a step is finer than FINE deviations.

    Args:
        pairs: likelihoods of a zero and a one of each bit (bits, 2), for each combination of error rates.
        weights: probabilities of the combinations, (..., combinations) for several likelihoods at once.
        received: number of the received word.
        grid: the words.
        prior: of y.
        dither: of the encoder.
    """
    # The sum over all words of few bits is cheap and exact.
    if grid.bits <= TABLE:
        blocks = 2 ** max(grid.bits - BLOCK, 0)
        return find_effect_from_sums(sum_neighbouring_words(pairs, weights, jnp.zeros(()), blocks, grid, prior, dither))

    word = pairs, weights, received, grid, prior, dither
    sum_wide_words, sum_fine_words = partial(_sum_wide_words, *word), partial(_sum_fine_words, *word)
    effect: WordEffect = jax.lax.cond(grid.step >= FINE * prior.deviation, sum_wide_words, sum_fine_words)
    return effect
