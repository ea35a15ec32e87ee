"""Losses whose rate drifts: the next packet is lost as often as the last ones were, with less weight further back."""

import numpy as np
from scipy.signal import lfilter
from scipy.special import expit

from heliograph.learning.losses.loss_law import AbstractLossLaw, Packets
from heliograph.learning.losses.shares import Share, logits, maximum, shares_at
from heliograph.learning.losses.stretches import as_fates

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
        parts = [part[~np.isnan(part)] for part in as_fates(fates)]

        def likelihood(x: np.ndarray) -> tuple[float, np.ndarray]:
            share = expit(x)
            ahead = [_ahead(part, *share) for part in parts]
            value, slope = (
                sum(column) for column in zip(*(_log(*a) for a in zip(parts, ahead, strict=True)), strict=True)
            )
            return float(value), np.asarray(slope * share * (1 - share))

        top, value = maximum(likelihood, [*STARTS])
        return RunningRateLosses(*shares_at(likelihood, top, value, intervals))

    def shares(self) -> dict[str, Share]:
        """Base, weight and step with likelihood intervals."""
        return {name: getattr(self, name) for name in ("base", "weight", "step")}

    def predicted(self, fate: Packets) -> Packets:
        """Probability of each loss by the running rate; an unknown fate leaves it where it is."""
        known = ~np.isnan(fate)
        at_known = _ahead(np.append(fate[known], 0.0), *(share.estimate for share in self.shares().values()))[0]
        return np.asarray(at_known[np.cumsum(known) - known])


def _ahead(lost: Packets, base: float, weight: float, step: float) -> tuple[Packets, Packets]:
    """P(lost) of each packet, and its derivatives (3, packets)."""
    before = np.concatenate([[0.0], lost - base])[:-1] if len(lost) else lost
    keep = [1.0, step - 1.0]
    rate = lfilter([step], keep, before)  # r - base, which starts at 0
    by_base = lfilter([step], keep, np.concatenate([[0.0], -np.ones(len(lost))])[: len(lost)])
    by_step = lfilter([1.0], keep, np.concatenate([[0.0], (lost - base - rate)])[: len(lost)])
    return base + weight * rate, np.stack([1 + weight * by_base, rate, weight * by_step])


def _log(lost: Packets, ahead: tuple[Packets, Packets]) -> tuple[float, np.ndarray]:
    p, slope = ahead
    p = np.clip(p, 1e-300, 1 - 1e-16)
    return float(np.sum(np.where(lost == 1, np.log(p), np.log1p(-p)))), slope @ ((lost - p) / (p * (1 - p)))
