"""Joint second moments of a map's gain and of the gains of its noises, as H-infinity designs take them."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from heliograph.numerics.check import SYMMETRY_TOLERANCE, fail, standard_deviations
from heliograph.numerics.types import Float

ROUNDING = 1e-13  # relative to the largest eigenvalue, in units of each component: smaller ones are rounding


class DisturbedGain(NamedTuple):
    """First and second moments of H = [G, N]: G takes the signal (inputs columns), N the disturbances (the others).

    Shapes: mean (m, c), second[a, b, i, j] = E[H_ab H_ij] of shape (m, c, m, c); inputs is the number of columns of G.
    """

    mean: np.ndarray
    second: np.ndarray
    inputs: int

    @property
    def disturbances(self) -> int:
        """Number of columns of N, each of which takes one disturbance."""
        return int(self.mean.shape[1]) - self.inputs

    @property
    def covariance(self) -> np.ndarray:
        """Cov(H_ab, H_ij), shape (m, c, m, c)."""
        covariance: np.ndarray = self.second - np.multiply.outer(self.mean, self.mean)
        return covariance

    def spreads(self) -> np.ndarray:
        """Return matrices X_j (rank, m, c) with E[(H - EH)' A (H - EH)] = sum_j X_j' A X_j for every A.

        They are the eigenvectors of the covariance of H's entries, in units of each entry, times the roots of their
        eigenvalues. Their number is the rank of the covariance, and zero if nothing is random.
        """
        m, c = self.mean.shape
        root_moments = np.sqrt(np.diagonal(self.second.reshape(m * c, m * c)))
        unit = np.where(root_moments > 0, root_moments, 1.0)  # rounding is relative to the size of each entry
        values, vectors = np.linalg.eigh(self.covariance.reshape(m * c, m * c) / np.outer(unit, unit))
        is_positive = values > ROUNDING * max(1.0, float(np.max(values, initial=0.0)))
        factors: np.ndarray = (unit[:, None] * np.sqrt(values[is_positive]) * vectors[:, is_positive]).T.reshape(
            -1, m, c
        )
        return factors

    def then(self, other: "DisturbedGain") -> "DisturbedGain":
        """Return the moments of H = [G2 G1, G2 N1, N2], this map [G1, N1] followed by the `other` map [G2, N2].

        G acts on the signal, and N on the disturbances d. In series z = G2 (G1 y + N1 d1) + N2 d2 = H (y, d1, d2). So
        H = H2 K with H2 = [G2, N2] and K = diag([G1, N1], I), which passes d2 on unchanged.
        """
        identity = np.eye(other.disturbances)
        second_disturbance = DisturbedGain(identity, np.multiply.outer(identity, identity), inputs=0)
        first_and_identity = stack_on_shared_inputs([self, second_disturbance], shared=0)  # K
        # H2 and K are independent: E[H_ab H_cd] = sum_ij E[H2_ai H2_cj] E[K_ib K_jd].
        second = np.einsum("aicj,ibjd->abcd", other.second, first_and_identity.second)
        return DisturbedGain(other.mean @ first_and_identity.mean, second, self.inputs)


def noise_gain(mean: Float[np.ndarray, " m"], covariance: Float[np.ndarray, "m m"]) -> np.ndarray:
    """Return a root N (m, rank) of a noise's covariance, N N' = covariance; no column has a negative sum.

    A worst-case disturbance d stands for the noise N d. Some d must give the noise's mean.

    Raises:
        ValueError: a mean of the noise that N cannot make.
    """
    unit = standard_deviations(covariance)
    values, vectors = np.linalg.eigh(covariance / np.outer(unit, unit))  # correlations do not depend on units
    is_positive = values > ROUNDING * np.max(values, initial=0.0)
    root: np.ndarray = unit[:, None] * np.sqrt(values[is_positive]) * vectors[:, is_positive]
    root = root * np.where(root.sum(axis=0) < 0, -1.0, 1.0)
    scaled = mean / unit
    basis = vectors[:, is_positive]
    residual = scaled - basis @ (basis.T @ scaled)
    if np.any(np.abs(residual) > SYMMETRY_TOLERANCE * np.abs(scaled).max()):
        raise fail("noise of an H-infinity design", "a mean that its covariance can make", mean.tolist())
    return root


def disturb_hop(gain: np.ndarray, moments: tuple[float, float], root: np.ndarray) -> DisturbedGain:
    """Return E[H] and E[H_ab H_ij] of a hop's H = [g A, N], with `gain` A, `root` N and `moments` (E[g], E[g^2]).

    With S = [A, 0] and F = [0, N], H = g S + F. So E[H_ab H_ij] is
    E[g^2] S_ab S_ij + E[g] (S_ab F_ij + F_ab S_ij) + F_ab F_ij.
    """
    S = np.concatenate([gain, np.zeros_like(root)], axis=1)
    F = np.concatenate([np.zeros_like(gain), root], axis=1)
    mean_gain, mean_square_gain = moments
    outer = np.multiply.outer
    cross = mean_gain * (outer(S, F) + outer(F, S))
    second = mean_square_gain * outer(S, S) + cross + outer(F, F)
    return DisturbedGain(mean_gain * S + F, second, gain.shape[1])


def mix_gains(gains: Sequence[DisturbedGain], weights: Float[np.ndarray, " parts"], inputs: int) -> DisturbedGain:
    """Return the moments of a map drawn from `gains` with probabilities `weights`: sum_i w_i E_i[H_ab], and so on.

    E_i is the expectation for map i. The first `inputs` columns of H take the signal. Then come columns for the
    disturbances of each map in turn, which are zero in the other maps.
    """
    in_joint_columns = [_place_columns(gain, inputs, gains, i) for i, gain in enumerate(gains)]
    mean = np.tensordot(weights, [gain.mean for gain in in_joint_columns], axes=1)
    second = np.tensordot(weights, [gain.second for gain in in_joint_columns], axes=1)
    return DisturbedGain(mean, second, inputs)


def _place_columns(gain: DisturbedGain, shared: int, gains: Sequence[DisturbedGain], index: int) -> DisturbedGain:
    """Return the moments of one map H = [G, N] among several, as a map of the signal and of the disturbances of all.

    The first `shared` columns of every map take the signal. The joint map has them first, and then the disturbance
    columns of each map in turn. The map `gain` is gains[index], and is zero in the columns of the other maps.
    """
    private_widths = [other.mean.shape[1] - shared for other in gains]
    start = shared + sum(private_widths[:index])
    columns = [*range(shared), *range(start, start + private_widths[index])]
    m, total = gain.mean.shape[0], shared + sum(private_widths)
    mean = np.zeros((m, total))
    second = np.zeros((m, total, m, total))
    mean[:, columns] = gain.mean
    second[np.ix_(range(m), columns, range(m), columns)] = gain.second
    return DisturbedGain(mean, second, shared)


def stack_on_shared_inputs(gains: Sequence[DisturbedGain], shared: int) -> DisturbedGain:
    """Return the moments E[H] and E[H_ab H_ij] of independent maps one above the other, with common first inputs.

    The first `shared` columns of each map take the common inputs. Its other columns belong to its own noises. For rows
    of two different maps E[H_ab H_ij] is the product of the means.
    """
    placed = [_place_columns(gain, shared, gains, i) for i, gain in enumerate(gains)]
    mean = np.concatenate([gain.mean for gain in placed])
    second = np.multiply.outer(mean, mean)
    row = 0
    for gain in placed:
        rows = slice(row, row + gain.mean.shape[0])
        second[rows, :, rows, :] = gain.second
        row = rows.stop
    return DisturbedGain(mean, second, shared)
