"""Sums over words that are much finer than the deviation of y: their low bits merged to cells."""

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.filters.words.likelihood_at_word_edges import ROOT_TWO_PI, signed_tail_and_density
from heliograph.filters.words.word_sums import (
    FINE,
    REACH,
    LikelihoodSums,
    SignalPrior,
    WordGrid,
    multiply_bits,
    tabulate_likelihoods,
)

MERGED = 4  # bits of neighbouring cells whose likelihoods are those of the bits above times one table
BLOCKS = 10  # of cells of an eighth to a quarter of a deviation within the reach, which may begin a block earlier
Carried = tuple[
    LikelihoodSums, jax.Array, jax.Array, jax.Array
]  # sums, e^(-a^2 / (2 v)), r and a of a block's first cell


def sum_merged_words(pairs: jax.Array, received: jax.Array, grid: WordGrid, prior: SignalPrior) -> LikelihoodSums:
    """Return M = E L, E[t L] and E[t^2 L] over codewords far finer than the deviation of y, t = (y - mean) / deviation.

    2^b neighbouring codewords, which differ in their b low bits, are taken together as a cell, an eighth to a quarter
    of a deviation wide. In it the likelihood of the low bits is taken for a Gaussian of y: with the step D between
    codewords, and pi_j = l_1 / (l_0 + l_1) from the likelihoods of low bit j, it has the mean and variance

        mu = first codeword + D sum_j 2^j pi_j,    v = D^2 (sum_j 4^j pi_j (1 - pi_j) + 1/12)

    y beyond the range is not in these sums.

    Args:
        pairs: likelihoods of a zero and a one of each bit, (bits, 2).
        received: number of the word that was received.
        grid: the words.
        prior: of y.
    """
    # b = `low_bits`: each cell has 2^b words, which differ in their b lowest bits.
    bits = np.arange(grid.bits)
    low_bits = jnp.floor(jnp.log2(jnp.maximum(prior.deviation * FINE / grid.step, 1.0)))
    low_bits = jnp.minimum(low_bits, grid.bits - 1.0)
    words_of_cell, is_low = jnp.round(jnp.exp2(low_bits)), bits < low_bits
    # mu in steps above the cell's first word, v, and the likelihood of the low bits: the same in every cell.
    total = jnp.sum(pairs, axis=1)
    ones = pairs[:, 1] / total
    mean = jnp.sum(jnp.where(is_low, 2.0**bits * ones, 0.0))
    variance = grid.step**2 * (jnp.sum(jnp.where(is_low, 4.0**bits * ones * (1 - ones), 0.0)) + 1 / 12)
    likelihood_of_low = jnp.prod(jnp.where(is_low, total, 1.0))
    # A cell's Gaussian about mu times the prior of mean m and deviation s has the mass e^(-a^2 / (2 wide)) up to a
    # factor: a = (mu - m) / s, wide = 1 + v / s^2. Blocks of cells begin REACH deviations below the prior's mean.
    wide = 1 + variance / prior.deviation**2
    width = words_of_cell * grid.step / prior.deviation
    block = 2.0**MERGED
    start = jnp.floor((prior.mean - REACH * prior.deviation - grid.low) / (grid.step * words_of_cell * block)) * block
    start = jnp.maximum(start, 0.0)

    def distance_of(cell: jax.Array) -> jax.Array:
        """Return a: how far the mean of a cell is from the prior's, in the prior's deviations."""
        return (grid.low + (cell * words_of_cell + mean) * grid.step - prior.mean) / prior.deviation

    # Likelihoods of the bits of the cells' numbers, and the cell of the received word.
    upper, received_cell = _drop_low_bits(pairs, low_bits), jnp.floor(received / words_of_cell)
    sums = _sum_blocks(upper, start / block, distance_of(start), width, wide)
    # The received word may be far more likely than all others: where no block has its cell, that is added.
    is_outside = (received_cell < start) | (received_cell >= start + BLOCKS * block)
    likelihood = multiply_bits(upper, received_cell) * is_outside
    likelihood = likelihood * jnp.exp(-(distance_of(received_cell) ** 2) / (2 * wide))
    mass, first, second = (
        sum_over_cells + likelihood * distance_of(received_cell) ** power for power, sum_over_cells in enumerate(sums)
    )
    # Of the product of both Gaussians: E t = a / wide, E t^2 = a^2 / wide^2 + 1 - 1 / wide.
    scale = likelihood_of_low * grid.step / (prior.deviation * ROOT_TWO_PI * jnp.sqrt(wide))
    first, second = first / wide, second / wide**2
    return LikelihoodSums(scale * mass, scale * first, scale * (second + mass * (1 - 1 / wide)))


def _sum_blocks(
    pairs: jax.Array, number: jax.Array, away: jax.Array, width: jax.Array, wide: jax.Array
) -> LikelihoodSums:
    """Return the sums over cells of q = likelihood e^(-a^2 / (2 v)), of q a and of q a^2.

    a is the distance of a cell from the prior's mean, w the width of a cell, both in the prior's deviations, v =
    `wide`. For cell j of a block whose first cell is at a, with r = e^(-a w / v),

        e^(-(a + j w)^2 / (2 v)) = e^(-a^2 / (2 v)) r^j e^(-(j w)^2 / (2 v))

    So the sum over a block is a polynomial in r, with the same coefficients in all blocks. From block to block, J cells
    on, e^(-a^2 / (2 v)) changes by the factor r^J e^(-(J w)^2 / (2 v)), and r by e^(-J w^2 / v).

    Args:
        pairs: likelihoods of a zero and a one of each bit of the cells' numbers (bits, 2).
        number: of the first block.
        away: a of its first cell.
        width: w.
        wide: v, the variance of prior and cell together over that of the prior.
    """
    # e^(-(j w)^2 / (2 v)) is the product of e^(-(2 i + 1) w^2 / (2 v)) over i < j.
    factor = jnp.exp(-(width**2) / (2 * wide))
    bell, next_factor = [jnp.ones(())], factor
    for _ in range(2**MERGED - 1):
        bell.append(bell[-1] * next_factor)
        next_factor = next_factor * factor**2
    # Coefficients of the polynomials (cells of a block, 3): of likelihood, and times j and j^2.
    cell_number = np.arange(2.0**MERGED)
    table = tabulate_likelihoods(pairs[:MERGED]) * jnp.stack(bell)
    coefficients = jnp.stack([table, table * cell_number, table * cell_number**2], axis=1)
    bell_of_next_block = bell[-1] * next_factor  # e^(-(J w)^2 / (2 v))
    ratio_change = jnp.exp(-(2**MERGED) * width**2 / wide)  # of r, from block to block

    def add_block(carried: Carried, block: jax.Array) -> tuple[Carried, None]:
        """Add the sums over one block to those in `carried`, with e^(-a^2 / (2 v)), r and a of its first cell.

        Cell j is at a + j w. The polynomials in r, by Horner's rule, are the sums of q, q j and q j^2.
        """
        sums, density, ratio, a = carried
        polynomials = coefficients[-1]
        for cell in range(2**MERGED - 2, -1, -1):
            polynomials = polynomials * ratio + coefficients[cell]
        # Times e^(-a^2 / (2 v)) and the likelihood of the block's high bits. Then q times a + j w, and times its
        # square.
        polynomials = polynomials * (density * multiply_bits(pairs[MERGED:], number + block))
        mass, first, second = polynomials[0], polynomials[1] * width, polynomials[2] * width**2
        sums = sums.plus(LikelihoodSums(mass, a * mass + first, a * (a * mass + 2 * first) + second))
        power = ratio
        for _ in range(MERGED):
            power = power**2
        next_density = density * power * bell_of_next_block  # power: r^J, J = 2^MERGED cells a block
        return (sums, next_density, ratio * ratio_change, a + 2**MERGED * width), None

    start = LikelihoodSums(*jnp.zeros(3)), jnp.exp(-(away**2) / (2 * wide)), jnp.exp(-away * width / wide), away
    (sums, *_), _ = jax.lax.scan(add_block, start, jnp.arange(BLOCKS, dtype=float))
    return sums


def _drop_low_bits(pairs: jax.Array, count: jax.Array) -> jax.Array:
    """Return the likelihoods (bits, 2) of the bits from index `count` on, filled up with bits that are certainly 0.

    `pairs` (bits, 2) holds the likelihoods that each bit was sent as 0 and as 1, the lowest bit first. `count` is known
    only at run time, so there is a shift by 1, 2, 4, ... for each of its binary digits that is 1.
    """
    shifted, quotient, shift = pairs, count, 1
    while shift < len(pairs):
        half = jnp.floor(quotient / 2)
        certain_zeros = jnp.tile(jnp.array([1.0, 0.0]), (shift, 1))
        shifted = jnp.where(quotient > 2 * half, jnp.concatenate([shifted[shift:], certain_zeros]), shifted)
        quotient, shift = half, 2 * shift
    return shifted


def sum_overloads(pair: jax.Array, grid: WordGrid, prior: SignalPrior) -> LikelihoodSums:
    """Return M = E L, E[t L] and E[t^2 L] over y beyond both ends of the range, for t = (y - mean) / deviation.

    There the likelihood L is constant: all bits of the codeword are zeros below the range, and ones above it. `pair`
    (bits, 2) holds the likelihoods of each bit's 0 and 1.
    """
    ends = jnp.array([0.0, 2.0**grid.bits - 1])
    outwards = jnp.array([-1.0, 1.0])
    # y is beyond the range from half a step beyond the last codeword on.
    t = (grid.low + (ends + outwards / 2) * grid.step - prior.mean) / prior.deviation
    a, likelihood = t * outwards, jnp.prod(pair, axis=0)
    # For t > a: E 1 = Q(a), E t = phi(a), E t^2 = Q(a) + a phi(a); for t < -a, E t has the other sign.
    tail, phi = signed_tail_and_density(a)
    mass, density = likelihood * tail, likelihood * phi
    return LikelihoodSums(mass=jnp.sum(mass), first=jnp.sum(outwards * density), second=jnp.sum(mass + a * density))
