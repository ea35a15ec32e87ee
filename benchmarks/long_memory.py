"""Memory of a recording that is filtered in blocks, and written as it goes: 10^6 rows, and ten times as many.

Run: python benchmarks/long_memory.py [ROWS ...]. Blocks of 131,072 rows of the model of benchmarks/one_series.py are
made, filtered by the filter alone and as the only one of a network, and their estimates and variances written to
Parquet; and by `heliograph run`, from Parquet and with covariances; each count of rows in a process of its own. Tells
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
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

import heliograph as hg
from heliograph import cli

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


def make_network() -> hg.Network:
    """A filter of two slow walks with velocities, of which positions are measured, alone in a network."""
    plant = hg.LinearPlant(
        np.eye(4) + 0.1 * np.eye(4, k=2), np.diag([1e-4, 1e-4, 1e-2, 1e-2]), np.zeros(4), np.eye(4), states=list("abcd")
    )
    sensor = hg.LinearSensor(np.eye(2, 4), 0.25 * np.eye(2), outputs=["y", "z"])
    return hg.Network(plant, {"node": hg.Node(sensor, hg.perfect(2), {"Kalman": hg.kalman_filter(plant, sensor)})})


def filter_rows(kind: str, rows: int) -> tuple[float, np.ndarray]:
    """Filter and write so many rows, by a "filter" or a "network"; return the time that took, and the last mean."""
    network = make_network()
    item: Any = network.nodes["node"].filters["Kalman"]
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
    return took, last


def run_command(rows: int) -> tuple[float, np.ndarray]:
    """Let `heliograph run` filter and write so many rows; return the time that took, and the last mean."""
    schema = pa.schema([(name, pa.float64()) for name in ("time", "y", "z")])
    with tempfile.TemporaryDirectory() as folder:
        data, out = Path(folder) / "data.parquet", Path(folder) / "estimates.parquet"
        with pq.ParquetWriter(data, schema) as file:
            begin = 0
            for z in blocks_of(rows):
                columns = [np.arange(begin, begin + len(z), dtype=float), *(np.ascontiguousarray(y) for y in z.T)]
                file.write_table(pa.table(columns, schema=schema))
                begin += len(z)
        began = time.process_time()
        with redirect_stdout(StringIO()):
            code = cli.main(["run", f"{__file__}:make_network", "--measurements", str(data), "--out", str(out)])
        took = time.process_time() - began
        if code:
            raise SystemExit("long_memory: the command failed")
        with pq.ParquetFile(out) as written:
            last = written.read_row_group(written.num_row_groups - 1, columns=list("abcd")).to_pandas()
    return took, last.to_numpy()[-1]


def measure(kind: str, rows: int) -> dict[str, Any]:
    """Return what so many rows take by a "filter", a "network" or the "command", and the last mean."""
    took, last = run_command(rows) if kind == "command" else filter_rows(kind, rows)
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return {"kind": kind, "rows": rows, "megabytes": most, "ns a row": 1e9 * took / rows, "last": last.tolist()}


if __name__ == "__main__":
    if sys.argv[1:2] == ["--one"]:
        print(json.dumps(measure(sys.argv[2], int(sys.argv[3]))))
        sys.exit()
    counts = list(map(int, sys.argv[1:])) or COUNTS
    results: dict[str, list[dict[str, Any]]] = {"filter": [], "network": [], "command": []}
    for kind, of_kind in results.items():
        for rows in counts:
            command = [sys.executable, __file__, "--one", kind, str(rows)]
            said = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout
            of_kind.append(json.loads(said))
            print(json.dumps(of_kind[-1]), flush=True)
        if of_kind[-1]["megabytes"] > MORE * of_kind[0]["megabytes"]:
            raise SystemExit(f"long_memory: memory of a {kind} grows with rows, by more than a factor of {MORE}")
    for one, *others in zip(*results.values(), strict=True):
        for other in others:
            if np.max(np.abs(np.subtract(one["last"], other["last"]))) > SAME:
                raise SystemExit(f"long_memory: the estimates of a {other['kind']} are not those of the filter")
