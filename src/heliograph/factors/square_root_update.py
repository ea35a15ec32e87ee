"""Kalman's update of covariances that are known before any data, on their roots, by LAPACK's QR."""

from typing import NamedTuple

import numpy as np

from heliograph.factors.covariance_factors import RANK
from heliograph.numerics.types import Bool, Float


class ObservedRoot(NamedTuple):
    """Gain K (..., n, m), and a root (..., n, columns) of the covariance after a measurement: W+ W+' = P - K S K'."""

    gain: Float[np.ndarray, "*items n m"]
    root: Float[np.ndarray, "*items n c"]

    @property
    def covariance(self) -> Float[np.ndarray, "*items n n"]:
        """Covariance W+ W+' after the observation."""
        return covariance_of_root(self.root)


def covariance_of_root(root: Float[np.ndarray, "*items n c"]) -> Float[np.ndarray, "*items n n"]:
    """Return the covariance W W' (n, n) of a root W (n, columns), symmetric to the last digit."""
    product = root @ root.swapaxes(-1, -2)
    return np.asarray(product + product.swapaxes(-1, -2)) / 2


def roots_of(covariance: Float[np.ndarray, "*items n n"]) -> Float[np.ndarray, "*items n n"]:
    """Return square roots W with W W' = P of many covariances P, by the eigenvectors of their correlation matrices.

    Correlations do not depend on units. An eigenvalue that rounding made negative counts as zero. A component of
    variance zero has a row of zeros in W.
    """
    deviation = np.sqrt(np.maximum(np.diagonal(covariance, axis1=-2, axis2=-1), 0.0))
    unit = np.where(deviation > 0, deviation, 1.0)
    scale = unit[..., :, None] * unit[..., None, :]
    # Entries of P between two components that have a variance; all others are 0.
    varies = deviation[..., :, None] * deviation[..., None, :] > 0
    values, vectors = np.linalg.eigh(np.where(varies, covariance, 0.0) / scale)
    root_values = np.sqrt(np.maximum(values, 0.0))
    return np.asarray(unit[..., :, None] * vectors * root_values[..., None, :])


def observe_root(
    root: Float[np.ndarray, "*items n c"],
    output: Float[np.ndarray, "*items m n"],
    noise: Float[np.ndarray, "*items m d"],
) -> ObservedRoot:
    """Condition x of covariance W W' on z = C x + v, Cov v = N N'; return the gain K (n, m) and a root of Cov(x | z).

    [[N, C W], [0, W]] = [[V, 0], [K V, W+]] U with an orthogonal U and V V' = C W W' C' + N N': sums of squares alone,
    so each row is known to eps of its length. A component of z is dependent if at most the share RANK of its variance
    remains given the components before it: that rest may be rounding, so it gets the gain zero.

    Args:
        root: W (n, c) for each item of a batch.
        output: C (m, n).
        noise: N (m, d).

    Source: Morf and Kailath, Square-root algorithms for least-squares estimation (1975).
    """
    (m, n), output_root = output.shape[-2:], output @ root
    columns = noise.shape[-1] + root.shape[-1]
    # At least as many columns as rows, so that the triangle is whole.
    rows = np.zeros((*output_root.shape[:-2], m + n, max(columns, m + n)))
    rows[..., :m, : noise.shape[-1]] = noise
    rows[..., :m, noise.shape[-1] : columns] = output_root
    rows[..., m:, noise.shape[-1] : columns] = root
    # Dependent components are moved after the others: else their rounding would take a part of these.
    independent = _find_independent_rows(rows[..., :m, :columns])
    order = None if independent.all() else np.argsort(~independent, axis=-1, kind="stable")
    if order is not None:
        independent = np.take_along_axis(independent, order, axis=-1)
        rows[..., :m, :] = np.take_along_axis(rows[..., :m, :], order[..., None], axis=-2)
    # The triangle [[V, 0], [K V, W+]]: transposed, it is R of the rows' QR.
    upper = np.asarray(np.linalg.qr(rows.swapaxes(-1, -2), mode="r"))
    lower = upper.swapaxes(-1, -2)
    v, k_v = lower[..., :m, :m], lower[..., m:, :m]
    gain = _solve_for_gain(v, k_v, independent)
    # The columns of K V for dependent components were used by no gain: they stay in the root beside W+.
    unused = np.where(independent[..., None, :], 0.0, k_v)
    if order is not None:  # the gain's columns in the order of z again, by the inverse of the permutation
        gain = np.take_along_axis(gain, np.argsort(order, axis=-1)[..., None, :], axis=-1)
    return ObservedRoot(np.ascontiguousarray(gain), np.concatenate([lower[..., m:, m:], unused], axis=-1))


def _solve_for_gain(v: np.ndarray, k_v: np.ndarray, independent: np.ndarray) -> np.ndarray:
    """Return K (..., n, m) from the lower triangular V (..., m, m) and K V, with zeros for dependent components.

    A dependent component repeats others, so that its pivot V_jj is only rounding. `independent` (..., m) is False for
    it. Columns are found from the last to the first: K_j = ((K V)_j - sum_{i > j} K_i V_ij) / V_jj.
    """
    pivots = np.diagonal(v, axis1=-2, axis2=-1)
    inverse = np.where(independent, 1 / np.where(independent, pivots, 1.0), 0.0)
    gain = np.zeros_like(k_v)
    for j in reversed(range(v.shape[-1])):
        remainder = k_v[..., j] - (gain[..., j + 1 :] @ v[..., j + 1 :, j, None])[..., 0]
        gain[..., j] = remainder * inverse[..., j, None]
    return gain


def observe_information(
    root: Float[np.ndarray, "*items n c"], information: Float[np.ndarray, "*items n n"]
) -> ObservedRoot:
    """Condition x of covariance W W' on measurements of information J = C' Cov(v)^-1 C: P+ = (P^-1 + J)^-1.

    P = W W' may be singular, so it is not inverted. With J = U U', the measurement z = U' x + v with Cov v = I has the
    same information. Returns the gain of this z, and a root of P+.
    """
    rows = roots_of(information).swapaxes(-1, -2)
    return observe_root(root, rows, np.eye(rows.shape[-1]))


def _find_independent_rows(rows: Float[np.ndarray, "*items m c"]) -> Bool[np.ndarray, "*items m"]:
    """Find which rows are independent of the independent rows before them, by Gram-Schmidt.

    Each row (..., m, c) loses its parts along the independent rows before it. It is independent if more than the share
    RANK of its squared length is left.
    """
    remainder, is_independent = rows, np.zeros(rows.shape[:-1], bool)
    for j in range(rows.shape[-2]):
        square = np.sum(remainder[..., j, :] ** 2, axis=-1)
        is_independent[..., j] = square > RANK * np.sum(rows[..., j, :] ** 2, axis=-1)
        length = np.where(is_independent[..., j], np.sqrt(square), np.inf)
        unit = remainder[..., j, :] / length[..., None]
        remainder = remainder - (remainder @ unit[..., None]) @ unit[..., None, :]
    return is_independent
