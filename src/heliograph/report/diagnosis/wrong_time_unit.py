"""Times in another unit than the plant's: thousandths of seconds, or thousands, for seconds."""

from collections.abc import Sequence

import numpy as np

from heliograph.filters.base import AbstractFilter
from heliograph.model.plant import TIME_STEP
from heliograph.numerics.types import ArrayLike, Float

CLEAR = np.log(1e6)  # of a likelihood ratio, from which one unit explains what another does not
AS_CLAIMED = 1.25  # ratio of a mean square of innovations to its claim, or the reverse
UNITS = {1e-3: "a thousandth of dt, as of times in milliseconds", 1e3: "a thousand times dt, as of times in thousands"}


def describe_wrong_time_unit(
    name: str,
    filter: AbstractFilter,
    measurements: Float[np.ndarray, "time m"],
    inputs: Float[np.ndarray, "time inputs"],
    names: Sequence[str],
) -> str:
    """Return the sentence that times seem to be in another unit than the plant's; "" if they do not.

    A common error is a recording in milliseconds for a plant in seconds. The filter runs on the recording as it is, and
    with dt in other units. The sentence is returned if the innovations agree with their claimed covariances in another
    unit alone, and the log likelihood is clearly higher there. "Clearly" is by CLEAR = log 10^6.

    Args:
        name: name of the filter.
        filter: a filter that claims a covariance.
        measurements: what it received (time, m), NaN where nothing arrived.
        inputs: its inputs (time, inputs); one of them is dt, the time between rows, else "" is returned.
        names: names of the inputs.
    """
    if TIME_STEP not in names:
        return ""
    column = list(names).index(TIME_STEP)
    as_stated = filter.run(measurements, inputs)
    if _is_as_claimed(as_stated.innovations, as_stated.innovation_covariances):
        return ""
    # A thousandth and a thousand times dt, with words for each.
    for factor, words in UNITS.items():
        scaled = np.array(inputs, dtype=float)
        scaled[:, column] *= factor
        in_unit = filter.run(measurements, scaled)
        gain = in_unit.log_likelihood - as_stated.log_likelihood
        if gain > CLEAR and _is_as_claimed(in_unit.innovations, in_unit.innovation_covariances):
            # The first row has none before it, so that its dt says little.
            usual = float(np.median(inputs[1:, column])) if len(inputs) > 1 else float(inputs[0, column])
            return (
                f"dt is {usual:g} between rows, and seems to be in another unit than the plant: with {words}, "
                f"innovations of {name} are as claimed (log likelihood higher by {gain:,.0f})"
            )
    return ""


def _is_as_claimed(innovations: ArrayLike, covariances: ArrayLike) -> bool:
    """Return whether the mean square of innovations (time, m) over their variances is about 1.

    "About 1" means between 1 / AS_CLAIMED and AS_CLAIMED (1.25). Numbers that did not arrive are NaN and do not count.
    """
    variance = np.diagonal(np.asarray(covariances), axis1=1, axis2=2)
    with np.errstate(divide="ignore", invalid="ignore"):
        squares = np.asarray(innovations) ** 2 / variance
    squares = squares[np.isfinite(squares)]
    return len(squares) > 0 and 1 / AS_CLAIMED < float(np.mean(squares)) < AS_CLAIMED
