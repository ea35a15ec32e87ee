"""What single precision leaves of numbers that are far from zero, as the header says it of a filter."""

import math

import numpy as np

from heliograph.factors.high_low_mean_gaussian import SplitMeanGaussian
from heliograph.filters.base import AbstractFilter
from heliograph.model.over_time import first
from heliograph.random_affine.base import AbstractRandomAffine
from heliograph.random_affine.moments.second_moments import second_order
from heliograph.random_affine.noises.noise import AbstractNoise

SHARE = 0.01  # of a measurement's noise that its rounding may be
HALF_UNIT = 2.0**-24  # by which single precision rounds, of the number


def explain_ranges(filter: AbstractFilter) -> list[str]:
    """Return a note for each component of z: up to which size rounding is small beside its noise; "" if unknown.

    HALF_UNIT is the largest relative error of rounding to single precision. SHARE is the largest share of the noise's
    deviation that rounding may have. So the largest size is SHARE (0.01) deviation / HALF_UNIT (2^-24).
    """
    deviations = _find_noise_deviations(filter)
    if deviations is None:
        return [""] * filter.received
    notes = []
    for deviation in deviations:
        largest = _round_down(SHARE * deviation / HALF_UNIT) if deviation > 0 else 0.0
        notes.append(f" (up to {largest:g}, see below)" if deviation > 0 else "")
    return notes


def explain_rounding(filter: AbstractFilter, ranged: bool) -> list[str]:
    """Return lines for the C header on the ranges of z (if `ranged`), and on the mean's low digits if there are any.

    A state in single precision may keep the digits of the mean that a float leaves out, in a second array `low`.
    """
    on_ranges = [
        "Up to the size that is noted, single precision rounds a component of z by a hundredth of its noise at most;",
        "beyond it take an origin off before it becomes a float, and off plant and sensor.",
    ]
    on_low_digits = [
        "mean is rounded to single precision. What that leaves out of mean[i] is state->low[i]: take an origin off",
        "mean[i] first, and then add it.",
    ]
    has_low_digits = isinstance(filter.init(), SplitMeanGaussian)
    return [*(on_ranges if ranged else []), *(on_low_digits if has_low_digits else [])]


def _find_noise_deviations(filter: AbstractFilter) -> np.ndarray | None:
    """Return the standard deviation of the noise of each component of z (received,); None of a filter that has none.

    The noise of z is M v + n: the sensor's noise v times the link's mean gain M, and the link's own noise n. A filter
    of which no sensor is known, or whose noise depends on the inputs, says none. `filter.assumed` are the plant, sensor
    and channel that the filter takes for true. `second_order` returns the link's mean gain M and its noise as columns
    with weights.
    """
    assumed = filter.assumed
    sensor = None if assumed is None or assumed.sensor is None else first(assumed.sensor)
    if assumed is None or sensor is None or not isinstance(sensor.noise, AbstractNoise):
        return None
    noise, link = np.asarray(sensor.noise.covariance), assumed.channel and first(assumed.channel)
    variances: np.ndarray = np.diagonal(noise)
    if isinstance(link, AbstractRandomAffine):
        try:
            moments = second_order(link)
        except ValueError:  # a link that remembers what it did before
            return None
        # The link's noise has the covariance C diag(weights) C', C the columns.
        gain, columns, weights = map(np.asarray, (moments.mean_gain, *moments.noise))
        if gain.shape[1] != len(noise):  # a link of what was sent before as well
            return None
        variances = np.diagonal(gain @ noise @ gain.T) + columns**2 @ weights
    return np.sqrt(variances) if len(variances) == filter.received else None


def _round_down(number: float) -> float:
    """Return a positive number rounded down to two digits, such as 0.012 for 0.0129."""
    unit = 10.0 ** (math.floor(math.log10(number)) - 1)
    return math.floor(number / unit) * unit
