"""Summary of innovations, one output at a time: how many were down-weighted, their bias, and their size."""

from typing import NamedTuple

import numpy as np

from heliograph.model.estimate import Innovation
from heliograph.numerics.readable import readable
from heliograph.numerics.shares import Share, wilson
from heliograph.numerics.types import Float

HALF = 0.5  # weight below which a component counts as down-weighted
NORMAL = 1.96  # quantile of a 95 % interval


@readable
class InnovationSummary(NamedTuple):
    """Summary of the innovations of one output.

    Args:
        expected: number of steps.
        received: number of values that arrived.
        down_weighted: number of them with a weight below 1/2.
        share: share of these, with Wilson's interval.
        independent: number of values that say as much of the share, were they independent.
        weight: mean weight; 1 of a filter that weighs nothing.
        bias: median of the innovations, in the output's unit.
        bias_low: lower end of its 95 % interval.
        bias_high: upper end.
        squared: mean of the innovation's square over its variance; 1 where the model is right.
    """

    expected: int
    received: int
    down_weighted: int
    share: Share
    independent: float
    weight: float
    bias: float
    bias_low: float
    bias_high: float
    squared: float

    def __str__(self) -> str:
        """One line, such as "7 of 200 down-weighted (2 % to 7 %), bias 0.14 +- 0.05"."""
        if not self.received:
            return f"received 0 of {self.expected}"
        share = f"({100 * self.share.low:.2g} % to {100 * self.share.high:.2g} %)"
        half = (self.bias_high - self.bias_low) / 2
        return f"{self.down_weighted} of {self.received} down-weighted {share}, bias {self.bias:.2g} +- {half:.1g}"


def summarise_innovations(innovation: Innovation) -> tuple[InnovationSummary, ...]:
    """Summarise innovations over time, one output after the other.

    Intervals count N values that are correlated over time as N (1 - a) / (1 + a), a the correlation of neighbours: of
    the share Wilson's, with a of being down-weighted or not, since outliers come in runs behind a moving mean; of the
    median the quantiles 1/2 -+ 1.96 / (2 sqrt N), with a of the innovations by ranks, which outliers do not hide.

    Args:
        innovation: values (time, m) with covariance (time, m, m), NaN where nothing arrived, and weight (time, m).
    """
    value = np.asarray(innovation.value)
    variance = np.diagonal(np.asarray(innovation.covariance), axis1=-2, axis2=-1)
    weight = np.ones_like(value) if innovation.weight is None else np.asarray(innovation.weight)
    return tuple(_summary(*columns) for columns in zip(value.T, variance.T, weight.T, strict=True))


def _summary(value: Float[np.ndarray, " time"], variance: np.ndarray, weight: np.ndarray) -> InnovationSummary:
    there = np.isfinite(value)
    e, w, d2 = value[there], weight[there], value[there] ** 2 / variance[there]
    down, count = int(np.sum(w < HALF)), len(e)
    if not count:
        return InnovationSummary(len(value), 0, 0, wilson(0, 0), 0.0, *[float("nan")] * 5)
    # What counts as independent: neighbours that are alike say less.
    independent = _independent(np.argsort(np.argsort(e)).astype(float))
    # The median's interval holds the quantiles between which it lies with 95 %.
    reach = NORMAL / (2 * np.sqrt(independent))
    low, middle, high = np.quantile(e, [max(0.5 - reach, 0.0), 0.5, min(0.5 + reach, 1.0)])
    doubted = _independent((w < HALF).astype(float))
    share = wilson(down / count * doubted, doubted)
    numbers = (float(x) for x in (w.mean(), middle, low, high, d2.mean()))
    return InnovationSummary(len(value), count, down, share, doubted, *numbers)


def _independent(values: Float[np.ndarray, " time"]) -> float:
    """N (1 - a) / (1 + a), a the correlation of neighbours from 0 to 0.999; at least 1."""
    apart = values - np.mean(values)
    power = float(np.sum(apart**2))
    a = np.clip(np.sum(apart[1:] * apart[:-1]) / power, 0.0, 0.999) if power and len(values) > 2 else 0.0
    return max(float(len(values) * (1 - a) / (1 + a)), 1.0)


def outlying(summaries: tuple[InnovationSummary, ...]) -> list[int]:
    """Outputs of which more values are down-weighted than of the others together, by an interval of the difference.

    Shares p with intervals (l, u), of one output and of the others together: p_1 - p_2 is above 0 by more than
    sqrt((p_1 - l_1)^2 + (u_2 - p_2)^2). Of outputs that are alike some 3 of 100 are named.

    Args:
        summaries: one of each output.

    Source: Newcombe, Interval estimation for the difference between independent proportions (1998), method 10.
    """
    result = []
    for i, summary in enumerate(summaries):
        others = [other for j, other in enumerate(summaries) if j != i and other.received]
        if not summary.received or not others:
            continue
        pooled = sum(other.down_weighted for other in others) / sum(other.received for other in others)
        independent = sum(other.independent for other in others)
        rest = wilson(pooled * independent, independent)
        share = summary.share
        if share.estimate - pooled > np.hypot(share.estimate - share.low, rest.high - pooled):
            result.append(i)
    return result
