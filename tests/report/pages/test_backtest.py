"""Verdicts on forecasts: an honest filter is rarely doubted, however short the recording, and a wrong one is."""

import numpy as np
import pytest

import heliograph as hg
from heliograph.report.pages.backtest import make_backtest_results

PLANT = hg.LinearPlant([[0.9]], 0.5, [0.0], 0.5 / 0.19, states=["x"])
SENSOR = hg.LinearSensor([[1.0]], 0.3, outputs=["y"])
SURE = hg.LinearPlant([[0.9]], 0.005, [0.0], 0.5 / 0.19, states=["x"])
FILTERS = {
    "right": hg.kalman_filter(PLANT, SENSOR),
    "sure": hg.kalman_filter(SURE, hg.LinearSensor([[1.0]], 0.003, outputs=["y"])),
}
NETWORK = hg.Network(PLANT, {"a": hg.Node(SENSOR, hg.perfect(1), FILTERS)})


@pytest.mark.parametrize("rows", [18, 60])
def test_an_honest_filter_is_rarely_doubted_and_one_too_sure_is(rows):
    """40 recordings of an honest filter: by chance one interval of 1,000 is doubted, so at most two recordings."""
    measured = hg.monte_carlo(NETWORK, rows, 40, key=2).measurements["a"]
    found = [make_backtest_results(hg.backtest(NETWORK, {"a": z}, [1, 5]), "net").summary["warnings"] for z in measured]
    doubts = {name: [[w for w in of if w.startswith(f"a/{name},")] for of in found] for name in FILTERS}
    assert sum(map(bool, doubts["right"])) <= 2
    assert sum(map(bool, doubts["sure"])) >= 35
    assert all(w.endswith("too sure") for of in doubts["sure"] for w in of)


def test_what_no_interval_can_miss_is_not_judged():
    """A constant that is known: nothing of it is a trial, and the page says so in place of a share."""
    plant = hg.LinearPlant([[1.0]], [[0.0]], [2.0], [[0.0]], states=["x"])
    network = hg.Network(
        plant, {"a": hg.Node(SENSOR, hg.erasure(hg.perfect(1), 0.5), {"f": hg.kalman_filter(plant, SENSOR)})}
    )
    found = hg.backtest(network, {"a": np.full((30, 1), np.nan)}, [1], truth=np.full((30, 1), 2.0))
    content = make_backtest_results(found, "known")
    page = content.page({"coverage": b"<svg></svg>"}).html()
    assert content.summary["warnings"] == [] and "a/f: nothing came that an interval could miss." in page
