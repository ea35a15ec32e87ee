"""Verdicts on forecasts: an honest filter is rarely doubted, however short the recording, and a wrong one is."""

import numpy as np
import pytest

import heliograph as hg
from heliograph.report.pages.backtest import judge_forecasts_of_filters, make_backtest_results

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
    verdicts = [judge_forecasts_of_filters(hg.backtest(NETWORK, {"a": z}, [1, 5])) for z in measured]
    doubted = {name: sum(bool(v.misses) for of in verdicts for v in of if v.name == f"a/{name}") for name in FILTERS}
    assert doubted["right"] <= 2
    assert doubted["sure"] >= 35
    assert all(v.summarise() == "are too sure" for of in verdicts for v in of if v.name == "a/sure" and v.misses)


def test_what_no_interval_can_miss_is_not_judged():
    """A constant that is known: nothing of it is a trial, and the page says so in place of a share."""
    plant = hg.LinearPlant([[1.0]], [[0.0]], [2.0], [[0.0]], states=["x"])
    network = hg.Network(
        plant, {"a": hg.Node(SENSOR, hg.erasure(hg.perfect(1), 0.5), {"f": hg.kalman_filter(plant, SENSOR)})}
    )
    found = hg.backtest(network, {"a": np.full((30, 1), np.nan)}, [1], truth=np.full((30, 1), 2.0))
    (verdict,) = judge_forecasts_of_filters(found)
    assert (verdict.compared, verdict.summarise()) == (0, "are not judged")
    assert verdict.describe() == "a/f: nothing came that an interval could miss."
    assert make_backtest_results(found, "known").summary["warnings"] == []
