"""Laws of losses: the probability that a packet is lost, given what became of those before it.

The fate of a packet is 0 if it arrived, 1 if it was lost, NaN if that is not known, and CHOSEN (2) if it arrived and is
an end of its stretch for that reason (`packet_fates.py`).
"""

from typing import NamedTuple, TypeVar

import numpy as np

from heliograph.learning.packet_losses.packet_fates import CHOSEN, Fates, check_fates, fill_ends, find_trials
from heliograph.learning.packet_losses.probability_intervals import estimate_shares, logits, maximise_over_shares
from heliograph.model.channel import erasure
from heliograph.model.fading import gilbert_elliott, markov_fading
from heliograph.numerics.check import check_count, fail
from heliograph.numerics.confidence_intervals import Share, wilson
from heliograph.numerics.module import Module, readable, unwritten
from heliograph.numerics.types import Float
from heliograph.random_affine.base import AbstractRandomAffine
from heliograph.random_affine.markov_chain_and_autoregression import MarkovChain

Law = TypeVar("Law", bound="AbstractLossLaw")
Packets = Float[np.ndarray, " packets"]


@readable
class AbstractLossLaw(Module):
    """Law of the losses of packets, fitted to recorded fates: 0 arrived, 1 lost, NaN unknown.

    Subclasses define `shares`, `predicted`, and `channel` where a channel can have such losses. The log-likelihood of a
    recording is the sum of log P(fate | fates before) over the packets whose fate is known; each stretch starts in the
    stationary law. Of a stretch between two packets that are its ends because they arrived (`fates_of_sequence`) it is
    that of the packets between, given that both ends arrived: log P(fates) - log P(ends), where P(ends) is the
    probability that the two arrive, whatever became of the others.
    """

    def shares(self) -> dict[str, Share]:
        """Return the probabilities that the law has, by name, as estimates with their 95 % intervals."""
        raise unwritten(self, "shares")

    def predicted(self, fate: Packets) -> Packets:
        """Return the probability that each packet of a stretch is lost, given the fates of those before it (packets,).

        `fate`: fates of the stretch: 0 arrived, 1 lost, NaN unknown.
        """
        raise unwritten(self, "predicted")

    def channel(self, link: AbstractRandomAffine) -> AbstractRandomAffine:
        """Return the link with such losses, which the receiver knows of.

        Raises:
            ValueError: a law that no channel has.
        """
        raise fail(f"channel with {type(self).__name__}", "a law with finitely many states", "a rate that drifts")

    def log_likelihoods(self, fates: object) -> Packets:
        """Return log P(fate | fates before it) of each packet of all stretches; NaN where the fate is unknown.

        A stretch may have been cut where packets arrived. Its likelihood is then P(fates) / P(last arrives | first
        arrived), since its end says nothing; the last packet's entry is reduced by the logarithm of that probability.

        Args:
            fates: stretches of packets in order of sending, 0 (arrived), 1 (lost) or NaN (unknown); one array or
                several.

        Raises:
            ValueError: what is no fates (see `heliograph.learning`).
        """
        return np.concatenate([self._score_stretch(stretch) for stretch in check_fates(fates)])

    def _score_stretch(self, fate: Packets) -> Packets:
        """Return log P(fate | earlier fates) of each packet of a stretch (packets,), or NaN if its fate is unknown.

        A fate is 0 (arrived), 1 (lost) or NaN (unknown). If the stretch was cut where packets arrived, its first and
        last fate are CHOSEN: they arrived, but say nothing of losses. The first has NaN. The sum of all entries has to
        be log P(fates between, last arrives | first arrived) - log P(last arrives | first arrived), so the last entry
        is log P(last arrives | all earlier fates) - log P(last arrives | first arrived). `find_trials` marks fates of 0
        and 1; `fill_ends` writes 0 in place of CHOSEN.
        """
        p = self.predicted(fill_ends(fate))  # P(lost) of each packet; chosen ends count as arrived for those after them
        with np.errstate(divide="ignore"):
            log_probability = np.where(fate == 1, np.log(p), np.log1p(-p))
        logs: Packets = np.where(find_trials(fate), log_probability, np.nan)  # trials: fates of 0 and 1
        if fate[-1] == CHOSEN and len(fate) > 2:
            last_given_first = self._compute_return_probability(steps=len(fate) - 1)
            logs[-1] = np.log1p(-p[-1]) - np.log(last_given_first)
        return logs

    def _compute_return_probability(self, steps: int) -> float:
        """Return P(a packet arrives | the packet `steps` before it arrived), if nothing is known of those between."""
        fate = np.full(steps + 1, np.nan)
        fate[0] = 0.0
        return 1.0 - float(self.predicted(fate)[-1])


class IndependentLosses(AbstractLossLaw):
    """Independent losses: each packet is lost with the same probability, whatever became of the others.

    Args:
        lost: number of packets that were lost.
        packets: number of packets whose fate is known.
    """

    lost: int
    packets: int

    @staticmethod
    def fit(fates: object) -> "IndependentLosses":
        """Return the law whose probability of a loss is the share of lost packets, by counting.

        Packets count if their fate is known, except the ends of a stretch that was cut where packets arrived
        (`fates_of_sequence`): they could not have been lost.

        Args:
            fates: stretches of packets in order of sending, 0 (arrived), 1 (lost) or NaN (unknown); one array or
                several.

        Raises:
            ValueError: an argument that is no fates.
        """
        all_fates = np.concatenate(check_fates(fates))
        is_counted = find_trials(all_fates)  # fates of 0 and 1; `check_fates` marks chosen ends by another value
        return IndependentLosses(lost=int(np.sum(all_fates == 1)), packets=int(np.sum(is_counted)))

    def shares(self) -> dict[str, Share]:
        """Return the share of losses, lost / packets, with Wilson's interval."""
        return {"loss": wilson(self.lost, self.packets)}

    def predicted(self, fate: Packets) -> Packets:
        """Return the probability of each packet's loss, (k + 1/2) / (n + 1) for k losses among n packets, (packets,).

        So neither a loss nor an arrival is impossible.
        """
        return np.full(len(fate), (self.lost + 0.5) / (self.packets + 1))

    def channel(self, link: AbstractRandomAffine) -> AbstractRandomAffine:
        """Return the link behind an erasure, which lets each packet pass with the share of those that arrived."""
        return erasure(link, 1 - self.lost / self.packets)


class MarkovLosses(AbstractLossLaw):
    """Losses as a Markov chain: the probability depends on what became of the last `order` packets.

    Args:
        counts: (arrived, lost) after each past (2^order, 2); a past is a number whose bits are the last fates, the
            latest one lowest.
        given_ends: P(lost | arrived) and P(arrived | lost) with likelihood intervals, of a chain between ends
            that arrived for being ends; none where counts say all.
    """

    counts: np.ndarray
    given_ends: tuple[Share, Share] | None = None

    @staticmethod
    def fit(fates: object, order: int = 1, intervals: bool = True) -> "MarkovLosses":
        """Return the law from counts over packets whose last `order` fates are known.

        The law has a probability of loss for each pattern of the last `order` fates (lost or arrived). The ends of a
        recorded stretch may have been chosen where packets arrived, so they say nothing of losses. For order 1 the
        probabilities maximise P(fates) / P(the last packet arrives | the first arrived), and the intervals come from
        the profile of that likelihood. For higher orders only the packets between the ends are counted.

        Args:
            fates: stretches of packets in order of sending, 0 (arrived), 1 (lost) or NaN (unknown); one array or
                several.
            order: how many of the last fates the probability of a loss depends on.
            intervals: whether to compute confidence intervals (of order 1).

        Raises:
            ValueError: an argument that is no fates, or an order that is not from 1 to 12.
        """
        if check_count("order", order) > 12:
            raise fail("order", "at most 12 packets back", order)
        # counts[past, fate]: how often each fate followed each pattern of last fates, patterns numbered in binary.
        counts = np.zeros((2**order, 2))
        stretches = check_fates(fates)
        for stretch in stretches:
            # `past`: number of the pattern before each packet. `length`: how many of its fates are known.
            past, length = _number_last_fates(fill_ends(stretch), order)
            # For order 1 P(fates) has the step to the end as a factor, so it is counted too; P(the end arrives) is
            # divided out below. `np.add.at` counts a past each time that it comes.
            counted = (length == order) & (~np.isnan(stretch) if order == 1 else find_trials(stretch))
            np.add.at(counts, (past[counted], fill_ends(stretch)[counted].astype(int)), 1.0)
        # Lengths of the stretches that were cut where packets arrived, for the division by P(the last packet arrives).
        spans = _measure_spans(stretches)
        return _condition_on_ends(counts, spans, intervals) if order == 1 and len(spans) else MarkovLosses(counts)

    @property
    def order(self) -> int:
        """Number of packets back on which the probability depends: `counts` has 2^order rows."""
        return len(self.counts).bit_length() - 1

    def shares(self) -> dict[str, Share]:
        """Return the law's probabilities with 95 % intervals, by name.

        For order 1 they are "fail", P(lost | the last arrived), and "recover", P(arrived | the last was lost). For a
        higher order it is "loss_after_PAST", P(lost | PAST), for each past: its digits are the last fates, 1 for a
        loss, the latest one last. Intervals are Wilson's of the counts, or those of the likelihood if stretches were
        cut where packets arrived (`given_ends`).
        """
        if self.given_ends is not None:
            return dict(zip(("fail", "recover"), self.given_ends, strict=True))
        if self.order == 1:
            (stayed, failed), (recovered, lost) = self.counts
            return {"fail": wilson(failed, stayed + failed), "recover": wilson(recovered, recovered + lost)}
        names = [f"loss_after_{past:0{self.order}b}" for past in range(len(self.counts))]
        return {name: wilson(lost, arrived + lost) for name, (arrived, lost) in zip(names, self.counts, strict=True)}

    def predicted(self, fate: Packets) -> Packets:
        """Return the probability of each packet's loss, (k + 1/2) / (n + 1) if k of n packets with its past were lost.

        The past of a packet are the last fates before it that are known without a gap, at most `order` of them. They
        are written as a number whose bit 0 is the latest fate (1: lost). `fate` (packets,): 0 arrived, 1 lost, NaN
        unknown. `counts` (2^order, 2): how many packets arrived and were lost after each past.
        """
        past, length = _number_last_fates(fate, self.order)
        probabilities = np.zeros(len(fate))
        for known in range(self.order + 1):
            # (arrived, lost) after the last `known` fates (2^known, 2), summed over fates further back.
            arrived, lost = self.counts.reshape(-1, 2**known, 2).sum(axis=0).T
            probability_after = (lost + 0.5) / (arrived + lost + 1)
            has_length = length == known
            # `past` has only its `known` lowest bits; the mask keeps the index within 2^known.
            probabilities[has_length] = probability_after[past[has_length] & (2**known - 1)]
        return probabilities

    def _compute_return_probability(self, steps: int) -> float:
        """Return P(a packet arrives | the packet `steps` before it arrived), if nothing is known of those between.

        For order 1 it is (b + a (1 - a - b)^steps) / (a + b) with a = P(lost | arrived) and b = P(arrived | lost).
        `predicted` returns P(lost) of each packet, of which the second is asked.
        """
        if self.order > 1:
            return super()._compute_return_probability(steps)
        # P(lost) of the second of two packets, whose first arrived or was lost.
        (_, lost_after_arrival), (_, lost_after_loss) = (
            self.predicted(np.array([fate, np.nan])) for fate in (0.0, 1.0)
        )
        a, b = lost_after_arrival, 1 - lost_after_loss
        return float((b + a * (1 - a - b) ** steps) / (a + b))

    def channel(self, link: AbstractRandomAffine) -> AbstractRandomAffine:
        """Return the link with these losses: a Markov chain whose modes are the fates of the last `order` packets.

        A mode whose last packet was lost lets nothing pass (an `erasure` that arrives with probability 0), any other
        one is the link. P(lost | past) is the share of losses among the packets with this past, or 1/2 of a past that
        was never seen. `link`: the channel without losses. `gilbert_elliott` and `markov_fading` switch between
        channels by a Markov chain, of two modes or more.
        """
        arrives, lost = erasure(link, 1.0), erasure(link, 0.0)
        if self.order == 1:
            fail, recover = (0.5 if np.isnan(share.estimate) else share.estimate for share in self.shares().values())
            return gilbert_elliott(arrives, lost, fail, recover)
        # P(lost | past) for each past, a number whose bits are the last fates, the latest one lowest.
        total = self.counts.sum(axis=1)
        p = np.where(total > 0, self.counts[:, 1], 0.5) / np.where(total > 0, total, 1.0)
        # The next past is the old one shifted left by a bit: the new fate becomes its lowest bit, the oldest drops out.
        pasts = np.arange(len(p))
        transition = np.zeros((len(p), len(p)))
        transition[pasts, (pasts << 1) & (len(p) - 1)] += 1 - p
        transition[pasts, ((pasts << 1) | 1) & (len(p) - 1)] += p
        return markov_fading([lost if past & 1 else arrives for past in pasts], MarkovChain(transition))


def _measure_spans(parts: Fates) -> np.ndarray:
    """Return the steps from the first to the last packet of each stretch that was cut where packets arrived.

    Such a stretch has CHOSEN as the fate of its ends. `parts`: all stretches, of which others are left out.
    """
    return np.array([len(fate) - 1 for fate in parts if fate[-1] == CHOSEN and len(fate) > 1])


def _condition_on_ends(counts: np.ndarray, spans: np.ndarray, intervals: bool) -> MarkovLosses:
    """Return the Markov law of order 1 that is most likely given that each stretch was cut where packets arrived.

    A stretch of packets begins and ends with one that arrived, since nothing outside is known; plain counts of losses
    would be biased by that. So the law's two probabilities maximise the likelihood given both ends. Its `counts` are
    then n p and n (1 - p) after an arrival, and after a loss, with p the most likely probability and
    n = 1 / (p (1 - p) Var(logit p)), the number of plain trials that have this variance (at most the number of packets
    counted).

    Args:
        counts: (arrived, lost) after an arrival and after a loss (2, 2).
        spans: steps from the first to the last packet of each such stretch (stretches,).
        intervals: whether the intervals of the two probabilities are computed too.
    """
    # The most likely logits of P(lost | arrived) and P(arrived | lost), searched from three starts.
    likelihood = _LikelihoodBetweenEnds(counts, spans).evaluate
    top, value = maximise_over_shares(likelihood, [logits(0.1, 0.5), logits(0.3, 0.3), logits(0.02, 0.9)])
    # Variances of the logits: the diagonal of the inverse Hessian of -log likelihood, by central differences of its
    # gradient. Over this width a difference is wrong by 1e-8 of it, and its rounding is 1e-12.
    width = 1e-4
    shifts = width * np.eye(2)

    def gradient_at(x: np.ndarray) -> np.ndarray:
        """Return the gradient of the log-likelihood at logits x (2,)."""
        _, gradient = likelihood(x)
        return gradient

    hessian = np.stack([gradient_at(top - shift) - gradient_at(top + shift) for shift in shifts]) / (2 * width)
    variances = np.diag(np.linalg.pinv((hessian + hessian.T) / 2))
    # n of each probability, and the equivalent counts [[n (1 - fail), n fail], [n recover, n (1 - recover)]].
    fail, recover = shares = 1 / (1 + np.exp(-top))
    packets = np.clip(1 / np.maximum(variances * shares * (1 - shares), 1e-300), 0.0, counts.sum(axis=1))
    equivalent = packets[:, None] * np.array([[1 - fail, fail], [recover, 1 - recover]])
    share_of_fail, share_of_recover = estimate_shares(likelihood, top, value, intervals)
    if not counts[1].any():  # without losses nothing tells how they end
        share_of_recover = wilson(0, 0)
    return MarkovLosses(np.asarray(equivalent), (share_of_fail, share_of_recover))


class _LikelihoodBetweenEnds(NamedTuple):
    """Log-likelihood of a Markov law of order 1 for stretches that were chosen for ending with an arrival.

    Args:
        counts: (arrived, lost) after an arrival and after a loss (2, 2).
        spans: steps m from the first to the last packet of each stretch (stretches,).
    """

    counts: np.ndarray
    spans: np.ndarray

    def evaluate(self, x: np.ndarray) -> tuple[float, np.ndarray]:
        """Return l = sum n log p - sum_spans log P_m, and its gradient (2,), at the logits x (2,) of (a, b).

        a = P(lost | arrived before) and b = P(arrived | lost before). n are the `counts` of arrivals and losses after
        either fate, and p their probabilities 1 - a, a, b, 1 - b. A stretch cut at two arrivals m steps apart (`spans`)
        is likely given its ends: P(fates) / P_m, with P_m = (b + a (1 - a - b)^m) / (a + b) the probability that the
        chain is in arrival m steps after an arrival.
        """
        a, b = shares = 1 / (1 + np.exp(-x))
        # P_m = numerator / total. The derivative of power = (1 - a - b)^m by a, and by b, is `slope`.
        eigenvalue = 1 - a - b
        power = eigenvalue**self.spans
        slope = -self.spans * eigenvalue ** (self.spans - 1.0)
        numerator = b + a * power
        total = a + b
        by_a = (power + a * slope) / numerator - 1 / total  # d log P_m / da
        by_b = (1 + a * slope) / numerator - 1 / total  # d log P_m / db
        (stayed, failed), (recovered, lost) = self.counts
        value = stayed * np.log1p(-a) + failed * np.log(a) + recovered * np.log(b) + lost * np.log1p(-b)
        score = np.array([failed / a - stayed / (1 - a) - by_a.sum(), recovered / b - lost / (1 - b) - by_b.sum()])
        # The derivative by a logit has the factor dp / d logit p = p (1 - p).
        return float(value - np.sum(np.log(numerator / total))), score * shares * (1 - shares)


def _number_last_fates(fate: Packets, order: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the last fates before each packet as a binary number, and how many are known without a gap (packets,).

    Bit 0 of the number is the fate of the packet just before, 1 for a loss; bit 1 that of the one before it. The number
    has as many bits as fates are known, at most `order`.
    """
    number = np.zeros(len(fate), dtype=int)
    length = np.zeros(len(fate), dtype=int)  # how many of the last fates are known
    for back in range(1, order + 1):
        # The fate `back` packets ago counts only if all later ones are known.
        earlier = np.concatenate([np.full(back, np.nan), fate])[: len(fate)]
        is_unbroken = (length == back - 1) & ~np.isnan(earlier)
        number += np.where(is_unbroken, np.nan_to_num(earlier).astype(int) << (back - 1), 0)
        length += is_unbroken
    return number, length
