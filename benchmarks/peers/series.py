"""The form of a peer of benchmarks/one_series.py: tasks on one recording, each timed when warm.

Usage: python PROGRAM.py problem.npz means.npz. Answers in JSON on the last line: nanoseconds a row by the clock and of
processors, the least of CALLS, by task, with the rows that were taken. Means go to the second file.
"""

import json
import sys
import time
from collections.abc import Callable

import numpy as np

CALLS = 3

Arrays = dict[str, np.ndarray]
Tasks = dict[str, Callable[[], np.ndarray]]  # what each returns: means (rows, n), or a likelihood


def least(task: Callable[[], object], rows: int, calls: int = CALLS) -> tuple[float, float]:
    """Nanoseconds a row, by the clock and of processors, the least of each after a first call."""
    task()
    clock, processors = [], []
    for _ in range(calls):
        began, worked = time.perf_counter(), time.process_time()
        task()
        clock.append(time.perf_counter() - began)
        processors.append(time.process_time() - worked)
    return 1e9 * min(clock) / rows, 1e9 * min(processors) / rows


def answer(prepare: Callable[[Arrays], Tasks], most: int | None = None) -> None:
    """Time each task on at most so many rows, and say what it took."""
    with np.load(sys.argv[1]) as file:
        problem = dict(file)
    problem["z"] = problem["z"][:most]
    rows, tasks = len(problem["z"]), prepare(problem)
    np.savez(sys.argv[2], **{name: np.asarray(task()) for name, task in tasks.items()})
    print(json.dumps({"rows": rows, "ns": {name: least(task, rows) for name, task in tasks.items()}}))
