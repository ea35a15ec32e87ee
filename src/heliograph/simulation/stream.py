"""One filter on live data: push a measurement, read the estimate."""

from heliograph.filters.base import AbstractFilter
from heliograph.model.estimate import Estimate
from heliograph.numerics.types import ArrayLike


class Stream:
    """Feed a filter one sample at a time; it holds the filter's state and the step counter.

    The numbers are those of `run` over the same data.
    """

    def __init__(self, filter_: AbstractFilter):
        self.filter = filter_
        self.steps = 0
        self._state = filter_.init()

    def push(self, measurement: ArrayLike, inputs: ArrayLike = ()) -> Estimate:
        """Advance one step: `inputs` led to this `measurement` (NaN where a component did not arrive).

        Raises:
            ValueError: a measurement or inputs that are not the filter's, infinite values, an input that is NaN, a
                step past the end of what varies over time; the state stays as it was.
        """
        self._state, estimate = self.filter.step(self._state, measurement, inputs, self.steps)
        self.steps += 1
        return estimate
