"""Covariances as L D L': factors of sums of squares, of small matrices, and of an update by one measurement.

L is unit lower triangular and D diagonal, so a variance is a sum of positive terms in whatever precision: nothing is
ever subtracted from one. Written out by rows, for straight-line code.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.numerics.types import Array

ROUNDING = 1e-12  # of a component's unit: less of a pivot is none


class Columns(NamedTuple):
    """A covariance as W diag(w) W'.  Shapes: matrix W (n, columns), weights w (columns,)."""

    matrix: Array
    weights: Array


class Factors(NamedTuple):
    """A covariance as L diag(d) L'.

    Shapes: lower (n (n - 1) / 2,), the entries of L left of its diagonal, row by row; variances d (n,).
    """

    lower: Array
    variances: Array

    def matrix(self) -> jax.Array:
        """L (n, n)."""
        n = len(self.variances)
        return jnp.eye(n).at[np.tril_indices(n, -1)].set(self.lower)

    def covariance(self) -> jax.Array:
        """L diag(d) L' (n, n)."""
        matrix = self.matrix()
        return (matrix * self.variances) @ matrix.T


def joined(parts: list[Columns]) -> Columns:
    """Sum of covariances: their columns one after another."""
    matrix = jnp.concatenate([jnp.asarray(columns.matrix) for columns in parts], axis=1)
    return Columns(matrix, jnp.concatenate([jnp.asarray(columns.weights) for columns in parts]))


def sum_of(columns: Columns) -> jax.Array:
    """Covariance of these columns, W diag(w) W'."""
    return jnp.asarray((columns.matrix * columns.weights) @ columns.matrix.T)


def gram_schmidt(columns: Columns) -> tuple[jax.Array, jax.Array]:
    """L (n, n) and d (n,) with L diag(d) L' = W diag(w) W', by orthogonalising the rows of W from the first one down.

    A row that depends linearly on those above has d = 0 and contributes nothing to those below.

    Source: Thornton, Triangular covariance factorizations for Kalman filtering (1976), modified weighted Gram-Schmidt.
    """
    n = columns.matrix.shape[0]
    rest = [columns.matrix[i] for i in range(n)]
    lower, variances = jnp.eye(n), []
    # d_j = |row j|^2 in the weights w, then row j is projected out of the rows below.
    for j in range(n):
        weighted = rest[j] * columns.weights
        variances.append(jnp.sum(weighted * rest[j]))
        inverse = reciprocal(variances[j])
        for i in range(j + 1, n):
            share = jnp.sum(rest[i] * weighted) * inverse
            rest[i] = rest[i] - share * rest[j]
            lower = lower.at[i, j].set(share)
    return lower, jnp.stack(variances)


def factors_of(columns: Columns) -> Factors:
    """Factors of a sum of squares."""
    lower, variances = gram_schmidt(columns)
    return Factors(lower[np.tril_indices(len(variances), -1)], variances)


def decorrelated(lower: jax.Array, rows: jax.Array) -> jax.Array:
    """L^-1 times rows (m, ...): with z = rows x + n and Cov n = L diag(d) L', rows whose noises are uncorrelated."""
    solved: list[jax.Array] = []
    for i in range(len(rows)):
        solved.append(rows[i] - sum((lower[i, j] * above for j, above in enumerate(solved)), jnp.zeros(())))
    return jnp.stack(solved)


def measured(
    rows: jax.Array, variances: jax.Array, f: jax.Array, noise: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Update by one scalar z = f' xi + n: rows V+, variances d+ and the gain V diag(d) f / s.

    V diag(d) V' is the prior covariance of the rows, V+ diag(d+) V+' the posterior one, xi has variances d, n the
    variance r, and s = f' diag(d) f + r. V (rows, n) may hold more than the state's rows: those of measurements still
    to come change alike. Each d is multiplied by a ratio of sums of positive terms, and nothing is subtracted from it.

    Source: Bierman, Factorization methods for discrete sequential estimation (1977), Section V.3, the order of the
    components reversed, since L is lower.
    """
    # Bierman's recursion, from the last component up: s grows by f_j^2 d_j.
    n = len(variances)
    total, inverse, gain = noise, reciprocal(noise), jnp.zeros(len(rows))
    columns, after = [rows[:, 0]] * n, [noise] * n
    for j in reversed(range(n)):
        product = variances[j] * f[j]
        before, total = total, total + f[j] * product
        columns[j] = rows[:, j] - (f[j] * inverse) * gain
        inverse = reciprocal(total)
        # d_j+ = d_j s_{j+1} / s_j.
        after[j] = jnp.where(total > 0, variances[j] * (before * inverse), variances[j])
        gain = gain + rows[:, j] * product
    return jnp.stack(columns, axis=1), jnp.stack(after), gain * inverse


def reciprocal(value: jax.Array) -> jax.Array:
    """1 / value of a positive number, 0 of 0."""
    positive = value > 0
    return jnp.where(positive, 1 / jnp.where(positive, value, 1.0), 0.0)


def columns_of(covariance: Array) -> Columns:
    """Columns of a covariance: as many as its rank where it is a NumPy array; else L and d by elimination."""
    if isinstance(covariance, np.ndarray):
        root = columns_of_known(covariance)
        return Columns(root, np.ones(root.shape[1]))
    n = len(covariance)
    rest, lower, variances = covariance, jnp.eye(n), []
    for j in range(n):
        variances.append(jnp.maximum(rest[0, 0], 0.0))
        column = rest[1:, 0] * reciprocal(rest[0, 0])
        lower = lower.at[j + 1 :, j].set(column)
        rest = rest[1:, 1:] - column[:, None] * rest[0, 1:]
    return Columns(lower, jnp.stack(variances))


def columns_of_known(covariance: np.ndarray) -> np.ndarray:
    """W (n, rank) with W W' = P, by Cholesky's method with pivots, each component scaled to unit variance."""
    # Correlations: the rank is decided in units of each component's deviation.
    unit = np.sqrt(np.maximum(np.diagonal(covariance), 0.0))
    scale = np.where(unit > 0, unit, 1.0)
    rest, columns = covariance / np.outer(scale, scale), []
    # Pivot: the largest remaining variance.
    for _ in range(len(covariance)):
        j = int(np.argmax(np.diagonal(rest)))
        if rest[j, j] <= ROUNDING:
            break
        column = rest[:, j] / np.sqrt(rest[j, j])
        columns.append(scale * column)
        rest = rest - np.outer(column, column)
    if np.max(np.abs(rest), initial=0.0) > 1e3 * ROUNDING:
        raise ValueError("no covariance")
    root = np.array(columns).T.reshape(len(covariance), -1)
    return np.where(np.abs(root) > ROUNDING * scale[:, None], root, 0.0)
