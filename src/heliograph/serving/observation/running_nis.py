"""Running test of a covariance: the NIS of the newest rows of a filter, and the band in which it should be."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from scipy.special import gammaincinv

from heliograph.model.estimate import Claim

MEMORY = 200  # rows, of which an old one counts 1/e: long enough to judge, short enough to see a change
FEWEST = 20  # received components before a test is made
# Fields of a filter that weighs what it receives: innovation, its variance, and the weight that it got.
WEIGHED = ("value", "variance", "weight")
HALF = 0.5  # from this weight on a number counts as used
DOUBT = 0.001  # how often an honest filter is outside its band


@dataclass
class RunningNis:
    """Exponentially weighted sum of NIS values, e' S^-1 e, of a filter at a node: weights w^age, w = 1 - 1/MEMORY.

    If S is the true covariance each NIS is chi-squared with m degrees of freedom, the number of received components:
    the weighted sum has mean sum w m and variance sum w^2 2m. Divided by its mean it should be 1; its band is that of a
    gamma law with these two moments (the chi-squared law itself where all weights are 1).
    """

    claim: Claim
    total: float = 0.0
    mean: float = 0.0
    variance: float = 0.0
    numbers: int = 0

    def add(self, squared: float, received: int) -> None:
        """Add the NIS (normalised innovation squared) of one row with `received` numbers, its degrees of freedom m.

        Earlier rows are weighted by w = 1 - 1/MEMORY again. `total` is the weighted sum of NIS. If each NIS is
        chi-squared (mean m, variance 2 m), `mean` and `variance` are those of the total.
        """
        weight = 1 - 1 / MEMORY
        self.total = weight * self.total + squared
        self.mean = weight * self.mean + received
        self.variance = weight * weight * self.variance + 2 * received
        self.numbers += received

    @property
    def ratio(self) -> float:
        """Return the weighted sum over its expected value: about 1 if the covariance is right."""
        return self.total / self.mean if self.mean else float("nan")

    def band(self) -> tuple[float, float]:
        """Return the interval that contains the ratio with probability 1 - DOUBT if the covariance is right.

        The ratio is the weighted sum of NIS over its expectation. Its distribution is approximated by the gamma
        distribution of mean 1 and of the same variance, `variance` / `mean`^2. Without rows, every ratio is allowed.
        """
        if not self.mean:
            return 0.0, float("inf")
        shape = self.mean**2 / self.variance
        low, high = gammaincinv(shape, [DOUBT / 2, 1 - DOUBT / 2]) / shape
        return float(low), float(high)

    def explain_doubt(self) -> str | None:
        """Return in words why the claimed covariance is doubtful, or None if it is not or too few numbers came.

        It is if the ratio is outside its band; below the band only if the covariance is not claimed as an upper bound.
        """
        low, high = self.band()
        if self.numbers < FEWEST:
            return None
        if self.ratio > high:
            return f"its squared innovations are {self.ratio:.1f} times what its covariance says (at most {high:.1f})"
        if self.ratio < low and self.claim != "upper":  # an upper bound may be too large
            # Too small a ratio is no sign of safety: noises are stated too large, or an error changes slowly.
            small = f"its squared innovations are {self.ratio:.2g} times what its covariance says (at least {low:.1f})"
            return f"{small}: noises are stated too large, or an error changes slowly; `heliograph run --report` tells"
        return None


def read_nis(message: Mapping[str, Any]) -> tuple[float | None, int]:
    """Return the normalised innovation squared (NIS) of the numbers that a filter used, and how many they are.

    A filter that weighs what it receives says for each number its innovation, variance and weight. Its NIS is the sum
    of innovation^2 / variance over the numbers of weight 1/2 or more, so that outliers do not count. It is None if
    there are no such numbers. Of any other filter both stand in the message.

    Args:
        message: the filter's part of a published estimate: `nis`, `received`, and `outputs` if it weighs.
    """
    outputs = message.get("outputs")
    if message.get("nis") is None or not outputs:
        return message.get("nis"), message.get("received", 0)
    squares = list[float]()
    for innovation, variance, weight in zip(*(outputs[name] for name in WEIGHED), strict=True):
        if None not in (innovation, variance, weight) and weight >= HALF and variance > 0:
            squares.append(innovation**2 / variance)
    return (math.fsum(squares), len(squares)) if squares else (None, 0)
