"""The example of a range-bearing station, with fewer runs and filters."""

import json

import pytest

import heliograph as hg
from heliograph_studies import range_bearing
from heliograph_studies.range_bearing import close_by, passing

pytestmark = pytest.mark.slow

CHEAP = ("extended", "cubature", "four_points")


def few(network: hg.Network) -> hg.Network:
    """With the filters that cost little to compile."""
    nodes = {
        name: hg.Node(node.sensor, node.channel, {f: item for f, item in node.filters.items() if f in CHEAP})
        for name, node in network.nodes.items()
        if name != "bursts"
    }
    return hg.Network(network.plant, nodes)


def test_angles_are_as_good_across_the_cut_and_tails_come_from_close_by(tmp_path, monkeypatch, fits):
    monkeypatch.setattr(range_bearing, "passing", lambda *which, **how: few(passing(*which, **how)))
    monkeypatch.setattr(range_bearing, "close_by", lambda setting: few(close_by(setting)))
    range_bearing.run(range_bearing.Setting(runs=64, fading_runs=192), tmp_path)
    summary = json.loads((tmp_path / "range-bearing" / "summary.json").read_text())
    for name in ("quiet_cubature", "quiet_extended"):
        elsewhere, across, line = (summary[case][name] for case in range_bearing.CASES)
        for item in (elsewhere, across):
            assert abs(item["nees"] - 1) < 4 * item["nees_se"]
        assert across["largest"] < 6 and line["rmse"] > across["rmse"]
    assert summary["on_a_line"]["quiet_extended"]["largest"] > 20
    closest = {name: item["rmse_by_closest_pass"] for name, item in summary["fading"].items()}
    for farther in zip(*(part[1:] for part in closest.values()), strict=True):
        assert max(farther) < 1.5 * min(farther)  # rules differ in the closest tenth alone
    assert closest["extended"][0] > 2 * closest["four_points"][0]
    assert {"across.svg", "closest.svg", "report.html"} <= {p.name for p in (tmp_path / "range-bearing").iterdir()}
    fits(tmp_path / "range-bearing" / "report.html")
