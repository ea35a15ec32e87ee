"""The example of late data and wrong clocks: what is known before data, and the shape of what it writes."""

import json

import numpy as np
import pytest

from heliograph_studies.delays import compute, page, run


@pytest.fixture
def outcome():
    """As it would be computed, with other numbers."""
    over_time = np.linspace(0.4, 0.2, 60)
    score = compute.Score("nominal", over_time, 2 * over_time, 0.01, 30)
    known = compute.Score("exact", over_time, over_time, 0.01, 30, over_time)
    late = {name: known if name in ("untold", "as_current", "none") else score for name in page.LATE}
    parts = dict.fromkeys(
        ("position", "offset", "drift"), compute.Score("nominal", np.ones(300), np.ones(300), 0.1, 299)
    )
    clocks = {kind: dict.fromkeys(page.CLOCKS, parts) for kind in page.SITUATIONS}
    return compute.Outcome(late, clocks)


def test_the_filters_are_those_that_are_shown():
    shown = {name: own for filters in compute.late_filters().values() for name, own in filters.items()}
    assert set(shown) == set(page.LATE)
    assert [name for name, item in shown.items() if item.claim != "exact"] == ["as_current"]


def test_the_summary(outcome, monkeypatch):
    monkeypatch.setattr(run, "trap", lambda: 0.6)
    found = json.loads(json.dumps(run.summary(outcome)))
    assert set(found["delays"]) == set(page.LATE)
    assert found["delays"]["untold"]["true_before_data"] == pytest.approx(np.linspace(0.4, 0.2, 60)[30:].mean())
    assert set(found["clocks"]) == {"moving", "at_rest", "no_true_clock"}
    assert found["clocks"]["moving"]["guarded"]["offset"] == {"true": 1.0, "claimed": 1.0}
    assert found["past_states_claim"] == 0.6


def test_the_page_shows_every_figure_and_filter(outcome, fits):
    pytest.importorskip("jinja2")
    figures = page.delay_figures(outcome)
    html = page.delay_page(outcome, {name: b"<svg/>" for name in figures}).html()
    fits(html)
    assert html.count("data:image/svg+xml") == len(figures) == 3
    assert all(label in html for label, _ in (*page.LATE.values(), *page.CLOCKS.values()))
