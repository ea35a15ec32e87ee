"""Intervals of every moment when probabilities are uncertain: exact from corner laws, interval arithmetic beyond."""

import jax
import numpy as np
from jaxtyping import Float

from heliograph.numerics.check import fail
from heliograph.numerics.traced import library, placed, stacked
from heliograph.random_affine.atoms import GainAndNoise
from heliograph.random_affine.base import AbstractRandomAffine, check_forgets
from heliograph.random_affine.combine import Series, Stack
from heliograph.random_affine.law import Discrete
from heliograph.random_affine.moments.lift import Lift
from heliograph.random_affine.moments.monomials import count, exponents, position, product_table

CORNERS = 2048  # corner laws evaluated one by one; above, intervals are combined (sound, but looser)

Entries = Float[jax.Array | np.ndarray, "..."]
Interval = tuple[Entries, Entries]


def moment_interval(channel: AbstractRandomAffine, order: int) -> Interval:
    """Lowest and highest value of each entry of E[Sym^order(H)].

    Up to CORNERS corner laws the ends are attained, since every entry is linear in each uncertain law; above, the
    intervals of the parts are multiplied: sound but not attained.

    Raises:
        ValueError: more corners than can be listed, in a map that is not a series or a stack.
    """
    check_forgets("channel of a bound", channel)
    corners = _corner_count(channel)
    # Every entry is multilinear in the uncertain probabilities, so corner laws attain its ends.
    if corners is not None and corners <= CORNERS:
        matrices = channel.corner_moments(order)
        return matrices.min(axis=0), matrices.max(axis=0)
    # Too many corners: interval products of the parts.
    match channel:
        case Series():
            low, high = moment_interval(channel.maps[0], order)
            for part in channel.maps[1:]:
                low, high = _multiply_matrices(moment_interval(part, order), (low, high))
            return low, high
        case Stack():
            return _stack_interval(channel, order)
        case GainAndNoise(law=Discrete() as law):
            return _atom_interval(channel, law, order)
        case Lift():
            raise fail("uncertain lifted channel", f"at most {CORNERS} corner laws", corners)
    raise fail("uncertain channel", f"at most {CORNERS} corner laws", corners)


def _corner_count(channel: AbstractRandomAffine) -> int | None:
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
    variables = channel.inputs + 1
    tables = [[moment_interval(m, k) if k else None for k in range(order + 1)] for m in channel.maps]
    rows = []
    for powers in exponents(channel.outputs + 1, order):
        # Row z^a = prod_parts z_part^(a_part) times a power of the constant 1.
        product: Interval = (np.ones(1), np.ones(1))
        degree, start = 0, 0
        for m, table in zip(channel.maps, tables, strict=True):
            a = powers[start : start + m.outputs]
            start, k = start + m.outputs, sum(a)
            part = table[k]
            if part is not None:
                row = position(m.outputs + 1, k)[(*a, 0)]
                product, degree = (
                    _multiply_rows(product, degree, (part[0][row], part[1][row]), k, variables),
                    degree + k,
                )
        # The constant's power is a column of its own.
        constant = np.zeros(count(variables, powers[-1]))
        constant[-1] = 1.0
        rows.append(_multiply_rows(product, degree, (constant, constant), powers[-1], variables))
    return stacked([r[0] for r in rows]), stacked([r[1] for r in rows])


def _multiply_rows(a: Interval, first: int, b: Interval, second: int, variables: int) -> Interval:
    """Interval product of two polynomials: ends of the four products, summed over equal monomials."""
    table = product_table(variables, first, second)
    size = (count(variables, first + second),)
    products = [x[:, None] * y for x in a for y in b]
    ends = stacked(products)
    return placed(size, table, ends.min(axis=0)), placed(size, table, ends.max(axis=0))
