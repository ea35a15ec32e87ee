"""The example of fusion that knows what is shared, with smaller numbers of nodes, steps and runs."""

import json
from itertools import pairwise

import pytest

from heliograph_studies.fusion import compute, example, machine

pytestmark = pytest.mark.slow

RULES = ["matrix", "matrix_with_mean", "all_reports", "central"]


def test_the_summary_has_every_rule_in_its_order(tmp_path, monkeypatch, fits):
    # One number of steps, and as many nodes as the tree has leaves: what is compiled for one serves the others.
    small = {"STEPS": 60, "MANY": 12, "MANY_STEPS": 60, "MEASURED_STEPS": 60, "RUNS": 64, "TREE_NODES": 30, "DEGREE": 5}
    for name, value in (
        small | {"STRONG_RUNS": 4, "INTERVALS": (1, 2), "THRESHOLDS": (0.3,), "TRAFFIC_STEPS": 8}
    ).items():
        monkeypatch.setattr(compute, name, value)
    monkeypatch.setattr(machine, "OUTPUTS", machine.OUTPUTS[:2])
    example(tmp_path, 0)
    fits(tmp_path / "fusion" / "report.html")
    found = json.loads((tmp_path / "fusion" / "summary.json").read_text())
    for case in compute.CASES:
        trace = [found[case][rule] for rule in RULES]
        assert all(a >= b * (1 - 1e-9) for a, b in pairwise(trace)), case  # more is never worse
        intersected = [found[case][f"equal_intersection_{what}"] for what in ("claimed", "true")]
        assert intersected[0] > intersected[1] >= trace[0] * (1 - 1e-9)
        assert min(found[case]["local"]) > trace[0] and found[case]["scalar"] >= trace[0] * (1 - 1e-9)
    assert found["tree"]["root"] >= found["tree"]["flat"] >= found["tree"]["central"]
    assert found["scale"]["matrix"] < found["scale"]["local"]
    assert {"nodes", "seconds", "peak_gb", "tree_seconds"} <= set(found["scale"])
    assert {"ci_equal", "matrix", "all_reports", "central"} <= set(found["strong"])
    every, rarely = found["traffic"]["every"]
    assert every["claimed"] < rarely["claimed"] and every["reports"] == 2 * rarely["reports"]
    (told,) = found["traffic"]["told"]
    assert told["claimed"] > told["error"] and told["reports"] < 1
    assert {"traces.svg", "tree.svg", "traffic.svg"} <= {p.name for p in (tmp_path / "fusion").iterdir()}
