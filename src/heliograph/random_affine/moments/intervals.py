"""Lowest and highest value of every moment of a channel over its possible laws."""

import jax
import numpy as np

from heliograph.numerics.caching import cache_by_object
from heliograph.numerics.check import fail
from heliograph.numerics.traced import library, scatter, stack_parts
from heliograph.numerics.types import Float
from heliograph.random_affine.base import AbstractRandomAffine, check_forgets
from heliograph.random_affine.combine import Series, Stack, stack_rows
from heliograph.random_affine.hop import GainAndNoise
from heliograph.random_affine.law import Discrete
from heliograph.random_affine.moments.monomials import count_monomials, product_table
from heliograph.random_affine.superposed import Superposed

CORNERS = 2048  # corner laws evaluated one by one; above, intervals are combined (sound, but looser)

Entries = Float[jax.Array | np.ndarray, "..."]
Interval = tuple[Entries, Entries]


def moment_interval(channel: AbstractRandomAffine, order: int) -> Interval:
    """Lowest and highest value of each entry of E[Sym^order(H)].

    Up to CORNERS corner laws the ends are attained, since every entry is linear in each uncertain law; above, the
    intervals of the parts are multiplied: sound but not attained.
    """
    check_forgets("channel of a bound", channel)
    corners = count_corners(channel)
    # Every entry is multilinear in the uncertain probabilities, so corner laws attain its ends.
    if corners is not None and corners <= CORNERS:
        matrices = channel.corner_moments(order)
        return matrices.min(axis=0), matrices.max(axis=0)
    # Too many corners: interval products of the parts.
    match channel:
        case Series():
            low, high = moment_interval(channel.maps[0], order)
            for affine in channel.maps[1:]:
                low, high = _multiply_matrices(moment_interval(affine, order), (low, high))
            return low, high
        case Stack():
            return _stack_interval(channel, order)
        case Superposed():
            return moment_interval(channel.as_stack, order)
        case GainAndNoise(law=Discrete() as law):
            return _atom_interval(channel, law, order)
    raise fail("uncertain channel", f"at most {CORNERS} corner laws", corners)


@cache_by_object
def count_corners(channel: AbstractRandomAffine) -> int | None:
    """Return the number of corner laws of a channel; None where they are too many to be counted."""
    try:
        return channel.corner_count()
    except ValueError:  # one law with more uncertain atoms than corners are listed for
        return None


def _multiply_matrices(second: Interval, first: Interval) -> Interval:
    """Interval matrix product by centres and radii: C2 C1 and |C2| R1 + R2 (|C1| + R1)."""
    c2, r2 = (second[1] + second[0]) / 2, (second[1] - second[0]) / 2
    c1, r1 = (first[1] + first[0]) / 2, (first[1] - first[0]) / 2
    size = library(c1, c2).abs
    center, radius = c2 @ c1, size(c2) @ r1 + r2 @ (size(c1) + r1)
    return center - radius, center + radius


def _atom_interval(channel: GainAndNoise, law: Discrete, order: int) -> Interval:
    """Moments are sum_k E[g^k] B_k with known B_k; each E[g^k] has its exact range from the closed-form LP."""
    basis = channel.gain_coefficients(order)
    ends = [(-law.worst(-(law.values**k)), law.worst(law.values**k)) if k else (1.0, 1.0) for k in range(order + 1)]
    xp = library(basis)
    products = [
        (xp.minimum(b * lo, b * hi), xp.maximum(b * lo, b * hi)) for b, (lo, hi) in zip(basis, ends, strict=True)
    ]
    return sum(low for low, _ in products), sum(high for _, high in products)


def _stack_interval(channel: Stack, order: int) -> Interval:
    """Products of the parts' interval polynomials, row by row."""
    tables = [[stack_parts(moment_interval(m, k)) if k else None for k in range(order + 1)] for m in channel.maps]
    rows = stack_parts(stack_rows(channel, order, tables, _multiply_rows))
    return rows[:, 0], rows[:, 1]


def _multiply_rows(a: Entries, first: int, b: Entries, second: int, variables: int) -> Entries:
    """Interval product of two polynomials: ends of the products of ends, summed over equal monomials.

    Shapes: a (ends, n), b (ends, m), with one pair of ends, or (n,) where they are one.
    """
    table = product_table(variables, first, second)
    size = (count_monomials(variables, first + second),)
    products = a.reshape(-1, 1, a.shape[-1], 1) * b.reshape(1, -1, 1, b.shape[-1])
    return stack_parts(
        [scatter(size, table, products.min(axis=(0, 1))), scatter(size, table, products.max(axis=(0, 1)))]
    )
