"""The example of links that remember: what it knows before data, and the shape of what it writes."""

import json

import numpy as np
import pytest

import heliograph as hg
from heliograph_studies.links_with_memory import compute, page, run
from heliograph_studies.links_with_memory.setting import bursts, correlated

pytestmark = pytest.mark.slow

FILTERS = {"memoryless", "exact", "gpb1", "imm", "gpb2", "particle", "mode_late", "mode_known"}


def test_one_shadow():
    found = compute._shadow()
    assert found["shared"] == pytest.approx(0.227110, abs=6e-7)
    assert found["separate_claimed"] == pytest.approx(0.148447, abs=6e-7)
    assert found["separate_true"] == pytest.approx(0.238690, abs=6e-7)


@pytest.mark.parametrize(("lag", "ratio"), [(0.0, 1.0), (0.5, 1.40), (0.9, 2.35)])
def test_how_wrong_no_memory_is(lag, ratio):
    assert compute._memoryless_truth(correlated(lag)).ratio[-1, 0] == pytest.approx(ratio, abs=0.006)
    levels = hg.random_affine.joint_modes(correlated(lag))
    np.testing.assert_allclose(levels.initial, hg.random_affine.joint_modes(bursts()).initial, atol=1e-12)


@pytest.fixture
def outcome():
    """As it would be computed, with other numbers."""
    over_time = np.linspace(0.3, 0.1, 12)
    score = compute.Score("nominal", 0.1, 0.2, 0.01, None, over_time, over_time)
    known = compute.Score("exact", 0.1, 0.1, 0.01, 0.1, over_time, over_time)
    scores = dict.fromkeys(sorted(FILTERS), score) | {"exact": known}
    told, shadow = {"losses": known, "classes": known}, {"shared": 0.2, "separate_claimed": 0.1, "separate_true": 0.3}
    lags = np.array([0.0, 0.5, 0.9])
    memory = hg.simulation.memory_test(np.random.default_rng(0).normal(size=200))
    return compute.Outcome(scores, scores, told, shadow, lags, 1 + lags, memory)


def test_the_summary(outcome):
    found = json.loads(json.dumps(run.summary(outcome)))
    assert set(found["e1"]) == set(found["e2"]) == FILTERS == set(page.ROWS)
    assert {"claimed", "true", "true_se"} <= set(found["e1"]["imm"])
    assert found["e1"]["exact"]["true_before_data"] == 0.1
    assert set(found["one_shadow"]) == {"shared", "separate_claimed", "separate_true"}
    assert found["curve"] == {"lambda": [0.0, 0.5, 0.9], "ratio": [1.0, 1.5, 1.9]}


def test_the_page_shows_every_figure_and_filter(outcome, fits):
    pytest.importorskip("jinja2")
    figures = page.memory_figures(outcome)
    html = page.memory_page(outcome, {name: b"<svg/>" for name in figures}).html()
    fits(html)
    assert html.count("data:image/svg+xml") == len(figures) == 3
    assert all(label in html for label, _ in page.ROWS.values())
