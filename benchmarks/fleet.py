"""A fleet of plants of the README's network behind one process and behind two, from JSON lines held in memory.

Run: python benchmarks/fleet.py. Microseconds of a step, which here is a message; least over ROUNDS: of processors, all
threads together, and by the clock on the wall. Where the state is kept, every batch is committed to a disk. With two
processes, each has half of the plants and a store of its own.
"""

import json
import tempfile
import time
import warnings
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from alone import show
from timeline import readme_network

from heliograph.live.fleet import Fleet
from heliograph.live.fleet_options import Options
from heliograph.live.network_step_program import NetworkProgram
from heliograph.serving.message import read_messages
from heliograph.serving.service import Service
from heliograph.serving.storage.store import Store
from heliograph.serving.storage.store_protocol import InMemoryStore, identity

PLANTS, STEPS, BATCH, SPACING, WINDOW, ROUNDS = 1000, 60, 8192, 0.5, 5.0, 3
LIMIT = 20.0  # 50,000 steps a second, on two processors


class Taken(NamedTuple):
    """Seconds of processors, and by the clock on the wall; of these to commit."""

    processors: float
    wall: float
    committed: float


def lines(plants: int) -> list[bytes]:
    """Messages of all plants in turn, in order."""
    z = np.random.default_rng(0).normal(5.0, 1.0, (STEPS, plants, 2)).tolist()
    results = []
    for i in range(STEPS):
        for plant in range(plants):
            item = {"plant": f"p{plant}", "node": "cart", "sequence": i, "time": SPACING * i, "values": z[i][plant]}
            results.append(json.dumps(item).encode())
    return results


def rounds(plants: int, stored: bool) -> Taken:
    """Least seconds of all messages, of each kind."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        program = NetworkProgram(readme_network())
    sent = lines(plants)
    Service(Fleet(program, Options(WINDOW)), InMemoryStore()).take(sent[:1])  # compiled
    results = []
    for _ in range(ROUNDS):
        with tempfile.TemporaryDirectory(dir=Path(__file__).parent) as folder:  # on a disk, not in memory
            fleet = Fleet(program, Options(WINDOW))
            service = Service(fleet, Store(f"{folder}/fleet.db", identity(fleet)) if stored else InMemoryStore())
            begun, worked, committed = time.perf_counter(), time.process_time(), 0.0
            for begin in range(0, len(sent), BATCH):
                service.take(sent[begin : begin + BATCH])
                committed += service.last.committed
            results.append(Taken(time.process_time() - worked, time.perf_counter() - begun, committed))
            service.store.close()
    return Taken(*map(min, zip(*results, strict=True)))


def half(_: int) -> float:
    """One of two processes."""
    return rounds(PLANTS // 2, True).wall


def least(function: Callable[[], object]) -> float:
    """Least microseconds of a call a message."""
    taken = []
    for _ in range(ROUNDS):
        begun = time.perf_counter()
        function()
        taken.append((time.perf_counter() - begun) * 1e6 / (PLANTS * STEPS))
    return min(taken)


def measure() -> dict[str, Any]:
    """A step in microseconds, and where its time goes."""
    count = PLANTS * STEPS
    memory, stored = rounds(PLANTS, False), rounds(PLANTS, True)
    sent = lines(PLANTS)
    with ProcessPoolExecutor(2, get_context("spawn")) as pool:
        both = max(pool.map(half, range(2)))
    values = {
        "processors, nothing kept": memory.processors / count * 1e6,
        "processors": stored.processors / count * 1e6,
        "one process, nothing kept": memory.wall / count * 1e6,
        "one process": stored.wall / count * 1e6,
        "of it committing": stored.committed / count * 1e6,
        "of it reading JSON": least(lambda: read_messages(sent)),
        "two processes": both / count * 1e6,
    }
    return {"unit": "us", "values": values, "at_most": {"processors": 2 * LIMIT, "two processes": LIMIT}}


if __name__ == "__main__":
    show(measure())
