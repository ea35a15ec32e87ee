"""Memory of a recording that is filtered in blocks, and written as it goes: 10^6 rows, and ten times as many.

Run: python benchmarks/long_memory.py [ROWS ...]. Blocks of 131,072 rows of the model of benchmarks/one_series.py are
made, filtered, and their estimates and variances written to Parquet; each count of rows in a process of its own. Tells
megabytes at most, and nanoseconds of processor time a row without those of making data. Ends with an error where the
most rows need more than MORE times the memory of the least.
"""

import json
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

import heliograph as hg

BLOCK, MORE = 1 << 17, 1.2
COUNTS = (1_000_000, 10_000_000)


def blocks_of(rows: int) -> Iterator[np.ndarray]:
    """Noisy positions of two slow walks, block by block."""
    rng, at = np.random.default_rng(0), np.zeros(2)
    for begin in range(0, rows, BLOCK):
        count = min(BLOCK, rows - begin)
        x = at + 0.01 * np.cumsum(rng.normal(size=(count, 2)), axis=0)
        at = x[-1]
        yield x + 0.5 * rng.normal(size=(count, 2))


def filter_rows(rows: int) -> dict[str, float]:
    """Filter and write so many rows; return what it took."""
    plant = hg.LinearPlant(np.eye(4) + 0.1 * np.eye(4, k=2), np.diag([1e-4, 1e-4, 1e-2, 1e-2]), np.zeros(4), np.eye(4))
    item = hg.kalman_filter(plant, hg.LinearSensor(np.eye(2, 4), 0.25 * np.eye(2)))
    schema = pa.schema([(f"{what}_{i}", pa.float64()) for what in ("mean", "variance") for i in range(4)])
    result, total, took = None, 0.0, 0.0
    with tempfile.TemporaryDirectory() as folder, pq.ParquetWriter(Path(folder) / "estimates.parquet", schema) as file:
        for z in blocks_of(rows):
            began = time.process_time()
            result = item.run(z, after=result)
            total += result.log_likelihood
            variances = np.diagonal(result.covariances, axis1=1, axis2=2)
            columns = [*result.means.T, *variances.T]
            file.write_table(pa.table([np.ascontiguousarray(column) for column in columns], schema=schema))
            took += time.process_time() - began
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return {"rows": rows, "megabytes": most, "ns a row": 1e9 * took / rows, "log-likelihood": total}


if __name__ == "__main__":
    if sys.argv[1:2] == ["--one"]:
        print(json.dumps(filter_rows(int(sys.argv[2]))))
        sys.exit()
    results = []
    for rows in map(int, sys.argv[1:] or COUNTS):
        command = [sys.executable, __file__, "--one", str(rows)]
        said = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout
        results.append(json.loads(said))
        print(json.dumps(results[-1]))
    if results[-1]["megabytes"] > MORE * results[0]["megabytes"]:
        raise SystemExit(f"long_memory: memory grows with rows, by more than a factor of {MORE}")
