"""What the benchmarks without peers share: how a call is timed, and how what was measured is printed."""

import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np


def milliseconds(work: Callable[[], object], repeats: int = 1) -> float:
    """Median of wall-clock times."""
    times = []
    for _ in range(repeats):
        begun = time.perf_counter()
        work()
        times.append(time.perf_counter() - begun)
    return float(np.median(times)) * 1e3


def show(measured: Mapping[str, Any]) -> None:
    """A line for each value."""
    for name, value in measured["values"].items():
        print(f"{name}: {value:.4g} {measured['unit']}")
