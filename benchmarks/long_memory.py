"""Memory of a recording that is filtered in blocks, and written as it goes: 10^6 rows, and ten times as many.

Run: python benchmarks/long_memory.py [ROWS ...]. Blocks of 131,072 rows of the model of benchmarks/one_series.py are
made, filtered by the filter alone and as the only one of a network, and their estimates and variances written to
Parquet; each count of rows in a process of its own. Tells megabytes at most, and nanoseconds of processor time a row
without those of making data. Ends with an error where the most rows need more than MORE times the memory of the least.
"""

import json
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

import heliograph as hg

BLOCK, MORE, SAME = 1 << 17, 1.2, 1e-9
COUNTS = (1_000_000, 10_000_000)


def blocks_of(rows: int) -> Iterator[np.ndarray]:
    """Noisy positions of two slow walks, block by block."""
    rng, at = np.random.default_rng(0), np.zeros(2)
    for begin in range(0, rows, BLOCK):
        count = min(BLOCK, rows - begin)
        x = at + 0.01 * np.cumsum(rng.normal(size=(count, 2)), axis=0)
        at = x[-1]
        yield x + 0.5 * rng.normal(size=(count, 2))


def filter_rows(kind: str, rows: int) -> dict[str, Any]:
    """Filter and write so many rows, by a "filter" or a "network"; return what it took, and the last mean."""
    plant = hg.LinearPlant(np.eye(4) + 0.1 * np.eye(4, k=2), np.diag([1e-4, 1e-4, 1e-2, 1e-2]), np.zeros(4), np.eye(4))
    sensor = hg.LinearSensor(np.eye(2, 4), 0.25 * np.eye(2))
    item = hg.kalman_filter(plant, sensor)
    network = hg.Network(plant, {"node": hg.Node(sensor, hg.perfect(2), {"Kalman": item})})
    schema = pa.schema([(f"{what}_{i}", pa.float64()) for what in ("mean", "variance") for i in range(4)])
    result: Any = None
    took, last = 0.0, np.zeros(4)
    with tempfile.TemporaryDirectory() as folder, pq.ParquetWriter(Path(folder) / "estimates.parquet", schema) as file:
        for z in blocks_of(rows):
            began = time.process_time()
            if kind == "filter":
                result = item.run(z, after=result)
                means, covariances = result.means, result.covariances
            else:
                result = hg.run(network, {"node": z}, after=result)
                estimate = result.estimates["node"]["Kalman"]
                means, covariances = estimate.mean, estimate.covariance
            columns = [*means.T, *np.diagonal(covariances, axis1=1, axis2=2).T]
            file.write_table(pa.table([np.ascontiguousarray(column) for column in columns], schema=schema))
            took, last = took + time.process_time() - began, means[-1].copy()
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return {"kind": kind, "rows": rows, "megabytes": most, "ns a row": 1e9 * took / rows, "last": last.tolist()}


if __name__ == "__main__":
    if sys.argv[1:2] == ["--one"]:
        print(json.dumps(filter_rows(sys.argv[2], int(sys.argv[3]))))
        sys.exit()
    counts = list(map(int, sys.argv[1:])) or COUNTS
    results: dict[str, list[dict[str, Any]]] = {"filter": [], "network": []}
    for kind, of_kind in results.items():
        for rows in counts:
            command = [sys.executable, __file__, "--one", kind, str(rows)]
            said = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout
            of_kind.append(json.loads(said))
            print(json.dumps(of_kind[-1]), flush=True)
        if of_kind[-1]["megabytes"] > MORE * of_kind[0]["megabytes"]:
            raise SystemExit(f"long_memory: memory of a {kind} grows with rows, by more than a factor of {MORE}")
    for one, other in zip(*results.values(), strict=True):
        if np.max(np.abs(np.subtract(one["last"], other["last"]))) > SAME:
            raise SystemExit("long_memory: the network's estimates are not those of the filter")
