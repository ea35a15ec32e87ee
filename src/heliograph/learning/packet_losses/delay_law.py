"""Law of the delays of a node's measurements, counted from the times when they were measured and logged."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from typing_extensions import TypeAliasType

from heliograph.numerics.check import TINY, array, fail, scalar
from heliograph.numerics.confidence_intervals import Share, count_independent, wilson
from heliograph.numerics.module import readable
from heliograph.numerics.types import ArrayLike, Float
from heliograph.random_affine.laws.law import Discrete

DelaysByNode = TypeAliasType("DelaysByNode", Mapping[str, "Delays"])


@readable
@dataclass(frozen=True)
class Delays:
    """Delays of measurements in whole steps, each with its probability and 95 % interval.

    Args:
        step: seconds of a step.
        counted: number of measurements.
        early: number of others that were logged more than half a step before they were measured, by clocks that are
            apart: of these nothing is known.
        shares: probability of each delay that occurred, by its steps.
    """

    step: float
    counted: int
    early: int
    shares: Mapping[int, Share]

    @property
    def law(self) -> Discrete:
        """The most likely law, for `heliograph.model.delayed(link, law)`."""
        return Discrete(
            np.array([float(steps) for steps in self.shares]), np.array([s.estimate for s in self.shares.values()])
        )

    def __str__(self) -> str:
        """Return a line with each delay in seconds, its probability and 95 % interval: "late by 1 s 0.9 (0.8 to 0.95)".

        `self.shares`: {delay in steps: its probability, with the ends of the interval}. `self.step`: seconds of a step.
        `self.counted`: number of measurements that were used. `self.early`: number of those that were logged before
        their time, which are not counted.
        """
        shares = [f"{steps * self.step:g} s {s.estimate:.3g} ({s.low:.2g} to {s.high:.2g})"
                  for steps, s in self.shares.items()]  # fmt: skip
        early = f"; {self.early} more were logged before they were measured" if self.early else ""
        return f"late by {', '.join(shares)}, of {self.counted} measurements{early}"


def learn_delays(late: "Float[ArrayLike, ' measurements']", step: "Float[ArrayLike, '']") -> Delays:
    """Learn the law of delays from how late each measurement was logged, in the order of measuring.

    A delay is a whole number of steps. Its share of the measurements is its most likely probability, and Wilson's
    interval says how well it is known. A link is late for a while at a time, so N measurements with correlation a
    between neighbours count as only N (1 - a) / (1 + a) independent ones. Measurements that were logged before their
    time are counted, but not used.

    Args:
        late: seconds from measuring to logging, for each measurement.
        step: seconds of a step; delays are rounded to whole steps.

    Raises:
        ValueError: no measurement that was logged after its time, a step that is not positive.
    """
    seconds = array("delays", late, (None,))
    size = float(scalar("step of delays", step, TINY))
    steps = np.floor(seconds / size + 0.5).astype(np.int64)
    # Delays below 0 are errors of clocks.
    known = steps[steps >= 0]
    if not len(known):
        raise fail("delays", "at least one measurement that was logged after its time", f"{len(steps)} before it")
    shares = {}
    for delay in np.unique(known):
        is_delay = (known == delay).astype(float)
        # N (1 - a) / (1 + a) independent measurements, a share of which has this delay.
        count = count_independent(is_delay)
        shares[int(delay)] = wilson(float(is_delay.mean()) * count, count)
    return Delays(size, len(known), len(steps) - len(known), shares)
