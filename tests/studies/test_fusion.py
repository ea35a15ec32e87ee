"""The example of fusion that knows what is shared, with smaller numbers of nodes, steps and runs."""

import json
from itertools import pairwise

import pytest

from heliograph_studies import fusion
from heliograph_studies.fusion import compute

pytestmark = pytest.mark.slow

RULES = ["matrix", "matrix_with_mean", "all_reports", "central"]


def test_the_summary_has_every_rule_in_its_order(tmp_path, fits):
    # One number of steps, and as many nodes as the tree has leaves: what is compiled for one serves the others.
    setting = fusion.Setting(
        steps=60, crossed_nodes=12, many_steps=60, measured_steps=60, runs=64, tree_nodes=30, degree=5, machine_runs=4,
        machine_nodes=2, intervals=(2, 4), thresholds=(0.3,), traffic_steps=8,
    )  # fmt: skip
    fusion.run(setting, tmp_path)
    fits(tmp_path / "fusion" / "report.html")
    summary = json.loads((tmp_path / "fusion" / "summary.json").read_text())
    for case in compute.CASES:
        trace = [summary[case][rule] for rule in RULES]
        assert all(a >= b * (1 - 1e-9) for a, b in pairwise(trace)), case  # more is never worse
        intersected = [summary[case][f"equal_intersection_{what}"] for what in ("claimed", "true")]
        assert intersected[0] > intersected[1] >= trace[0] * (1 - 1e-9)
        assert min(summary[case]["local"]) > trace[0] and summary[case]["scalar"] >= trace[0] * (1 - 1e-9)
    assert summary["tree"]["root"] >= summary["tree"]["flat"] >= summary["tree"]["central"]
    assert summary["scale"]["matrix"] < summary["scale"]["local"]
    assert {"nodes", "seconds", "peak_gb", "tree_seconds"} <= set(summary["scale"])
    assert {"ci_equal", "matrix", "all_reports", "central"} <= set(summary["strong"])
    every, rarely = summary["traffic"]["every"]
    assert every["claimed"] < rarely["claimed"] and every["reports"] == 2 * rarely["reports"]
    (known,) = summary["traffic"]["informed"]
    assert known["claimed"] > known["error"] and known["reports"] < 1
    assert {"traces.svg", "tree.svg", "traffic.svg"} <= {p.name for p in (tmp_path / "fusion").iterdir()}
