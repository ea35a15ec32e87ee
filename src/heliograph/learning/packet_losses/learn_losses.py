"""Losses learned from a recording: laws fitted, tests of their memory, drifting rates, the law that predicts best."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy
from scipy.special import expit, xlogy

from heliograph.learning.long_run_covariance import estimate_mean_and_error
from heliograph.learning.packet_losses.hidden_mode_losses import HiddenModeLosses
from heliograph.learning.packet_losses.loss_laws import AbstractLossLaw, IndependentLosses, MarkovLosses, Packets
from heliograph.learning.packet_losses.packet_fates import CheckedFates, Fates, check_fates, fill_ends, find_trials
from heliograph.learning.packet_losses.probability_intervals import Share, estimate_shares, logits, maximise_over_shares
from heliograph.numerics.check import fail, scalar
from heliograph.numerics.module import readable
from heliograph.random_affine.base import AbstractRandomAffine

INDEPENDENT, HIDDEN, RUNNING = "independent", "hidden", "running"  # names of laws

LONG_ORDER = 4  # packets back that the longer of the two chains looks
TEST_LEVEL = 0.01  # probability that independent losses are said to have memory


class HeldOutScores(NamedTuple):
    """Scores of a law on packets that it was not fitted to.

    Args:
        log_likelihood: mean of log P(fate | fates before) over these packets, in nats.
        gain: how much larger it is than that of independent losses.
        gain_error: standard error of the gain, which allows for correlation over time.
    """

    log_likelihood: float
    gain: float
    gain_error: float


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

    @classmethod
    def of(cls, fates: object) -> "LossMemory":
        """Test losses that the receiver knows of for memory; where nothing varies there is no evidence, p = 1.

        Memory means that a loss makes the next one more or less probable. Two tests: a likelihood ratio of dependent
        and of independent losses, and the number of runs of equal fates (arrived or lost).

        Args:
            fates: one stretch of 0 (arrived), 1 (lost) and NaN (unknown), or a list of stretches.

        Raises:
            ValueError: what is no fates (see `heliograph.learning`).
        Source: Anderson and Goodman (1957); Wald and Wolfowitz (1940), given the losses of each unbroken stretch.
        """
        # The likelihood ratio of a chain, whose losses depend on the packet before, and of independent losses: those
        # have one law for both rows of the counts.
        counts = MarkovLosses.fit(fates, intervals=False).counts
        both = counts.sum(axis=0)
        ratio = max(2 * (_compute_maximum_log_likelihood(counts) - _compute_maximum_log_likelihood(both[None])), 0.0)
        # Wald and Wolfowitz: of n packets, n1 lost and n0 arrived, the number of runs of equal fates has the mean
        # 1 + 2 n1 n0 / n. `excess` is how many more there are, with its variance, over all unbroken stretches.
        excess, variance = 0.0, 0.0
        for stretch in check_fates(fates):
            # Of a stretch between arrivals the packets between them, which are exchangeable if losses are independent.
            for lost in _split_at_unknown(np.where(find_trials(stretch), stretch, np.nan)):
                n = len(lost)
                losses = float(lost.sum())
                pairs = 2 * losses * (n - losses)  # 2 n1 n0
                runs = 1 + np.sum(np.diff(lost) != 0)
                excess += runs - (1 + pairs / n)
                variance += pairs * (pairs - n) / (n**2 * (n - 1)) if n > 1 else 0.0
        z = float(excess / np.sqrt(variance)) if variance > 0 else 0.0
        return cls(
            likelihood_ratio=float(ratio),
            likelihood_p=float(scipy.stats.chi2.sf(ratio, 1)),
            runs_z=z,
            runs_p=float(2 * scipy.stats.norm.sf(abs(z))),
        )


@readable
@dataclass(frozen=True)
class Losses:
    """Losses of a recording: fitted laws, tests of memory, and how well each law predicts.

    Args:
        packets: number of packets whose fate is known.
        lost: number of these that were lost.
        laws: fitted to all packets, by name: "independent", "markov", "markov_4", "hidden", "running".
        memory: tests of independence on all packets.
        held_out: scores of each law on the later packets, when fitted to the earlier ones alone; empty where one part
            is too short.
        best: name of the law that predicts best of those whose likelihood ratio is significant; "independent" where
            none is. Where nothing was held out, "hidden" if that is significant.
        best_channel: the same among the laws that a channel can have, which are all but "running".
    """

    packets: int
    lost: int
    laws: dict[str, AbstractLossLaw]
    memory: LossMemory
    held_out: dict[str, HeldOutScores]
    best: str
    best_channel: str

    def channel(self, link: AbstractRandomAffine) -> AbstractRandomAffine:
        """Return the link with the losses of the law `best_channel`."""
        return self.laws[self.best_channel].channel(link)


def learn_losses(fates: object, held_out: float = 1 / 3) -> Losses:
    """Fit four kinds of laws to losses, test for memory, and choose by how well the laws predict the later packets.

    Losses are independent unless another law is significant: twice its gain of log-likelihood on all packets is above
    the chi-square quantile of the numbers that it has more, at 1 % for the four other laws together, a quarter each. Of
    these laws and "independent" the one is chosen under which the later packets are most likely.

    Args:
        fates: a stretch of 0 (arrived), 1 (lost) and NaN (unknown), or several in the order of time, as
            `fates_of_sequence`, `fates_by_node`, `fates_by_hop` and `fates_of_measurements` give them.
        held_out: share of the packets, the last ones, that are not fitted to but choose; a third by default.

    Raises:
        ValueError: what is no fates, a share outside [0, 1).
    """
    # Known fates, of which the first `cut` are fitted to, and log-probabilities of the later ones under each law.
    parts = check_fates(fates)
    share = float(scalar("held-out share", held_out, 0.0, 1.0))
    if share == 1.0:
        raise fail("held-out share", "less than 1: something must be fitted", share)
    known = find_trials(np.concatenate(parts))
    cut = int(np.floor(known.sum() * (1 - share)))
    held_out_scores = _score_held_out(parts, known, cut) if 0 < cut < known.sum() else {}
    # Laws fitted to all packets; those that are significant, and of these the best, also among what a channel can have.
    laws = _fit_laws(parts, intervals=True)
    significant = _find_significant_laws(laws, parts)
    best = _choose_law(significant, held_out_scores)
    best_channel = _choose_law(significant - {RUNNING}, held_out_scores)
    return Losses(
        packets=int(known.sum()),
        lost=int(np.sum(np.concatenate(parts) == 1)),
        laws=laws,
        memory=LossMemory.of(parts),
        held_out=held_out_scores,
        best=best,
        best_channel=best_channel,
    )


def _find_significant_laws(laws: dict[str, AbstractLossLaw], parts: Fates) -> set[str]:
    """Return the names of the laws that a likelihood ratio test prefers to independent losses.

    Twice the gain of log-likelihood is chi-square if losses are independent, with a degree of freedom for each further
    probability that a law has. All tests together have the level TEST_LEVEL (1 %).

    Args:
        laws: fitted laws by name.
        parts: stretches of fates to which they were fitted.
    """
    level = TEST_LEVEL / (len(laws) - 1)  # shared by the tests of all laws but "independent"
    total = {name: float(np.nansum(law.log_likelihoods(parts))) for name, law in laws.items()}
    significant = set[str]()
    for name, law in laws.items():
        # Independent losses have one number, so a law's further numbers are its degrees of freedom.
        ratio = 2 * (total[name] - total[INDEPENDENT])
        freedom = len(law.shares()) - 1
        if name != INDEPENDENT and scipy.stats.chi2.sf(ratio, freedom) < level:
            significant.add(name)
    return significant


def _choose_law(significant: set[str], held_out: dict[str, HeldOutScores]) -> str:
    """Return the name of the law with the largest held-out likelihood, among independent losses and significant laws.

    Without scores it is that of hidden modes (HIDDEN) if it is significant, else INDEPENDENT.

    Args:
        significant: names of the laws that a test prefers to independent losses.
        held_out: scores of the laws on packets that they were not fitted to, by name; empty if there are none.
    """
    if not held_out:
        return HIDDEN if HIDDEN in significant else INDEPENDENT
    candidates = [name for name in held_out if name in {INDEPENDENT, *significant}]
    return max(candidates, key=lambda name: held_out[name].log_likelihood)


def _fit_laws(parts: Fates, intervals: bool) -> dict[str, AbstractLossLaw]:
    """Return the five laws fitted to stretches of fates, by name; intervals of their numbers only if asked for.

    One Markov law looks back over one packet, the other over LONG_ORDER packets. HIDDEN has a good and a bad mode that
    are not seen. RUNNING follows the share of losses as it drifts.

    Args:
        parts: stretches of fates: 0 arrived, 1 lost, NaN unknown.
        intervals: whether to compute the intervals.
    """
    return {
        INDEPENDENT: IndependentLosses.fit(parts),
        "markov": MarkovLosses.fit(parts, intervals=intervals),
        f"markov_{LONG_ORDER}": MarkovLosses.fit(parts, LONG_ORDER),
        HIDDEN: HiddenModeLosses.fit(parts, intervals),
        RUNNING: RunningRateLosses.fit(parts, intervals),
    }


def _score_held_out(parts: Fates, known: np.ndarray, cut: int) -> dict[str, HeldOutScores]:
    """Return the scores of the laws on later packets by name, when the laws are fitted to the earlier ones.

    Each later packet is predicted from all packets before it.

    Args:
        parts: stretches of fates: 0 arrived, 1 lost, NaN unknown.
        known: which packets count, of all stretches one after the other: those with a known fate, except ends that were
            chosen because they arrived.
        cut: how many of the packets that count the laws are fitted to, the first ones.
    """
    is_held_out = known & (np.cumsum(known) > cut)
    # Hide later fates as unknown, so that the laws are fitted to the first `cut` trials.
    fates_to_fit = np.where(is_held_out, np.nan, np.concatenate(parts))
    ends = np.cumsum([len(stretch) for stretch in parts])[:-1]
    laws = _fit_laws(CheckedFates(np.split(fates_to_fit, ends)), intervals=False)
    log_likelihoods = {name: law.log_likelihoods(parts)[is_held_out] for name, law in laws.items()}
    scores = {}
    for name, logs in log_likelihoods.items():
        gain, error = estimate_mean_and_error(logs - log_likelihoods[INDEPENDENT])
        scores[name] = HeldOutScores(log_likelihood=float(logs.mean()), gain=gain, gain_error=error)
    return scores


def _compute_maximum_log_likelihood(counts: np.ndarray) -> float:
    """Return the largest log-likelihood of counts n_ab, (pasts, fates), over all P(b | a): sum n_ab log(n_ab / n_a).

    n_ab is how often fate b followed past a, and n_a = sum_b n_ab.
    """
    rows = counts.sum(axis=1, keepdims=True)
    return float(np.sum(xlogy(counts, counts / np.where(rows > 0, rows, 1.0))))


def _split_at_unknown(fate: np.ndarray) -> list[np.ndarray]:
    """Return the parts of a stretch of fates between unknown ones (NaN), without these."""
    edges = np.flatnonzero(np.isnan(fate))
    return [stretch[~np.isnan(stretch)] for stretch in np.split(fate, edges) if np.any(~np.isnan(stretch))]


STARTS = (logits(0.2, 0.8, 0.05), logits(0.2, 0.5, 0.3), logits(0.2, 0.95, 0.01))


class RunningRateLosses(AbstractLossLaw):
    """Losses whose rate drifts: P(lost) = (1 - weight) base + weight r, r <- r + step (lost - r) after a known fate.

    A yardstick for the others: where it predicts as well as a hidden mode, the rate drifts. No channel has it.

    Args:
        base: rate from which r begins, and to which the probability is drawn.
        weight: share of the running rate r in the probability.
        step: share of the last fate in the running rate.
    """

    base: Share
    weight: Share
    step: Share

    @staticmethod
    def fit(fates: object, intervals: bool = True) -> "RunningRateLosses":
        """Fit by maximum likelihood from three starts, with intervals by the profile of the likelihood.

        Raises:
            ValueError: what is no fates.
        """
        # Packets of unknown fate are left out. Ends at which a stretch was cut because they arrived are no trials, and
        # become 0 (arrived), so that the law of the packets after them knows it.
        known = [stretch[~np.isnan(stretch)] for stretch in check_fates(fates)]
        trials = [find_trials(stretch) for stretch in known]
        stretches = [fill_ends(stretch) for stretch in known]

        def likelihood(x: np.ndarray) -> tuple[float, np.ndarray]:
            """Return the log-likelihood at the logits x (3,) of base, weight and step, and its gradient (3,).

            `stretches` are the known fates, and `trials` says which of them count.
            """
            # The derivative of a share p by its logit is p (1 - p).
            share = expit(x)
            total, gradient = 0.0, np.zeros(len(x))
            for stretch, trial_mask in zip(stretches, trials, strict=True):
                value, slope = _sum_log_probabilities(stretch, _predict_losses(stretch, *share), trial_mask)
                total, gradient = total + value, gradient + slope
            return total, gradient * share * (1 - share)

        top, value = maximise_over_shares(likelihood, [*STARTS])
        return RunningRateLosses(*estimate_shares(likelihood, top, value, intervals))

    def shares(self) -> dict[str, Share]:
        """Return the base, weight and step with likelihood intervals."""
        return {name: getattr(self, name) for name in ("base", "weight", "step")}

    def predicted(self, fate: Packets) -> Packets:
        """Return the probability of each loss by the running rate, which an unknown fate does not change.

        `fate` (packets,): 0 arrived, 1 lost, NaN unknown. The rate is followed over the known fates alone, and each
        packet takes the one after the last known fate before it.
        """
        known = ~np.isnan(fate)
        base, weight, step = (share.estimate for share in self.shares().values())
        # The probability of loss after 0, 1, ..., all known fates.
        after_known, _ = _predict_losses(np.append(fate[known], 0.0), base, weight, step)
        known_before = np.cumsum(known) - known  # of each packet, how many known fates are before it
        return np.asarray(after_known[known_before])


def _predict_losses(lost: Packets, base: float, weight: float, step: float) -> tuple[Packets, Packets]:
    """Return P(lost) of each packet by the running rate, and its derivatives by base, weight and step (3, packets).

    P(lost) = base + weight d, where d+ = (1 - step) d + step (lost - base) follows the fates, from d = 0 on. Its
    derivatives follow recursions of the same form, so all run as linear filters. `lost`: the fates, 1 for a loss.
    """
    recursion = [1.0, step - 1.0]  # lfilter([b], recursion, x) is y_k = (1 - step) y_(k-1) + b x_k

    def delay(x: Packets) -> Packets:
        """Return x one packet later, from 0 on: a packet's probability depends on the fates before it."""
        return np.concatenate([[0.0], x])[: len(x)]

    d = scipy.signal.lfilter([step], recursion, delay(lost - base))
    d_by_base = scipy.signal.lfilter([step], recursion, delay(-np.ones(len(lost))))
    d_by_step = scipy.signal.lfilter([1.0], recursion, delay(lost - base - d))
    return base + weight * d, np.stack([1 + weight * d_by_base, d, weight * d_by_step])


def _sum_log_probabilities(
    lost: Packets, predictions: tuple[Packets, Packets], trials: np.ndarray
) -> tuple[float, np.ndarray]:
    """Return l = sum log P(fate) over the `trials`, and its gradient by the law's three numbers (3,).

    They are base, weight and step. `lost`: 1 of a lost packet, 0 of one that arrived. `predictions`: p = P(lost) of
    each packet, and its derivatives by the three (3, packets). dl/dp = (lost - p) / (p (1 - p)).
    """
    p, slope = predictions
    p = np.clip(p, 1e-300, 1 - 1e-16)  # so that both logarithms are finite
    log_probability = np.where(lost == 1, np.log(p), np.log1p(-p))
    score = (lost - p) / (p * (1 - p))  # dl/dp of each packet
    return float(np.sum(log_probability[trials])), slope @ np.where(trials, score, 0.0)
