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
WINDOW = 72  # edges of words that are at least so wide, within the reach, and a few more
FAR = 30.0  # deviations from which on differences of tails have no digits
NARROW = 1e-3  # of a deviation: the density is linear over a cell of this half width
LEAST = 1e-3  # width, in deviations, of the dither by which edges are smoothed: less changes nothing
MERGED = 134  # cells between an eighth and a quarter of a deviation within the reach


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


def tail(a: jax.Array) -> jax.Array:
    """Q(a) = P(t > a)."""
    return jax.scipy.special.erfc(a / np.sqrt(2)) / 2


def normal_density(a: jax.Array) -> jax.Array:
    """phi(a)."""
    density: jax.Array = jnp.exp(-(a**2) / 2) / ROOT
    return density


def step_as_it_is(a: jax.Array, width: jax.Array) -> Steps:
    """No dither: Q, phi and a phi."""
    density = normal_density(a)
    return Steps(tail(a), density, a * density)


def step_by_uniform(a: jax.Array, width: jax.Array) -> Steps:
    """A uniform dither of width D: differences over D of I(a) = E(t - a)+ = phi - a Q, of Q and of phi."""
    low, high = a - width / 2, a + width / 2
    (q, p), (q_above, p_above) = ((tail(x), normal_density(x)) for x in (low, high))
    return Steps((p - low * q - p_above + high * q_above) / width, (q - q_above) / width, (p - p_above) / width)


def step_by_triangle(a: jax.Array, width: jax.Array) -> Steps:
    """A triangular dither: second differences of E((t - a)+)^2 / 2 = ((1 + a^2) Q - a phi)/2, of I and of Q."""
    q, p = zip(*((tail(x), normal_density(x)) for x in (a - width, a, a + width)), strict=True)
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


def sum_window(
    likelihood_of: Callable[[jax.Array], jax.Array], received: jax.Array, grid: Grid, prior: Prior, dither: str
) -> Sums:
    """Sum over the words within the reach of the prior, and the one that was received."""
    last = 2.0**grid.bits - 1
    start = jnp.floor((prior.mean - REACH * prior.deviation - grid.low) / grid.step)
    start = jnp.clip(start, 0.0, jnp.maximum(last - WINDOW, 0.0))
    words = start + np.arange(WINDOW + 1)
    likelihood = likelihood_of(words)
    sums = sum_all_cells(likelihood, Grid(grid.low + start * grid.step, grid.step, grid.bits), prior, dither)
    outside = (received < start) | (received > start + WINDOW)
    return sums.plus(sum_cell(likelihood_of(received[None])[0] * outside, received, grid, prior, dither))


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
    # Cells within the reach, and the one of the received word.
    cells = 2.0**grid.bits / size
    start = jnp.floor((prior.mean - REACH * prior.deviation - grid.low) / (grid.step * size))
    start = jnp.clip(start, 0.0, jnp.maximum(cells - MERGED, 0.0))
    number = start + np.arange(MERGED + 1)
    home = jnp.floor(received / size)
    number = number.at[MERGED].set(home)
    counts = (number < cells).at[MERGED].set((home < start) | (home >= start + MERGED))
    bit = jnp.mod(jnp.floor(number[:, None] * size / 2.0**bits), 2.0)
    outer = jnp.prod(jnp.where(low, 1.0, jnp.where(bit > 0, pairs[:, 1], pairs[:, 0])), axis=1)
    # A Gaussian times the prior's.
    square = prior.deviation**2
    away = (grid.low + (number * size + mean) * grid.step - prior.mean) / prior.deviation
    wide = 1 + variance / square
    mass = outer * jnp.exp(-(away**2) / (2 * wide)) * counts
    scale = inner * grid.step / (prior.deviation * ROOT * jnp.sqrt(wide))
    first, second = jnp.sum(mass * away) / wide, jnp.sum(mass * away**2) / wide**2
    whole = jnp.sum(mass)
    return Sums(scale * whole, scale * first, scale * (second + whole * (variance / square) / wide))


def _sum_overloads(grid: Grid, prior: Prior, likelihood_of: Callable[[jax.Array], jax.Array]) -> Sums:
    """Sum over y beyond both ends of the range."""
    ends = jnp.array([0.0, 2.0**grid.bits - 1])
    outwards = jnp.array([-1.0, 1.0])
    t = (grid.low + (ends + outwards / 2) * grid.step - prior.mean) / prior.deviation
    a, likelihood = t * outwards, likelihood_of(ends)
    mass, density = likelihood * tail(a), likelihood * normal_density(a)
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

    def likelihood_of(numbers: jax.Array) -> jax.Array:
        bit = jnp.mod(jnp.floor(numbers[:, None] / 2.0 ** np.arange(grid.bits)), 2.0)
        each = [jnp.prod(jnp.where(bit > 0, pair[:, 1], pair[:, 0]), axis=1) for pair in pairs]
        return weights @ jnp.stack(each)

    if grid.bits <= TABLE:
        table = weights @ jnp.stack([_tabulate(pair) for pair in pairs])
        return change_by_sums(sum_all_cells(table, grid, prior, dither))

    def wide_words() -> Change:
        return change_by_sums(sum_window(likelihood_of, received, grid, prior, dither))

    def fine_words() -> Change:
        wider, wide = widen(prior, grid, dither)
        merged = _sum_overloads(grid, wider, likelihood_of)
        for a, pair in enumerate(pairs):
            sums = sum_merged(pair, received, grid, wider)
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
