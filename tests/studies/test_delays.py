"""The example of late data and wrong clocks: what is known before data, and the shape of what it writes."""

import json
from dataclasses import replace

import numpy as np
import pytest

from heliograph_studies import delays


@pytest.fixture
def outcome():
    """As it would be computed, with other numbers."""
    over_time = np.linspace(0.4, 0.2, 60)
    mean = float(over_time[30:].mean())
    score = delays.Late("nominal", mean, 2 * mean, 0.01, over_time, 2 * over_time, {})
    before = {"true_before_data": mean, "true_before_data_over_time": over_time}
    known = replace(score, claim="exact", before_data=before)
    late = {name: known if name in ("uninformed", "as_current", "none") else score for name in delays.LATE}
    parts = dict.fromkeys(("position", "offset", "drift"), delays.Deviation(1.0, 1.0, np.ones(300), np.ones(300)))
    clocks = {kind: dict.fromkeys(delays.CLOCKS, parts) for kind in delays.SITUATIONS}
    return delays.Outcome({"delays": 4096, "clocks": 1024}, {"delays": 60, "clocks": 300}, late, 0.6, clocks)


def test_the_filters_are_those_that_are_shown():
    shown = {name: item for filters in delays.late_filters().values() for name, item in filters.items()}
    assert set(shown) == set(delays.LATE)
    assert [name for name, item in shown.items() if item.claim != "exact"] == ["as_current"]


def test_the_summary(outcome):
    summary = json.loads(json.dumps(delays.example.summary(delays.Setting(), outcome, {})))
    assert set(summary["delays"]) == set(delays.LATE)
    assert summary["delays"]["uninformed"]["true_before_data"] == pytest.approx(np.linspace(0.4, 0.2, 60)[30:].mean())
    assert set(summary["clocks"]) == {"moving", "at_rest", "no_true_clock"}
    assert summary["clocks"]["moving"]["guarded"]["offset"] == {"true": 1.0, "claimed": 1.0}
    assert summary["past_states_claim"] == 0.6


@pytest.mark.slow
def test_the_page_shows_every_figure_and_filter(outcome, fits):
    pytest.importorskip("jinja2")
    drawn = delays.figures(outcome)
    html = delays.example.make_page(delays.Setting(), outcome, {}, {name: b"<svg/>" for name in drawn}).html()
    fits(html)
    assert html.count("data:image/svg+xml") == len(drawn) == 3
    labels = [label for label, _ in delays.LATE.values()]
    assert all(label in html for label in (*labels, *delays.CLOCKS.values()))
