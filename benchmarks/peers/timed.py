"""The form of every program: read a problem, write the estimates, then time one pass for each line on standard input.

Usage: python PROGRAM problem.npz means.npy. The first line out tells runs and versions; each later one nanoseconds per
step and run, by the clock and of processors. The driver asks the programs in turn, so that a disturbance of the machine
meets all of them.
"""

import json
import sys
import time
from collections.abc import Callable
from importlib.metadata import version
from typing import Any, NamedTuple

import numpy as np

Arrays = dict[str, np.ndarray]


class Contender(NamedTuple):
    """`work()` does one timed pass; `means(result)` lays its result out as (runs, steps, n), untimed."""

    work: Callable[[], Any]
    means: Callable[[Any], np.ndarray]
    how: str


def serve(prepare: Callable[[Arrays], Contender], packages: tuple[str, ...]) -> None:
    """Answer the driver until it closes standard input."""
    with np.load(sys.argv[1]) as file:
        problem = dict(file)
    contender = prepare(problem)
    means = contender.means(contender.work())
    np.save(sys.argv[2], means)
    about = {"how": contender.how, "runs": len(means), "versions": {name: version(name) for name in packages}}
    print(json.dumps(about), flush=True)
    for _ in sys.stdin:
        worked = time.process_time()
        taken = seconds(contender.work), time.process_time() - worked
        print(json.dumps([1e9 * x / means[..., 0].size for x in taken]), flush=True)


def seconds(work: Callable[[], Any]) -> float:
    """Time of one pass."""
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def fastest(candidates: dict[str, Callable[[], Any]]) -> tuple[str, Callable[[], Any]]:
    """The candidate with the best of three passes after a first one: every program gets its best width of a batch."""
    best: dict[str, float] = {}
    for name, work in candidates.items():
        work()
        best[name] = min(seconds(work) for _ in range(3))
    name = min(best, key=best.__getitem__)
    return name, candidates[name]
