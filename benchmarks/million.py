"""One million runs of the strong scenario: time, how honest the estimate of it was, peak memory, both precisions.

Run: python benchmarks/million.py [RUNS]. Four nodes, 40 steps, the zero-mean filter at each node and their equal
intersection; running statistics only. Prints.
"""

import json
import resource
import subprocess
import sys
import time
from typing import Any

import heliograph as hg
from heliograph.report.progress import Countdown
from heliograph_studies.cubature_fusion.compute import network
from heliograph_studies.cubature_fusion.setting import STRONG

RUNS = 1_000_000
FILTER, FUSED = "cubature_zero_mean", "ci_equal"
ESTIMATE_AT = 0.1  # share of the runs after which the estimate of the whole time is taken down


def strong() -> hg.Network:
    """The scenario with one filter."""
    whole = network(STRONG)
    nodes = {name: hg.Node(n.sensor, n.channel, {FILTER: n.filters[FILTER]}) for name, n in whole.nodes.items()}
    return hg.Network(whole.plant, nodes, {FUSED: hg.Fusion(FILTER, hg.fusion.EqualIntersection())})


def measure(runs: int, precision: str) -> dict[str, Any]:
    """Simulate, and take down time, estimate and peak memory of this process."""
    countdown, begun, estimate = Countdown(), time.perf_counter(), 0.0
    countdown.note(0)

    def progressed(done: int, total: int) -> None:
        nonlocal estimate
        countdown.note(done)
        left = countdown.left(total)
        if not estimate and done >= ESTIMATE_AT * total and left is not None:
            estimate = time.perf_counter() - begun + left

    with hg.show_progress() as shown:

        def tell(done: int, total: int) -> None:
            shown(done, total)
            progressed(done, total)

        record = hg.monte_carlo(
            strong(),
            STRONG.horizon,
            runs,
            0,
            hg.Statistics(),
            chunk=8192,
            precision="float32" if precision == "float32" else "float64",
            progress=tell,
        )
    rmse = {node: record[node][FUSED if node == "fused" else FILTER].rmse() for node in record}
    return {
        "precision": precision,
        "runs": runs,
        "seconds": time.perf_counter() - begun,
        "seconds estimated after a tenth": estimate,
        "peak memory in MB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "rmse": {node: value for node, (value, _) in rmse.items()},
        "rmse standard error": {node: error for node, (_, error) in rmse.items()},
        "nees per dimension of node 1": record["1"][FILTER].nees_per_dimension()[0],
    }


def main() -> None:
    if len(sys.argv) == 3:
        print(json.dumps(measure(int(sys.argv[1]), sys.argv[2])))
        return
    runs = sys.argv[1] if len(sys.argv) > 1 else str(RUNS)
    for precision in ("float64", "float32"):  # a process each, so that each has a peak of its own
        said = subprocess.run(
            [sys.executable, __file__, runs, precision], stdout=subprocess.PIPE, text=True, check=True
        )
        print(json.dumps(json.loads(said.stdout), indent=2), flush=True)


if __name__ == "__main__":
    main()
