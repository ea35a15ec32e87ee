"""Description of a channel in words: its hops in order, what is lost and how late, and what they share."""

import numpy as np

from heliograph.model.channel import Channel
from heliograph.model.over_time import OverTime, first
from heliograph.numerics.traced import is_traced
from heliograph.random_affine.base import AbstractModal, AbstractRandomAffine, fold
from heliograph.random_affine.combine import GainAndNoise, Mixture, Series, Stack
from heliograph.random_affine.delay import Delayed, OfLine
from heliograph.random_affine.erasure import Erasure
from heliograph.random_affine.law import Constant
from heliograph.random_affine.modes import Faded, Modes

ARROW, DIRECT = " → ", "direct"


def link_in_words(channel: Channel) -> str:
    """Return a channel in words, such as "Rician hop → hop of gain 1.1, 10% lost"; `direct` where z = y."""
    if isinstance(channel, OverTime):
        return f"varying over time, at first {link_in_words(first(channel))}"
    if is_traced(channel):
        return type(channel).__name__
    return _words(channel) or DIRECT


def _words(channel: AbstractRandomAffine) -> str:
    """Return a map in words; nothing for one that only selects components."""
    in_words: str = fold(channel, {
        # One case for each way of making a channel.
        GainAndNoise: lambda hop, _: _hop(hop),
        Series: lambda _, parts: ARROW.join(filter(None, parts)),
        Stack: lambda _, parts: _stack([words or DIRECT for words in parts]),
        Erasure: lambda loss, parts: f"{parts[0] or DIRECT}, {_percent(1 - loss.arrival)} lost",
        Mixture: lambda mixture, parts: _mixture(mixture, [words or DIRECT for words in parts]),
        # Links that deliver late, and those whose modes remember.
        Delayed: lambda late, parts: f"{parts[0] or DIRECT}, {'/'.join(map(str, late.times))} steps late"
                                     f"{', timestamped' if late.timestamped else ''}",
        OfLine: lambda _, parts: parts[0],
        Modes: lambda modes, parts: f"{_memory(modes)}modes ({' or '.join(words or DIRECT for words in parts)})",
        Faded: lambda faded, _: f"{_memory(faded)}drifting hop",
        AbstractRandomAffine: lambda other, _: type(other).__name__,
    })  # fmt: skip
    return in_words


def _stack(parts: list[str]) -> str:
    return f"{len(parts)} × ({parts[0]})" if len(set(parts)) == 1 else f"({' | '.join(parts)})"


def _hop(hop: GainAndNoise) -> str:
    """Return one hop in words by its law, its gain where that is one known number, and whether it adds noise."""
    matrix = np.asarray(hop.matrix)
    silent = not (np.any(np.asarray(hop.noise.covariance)) or np.any(np.asarray(hop.noise.mean)))
    if not matrix.any():
        return "nothing sent"
    diagonal = matrix.shape[0] == matrix.shape[1] and np.array_equal(matrix, matrix[0, 0] * np.eye(len(matrix)))
    if not isinstance(hop.law, Constant):
        return f"{type(hop.law).__name__} hop"
    gain = float(hop.law.value) * matrix[0, 0] if diagonal else np.nan
    selects = float(hop.law.value) == 1 and np.isin(matrix, (0, 1)).all() and (matrix.sum(axis=1) == 1).all()
    if silent and (gain == 1 or selects):
        return ""
    kind = "known gain" if silent else "hop"
    return f"{kind} {gain:.3g}" if diagonal and gain != 1 else kind


def _mixture(channel: Mixture, parts: list[str]) -> str:
    """Return a mixture in words; of a channel and silence, as a loss that nobody notices."""
    shares = channel.choice.probabilities
    if len(parts) == 2 and parts[1] == "nothing sent":
        return f"{parts[0]}, {_percent(shares[1])} lost unnoticed"
    return f"({' or '.join(f'{words} ({_percent(p)})' for words, p in zip(parts, shares, strict=True))})"


def _memory(channel: AbstractModal) -> str:
    return "" if channel.memory.name is None else f"{channel.memory.name!r}: "


def _percent(share: object) -> str:
    return f"{100 * float(np.asarray(share)):.3g}%"
