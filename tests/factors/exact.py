"""Kalman filter and smoother in fractions: what factors are compared with."""

from fractions import Fraction


def exactly(matrix):
    """A matrix of floats as fractions, which they are."""
    return [[Fraction(float(x)) for x in row] for row in matrix]


def product(a, b):
    return [[sum(x * y for x, y in zip(row, column, strict=True)) for column in zip(*b, strict=True)] for row in a]


def transposed(a):
    return [list(row) for row in zip(*a, strict=True)]


def total(a, b, sign=1):
    return [[x + sign * y for x, y in zip(p, q, strict=True)] for p, q in zip(a, b, strict=True)]


def inverse(a):
    """By Gauss and Jordan, without pivots other than those that are not zero."""
    n = len(a)
    rows = [list(row) + [Fraction(int(i == j)) for j in range(n)] for i, row in enumerate(a)]
    for j in range(n):
        k = next(i for i in range(j, n) if rows[i][j] != 0)
        rows[j], rows[k] = rows[k], rows[j]
        rows[j] = [x / rows[j][j] for x in rows[j]]
        for i in range(n):
            if i != j:
                rows[i] = [x - rows[i][j] * y for x, y in zip(rows[i], rows[j], strict=True)]
    return [row[n:] for row in rows]


def congruence(a, p):
    return product(product(a, p), transposed(a))


def after(p, h, r):
    """P - P H' (H P H' + R)^-1 H P, and the gain."""
    cross = product(p, transposed(h))
    gain = product(cross, inverse(total(congruence(h, p), r)))
    return total(p, product(gain, transposed(cross)), -1), gain
