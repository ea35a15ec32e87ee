"""The exact moments of a Gaussian number y of which a word is received, whose bits may have flipped.

With L_i = P(received | word i sent), M = P(received) = E L(y) and t = (y - m)/s, everything follows from the sums M,
E[t L] and E[t^2 L]: E y = m + s E[t L]/M, Var y = s^2 (E[t^2 L]/M - (E[t L]/M)^2). The variance may be larger than s^2.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.filters.event.truncated_normal import truncated_normal

ROOT = np.sqrt(2 * np.pi)
TABLE = 6  # bits of words whose cells are all summed
REACH = 8.5  # deviations to each side, beyond which 2e-17 lies
FINE = 0.25  # of a deviation: finer words are merged
BLOCK = 3  # bits of neighbouring words whose likelihoods are those of the bits above times one table
WINDOW = 10  # blocks of words that are at least so wide within the reach, the first of which may begin a block earlier
FAR = 30.0  # deviations from which on differences of tails have no digits
NARROW = 1e-3  # of a deviation: the density is linear over a cell of this half width
LEAST = 1e-3  # width, in deviations, of the dither by which edges are smoothed: less changes nothing
MERGED = 18  # blocks of cells between an eighth and a quarter of a deviation within the reach
CENTRE = 3.75  # of x = a / root 2, where c is 0
POWERS = (
    1.2375126308378275,
    -0.14024059858554525,
    0.0035854154854790257,
    0.08227673848999506,
    -0.10880393014244462,
    0.09230432116428125,
    -0.05869339857664934,
    0.02836227737211114,
    -0.009746579683265262,
    0.0017556261651970652,
    0.000293714378044958,
    -0.00029015535246077655,
    5.164652974177416e-05,
    2.2387565714911816e-05,
    -1.1438048033346894e-05,
    -9.792625707303523e-07,
    1.7419821586224816e-06,
    -5.084465378687302e-08,
    -2.4857126248016745e-07,
    1.879082322370048e-08,
    3.197926671666804e-08,
    -1.9551358868985616e-09,
    -2.623107347133476e-09,
)  # of (1 + 2 x) e^(x^2) erfc x


class Sums(NamedTuple):
    """M, E[t L] and E[t^2 L]."""

    mass: jax.Array
    first: jax.Array
    second: jax.Array

    def plus(self, other: "Sums") -> "Sums":
        """Add those of other words."""
        return Sums(self.mass + other.mass, self.first + other.first, self.second + other.second)


class Grid(NamedTuple):
    """Words of one component: the lowest, the step, and their number."""

    low: jax.Array
    step: jax.Array
    bits: int


class Prior(NamedTuple):
    """Mean and deviation of y before the word."""

    mean: jax.Array
    deviation: jax.Array


class Steps(NamedTuple):
    """A step from 0 to 1 at t, smoothed by a dither: E of it, of t times it less E of it times 0, and so on.

    beyond: P(t' > a) of a standard normal t' plus dither, a = |t|; density: its derivative; slope: of that, negative.
    """

    beyond: jax.Array
    density: jax.Array
    slope: jax.Array


Smooth = Callable[[jax.Array, jax.Array], Steps]


def tail_and_density(a: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Q(a) = P(t > a) and phi(a) of a >= 0, with one exponential and one reciprocal; both to 5e-16 of themselves.

    With x = a / root 2 and c = (x - K) / (x + K), (1 + 2 x) e^(x^2) erfc x is smooth in c from -1 to 1.

    Source: Shepherd and Laframboise, Chebyshev approximation of (1 + 2 x) exp(x^2) erfc x (1981), in powers of c.
    """
    x = a * np.sqrt(0.5)
    falling = jnp.exp(-x * x)
    reciprocal = 1 / ((x + CENTRE) * (1 + 2 * x))
    c = (x - CENTRE) * (1 + 2 * x) * reciprocal
    ratio = jnp.full_like(a, POWERS[-1])
    for power in POWERS[-2::-1]:
        ratio = ratio * c + power
    return ratio * ((x + CENTRE) * reciprocal) * (falling / 2), falling * (1 / ROOT)


def signed_tail_and_density(a: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Q(a) and phi(a) of any a."""
    q, density = tail_and_density(jnp.abs(a))
    return jnp.where(a < 0, 1 - q, q), density


def step_as_it_is(a: jax.Array, width: jax.Array) -> Steps:
    """No dither: Q, phi and a phi."""
    q, density = tail_and_density(a)
    return Steps(q, density, a * density)


def step_by_uniform(a: jax.Array, width: jax.Array) -> Steps:
    """A uniform dither of width D: differences over D of I(a) = E(t - a)+ = phi - a Q, of Q and of phi."""
    low, high = a - width / 2, a + width / 2
    (q, p), (q_above, p_above) = (signed_tail_and_density(x) for x in (low, high))
    return Steps((p - low * q - p_above + high * q_above) / width, (q - q_above) / width, (p - p_above) / width)


def step_by_triangle(a: jax.Array, width: jax.Array) -> Steps:
    """A triangular dither: second differences of E((t - a)+)^2 / 2 = ((1 + a^2) Q - a phi)/2, of I and of Q."""
    q, p = zip(*(signed_tail_and_density(x) for x in (a - width, a, a + width)), strict=True)
    x = a - width, a, a + width

    def second_difference(values: list[jax.Array]) -> jax.Array:
        return (values[0] - 2 * values[1] + values[2]) / width**2

    squares = [((1 + x_ * x_) * q_ - x_ * p_) / 2 for x_, q_, p_ in zip(x, q, p, strict=True)]
    rest = [p_ - x_ * q_ for x_, q_, p_ in zip(x, q, p, strict=True)]
    return Steps(second_difference(squares), second_difference(rest), second_difference(list(q)))


SMOOTH: dict[str, Smooth] = {
    "none": step_as_it_is,
    "subtracted": step_as_it_is,
    "stochastic": step_by_uniform,
    "triangular": step_by_triangle,
}
ADDED = {"none": 0.0, "subtracted": 0.0, "stochastic": 1 / 12, "triangular": 1 / 6}  # variance of a dither, in D^2


def sum_by_edges(t: jax.Array, jumps: jax.Array, here: jax.Array, width: jax.Array, smooth: Smooth) -> Sums:
    """Sum over the edges at t, across which L jumps upwards by `jumps`; L is `here` at t = 0.

    M = L(0) + sum_{t >= 0} J Q(t) - sum_{t < 0} J Q(-t), E[t L] = sum J phi(t), E[t^2 L] = M + sum J t phi(t).
    """
    sign = jnp.where(t < 0, -1.0, 1.0)
    step = smooth(jnp.abs(t), jnp.maximum(width, LEAST))
    mass = here + jnp.sum(jumps * sign * step.beyond)
    return Sums(mass, jnp.sum(jumps * step.density), mass + jnp.sum(jumps * sign * step.slope))


def sum_all_cells(likelihood: jax.Array, grid: Grid, prior: Prior, dither: str) -> Sums:
    """Sum over all words of likelihoods L (2^bits,)."""
    places = np.arange(len(likelihood) - 1) + 0.5
    t = (grid.low + places * grid.step - prior.mean) / prior.deviation
    below = jnp.concatenate([jnp.ones(1, bool), t < 0])
    inside = below & ~jnp.concatenate([t < 0, jnp.zeros(1, bool)])
    here = jnp.sum(jnp.where(inside, likelihood, 0.0))
    return sum_by_edges(t, jnp.diff(likelihood), here, grid.step / prior.deviation, SMOOTH[dither])


def multiply_bits(pairs: jax.Array, numbers: jax.Array) -> jax.Array:
    """Return the likelihoods of words by their numbers, the products of those of their bits; 0 of what is no word.

    Args:
        pairs: likelihoods of a zero and a one of each bit, the lowest first, (bits, 2).
        numbers: whole numbers from 0 (...,).
    """
    rest, likelihood = numbers, jnp.ones(numbers.shape)
    for zero, one in pairs:
        half = jnp.floor(rest / 2)
        likelihood = likelihood * jnp.where(rest > 2 * half, one, zero)
        rest = half
    return jnp.where(rest > 0, 0.0, likelihood)


def multiply_block_bits(pairs: jax.Array, first: jax.Array, blocks: int) -> tuple[jax.Array, jax.Array]:
    """Return likelihoods of neighbouring words as those of the bits above a block (blocks,) times those in it (8,).

    Args:
        pairs: as of `multiply_bits`.
        first: number of the first word, with which a block begins.
        blocks: how many.
    """
    return multiply_bits(pairs[BLOCK:], first / 2**BLOCK + np.arange(blocks)), _tabulate(pairs[:BLOCK])


def sum_window(
    pairs: list[jax.Array], weights: jax.Array, received: jax.Array, grid: Grid, prior: Prior, dither: str
) -> Sums:
    """Sum over the words within the reach of the prior, and the one that was received; arguments `change_by_bits`'."""
    count = WINDOW * 2**BLOCK
    start = jnp.floor((prior.mean - REACH * prior.deviation - grid.low) / (grid.step * 2**BLOCK)) * 2**BLOCK
    start = jnp.clip(start, 0.0, 2.0**grid.bits - count)
    tables = [jnp.outer(*multiply_block_bits(pair, start, WINDOW)).ravel() for pair in pairs]
    likelihood = weights @ jnp.stack(tables)
    sums = sum_all_cells(likelihood, Grid(grid.low + start * grid.step, grid.step, grid.bits), prior, dither)
    outside = (received < start) | (received >= start + count)
    own = weights @ jnp.stack([multiply_bits(pair, received) for pair in pairs])
    return sums.plus(sum_cell(own * outside, received, grid, prior, dither))


def sum_cell(likelihood: jax.Array, index: jax.Array, grid: Grid, prior: Prior, dither: str) -> Sums:
    """Sum over one word that is far from the prior."""
    edges = index + jnp.array([-0.5, 0.5])
    t = (grid.low + edges * grid.step - prior.mean) / prior.deviation
    if grid.bits:  # overloads: the end words have one edge
        t = jnp.where(jnp.array([True, False]) & (index <= 0), -40.0, t)
        t = jnp.where(jnp.array([False, True]) & (index >= 2.0**grid.bits - 1), 40.0, t)
    jumps = likelihood * jnp.array([1.0, -1.0])
    here = likelihood * ((t[0] < 0) & (t[1] >= 0))
    return sum_by_edges(t, jumps, here, grid.step / prior.deviation, SMOOTH[dither])


def sum_merged(pairs: jax.Array, received: jax.Array, grid: Grid, prior: Prior) -> Sums:
    """Sum over cells of 2^b fine words, between an eighth and a quarter of a deviation wide, without the overloads.

    Within a merged cell the low bits say that y is about mu with a variance v, a Gaussian as the prior: with
    pi = l_1 / (l_0 + l_1) of each low bit, mu = first word + D sum 2^j pi and v = D^2 (sum 4^j pi (1 - pi) + 1/12).

    Args:
        pairs: likelihoods of a zero and a one of each bit, (bits, 2).
        received: number of the word that was received.
        grid: the words.
        prior: of y.
    """
    bits = np.arange(grid.bits)
    level = jnp.floor(jnp.log2(jnp.maximum(prior.deviation * FINE / grid.step, 1.0)))
    level = jnp.minimum(level, grid.bits - 1.0)
    size, low = jnp.round(jnp.exp2(level)), bits < level
    # The low bits, the same in every cell.
    total = jnp.sum(pairs, axis=1)
    ones = pairs[:, 1] / total
    mean = jnp.sum(jnp.where(low, 2.0**bits * ones, 0.0))
    variance = grid.step**2 * (jnp.sum(jnp.where(low, 4.0**bits * ones * (1 - ones), 0.0)) + 1 / 12)
    inner = jnp.prod(jnp.where(low, total, 1.0))
    # Each cell is a Gaussian times the prior's, wide s^2 together: mass e^(-away^2 / (2 wide)).
    wide = 1 + variance / prior.deviation**2
    width = size * grid.step / prior.deviation
    start = jnp.floor((prior.mean - REACH * prior.deviation - grid.low) / (grid.step * size * 2**BLOCK)) * 2**BLOCK
    start = jnp.maximum(start, 0.0)

    def away_of(cell: jax.Array) -> jax.Array:
        return (grid.low + (cell * size + mean) * grid.step - prior.mean) / prior.deviation

    # Cells within the reach, by blocks: with a of a block's first, e^(-(a + j w)^2 / 2) is e^(-a^2 / 2) (e^(-a w))^j
    # e^(-(j w)^2 / 2).
    upper = _shift_bits(pairs, level)
    outer, table = multiply_block_bits(upper, start, MERGED)
    away, places = away_of(start + np.arange(MERGED) * 2.0**BLOCK), np.arange(2.0**BLOCK)
    table = table * jnp.exp(-((places * width) ** 2) / (2 * wide))
    ratio, powers = jnp.exp(-away * width / wide), [jnp.ones(MERGED)]
    for _ in places[1:]:
        powers.append(powers[-1] * ratio)
    inside = jnp.stack(powers, axis=1) * table
    moments = [outer * jnp.exp(-(away**2) / (2 * wide)) * (inside @ places**power) for power in range(3)]
    sums = [jnp.sum(moments[0]), jnp.sum(away * moments[0] + width * moments[1])]
    sums.append(jnp.sum(away**2 * moments[0] + 2 * width * away * moments[1] + width**2 * moments[2]))
    # The cell of the received word, where it is none of them.
    home = jnp.floor(received / size)
    own = multiply_bits(upper, home) * ((home < start) | (home >= start + MERGED * 2.0**BLOCK))
    own = own * jnp.exp(-(away_of(home) ** 2) / (2 * wide))
    whole, first, second = (total + own * away_of(home) ** power for power, total in enumerate(sums))
    scale = inner * grid.step / (prior.deviation * ROOT * jnp.sqrt(wide))
    first, second = first / wide, second / wide**2
    return Sums(scale * whole, scale * first, scale * (second + whole * (1 - 1 / wide)))


def _shift_bits(pairs: jax.Array, count: jax.Array) -> jax.Array:
    """Return the likelihoods of the bits from number `count` on (bits, 2), above the last ones of a sure zero."""
    shifted, rest, step = pairs, count, 1
    while step < len(pairs):
        half = jnp.floor(rest / 2)
        sure = jnp.tile(jnp.array([1.0, 0.0]), (step, 1))
        shifted = jnp.where(rest > 2 * half, jnp.concatenate([shifted[step:], sure]), shifted)
        rest, step = half, 2 * step
    return shifted


def _sum_overloads(pair: jax.Array, grid: Grid, prior: Prior) -> Sums:
    """Sum over y beyond both ends of the range, where all bits are zeros or ones."""
    ends = jnp.array([0.0, 2.0**grid.bits - 1])
    outwards = jnp.array([-1.0, 1.0])
    t = (grid.low + (ends + outwards / 2) * grid.step - prior.mean) / prior.deviation
    a, likelihood = t * outwards, jnp.prod(pair, axis=0)
    mass, density = (likelihood * part for part in signed_tail_and_density(a))
    return Sums(jnp.sum(mass), jnp.sum(outwards * density), jnp.sum(mass + a * density))


class Change(NamedTuple):
    """What a word does to y: log M, E y - m in deviations, and Var y over s^2."""

    log_mass: jax.Array
    shift: jax.Array
    ratio: jax.Array


def change_by_sums(sums: Sums) -> Change:
    """Return the moments from the sums; log M is -inf where it is less than the smallest number."""
    possible = sums.mass > np.finfo(float).tiny
    mass = jnp.where(possible, sums.mass, 1.0)
    shift = sums.first / mass
    return Change(jnp.where(possible, jnp.log(mass), -jnp.inf), shift, sums.second / mass - shift**2)


def widen(prior: Prior, grid: Grid, dither: str) -> tuple[Prior, jax.Array]:
    """Return the law of y + d, taken for Gaussian as D is small, and its variance in that of y."""
    wide = 1 + ADDED[dither] * (grid.step / prior.deviation) ** 2
    return Prior(prior.mean, prior.deviation * jnp.sqrt(wide)), wide


def narrow(change: Change, wide: jax.Array) -> Change:
    """Return what is known of y from what is known of y + d."""
    return Change(change.log_mass, change.shift / jnp.sqrt(wide), 1 - (1 - change.ratio) / wide)


def change_by_cell(index: jax.Array, grid: Grid, prior: Prior, dither: str) -> Change:
    """Condition y on the word of number `index`, no bit of which can have flipped; `bits` 0: words without end."""
    wider, wide = widen(prior, grid, dither)
    cut = narrow(_cut_to_cell(index, grid, wider), wide)
    if not ADDED[dither]:
        return cut
    # A dither of steps that are not small: the edges are smooth, but far away only cells have digits.
    away = jnp.abs((grid.low + index * grid.step - prior.mean) / prior.deviation)
    width = grid.step / prior.deviation
    smooth = change_by_sums(sum_cell(jnp.ones(()), index, grid, prior, dither))
    use = (width >= FINE) & (away - width < FAR)
    return Change(*(jnp.where(use, a, b) for a, b in zip(smooth, cut, strict=True)))


def _cut_to_cell(index: jax.Array, grid: Grid, prior: Prior) -> Change:
    """Condition y on its cell, by the ends; by the centre where the difference of ends would lose digits."""
    centre = (grid.low + index * grid.step - prior.mean) / prior.deviation
    half = grid.step / prior.deviation / 2
    lower, upper = centre - half, centre + half
    if grid.bits:
        lower = jnp.where(index <= 0, -jnp.inf, lower)
        upper = jnp.where(index >= 2.0**grid.bits - 1, jnp.inf, upper)
    narrow_cell = (half * (1 + jnp.abs(centre)) < NARROW) & jnp.isfinite(lower) & jnp.isfinite(upper)
    cut = truncated_normal(jnp.where(narrow_cell, -1.0, lower), jnp.where(narrow_cell, 1.0, upper))
    log_mass = -(centre**2) / 2 - np.log(ROOT) + jnp.log(2 * half)
    short = Change(log_mass, centre * (1 - half**2 / 3), half**2 / 3)
    return Change(*(jnp.where(narrow_cell, a, b) for a, b in zip(short, cut, strict=True)))


def change_by_bits(
    pairs: list[jax.Array], weights: jax.Array, received: jax.Array, grid: Grid, prior: Prior, dither: str
) -> Change:
    """Condition y on what was received of its bits.

    Args:
        pairs: likelihoods of a zero and a one of each bit (bits, 2), for each combination of error rates.
        weights: probabilities of the combinations.
        received: number of the word that came.
        grid: the words.
        prior: of y.
        dither: of the encoder.
    """

    if grid.bits <= TABLE:
        table = weights @ jnp.stack([_tabulate(pair) for pair in pairs])
        return change_by_sums(sum_all_cells(table, grid, prior, dither))

    def wide_words() -> Change:
        return change_by_sums(sum_window(pairs, weights, received, grid, prior, dither))

    def fine_words() -> Change:
        wider, wide = widen(prior, grid, dither)
        merged = Sums(*jnp.zeros(3))
        for a, pair in enumerate(pairs):
            sums = sum_merged(pair, received, grid, wider).plus(_sum_overloads(pair, grid, wider))
            merged = merged.plus(Sums(*(weights[a] * one for one in sums)))
        return narrow(change_by_sums(merged), wide)

    change: Change = jax.lax.cond(grid.step >= FINE * prior.deviation, wide_words, fine_words)
    return change


def _tabulate(pair: jax.Array) -> jax.Array:
    """Return the likelihoods of all words, the product of those of their bits (2^bits,)."""
    table = jnp.ones(1)
    for bit in range(len(pair)):
        table = jnp.concatenate([table * pair[bit, 0], table * pair[bit, 1]])
    return table
