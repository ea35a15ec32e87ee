"""Tests of losses for memory: a likelihood ratio against a first-order chain, and the number of runs."""

from typing import NamedTuple

import numpy as np
from scipy.special import xlogy
from scipy.stats import chi2, norm

from heliograph.learning.losses.loss_law import MarkovLosses
from heliograph.learning.losses.stretches import as_fates
from heliograph.numerics.readable import readable


@readable
class LossMemory(NamedTuple):
    """Result of two tests of losses that are independent by assumption.

    Args:
        likelihood_ratio: 2 (l1 - l0) of a first-order chain on the packets whose predecessor is known; chi-square with
            one degree of freedom if the losses are independent.
        likelihood_p: its p-value.
        runs_z: number of runs of equal fates, less what is expected, in standard deviations: negative for bursts.
        runs_p: its two-sided p-value.
    """

    likelihood_ratio: float
    likelihood_p: float
    runs_z: float
    runs_p: float

    @property
    def significant(self) -> bool:
        """True if the likelihood ratio rejects independence at 1 %."""
        return self.likelihood_p < 0.01


def loss_memory(fates: object) -> LossMemory:
    """Test losses that the receiver knows of for memory; where nothing varies there is no evidence, p = 1.

    Args:
        fates: one stretch of 0 (arrived), 1 (lost) and NaN (unknown), or a list of stretches.

    Raises:
        ValueError: what is no fates (see `heliograph.learning`).
    Source: Anderson and Goodman (1957); Wald and Wolfowitz (1940), given the losses of each unbroken stretch.
    """
    counts = MarkovLosses.fit(fates).counts
    both = counts.sum(axis=0)
    ratio = max(2 * (_likelihood(counts) - _likelihood(both[None])), 0.0)
    # Wald and Wolfowitz: runs less their mean, given the number of losses, and their variance
    off, variance = 0.0, 0.0
    for part in as_fates(fates):
        for lost in _unbroken(part):
            n, ones = len(lost), float(lost.sum())
            pairs = 2 * ones * (n - ones)
            off += 1 + np.sum(np.diff(lost) != 0) - (1 + pairs / n)
            variance += pairs * (pairs - n) / (n**2 * (n - 1)) if n > 1 else 0.0
    z = float(off / np.sqrt(variance)) if variance > 0 else 0.0
    return LossMemory(float(ratio), float(chi2.sf(ratio, 1)), z, float(2 * norm.sf(abs(z))))


def _likelihood(counts: np.ndarray) -> float:
    """Log-likelihood sum n_ab log(n_ab / n_a)."""
    rows = counts.sum(axis=1, keepdims=True)
    return float(np.sum(xlogy(counts, counts / np.where(rows > 0, rows, 1.0))))


def _unbroken(fate: np.ndarray) -> list[np.ndarray]:
    """Parts of a stretch without an unknown fate."""
    edges = np.flatnonzero(np.isnan(fate))
    return [part[~np.isnan(part)] for part in np.split(fate, edges) if np.any(~np.isnan(part))]
