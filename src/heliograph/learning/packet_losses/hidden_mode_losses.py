"""Losses of a link that is good or bad for a while, as a hidden mode: its two-mode filter and its likelihood."""

import numpy as np

from heliograph.learning.packet_losses.loss_laws import AbstractLossLaw, Packets
from heliograph.learning.packet_losses.packet_fates import CHOSEN, Fates, check_fates, fill_ends, keep_ends_only
from heliograph.learning.packet_losses.probability_intervals import Share, estimate_shares, logits, maximise_over_shares
from heliograph.model.channel import erasure
from heliograph.model.fading import gilbert_elliott
from heliograph.random_affine.base import AbstractRandomAffine

STEP = 1e-20  # of the complex step, whose error is its square
UNKNOWN, START = 2, 3  # codes of a packet of unknown fate and of the start of a stretch, besides 0 arrived and 1 lost

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

        A hidden Markov chain is good or bad; packets are lost with another probability in each mode. The four shares
        are searched by their logits x (4,).

        Args:
            fates: a stretch of packets, 0 (arrived), 1 (lost) or NaN (unknown), or several.
            intervals: whether to compute the intervals; their ends are NaN otherwise.

        Raises:
            ValueError: what is no fates.
        """
        stretches = check_fates(fates)
        # A stretch cut where packets arrived (its ends are CHOSEN) counts as log P(fates) - log P(both ends arrive).
        chosen = [keep_ends_only(fate) for fate in stretches if fate[-1] == CHOSEN]
        whole = FateRuns.of([fill_ends(fate) for fate in stretches])
        ends = FateRuns.of(chosen) if chosen else None

        def likelihood(x: np.ndarray) -> tuple[float, np.ndarray]:
            """Return log P(fates) - log P(ends arrive) at the logits x, and its gradient.

            `whole` has all stretches. The second term is for stretches that were chosen to end with an arrival: `ends`
            has these ends alone, and is None if there are none.
            """
            value, gradient = whole.likelihood(x)
            if ends is None:
                return value, gradient
            value_of_ends, gradient_of_ends = ends.likelihood(x)
            return value - value_of_ends, gradient - gradient_of_ends

        # The maximum, then each of the four shares with its interval.
        top, value = maximise_over_shares(likelihood, [*STARTS])
        good, bad, fails, recovers = estimate_shares(likelihood, top, value, intervals)
        if good.estimate > bad.estimate:  # the good mode is the one that loses less
            good, bad, fails, recovers = bad, good, recovers, fails
        return HiddenModeLosses(good_loss=good, bad_loss=bad, fail=fails, recover=recovers)

    def shares(self) -> dict[str, Share]:
        """Return the losses of each mode and the chain's probabilities, with likelihood intervals."""
        return {name: getattr(self, name) for name in ("good_loss", "bad_loss", "fail", "recover")}

    def predicted(self, fate: Packets) -> Packets:
        """Return the probability of each packet's loss (packets,), given the fates before it.

        P(lost) = sum_i P(mode i | fates before) P(lost | mode i), by a filter of the two modes: a known fate changes
        the probabilities of the modes by Bayes' rule, then the chain moves them to the next packet. `fate`: 0 arrived,
        1 lost, NaN unknown.
        """
        good, bad, fails, recovers = (share.estimate for share in self.shares().values())
        away = fails + recovers
        # P(bad mode), from the stationary law on; of two modes that never change nobody knows which it is.
        is_bad = fails / away if away else 0.5
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

    Args:
        kind: of each run: 0 arrived, 1 lost, UNKNOWN, or START before a stretch (runs,).
        length: number of packets in each run (runs,).
    """

    def __init__(self, kind: np.ndarray, length: np.ndarray):
        """Store for each kind which runs have it, their distinct lengths, and which of these lengths each run has.

        A run is a row of packets of one kind: a fate that they share, or a single START. Runs of one kind and length
        share a matrix power, which is computed once.

        Args:
            kind: of each run: 0 arrived, 1 lost, UNKNOWN, or START (runs,).
            length: number of packets in each run (runs,).
        """
        self.kind = kind
        self.runs_by_kind: dict[int, tuple[np.ndarray, np.ndarray, np.ndarray]] = {}
        for fate in np.unique(kind):
            has_kind = kind == fate
            distinct_lengths, length_of_run = np.unique(length[has_kind], return_inverse=True)
            self.runs_by_kind[int(fate)] = has_kind, distinct_lengths, length_of_run

    @staticmethod
    def of(fates: Fates) -> "FateRuns":
        """Return the runs of equal fates in some stretches (packets,), each stretch after a START.

        A run is a row of successive packets with the same fate; the likelihood has one factor for each.

        Args:
            fates: fates of each stretch (packets,): 0 arrived, 1 lost, NaN unknown.
        """
        # Write fates as whole numbers: 0 arrived, 1 lost, or UNKNOWN.
        code = np.concatenate([[START, *np.where(np.isnan(f), UNKNOWN, f).tolist()] for f in fates]).astype(int)
        begins_run = np.concatenate([[True], (np.diff(code) != 0) | (code[1:] == START)])
        starts = np.flatnonzero(begins_run)
        return FateRuns(kind=code[starts], length=np.diff(np.append(starts, len(code))))

    def likelihood(self, x: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the log-likelihood l and its gradient (4,) at logits x of (loss when good, when bad, fail, recover).

        The gradient comes from complex steps: the imaginary part of l(x + i h) is h dl/dx for a tiny h = STEP.
        """
        # Rows 0 to 3 have a step in one logit each, and row 4 has none.
        shifted = np.broadcast_to(x, (5, 4)).astype(complex)
        shifted[np.arange(4), np.arange(4)] += 1j * STEP
        total = self._compute_log_likelihoods(1 / (1 + np.exp(-shifted)))
        return float(total[4].real), np.asarray(total[:4].imag / STEP)

    def _compute_log_likelihoods(self, shares: np.ndarray) -> np.ndarray:
        """Return the log-likelihood of all stretches for several sets of shares, (sets,); shares may be complex.

        A stretch is a sequence of packets, and a run in it has one fate (arrived, lost, unknown). The likelihood is
        1' (T' A)^n ... (T' A)^m p, a product over runs: the first has m packets, the last n. A is the diagonal of the
        probabilities of the run's fate in each mode, T is the transition of the modes, and p their stationary law.
        Complex shares give derivatives: the imaginary part of l(x + i h) is h dl/dx for a tiny h.

        `shares`: (sets, 4), in each the losses when good and when bad, and the probabilities to fail and to recover.
        `self.kind`: the fate of each run in turn, START where a stretch begins. `self.runs_by_kind`: for each kind the
        indices of its runs, their distinct lengths, and which of these each run has.
        """
        good, bad, fails, recovers = shares.T
        ones = np.ones_like(good)
        # T', with a column for each present mode; the diagonal of A for each fate; p 1', for the start of a stretch.
        transposed = _stack_matrices([[1 - fails, recovers], [fails, 1 - recovers]])
        probabilities = {0: [1 - good, 1 - bad], 1: [good, bad], UNKNOWN: [ones, ones]}
        away = fails + recovers  # probability to leave a mode, of both together
        start = _stack_matrices([[recovers / away] * 2, [fails / away] * 2])
        # (T' A)^length of each run, as a matrix and the logarithm of its scale, computed once for each length.
        matrices = np.zeros((len(shares), len(self.kind), 2, 2), dtype=complex)
        scales = np.zeros((len(shares), len(self.kind)), dtype=complex)
        for kind, (runs, lengths, length_of_run) in self.runs_by_kind.items():
            if kind == START:
                matrices[:, runs] = start[:, None]
                continue
            step = transposed * np.stack(probabilities[kind], axis=-1)[:, None, :]  # T' A
            power, scale = _raise_matrices(step, lengths)
            matrices[:, runs], scales[:, runs] = power[:, length_of_run], scale[:, length_of_run]
        product, scale = _multiply_runs(matrices)
        # Each stretch begins with a START, whose matrix is p 1'. So all columns of the product are (...) p, and the
        # sum of one column is 1' (...) p.
        probability = product.sum(axis=-2)[..., 0]
        return np.asarray(np.log(probability) + scale + scales.sum(axis=1))


def _stack_matrices(rows: list[list[np.ndarray]]) -> np.ndarray:
    """Return 2 x 2 matrices (sets, 2, 2) from rows of entries, each an array (sets,)."""
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def _rescale_matrices(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return matrices (..., 2, 2) divided by their largest real part, and its logarithm (...).

    Without this, products of many matrices would underflow. `matrix` may be complex, as in derivatives by complex
    steps.
    """
    largest_of_columns = np.maximum(matrix.real[..., 0, :], matrix.real[..., 1, :])
    largest = np.maximum(largest_of_columns[..., 0], largest_of_columns[..., 1])
    scale = np.where(largest > 0, largest, 1.0)
    return matrix * (1 / scale)[..., None, None], np.log(scale)  # multiplied, since NumPy divides as by complex numbers


def _raise_matrices(matrix: np.ndarray, lengths: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return each matrix (sets, 2, 2) to the power of each length, (sets, lengths, 2, 2), and logarithms of scales.

    A power is the returned matrix times its scale. By the binary digits of the lengths: `square` is the matrix to the
    power 1, 2, 4, ...
    """
    shape = (len(matrix), len(lengths))
    power = np.broadcast_to(np.eye(2, dtype=complex), (*shape, 2, 2))
    scale, (square, square_scale) = np.zeros(shape), _rescale_matrices(matrix)
    digits = lengths.copy()
    while np.any(digits):
        odd = (digits & 1).astype(bool)  # lengths that have this binary digit
        power = np.where(odd[:, None, None], square[:, None] @ power, power)
        power, more = _rescale_matrices(power)
        scale = scale + more + np.where(odd, square_scale[:, None], 0.0)
        digits = digits >> 1
        square, more = _rescale_matrices(square @ square)
        square_scale = 2 * square_scale + more
    return power, scale


def _multiply_runs(matrices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the product of matrices (sets, runs, 2, 2) over runs, the last leftmost, and the log of its scale.

    The product is the returned matrix (sets, 2, 2) times its scale (sets,). Each turn multiplies pairs, which halves
    the number of matrices. An odd number of matrices is filled up with the identity.
    """
    log_scale = np.zeros(len(matrices))
    while matrices.shape[1] > 1:
        if matrices.shape[1] % 2:
            identity = np.broadcast_to(np.eye(2), (len(matrices), 1, 2, 2))
            matrices = np.concatenate([matrices, identity], axis=1)
        matrices, log_scales = _rescale_matrices(matrices[:, 1::2] @ matrices[:, ::2])
        log_scale = log_scale + log_scales.sum(axis=1)
    return matrices[:, 0], log_scale
