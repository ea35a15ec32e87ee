"""Comparison of two laws by a recording: a test of the mean difference of their log-likelihoods."""

from typing import NamedTuple

import numpy as np
from scipy.stats import norm

from heliograph.learning.likelihood.predictive_density import Predictive
from heliograph.learning.long_run import mean_and_error
from heliograph.numerics.check import fail, instance
from heliograph.numerics.readable import readable
from heliograph.numerics.types import Float


@readable
class Comparison(NamedTuple):
    """Test of whether a recording speaks for the first of two laws or for the second.

    Args:
        difference: mean of log p_a - log p_b per step, in nats.
        standard_error: its standard error, which allows for correlation over time.
        z: difference over standard error.
        p_value: two-sided p-value of z.
    """

    difference: float
    standard_error: float
    z: float
    p_value: float

    @property
    def decided(self) -> bool:
        """True if the data speak for one law at 5 %, the first where the difference is positive."""
        return self.p_value < 0.05


def compare_laws(a: Predictive, b: Predictive) -> Comparison:
    """Test whether two laws predict one recording equally well: z of the mean difference of log-likelihoods.

    Steps where nothing arrived do not count.

    Args:
        a: densities of the recording under the first law, from `predictive`.
        b: densities of the same recording under the second.

    Raises:
        ValueError: different recordings, or fewer than 10 steps with a measurement.
    Source: Vuong (1989); Newey and West (1987) for the standard error.
    """
    for name, item in (("first law", a), ("second law", b)):
        instance(name, item, Predictive, "what `predictive` gives")
    if a.pit.shape != b.pit.shape or np.any(np.isnan(a.pit) != np.isnan(b.pit)):
        raise fail("second law", "the same recording as the first", "another")
    received = ~np.all(np.isnan(a.pit), axis=1)
    if received.sum() < 10:
        raise fail("recording", "at least 10 steps with a measurement", int(received.sum()))
    return compared((a.log_likelihood - b.log_likelihood)[received])


def compared(differences: Float[np.ndarray, " steps"]) -> Comparison:
    """Test a mean difference (steps,) against zero."""
    mean, error = mean_and_error(differences)
    z = mean / error if error > 0 else 0.0
    return Comparison(mean, error, float(z), float(2 * norm.sf(abs(z))))
