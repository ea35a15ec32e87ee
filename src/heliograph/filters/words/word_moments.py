"""The exact moments of a Gaussian number y that is sent as a codeword (word, for short), whose bits may flip.

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

    With the normal tail Q and density phi, integration by parts gives sums over the edges t_e, where L jumps by J_e:

        M = L(0) + sum_{t_e >= 0} J_e Q(t_e) - sum_{t_e < 0} J_e Q(-t_e)
        E[t L] = sum J_e phi(t_e)
        E[t^2 L] = M + sum J_e t_e phi(t_e)

    A dither smooths the edges: Q, phi and t phi are then means over it.

    Args:
        t: the edges (edges,).
        jumps: L above each edge less L below it (..., edges), for several likelihoods at once.
        at_zero: L(0) (...).
        width: of the dither, in deviations.
        smooth: returns the means of Q, phi and t phi at t >= 0 over the dither.
    """
    sign = jnp.where(t < 0, -1.0, 1.0)
    at_edge = smooth(jnp.abs(t), jnp.maximum(width, LEAST))
    mass = at_zero + jumps @ (sign * at_edge.beyond)
    return LikelihoodSums(mass=mass, first=jumps @ at_edge.density, second=mass + jumps @ (sign * at_edge.slope))


def sum_neighbouring_words(
    pairs: list[jax.Array],
    weights: jax.Array,
    start: jax.Array,
    blocks: int,
    grid: WordGrid,
    prior: SignalPrior,
    dither: str,
) -> LikelihoodSums:
    """Return M = E L, E[t L] and E[t^2 L] over blocks of neighbouring codewords, for t = (y - mean) / deviation.

    L(t) is the likelihood of the codeword that y is rounded to. All y below the first codeword count to it, and all y
    above the last one to that. A block is 2^BLOCK codewords that differ in their BLOCK lowest bits: the likelihood of
    each is that of its high bits, one number for a block, times that of its low bits, a table for all blocks. L jumps
    at the edges between codewords only, so the sums are over these edges.

    Args:
        pairs: likelihoods of a zero and a one of each bit (bits, 2), for each combination of error rates.
        weights: probabilities of the combinations, (..., combinations) of several likelihoods at once.
        start: number of the first codeword, at which a block begins.
        blocks: how many.
        grid: the words.
        prior: of y.
        dither: of the encoder.
    """
    tables = jnp.stack([tabulate_likelihoods(pair[:BLOCK]) for pair in pairs])
    size = tables.shape[1]

    def weigh_bits_above(block: jax.Array) -> jax.Array:
        """Return the likelihood of the high bits of a block's codewords, times the probability of the error rates.

        It has one entry for each combination of error rates; `block` counts from the first codeword, number `start`.
        """
        return weights * jnp.stack([multiply_bits(pair[BLOCK:], start / size + block) for pair in pairs])

    def add_block(
        carried: tuple[LikelihoodSums, jax.Array], block: jax.Array
    ) -> tuple[tuple[LikelihoodSums, jax.Array], None]:
        """Add what the edges above each codeword of one block contribute: L jumps there to the next codeword's.

        `carried`: the sums so far, and the likelihood of the block's high bits, with which the likelihood of each
        codeword of the block is `high_bits @ tables`.
        """
        total, high_bits = carried
        high_bits_of_next = weigh_bits_above(block + 1)
        likelihood = high_bits @ tables
        # The last codeword of all has no upper edge: no jump there.
        first_of_next = jnp.where(block < blocks - 1, high_bits_of_next @ tables[:, 0], likelihood[..., -1])
        jumps = jnp.concatenate([likelihood[..., 1:], first_of_next[..., None]], axis=-1) - likelihood
        edges = start + size * block + np.arange(-0.5, size)
        t = (grid.low + edges * grid.step - prior.mean) / prior.deviation
        # L(0): that of the codeword whose cell holds t = 0. The cells of the end codewords are half-lines.
        begins_below = (t[:-1] < 0) | ((block == 0) & (np.arange(size) == 0))
        ends_below = (t[1:] < 0) & ((block < blocks - 1) | (np.arange(size) < size - 1))
        at_zero = jnp.sum(jnp.where(begins_below & ~ends_below, likelihood, 0.0), axis=-1)
        sums = sum_by_edges(t[1:], jumps, at_zero, grid.step / prior.deviation, SMOOTH[dither])
        return (total.plus(sums), high_bits_of_next), None

    zero = LikelihoodSums(*jnp.zeros((3, *weights.shape[:-1])))
    (sums, _), _ = jax.lax.scan(add_block, (zero, weigh_bits_above(jnp.zeros(()))), jnp.arange(blocks, dtype=float))
    return sums


def sum_words_near_prior(
    pairs: list[jax.Array], weights: jax.Array, received: jax.Array, grid: WordGrid, prior: SignalPrior, dither: str
) -> LikelihoodSums:
    """Return M = E L, E[t L] and E[t^2 L] over the codewords near the prior's mean, and the received one.

    L is the likelihood of the codeword to which y is rounded: P(received | it was sent). t = (y - mean) / deviation.
    Beyond REACH (8.5) deviations there is no probability, so it is enough to sum a window of WINDOW (10) blocks of
    2^BLOCK (8) codewords; steps are so wide that it covers all deviations within the reach.

    Args:
        pairs: likelihoods of a zero and a one of each bit (bits, 2), for each combination of error rates.
        weights: probabilities of the combinations.
        received: number of the received codeword.
        grid: the codewords low + i step, i = 0, ..., 2^bits - 1.
        prior: mean and standard deviation of y before the codeword.
        dither: kind of dither (random shift before rounding) of the encoder.
    """
    count = WINDOW * 2**BLOCK  # codewords in the window
    lowest = prior.mean - REACH * prior.deviation
    # The first codeword of the block in which `lowest` lies; at the ends of the range the window is moved inwards.
    start = jnp.floor((lowest - grid.low) / (grid.step * 2**BLOCK)) * 2**BLOCK
    start = jnp.clip(start, 0.0, 2.0**grid.bits - count)
    sums = sum_neighbouring_words(pairs, weights, start, blocks=WINDOW, grid=grid, prior=prior, dither=dither)
    # The received codeword may be far more likely than all others: it is added if it is not among these.
    is_outside = (received < start) | (received >= start + count)
    likelihood = weights @ jnp.stack([multiply_bits(pair, received) for pair in pairs])
    return sums.plus(sum_one_word(likelihood * is_outside, received, grid, prior, dither))


def sum_one_word(
    likelihood: jax.Array, index: jax.Array, grid: WordGrid, prior: SignalPrior, dither: str
) -> LikelihoodSums:
    """Return M = E L, E[t L] and E[t^2 L] of an L(t) that is `likelihood` in the cell of one codeword, and 0 elsewhere.

    t = (y - mean) / deviation, and the cell are the y that are rounded to codeword number `index`. L is written as two
    jumps, which a dither smooths.
    """
    edges = index + jnp.array([-0.5, 0.5])
    t = (grid.low + edges * grid.step - prior.mean) / prior.deviation
    # The cell of the first codeword has no lower edge and that of the last no upper one: BEYOND_ALL is infinity.
    if grid.bits:
        is_lower, is_upper = jnp.array([True, False]), jnp.array([False, True])
        t = jnp.where(is_lower & (index <= 0), -BEYOND_ALL, t)
        t = jnp.where(is_upper & (index >= 2.0**grid.bits - 1), BEYOND_ALL, t)
    # L jumps up at the lower edge and down at the upper one. L(0) is not 0 only if 0 lies between them.
    jumps = likelihood[..., None] * jnp.array([1.0, -1.0])
    at_zero = likelihood * ((t[0] < 0) & (t[1] >= 0))
    return sum_by_edges(t, jumps, at_zero, grid.step / prior.deviation, SMOOTH[dither])


class WordEffect(NamedTuple):
    """What a received codeword says of y ~ N(m, s^2): log M, its log probability; (E y - m) / s; and Var y / s^2."""

    log_mass: jax.Array
    shift: jax.Array
    ratio: jax.Array


def find_effect_from_sums(sums: LikelihoodSums) -> WordEffect:
    """Return log M, and mean and variance of t, from M = E L, E[t L] and E[t^2 L] of a likelihood L(t).

    E t = E[t L] / M and Var t = E[t^2 L] / M - (E t)^2 given what was received. log M is -inf if M is below the
    smallest normal number.
    """
    is_possible = sums.mass > np.finfo(float).tiny
    mass = jnp.where(is_possible, sums.mass, 1.0)
    mean = sums.first / mass
    log_mass = jnp.where(is_possible, jnp.log(mass), -jnp.inf)
    return WordEffect(log_mass, mean, sums.second / mass - mean**2)


def widen_by_dither(prior: SignalPrior, grid: WordGrid, dither: str) -> tuple[SignalPrior, jax.Array]:
    """Return the law of y + d, and Var(y + d) / Var(y), for the signal y and a dither d that is not subtracted again.

    Var d is ADDED in squared steps D of the codewords. y + d is taken for Gaussian, since D is small here.
    """
    wide = 1 + ADDED[dither] * (grid.step / prior.deviation) ** 2
    return SignalPrior(prior.mean, prior.deviation * jnp.sqrt(wide)), wide


def remove_dither(change: WordEffect, wide: jax.Array) -> WordEffect:
    """Return the effect of a codeword on y from its effect on y + d, for a dither d, with `wide` = Var(y + d) / Var(y).

    With y + d ~ N(m, wide s^2), Cov(y, y + d) = s^2, so that E y - m = (E(y + d) - m) / wide and
    Var y = s^2 - (wide s^2 - Var(y + d)) / wide^2. Both are returned relative to s and s^2.
    """
    return WordEffect(change.log_mass, change.shift / jnp.sqrt(wide), 1 - (1 - change.ratio) / wide)


def find_effect_of_cell(index: jax.Array, grid: WordGrid, prior: SignalPrior, dither: str) -> WordEffect:
    """Return what codeword number `index` says of y if no bit can flip: the sent number lies in the codeword's cell.

    Without a dither, or with one that is subtracted again, y itself lies in the cell. Otherwise y + d lies in it for a
    random d, in one of two ways: as a Gaussian y + d cut to the cell, or as a cell whose edges the dither smooths.
    """
    wider, variance_ratio = widen_by_dither(prior, grid, dither)
    by_cut = remove_dither(_cut_to_cell(index, grid, wider), variance_ratio)
    if not ADDED[dither]:
        return by_cut
    # Smooth edges are exact, but their sums have no digits from FAR deviations on. In steps below FINE deviations y + d
    # is close to Gaussian.
    distance = jnp.abs((grid.low + index * grid.step - prior.mean) / prior.deviation)
    width = grid.step / prior.deviation
    by_smooth_edges = find_effect_from_sums(sum_one_word(jnp.ones(()), index, grid, prior, dither))
    is_smooth_valid = (width >= FINE) & (distance - width < FAR)
    effect: WordEffect = jax.tree.map(lambda a, b: jnp.where(is_smooth_valid, a, b), by_smooth_edges, by_cut)
    return effect


def _cut_to_cell(index: jax.Array, grid: WordGrid, prior: SignalPrior) -> WordEffect:
    """Return what it says of y that y lies in the cell of codeword number `index`: moments of a truncated normal law.

    The cells of the first and last codeword reach to infinity; with `grid.bits` 0 there is no first and last one.
    """
    centre = (grid.low + index * grid.step - prior.mean) / prior.deviation
    half = grid.step / prior.deviation / 2
    lower, upper = centre - half, centre + half
    if grid.bits:
        lower = jnp.where(index <= 0, -jnp.inf, lower)
        upper = jnp.where(index >= 2.0**grid.bits - 1, jnp.inf, upper)
    narrow_cell = (half * (1 + jnp.abs(centre)) < NARROW) & jnp.isfinite(lower) & jnp.isfinite(upper)
    cut = truncated_normal(jnp.where(narrow_cell, -1.0, lower), jnp.where(narrow_cell, 1.0, upper))
    # In a narrow cell a difference of its ends loses digits. But there the density is linear: for half width h about c
    # the mass is 2 h phi(c), the mean c - c h^2 / 3 and the variance h^2 / 3.
    log_mass = -(centre**2) / 2 - np.log(ROOT_TWO_PI) + jnp.log(2 * half)
    short = WordEffect(log_mass, centre * (1 - half**2 / 3), half**2 / 3)
    return WordEffect(*(jnp.where(narrow_cell, a, b) for a, b in zip(short, cut, strict=True)))


def _sum_wide_words(
    pairs: list[jax.Array], weights: jax.Array, received: jax.Array, grid: WordGrid, prior: SignalPrior, dither: str
) -> WordEffect:
    """Return the effect of a received codeword on y by a sum over the codewords within 8.5 deviations of its mean.

    `pairs` holds the likelihoods of each bit's 0 and 1 for each combination of error rates, with the probabilities
    `weights`. `grid` has all words, `prior` is the law of y, and `dither` the kind of the encoder's dither.
    """
    return find_effect_from_sums(sum_words_near_prior(pairs, weights, received, grid, prior, dither))


def _sum_fine_words(
    pairs: list[jax.Array], weights: jax.Array, received: jax.Array, grid: WordGrid, prior: SignalPrior, dither: str
) -> WordEffect:
    """Return the effect of a received codeword on y, if the steps between codewords are far finer than its deviation.

    `pairs` holds the likelihoods of each bit's 0 and 1 for each combination of error rates, with the probabilities
    `weights`. `grid` has all codewords.
    """
    # The number that is rounded is y + d with the dither d.
    wider, variance_ratio = widen_by_dither(prior, grid, dither)
    # For each combination the sums over the range, neighbouring codewords taken together, and beyond its ends.
    sums = [sum_merged_words(pair, received, grid, wider).plus(sum_overloads(pair, grid, wider)) for pair in pairs]
    # Their mean over the combinations of error rates, from which the effect on y + d follows, and that on y.
    mean_sums = LikelihoodSums(*(weights @ jnp.stack(terms) for terms in zip(*sums, strict=True)))
    return remove_dither(find_effect_from_sums(mean_sums), variance_ratio)


def find_effect_of_bits(
    pairs: list[jax.Array], weights: jax.Array, received: jax.Array, grid: WordGrid, prior: SignalPrior, dither: str
) -> WordEffect:
    """Return what a received codeword says of y: its log probability, the shift of the mean, the ratio of variances.

    A codeword is the number of the quantised value of the sender's signal y, sent as bits that may have been flipped.
    The law of y given the received bits is a sum over the codewords that may have been sent, in one of three ways: all
    codewords if they have at most TABLE (6) bits; else those near the prior's mean, if a step is at least FINE (a
    quarter) of a deviation; else groups of neighbouring codewords, since single ones would be too many.

    Args:
        pairs: P(received | the bit was sent as 0), and as 1, of each bit (bits, 2); an array for each combination of
            the links' possible bit error rates.
        weights: probabilities of the combinations, (..., combinations) for several likelihoods at once.
        received: number of the received codeword.
        grid: the codewords: the lowest value, the step between values, and the number of bits.
        prior: mean and deviation of y before the codeword.
        dither: kind of the random number that the encoder adds before rounding.
    """
    # Few codewords: all are summed, from number 0 on. A block has 2^BLOCK (8) of them.
    if grid.bits <= TABLE:
        first_word = jnp.zeros(())
        blocks = 2 ** max(grid.bits - BLOCK, 0)
        sums = sum_neighbouring_words(pairs, weights, first_word, blocks, grid, prior, dither)
        return find_effect_from_sums(sums)
    # Many: which of two ways depends on the prior, which is known only when the program runs.
    arguments = pairs, weights, received, grid, prior, dither
    sum_wide_words, sum_fine_words = partial(_sum_wide_words, *arguments), partial(_sum_fine_words, *arguments)
    effect: WordEffect = jax.lax.cond(grid.step >= FINE * prior.deviation, sum_wide_words, sum_fine_words)
    return effect
