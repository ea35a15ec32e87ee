"""This machine: what it is, and the arithmetic and memory rates that set the floor under every time."""

import os
import platform
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

REPEATS = 7
ORDER = 1_500  # of the matrices multiplied
COPIED = 8_000_000  # numbers a core copies: 64 MB, beyond any cache of one core


def describe() -> dict[str, Any]:
    """Model, cores and rates, in 1e9 operations and bytes a second: the best a library reaches with all cores."""
    return {
        "cpu": cpu(),
        "cores": os.cpu_count(),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "gflops": round(arithmetic(), 1),
        "gbytes": round(traffic(), 1),
    }


def cpu() -> str:
    """The processor's name."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.is_file() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or "unknown"


def arithmetic() -> float:
    """Additions and multiplications of a large matrix product, 1e9 a second."""
    a = np.random.default_rng(0).normal(size=(ORDER, ORDER))
    return 2e-9 * ORDER**3 / best(lambda: a @ a)


def traffic() -> float:
    """Bytes read and written by large copies, one on each core, 1e9 a second."""
    cores = os.cpu_count() or 1
    pairs = [(np.ones(COPIED), np.zeros(COPIED)) for _ in range(cores)]
    with ThreadPoolExecutor(cores) as pool:
        return 16e-9 * COPIED * cores / best(lambda: list(pool.map(lambda pair: np.copyto(pair[1], pair[0]), pairs)))


def best(call: Callable[[], object]) -> float:
    """Least time of one call."""
    times = []
    for _ in range(REPEATS):
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return min(times)
