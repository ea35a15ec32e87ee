"""Whether losses remember: a likelihood ratio against a first-order chain, and the number of runs."""

from typing import NamedTuple

import numpy as np
from scipy.special import xlogy
from scipy.stats import chi2, norm

from heliograph.learning.losses.loss_law import MarkovLosses
from heliograph.learning.losses.stretches import as_fates
from heliograph.numerics.readable import readable


@readable
class LossMemory(NamedTuple):
    """What two tests say of losses that are independent by assumption.

    likelihood_ratio: 2 (l1 - l0) of a first-order chain on the packets whose predecessor is known, chi-square with one
    degree of freedom if the losses are independent, and its p-value. runs_z: the number of runs of equal fates, less
    what is expected, in standard deviations: negative where losses come in bursts; its two-sided p-value.
    """

    likelihood_ratio: float
    likelihood_p: float
    runs_z: float
    runs_p: float

    @property
    def result(self) -> bool:
        """Whether the likelihood ratio rejects independence at 1 %."""
        return self.likelihood_p < 0.01


def loss_memory(fates: object) -> LossMemory:
    """Test told losses for memory; where nothing varies there is no evidence, p = 1.

    Raises:
        ValueError: what is no fates (see `heliograph.learning`).
    Source: Anderson and Goodman (1957); Wald and Wolfowitz (1940), given the losses of each unbroken stretch.
    """
    counts = MarkovLosses.fit(fates).counts
    both = counts.sum(axis=0)
    ratio = max(2 * (_likelihood(counts) - _likelihood(both[None])), 0.0)
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
    """sum n_ab log(n_ab / n_a)."""
    rows = counts.sum(axis=1, keepdims=True)
    return float(np.sum(xlogy(counts, counts / np.where(rows > 0, rows, 1.0))))


def _unbroken(fate: np.ndarray) -> list[np.ndarray]:
    """Parts of a stretch without an unknown fate."""
    edges = np.flatnonzero(np.isnan(fate))
    return [part[~np.isnan(part)] for part in np.split(fate, edges) if np.any(~np.isnan(part))]
