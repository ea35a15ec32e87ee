"""One filter on live data: push a measurement, read the estimate."""

from typing import Any

import numpy as np

from heliograph.filters.base import AbstractFilter
from heliograph.model.estimate import Estimate
from heliograph.numerics.check import fail


class Stream:
    """Feed a filter one sample at a time; it holds the filter's state and the step counter.

    The numbers are those of `run` over the same data. Raises ValueError for a measurement that is infinite.
    """

    def __init__(self, filter_: AbstractFilter):
        self.filter = filter_
        self.steps = 0
        self._state = filter_.init()

    def push(self, measurement: Any, inputs: Any = ()) -> Estimate:
        """Advance one step: `inputs` led to this `measurement` (NaN where a component did not arrive).

        Raises:
            ValueError: an infinite measurement; the state stays as it was.
        """
        z = np.atleast_1d(np.asarray(measurement, dtype=np.float64))
        if np.any(np.isinf(z)):
            raise fail("measurement", "numbers, or NaN for what is missing", z.tolist())
        self._state, estimate = self.filter.step(self._state, z, np.asarray(inputs, dtype=np.float64), self.steps)
        self.steps += 1
        return estimate
