"""Innovations: value, covariance under the filter's model and log-likelihood of each, and a summary of many."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.model.estimate import Innovation
from heliograph.numerics.confidence_intervals import Share, count_independent, round_to, wilson
from heliograph.numerics.gaussian_density import log_density
from heliograph.numerics.module import readable
from heliograph.numerics.trace_settings import writes_for_derivatives
from heliograph.numerics.types import Array, Float


def gaussian_innovation(
    z: "Float[Array, ' m']", expected: "Float[Array, ' m']", covariance: "Float[Array, 'm m']"
) -> "Innovation":
    """Return the innovation z - expected with its covariance and Gaussian log-likelihood.

    Value and covariance are NaN where a component did not arrive, and the likelihood is that of the others.

    Args:
        z: measurement (m,), NaN for a component that did not arrive.
        expected: its predicted mean (m,).
        covariance: the innovation covariance (m, m).
    """
    present = ~jnp.isnan(z)
    value = jnp.asarray(z - expected)
    both_present = present[:, None] & present
    size = jnp.abs(z) + jnp.abs(expected)  # the difference is rounded relative to the size of both terms
    log_likelihood = log_density(value, jnp.asarray(covariance), size)
    return Innovation(value, jnp.where(both_present, covariance, jnp.nan), log_likelihood)


def no_innovation() -> Innovation:
    """Return the empty innovation of a filter that uses no measurements."""
    return Innovation(jnp.zeros(0), jnp.zeros((0, 0)), jnp.zeros(()))


def mixed_innovation(
    weight: "Float[Array, ' parts']",
    value: "Float[Array, 'parts m']",
    total: "Float[Array, 'parts m m']",
    density: "Float[Array, '']",
) -> "Innovation":
    """Return the innovation of a mixture: its covariance is the mean covariance within plus that of the means.

    Args:
        weight: prior probability (parts,) of each component.
        value: its innovation (parts, m).
        total: its innovation covariance (parts, m, m).
        density: log-likelihood of z under the mixture.
    """
    if not writes_for_derivatives():
        return innovation_of_mean_covariance(weight, value, jnp.einsum("a,aij->ij", weight, total), density)
    # 0 times NaN is NaN, in derivatives too: what did not arrive is 0 in the sums.
    arrived = ~jnp.isnan(value[0])
    both = arrived[:, None] & arrived
    within = jnp.einsum("a,aij->ij", weight, jnp.where(both, total, 0.0))
    mixed = innovation_of_mean_covariance(weight, jnp.where(arrived, value, 0.0), within, density)
    return Innovation(
        value=jnp.where(arrived, mixed.value, jnp.nan),
        covariance=jnp.where(both, mixed.covariance, jnp.nan),
        log_likelihood=jnp.where(jnp.any(arrived), density, 0.0),
    )


def innovation_of_mean_covariance(
    weight: "Float[Array, ' parts']",
    value: "Float[Array, 'parts m']",
    within: "Float[Array, 'm m']",
    density: "Float[Array, '']",
) -> "Innovation":
    """Return the innovation of a mixture, by the mean covariance within its components.

    The covariance is the mean covariance within the components plus the covariance of their means.

    Args:
        weight: prior probability (parts,) of each component.
        value: its innovation (parts, m).
        within: mean over the components of their innovation covariances (m, m).
        density: log-likelihood of z under the mixture.
    """
    # Differences from the first value are taken, so that equal values, however large, leave no rounding.
    difference = value - value[0]
    mean_difference = weight @ difference
    mean = value[0] + mean_difference
    deviation = difference - mean_difference
    covariance = within + jnp.einsum("a,ai,aj->ij", weight, deviation, deviation)
    none_arrived = jnp.all(jnp.isnan(mean))  # then the density is 1, to rounding
    return Innovation(mean, covariance, jnp.where(none_arrived, 0.0, density))


def posterior_weights(
    weight: "Float[Array, ' parts']", likelihood: "Float[Array, ' parts']"
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return posterior weights of a mixture's components, the log-likelihood of z, and whether all exclude z.

    `weight` are the prior probabilities p_a. `likelihood` holds log N_a(z), which is -inf if component a excludes z.
    The posterior weights are p_a N_a(z) over their sum. If all components exclude z, the weights stay as they are.
    """
    # log p_a N_a(z), and -inf if p_a is 0, whatever the likelihood is.
    is_possible = jnp.asarray(weight) > 0
    log_prior = jnp.where(is_possible, jnp.log(jnp.where(is_possible, weight, 1.0)), -jnp.inf)
    log_posterior = jnp.where(is_possible, likelihood, 0.0) + log_prior
    all_excluded = jnp.max(log_posterior) == -jnp.inf
    possible = jnp.where(all_excluded, log_prior, log_posterior)
    if not writes_for_derivatives():
        return jax.nn.softmax(possible), jax.nn.logsumexp(log_posterior), all_excluded
    # A sum of zeros has a logarithm whose derivative, even where it is not used, is NaN.
    return jax.nn.softmax(possible), jnp.where(all_excluded, -jnp.inf, jax.nn.logsumexp(possible)), all_excluded


@readable
class Weighed(NamedTuple):
    """Innovations by component: value, variance, and weight in the update, (..., m) each; NaN where none arrived."""

    value: Array
    variance: Array
    weight: Array

    def summarise(self) -> "tuple[InnovationSummary, ...]":
        """Return a summary over time for each output, with shares and medians and their 95 % intervals.

        N values that are correlated over time count as N (1 - a) / (1 + a) independent ones, with a the correlation of
        neighbours. The share of down-weighted values has Wilson's interval. There a is the correlation of being
        down-weighted, since outliers come in runs. The median has the interval of the quantiles
        1/2 -+ 1.96 / (2 sqrt N). There a is the correlation of the innovations' ranks, on which outliers have little
        effect.
        """
        fields_by_output = [np.asarray(field).T for field in self]
        return tuple(_summarise_output(*of_output) for of_output in zip(*fields_by_output, strict=True))

    def square_used(self) -> Float[np.ndarray, "time m"]:
        """Return e^2 / variance of each innovation e with a weight of at least 1/2 (HALF), NaN for the others."""
        value, variance, weight = (np.asarray(column) for column in self)
        return np.where(weight >= HALF, value**2 / variance, np.nan)


HALF = 0.5  # weight below which a component counts as down-weighted
NORMAL = 1.96  # quantile of a 95 % interval
MOST = 0.5  # a share of values left out above this is no matter of outliers


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
        """Return one line, such as "7 of 200 down-weighted (2 % to 7 %), bias 0.14 +- 0.05"."""
        if not self.received:
            return f"received 0 of {self.expected}"
        share = f"({100 * self.share.low:.2g} % to {100 * self.share.high:.2g} %)"
        # Numbers are rounded to as many digits as their standard error, half the 95 % interval over 1.96, has.
        half_width = (self.bias_high - self.bias_low) / 2
        shown_bias, shown_half_width = (round_to(number, half_width / NORMAL) for number in (self.bias, half_width))
        return f"{self.down_weighted} of {self.received} down-weighted {share}, bias {shown_bias} +- {shown_half_width}"

    def describe_left_out(self, filter: str, output: str) -> list[str]:
        """Return a line of warning if a filter left out most values of an output, else an empty list.

        Outliers are never the most. The lower limit of the share's interval must be above MOST, one half.
        """
        if not self.share.low > MOST:
            return []
        return [
            f"{filter} left out {self.down_weighted} of {self.received} values of {output}: more than outliers would "
            "be; it may be wrong itself, by its start or after an outage, and then it does not come back"
        ]

    @staticmethod
    def find_outlying(summaries: "Sequence[InnovationSummary]") -> list[int]:
        """Return the indices of outputs with a larger share of down-weighted values than all others together.

        A filter against outliers gives values that do not fit a small weight; a sensor with many of them is suspect.
        Let p_1 be the share of down-weighted values of one output and p_2 that of the others together, with Wilson's
        95 % intervals (l, u). The output is named if p_1 - p_2 > sqrt((p_1 - l_1)^2 + (u_2 - p_2)^2). Of outputs that
        are alike, some 3 of 100 are named. `summary.independent` is the number of independent values that would give
        the same interval.

        Args:
            summaries: a summary of each output.

        Source: Newcombe, Interval estimation for the difference between independent proportions (1998), method 10.
        """
        outliers = []
        for i, summary in enumerate(summaries):
            # The other outputs that received anything.
            others = [other for j, other in enumerate(summaries) if j != i and other.received]
            if not summary.received or not others:
                continue
            # p_2, and its interval.
            pooled = sum(other.down_weighted for other in others) / sum(other.received for other in others)
            independent_count = sum(other.independent for other in others)
            interval_of_others = wilson(pooled * independent_count, independent_count)
            # p_1, and the test.
            share = summary.share
            if share.estimate - pooled > np.hypot(share.estimate - share.low, interval_of_others.high - pooled):
                outliers.append(i)
        return outliers


def _summarise_output(value: Float[np.ndarray, " time"], variance: np.ndarray, weight: np.ndarray) -> InnovationSummary:
    """Return counts, down-weighted share and median of one output's innovations, the latter two with their intervals.

    Args:
        value: innovations (time,), NaN where none arrived.
        variance: their variances under the filter's model (time,).
        weight: of each in the update (time,); below HALF it counts as down-weighted.
    """
    # Innovations e, weights w and normalised squares e^2 / variance of the steps at which something arrived.
    arrived = np.isfinite(value)
    e, w, squares = value[arrived], weight[arrived], value[arrived] ** 2 / variance[arrived]
    is_down_weighted, count = w < HALF, len(e)
    if not count:
        nan = float("nan")
        return InnovationSummary(
            expected=len(value), received=0, down_weighted=0, share=wilson(0, 0), independent=0.0,
            weight=nan, bias=nan, bias_low=nan, bias_high=nan, squared=nan,
        )  # fmt: skip
    # The median lies with probability 95 % between the quantiles 1/2 -+ 1.96 / (2 sqrt N), for N independent values.
    # Innovations are correlated in time, so N is the number of independent values that tell the median as well. It is
    # found by the correlation of ranks, since outliers would dominate the correlation of the values.
    ranks = np.argsort(np.argsort(e)).astype(float)
    reach = NORMAL / (2 * np.sqrt(count_independent(ranks)))
    low, median, high = np.quantile(e, [max(0.5 - reach, 0.0), 0.5, min(0.5 + reach, 1.0)])
    # The number of independent values for the down-weighted share: by the correlation of being down-weighted.
    down = int(np.sum(is_down_weighted))
    independent = count_independent(is_down_weighted.astype(float))
    return InnovationSummary(
        expected=len(value),
        received=count,
        down_weighted=down,
        share=wilson(down / count * independent, independent),
        independent=independent,
        weight=float(w.mean()),
        bias=float(median),
        bias_low=float(low),
        bias_high=float(high),
        squared=float(squares.mean()),
    )
