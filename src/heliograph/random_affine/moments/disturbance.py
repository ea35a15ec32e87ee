"""A channel's noise as an input of its own: joint second moments of gain and noise gain, for designs against energy.

z = G y + N rho, where each column of N is one noise source of unit size. A hop's noise passes through the hops behind
it, so N is as random as G, and through a shared hop the two are dependent. Where rho is a disturbance of bounded energy
rather than a random variable, E[G N] matters, which the moments of (G, n) do not show.
"""

from functools import reduce, singledispatch
from typing import NamedTuple

import numpy as np

from heliograph.numerics.check import fail
from heliograph.random_affine.atoms import GainAndNoise
from heliograph.random_affine.base import AbstractRandomAffine, check_forgets
from heliograph.random_affine.combine import Mixture, Series, Stack

ROUNDING = 1e-13  # relative to the largest eigenvalue of a covariance: smaller ones are zero up to rounding


class DisturbedGain(NamedTuple):
    """First and second moments of H = [G, N]: G takes the signal (inputs columns), N the disturbances (the others).

    Shapes: mean (m, c), second[a, b, i, j] = E[H_ab H_ij] of shape (m, c, m, c); inputs is the number of columns of G.
    """

    mean: np.ndarray
    second: np.ndarray
    inputs: int

    @property
    def disturbances(self) -> int:
        """Number of noise sources."""
        return int(self.mean.shape[1]) - self.inputs

    @property
    def covariance(self) -> np.ndarray:
        """Cov(H_ab, H_ij), shape (m, c, m, c)."""
        covariance: np.ndarray = self.second - np.multiply.outer(self.mean, self.mean)
        return covariance

    def spreads(self) -> np.ndarray:
        """Matrices X_j with E[(H - EH)' A (H - EH)] = sum_j X_j' A X_j for every A.

        They are the eigenvectors of the covariance of H's entries, times the roots of their eigenvalues; as many as its
        rank, so none where nothing is random.

        Shapes: (rank, m, c).
        """
        m, c = self.mean.shape
        values, vectors = np.linalg.eigh(self.covariance.reshape(m * c, m * c))
        largest = max(float(np.max(np.abs(self.second), initial=0.0)), float(np.max(values, initial=0.0)))
        used = values > ROUNDING * largest
        factors: np.ndarray = (np.sqrt(values[used]) * vectors[:, used]).T.reshape(-1, m, c)
        return factors


@singledispatch
def disturbed_gain(channel: AbstractRandomAffine) -> DisturbedGain:
    """Joint moments of a channel's gain and of the gains of its noise sources, in the order of the signal's way.

    A noise of covariance R counts as rank(R) sources of unit size; its mean is not used. Uncertain probabilities count
    as nominal.

    Raises:
        ValueError: a channel that is not made of hops, series, mixtures and stacks.
    """
    raise fail("channel", "hops, series, mixtures and stacks of them", type(channel).__name__)


@disturbed_gain.register
def _(channel: GainAndNoise) -> DisturbedGain:
    check_forgets("channel of a design", channel)
    values, vectors = np.linalg.eigh(np.asarray(channel.noise.covariance))
    used = values > ROUNDING * np.max(values, initial=0.0)
    root = np.sqrt(values[used]) * vectors[:, used]
    root = root * np.where(root.sum(axis=0) < 0, -1.0, 1.0)
    scaled = np.concatenate([np.asarray(channel.matrix), np.zeros_like(root)], axis=1)
    fixed = np.concatenate([np.zeros_like(np.asarray(channel.matrix)), root], axis=1)
    first, second = float(channel.law.moment(1)), float(channel.law.moment(2))
    outer = np.multiply.outer
    cross = first * (outer(scaled, fixed) + outer(fixed, scaled))
    return DisturbedGain(
        first * scaled + fixed, second * outer(scaled, scaled) + cross + outer(fixed, fixed), channel.inputs
    )


@disturbed_gain.register
def _(channel: Series) -> DisturbedGain:
    return reduce(_after, [disturbed_gain(part) for part in channel.maps])


def _after(first: DisturbedGain, then: DisturbedGain) -> DisturbedGain:
    """[G2, N2] diag([G1, N1], I) = [G2 G1, G2 N1, N2], with independent factors."""
    passed = _stack([first, _known(np.eye(then.disturbances))], shared=0)
    mean = then.mean @ passed.mean
    second = np.einsum("aicj,ibjd->abcd", then.second, passed.second)
    return DisturbedGain(mean, second, first.inputs)


@disturbed_gain.register
def _(channel: Mixture) -> DisturbedGain:
    parts = [disturbed_gain(part) for part in channel.maps]
    widened = [_place(part, channel.inputs, parts, i) for i, part in enumerate(parts)]
    weights = np.asarray(channel.choice.probabilities)
    mean = np.tensordot(weights, [part.mean for part in widened], axes=1)
    second = np.tensordot(weights, [part.second for part in widened], axes=1)
    return DisturbedGain(mean, second, channel.inputs)


@disturbed_gain.register
def _(channel: Stack) -> DisturbedGain:
    return _stack([disturbed_gain(part) for part in channel.maps], channel.inputs)


def _known(matrix: np.ndarray) -> DisturbedGain:
    return DisturbedGain(matrix, np.multiply.outer(matrix, matrix), 0)


def _place(part: DisturbedGain, shared: int, parts: list[DisturbedGain], index: int) -> DisturbedGain:
    """The same map in the joint columns of `parts`: `shared` ones first, then those of each part in turn."""
    private_widths = [p.mean.shape[1] - shared for p in parts]
    start = shared + sum(private_widths[:index])
    columns = [*range(shared), *range(start, start + private_widths[index])]
    m, total = part.mean.shape[0], shared + sum(private_widths)
    mean, second = np.zeros((m, total)), np.zeros((m, total, m, total))
    mean[:, columns] = part.mean
    second[np.ix_(range(m), columns, range(m), columns)] = part.second
    return DisturbedGain(mean, second, shared)


def _stack(parts: list[DisturbedGain], shared: int) -> DisturbedGain:
    """Independent maps one above the other that share their first `shared` inputs; E[H_ab H_ij] factors across maps."""
    placed = [_place(part, shared, parts, i) for i, part in enumerate(parts)]
    mean = np.concatenate([part.mean for part in placed])
    second = np.multiply.outer(mean, mean)
    row = 0
    for part in placed:
        rows = slice(row, row + part.mean.shape[0])
        second[rows, :, rows, :] = part.second
        row = rows.stop
    return DisturbedGain(mean, second, shared)
