"""Losses of a link that is good or bad for a while, as a hidden mode: its two-mode filter and its likelihood."""

import numpy as np

from heliograph.learning.losses.loss_law import AbstractLossLaw, Packets
from heliograph.learning.losses.packet_fates import CHOSEN, Fates, check_fates, fill_ends, keep_ends_only
from heliograph.learning.losses.probability_intervals import Share, estimate_shares, logits, maximise_shares
from heliograph.model.channel import erasure
from heliograph.model.fading import gilbert_elliott
from heliograph.random_affine.base import AbstractRandomAffine

STEP = 1e-20  # of the complex step, whose error is its square
UNKNOWN, START = 2, 3  # kinds of runs of packets, after arrived (0) and lost (1)

STARTS = (  # loss when good, loss when bad, fail, recover: bursts, long spells, two rates that hardly differ
    logits(0.02, 0.9, 0.05, 0.5),
    logits(0.05, 0.5, 0.005, 0.02),
    logits(0.1, 0.3, 0.1, 0.1),
)


class HiddenModeLosses(AbstractLossLaw):
    """Hidden mode, good or bad, that fails and recovers as a chain; a packet is lost with the mode's probability.

    Args:
        good_loss: probability of a loss in the good mode.
        bad_loss: probability of a loss in the bad mode.
        fail: probability that the good mode turns bad before the next packet.
        recover: probability that the bad mode turns good before the next packet.

    Source: Gilbert (1960), Elliott (1963).
    """

    good_loss: Share
    bad_loss: Share
    fail: Share
    recover: Share

    @staticmethod
    def fit(fates: object, intervals: bool = True) -> "HiddenModeLosses":
        """Fit by maximum likelihood from three starts, with intervals by the profile of the likelihood.

        Raises:
            ValueError: what is no fates.
        """
        parts = check_fates(fates)
        # log P(fates) - log P(chosen ends arrive).
        chosen = [keep_ends_only(fate) for fate in parts if fate[-1] == CHOSEN]
        whole, ends = FateRuns.of([fill_ends(fate) for fate in parts]), FateRuns.of(chosen) if chosen else None

        def likelihood(x: np.ndarray) -> tuple[float, np.ndarray]:
            value, slope = whole.likelihood(x)
            if ends is None:
                return value, slope
            value_of_ends, slope_of_ends = ends.likelihood(x)
            return value - value_of_ends, slope - slope_of_ends

        top, value = maximise_shares(likelihood, [*STARTS])
        good, bad, fails, recovers = estimate_shares(likelihood, top, value, intervals)
        if good.estimate > bad.estimate:  # the good mode is the one that loses less
            good, bad, fails, recovers = bad, good, recovers, fails
        return HiddenModeLosses(good, bad, fails, recovers)

    def shares(self) -> dict[str, Share]:
        """Return the losses of each mode and the chain's probabilities, with likelihood intervals."""
        return {name: getattr(self, name) for name in ("good_loss", "bad_loss", "fail", "recover")}

    def predicted(self, fate: Packets) -> Packets:
        """Return the probability of each loss by the filter of the mode: P(lost) = sum_i P(mode i | past) loss_i."""
        good, bad, fails, recovers = (share.estimate for share in self.shares().values())
        away = fails + recovers
        is_bad = fails / away if away else 0.5  # two modes that never change: nobody knows which it is
        probabilities = np.zeros(len(fate))
        for k, observed in enumerate(fate.tolist()):
            p = (1 - is_bad) * good + is_bad * bad
            probabilities[k] = p
            # Bayes' rule on a known fate, then the step of the chain.
            if observed == 1 and p > 0:
                is_bad = is_bad * bad / p
            elif observed == 0 and p < 1:
                is_bad = is_bad * (1 - bad) / (1 - p)
            is_bad = (1 - is_bad) * fails + is_bad * (1 - recovers)
        return probabilities

    def channel(self, link: AbstractRandomAffine) -> AbstractRandomAffine:
        """Return the link in two modes (`gilbert_elliott`) with the losses of each."""
        good, bad = (erasure(link, 1 - share.estimate) for share in (self.good_loss, self.bad_loss))
        return gilbert_elliott(good, bad, self.fail.estimate, self.recover.estimate)


class FateRuns:
    """Stretches as runs of equal fates, whose matrices are powers: the likelihood needs one product for each run.

    The likelihood of a stretch is 1' A_n T' A_(n-1) ... T' A_1 p, with A the diagonal of the fate's probabilities in
    each mode, T the transition and p its stationary law. Between stretches stands p 1', which starts anew; one more T'
    after the last A changes nothing, 1' T' = 1', so that each A is followed by one.
    """

    def __init__(self, kind: np.ndarray, length: np.ndarray):
        """Take kind and length of each run; by kind keep its runs, their distinct lengths, and which each one has."""
        self.kind = kind
        masks = {int(fate): kind == fate for fate in np.unique(kind)}
        self.places = {fate: (mask, *np.unique(length[mask], return_inverse=True)) for fate, mask in masks.items()}

    @staticmethod
    def of(fates: Fates) -> "FateRuns":
        """Return the runs of stretches one after another, each behind a START."""
        code = np.concatenate([[START, *np.where(np.isnan(f), UNKNOWN, f).tolist()] for f in fates]).astype(int)
        first = np.flatnonzero(np.concatenate([[True], (np.diff(code) != 0) | (code[1:] == START)]))
        return FateRuns(code[first], np.diff(np.append(first, len(code))))

    def likelihood(self, x: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the log-likelihood at logits (loss when good, when bad, fail, recover), and its gradient (4,).

        By complex steps: the imaginary part of l(x + i h) is h dl/dx.
        """
        shifted = np.broadcast_to(x, (5, 4)).astype(complex)
        shifted[np.arange(4), np.arange(4)] += 1j * STEP
        total = self._compute_log_likelihoods(1 / (1 + np.exp(-shifted)))
        return float(total[4].real), np.asarray(total[:4].imag / STEP)

    def _compute_log_likelihoods(self, shares: np.ndarray) -> np.ndarray:
        """Return the log-likelihoods for several sets of shares (sets, 4)."""
        good, bad, fails, recovers = shares.T
        ones = np.ones_like(good)
        # T' and A of each fate, and the stationary law p.
        moved = _stack_matrices([[1 - fails, recovers], [fails, 1 - recovers]])  # T', columns from the present mode
        emitted = {0: [1 - good, 1 - bad], 1: [good, bad], UNKNOWN: [ones, ones]}
        away = fails + recovers
        start = _stack_matrices([[recovers / away] * 2, [fails / away] * 2])  # p 1'
        parts = np.zeros((len(shares), len(self.kind), 2, 2), dtype=complex)
        scales = np.zeros((len(shares), len(self.kind)), dtype=complex)
        # (T' A)^length of each run, computed once for each length, and their product.
        for kind, (runs, lengths, position) in self.places.items():
            if kind == START:
                parts[:, runs] = start[:, None]
                continue
            step = moved * np.stack(emitted[kind], axis=-1)[:, None, :]  # T' A
            power, scale = _raise_matrices(step, lengths)
            parts[:, runs], scales[:, runs] = power[:, position], scale[:, position]
        product, scale = _multiply_runs(parts)
        probability = product.sum(axis=-2)[..., 0]  # 1' (...): all columns of what starts with p 1' agree
        return np.asarray(np.log(probability) + scale + scales.sum(axis=1))


def _stack_matrices(rows: list[list[np.ndarray]]) -> np.ndarray:
    """Return rows of entries (sets,) as matrices (sets, 2, 2)."""
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def _rescale(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return matrices (..., 2, 2) over their largest real part, lest products underflow, and its logarithm."""
    rows = np.maximum(matrix.real[..., 0, :], matrix.real[..., 1, :])
    size = np.maximum(rows[..., 0], rows[..., 1])
    size = np.where(size > 0, size, 1.0)
    return matrix * (1 / size)[..., None, None], np.log(size)  # a division by a real number would be a complex one


def _raise_matrices(matrix: np.ndarray, lengths: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return matrix^length for each length, (sets, lengths, 2, 2), rescaled, and the logarithms of the scales.

    By the binary digits of the lengths: `square` is the matrix to the power 1, 2, 4, ...
    """
    shape = (len(matrix), len(lengths))
    power = np.broadcast_to(np.eye(2, dtype=complex), (*shape, 2, 2))
    scale, (square, square_scale) = np.zeros(shape), _rescale(matrix)
    digits = lengths.copy()
    while np.any(digits):
        odd = (digits & 1).astype(bool)
        power = np.where(odd[:, None, None], square[:, None] @ power, power)
        power, more = _rescale(power)
        scale = scale + more + np.where(odd, square_scale[:, None], 0.0)
        digits = digits >> 1
        square, more = _rescale(square @ square)
        square_scale = 2 * square_scale + more
    return power, scale


def _multiply_runs(parts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the product of (sets, runs, 2, 2) over runs, the last one leftmost, rescaled, and the scale's logarithm.

    Pair by pair: each turn halves the number of matrices.
    """
    scale = np.zeros(len(parts))
    while parts.shape[1] > 1:
        if parts.shape[1] % 2:
            parts = np.concatenate([parts, np.broadcast_to(np.eye(2), (len(parts), 1, 2, 2))], axis=1)
        parts, more = _rescale(parts[:, 1::2] @ parts[:, ::2])
        scale = scale + more.sum(axis=1)
    return parts[:, 0], scale
