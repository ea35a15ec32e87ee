"""Memory that runs need, known from shapes before any of them starts; what does not fit is refused in one line."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import jax

from heliograph.numerics.check import fail
from heliograph.numerics.types import PyTree

GB = 1e9
MEMINFO = Path("/proc/meminfo")  # of Linux, which counts what the cache of files would give back
LESS = "a shorter horizon, or fewer nodes or filters at once"
FEWER = f"fewer runs at once (`first_run` goes on from there), keep=Statistics(), or {LESS}"


class NeededMemory(NamedTuple):
    """Bytes that runs hold at the same time.

    Args:
        collected: results of single runs.
        sums: over runs, by step and batch.
        trajectories: of the runs that are computed at once.
    """

    collected: float
    sums: float
    trajectories: float


def count_bytes(tree: PyTree) -> float:
    """Return how many bytes the arrays of a tree have, or arrays of its shapes would have."""
    return float(sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(tree)))


def find_available_memory() -> float | None:
    """Return the number of bytes that this machine can still give, or of all its memory if it does not say that.

    The result is None if it says neither.
    """
    try:
        lines = dict(line.split(":", 1) for line in MEMINFO.read_text().splitlines())
        return 1024.0 * int(lines["MemAvailable"].split()[0])
    except (OSError, KeyError, ValueError):
        pass
    try:
        return float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    except (AttributeError, OSError, ValueError):  # no POSIX, or a system that does not tell
        return None


def check_memory(needed: NeededMemory, runs: int, horizon: int) -> None:
    """Raise ValueError for runs that need more memory than there is, or do nothing if the available memory is unknown.

    The error names the needed and the available memory, the largest part, and what would need less.
    """
    total, free = sum(needed), find_available_memory()
    if free is None or total <= free:
        return
    # The part that needs most: the name of its field, and its bytes.
    kind, largest_part = max(needed._asdict().items(), key=lambda item: item[1])
    advice = FEWER if kind == "collected" else LESS
    what_is_largest = f"{largest_part / GB:.3g} GB of them {_DESCRIPTIONS[kind]}"
    got = f"{total / GB:.3g} GB for runs={runs}, horizon={horizon}, {what_is_largest}: {advice}"
    raise fail("memory of a simulation", f"at most {free / GB:.3g} GB, which are available", got)


@contextmanager
def explain_out_of_memory(runs: int, horizon: int) -> Iterator[None]:
    """Raise ValueError with one clear line if memory cannot be allocated within the `with` block.

    `runs`, `horizon`: numbers of runs and steps, which the line names with what would need less. Other errors pass
    unchanged.
    """
    try:
        yield
    except (MemoryError, jax.errors.JaxRuntimeError) as error:
        if isinstance(error, jax.errors.JaxRuntimeError) and "RESOURCE_EXHAUSTED" not in str(error):
            raise
        got = f"none for runs={runs}, horizon={horizon} ({str(error).splitlines()[0][:100]}): {FEWER}"
        raise fail("memory of a simulation", "what the system gives", got) from None


_DESCRIPTIONS = {
    "collected": "results of single runs",
    "sums": "sums by step and batch of runs",
    "trajectories": "trajectories of runs side by side",
}
