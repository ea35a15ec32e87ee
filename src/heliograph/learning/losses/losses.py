"""Losses learned from a recording: laws fitted to them, tests of their memory, and the law that predicts best."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from heliograph.learning.long_run import mean_and_error
from heliograph.learning.losses.hidden_losses import HiddenModeLosses
from heliograph.learning.losses.loss_law import AbstractLossLaw, IndependentLosses, MarkovLosses
from heliograph.learning.losses.loss_tests import LossMemory, loss_memory
from heliograph.learning.losses.running_losses import RunningRateLosses
from heliograph.learning.losses.stretches import Fates, as_fates
from heliograph.numerics.check import fail, scalar, table
from heliograph.numerics.readable import readable
from heliograph.random_affine.base import AbstractRandomAffine

INDEPENDENT, HIDDEN, RUNNING = "independent", "hidden", "running"
LONG = 4  # packets back that the longer of the two chains looks


class HeldOutScores(NamedTuple):
    """Scores of a law on packets that it was not fitted to.

    log_likelihood: mean over packets, nats. gain: difference from that of independent losses; gain_error: its standard
    error, which allows for correlation over time.
    """

    log_likelihood: float
    gain: float
    gain_error: float


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
        best: name of the law that predicts best, "hidden" where nothing was held out.
    """

    packets: int
    lost: int
    laws: dict[str, AbstractLossLaw]
    memory: LossMemory
    held_out: dict[str, HeldOutScores]
    best: str

    def channel(self, link: AbstractRandomAffine) -> AbstractRandomAffine:
        """Link with the losses of the law that predicts best among those that a channel can have."""
        able = [name for name in self.laws if name != RUNNING]
        name = max(able, key=lambda item: self.held_out[item].log_likelihood) if self.held_out else self.best
        return self.laws[name].channel(link)


def learn_losses(fates: object, held_out: float = 1 / 3) -> Losses:
    """Fit four kinds of laws to losses, test for memory, and choose by how well the laws predict the later packets.

    Args:
        fates: a stretch of 0 (arrived), 1 (lost) and NaN (unknown), or several in the order of time, as
            `fates_of_sequence`, `fates_by_node`, `fates_by_hop` and `fates_of_measurements` give them.
        held_out: share of the packets, the last ones, that are not fitted to but choose; a third by default.

    Raises:
        ValueError: what is no fates, a share outside [0, 1).
    """
    parts = as_fates(fates)
    share = float(scalar("held-out share", held_out, 0.0, 1.0))
    if share == 1.0:
        raise fail("held-out share", "less than 1: something must be fitted", share)
    known = ~np.isnan(np.concatenate(parts))
    cut = int(np.floor(known.sum() * (1 - share)))
    held_out_scores = _held_out_scores(parts, known, cut) if 0 < cut < known.sum() else {}
    best = max(held_out_scores, key=lambda name: held_out_scores[name].log_likelihood) if held_out_scores else HIDDEN
    lost = int(np.nansum(np.concatenate(parts)))
    return Losses(int(known.sum()), lost, _fitted(parts, True), loss_memory(parts), held_out_scores, best)


def learn_losses_of(fates: Mapping[str, Fates], held_out: float = 1 / 3) -> dict[str, Losses]:
    """Learn the losses of each node or hop, by its name.

    Args:
        fates: {name: fates}, as `fates_by_node` and `fates_by_hop` give them.
        held_out: share of the packets that choose, as in `learn_losses`.

    Raises:
        ValueError: as `learn_losses`.
    """
    return {name: learn_losses(item, held_out) for name, item in table("fates", fates, "fates").items()}


def _fitted(parts: Fates, intervals: bool) -> dict[str, AbstractLossLaw]:
    return {
        INDEPENDENT: IndependentLosses.fit(parts),
        "markov": MarkovLosses.fit(parts),
        f"markov_{LONG}": MarkovLosses.fit(parts, LONG),
        HIDDEN: HiddenModeLosses.fit(parts, intervals),
        RUNNING: RunningRateLosses.fit(parts, intervals),
    }


def _held_out_scores(parts: Fates, known: np.ndarray, cut: int) -> dict[str, HeldOutScores]:
    """Fit to the first `cut` known packets, judge on the others, each given all before it."""
    everything = np.concatenate(parts)
    late = known & (np.cumsum(known) > cut)
    early = np.where(late, np.nan, everything)
    ends = np.cumsum([len(part) for part in parts])[:-1]
    laws = _fitted(np.split(early, ends), False)
    said = {name: law.log_likelihoods(parts)[late] for name, law in laws.items()}
    result = {}
    for name, item in said.items():
        gain, error = mean_and_error(item - said[INDEPENDENT])
        result[name] = HeldOutScores(float(item.mean()), gain, error)
    return result
