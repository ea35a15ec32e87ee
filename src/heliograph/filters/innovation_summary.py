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
    the share Wilson's, of the median the quantiles 1/2 -+ 1.96 / (2 sqrt N).

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
        return InnovationSummary(len(value), 0, 0, wilson(0, 0), *[float("nan")] * 5)
    # What counts as independent: neighbours that are alike say less.
    a = _correlation(e)
    independent = max(count * (1 - a) / (1 + a), 1.0)
    # The median's interval holds the quantiles between which it lies with 95 %.
    reach = NORMAL / (2 * np.sqrt(independent))
    low, middle, high = np.quantile(e, [max(0.5 - reach, 0.0), 0.5, min(0.5 + reach, 1.0)])
    share = wilson(down / count * independent, independent)
    numbers = (float(x) for x in (w.mean(), middle, low, high, d2.mean()))
    return InnovationSummary(len(value), count, down, share, *numbers)


def _correlation(e: Float[np.ndarray, " time"]) -> float:
    """Correlation of neighbours, by ranks so that single outliers do not hide it; from 0 to 0.999."""
    if len(e) < 3:
        return 0.0
    rank = np.argsort(np.argsort(e)) - (len(e) - 1) / 2
    return float(np.clip(np.sum(rank[1:] * rank[:-1]) / np.sum(rank**2), 0.0, 0.999))


def outlying(summaries: tuple[InnovationSummary, ...]) -> list[int]:
    """Outputs whose share of down-weighted values is above what the others have together, by their own interval.

    Args:
        summaries: one of each output.
    """
    result = []
    for i, summary in enumerate(summaries):
        others = [other for j, other in enumerate(summaries) if j != i]
        received = sum(other.received for other in others)
        pooled = sum(other.down_weighted for other in others) / received if received else np.nan
        if summary.received and summary.share.low > pooled:
            result.append(i)
    return result
