"""Options of a fleet of plants: how late an event may be, how far ahead, and how many rows are held."""

from typing import NamedTuple

import numpy as np

from heliograph.numerics.check import TINY, check_count, scalar


class Options(NamedTuple):
    """Limits of a fleet: which events it accepts, and how many rows it holds.

    Args:
        window: how late an event may be, in the unit of time of the network (default 10).
        ahead: how much later than its arrival the time of an event may be (default 0).
        leap: how much later than all before it an event may be that no other clock has confirmed (default 10,000).
        capacity: greatest number of rows held for each plant (default 1000).
        step: seconds of a step, where time counts steps and messages carry dates; None where they carry steps.
    """

    window: float = 10.0
    ahead: float = 0.0
    leap: float = 10_000.0
    capacity: int = 1000
    step: float | None = None


def check_options(options: Options) -> Options:
    """Return the options converted to floats and integers; raise ValueError if one is out of range.

    `window` and `ahead` are at least 0, `leap` too, or infinite; `capacity` is at least 1; `step` is above 0 or None.
    """
    step = None if options.step is None else float(scalar("step", options.step, TINY))
    leap = options.leap if options.leap == np.inf else scalar("leap", options.leap, 0)
    window, ahead = (float(scalar(name, getattr(options, name), 0)) for name in ("window", "ahead"))
    capacity = check_count("capacity", options.capacity)
    return Options(window=window, ahead=ahead, leap=float(leap), capacity=capacity, step=step)
