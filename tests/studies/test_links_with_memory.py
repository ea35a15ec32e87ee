"""The example of links that remember: what it knows before data, and the shape of what it writes."""

import json

import numpy as np
import pytest

import heliograph as hg
from heliograph_studies import links_with_memory
from heliograph_studies.links_with_memory import Setting, bursts

pytestmark = pytest.mark.slow

FILTERS = {"memoryless", "exact", "gpb1", "imm", "gpb2", "particle", "mode_late", "mode_known"}
TOGETHER = {"shared", "separate_claimed", "separate_true"}


def test_one_fading():
    result = links_with_memory.fading_together(Setting())
    assert result["shared"] == pytest.approx(0.227110, abs=6e-7)
    assert result["separate_claimed"] == pytest.approx(0.148447, abs=6e-7)
    assert result["separate_true"] == pytest.approx(0.238690, abs=6e-7)


@pytest.mark.parametrize(("lag", "ratio"), [(0.0, 1.0), (0.5, 1.40), (0.9, 2.35)])
def test_how_wrong_no_memory_is(lag, ratio):
    assert links_with_memory.too_sure(Setting(), lag) == pytest.approx(ratio, abs=0.006)
    levels = hg.random_affine.joint_modes(bursts(Setting(), lag))
    np.testing.assert_allclose(levels.initial, hg.random_affine.joint_modes(bursts(Setting())).initial, atol=1e-12)


@pytest.fixture
def outcome():
    """As it would be computed, with other numbers."""
    over_time = np.linspace(0.3, 0.1, 12)
    score = links_with_memory.Score("nominal", 0.1, 0.2, 0.01, over_time, over_time)
    known = links_with_memory.Known("exact", 0.1, 0.1, 0.01, over_time, over_time, 0.1)
    scores = dict.fromkeys(sorted(FILTERS), score) | {"exact": known}
    informed, together = {"losses": known, "classes": known}, dict.fromkeys(TOGETHER, 0.2)
    curve = {"lambda": [0.0, 0.5, 0.9], "ratio": [1.0, 1.5, 1.9]}
    memory = {"correlation": np.ones(3), "standard_error": np.ones(3), "p_value": 0.1, "predictable": 0.2}
    return links_with_memory.Outcome({"e1": 9, "e2": 9}, {}, scores, scores, informed, together, curve, memory)


def test_the_summary(outcome):
    summary = json.loads(json.dumps(links_with_memory.example.summary(Setting(), outcome, {})))
    assert set(summary["e1"]) == set(summary["e2"]) == FILTERS == set(links_with_memory.ROWS)
    assert set(summary["e1"]["imm"]) == {"claim", "claimed", "true", "true_se"}
    assert summary["e1"]["exact"]["true_before_data"] == 0.1
    assert summary["runs"] == {"e1": 9, "e2": 9} and set(summary["one_fading"]) == TOGETHER
    assert summary["curve"] == {"lambda": [0.0, 0.5, 0.9], "ratio": [1.0, 1.5, 1.9]}


def test_the_page_shows_every_figure_and_filter(outcome, fits):
    pytest.importorskip("jinja2")
    drawn = links_with_memory.figures(outcome)
    html = links_with_memory.example.make_page(Setting(), outcome, {}, {name: b"<svg/>" for name in drawn}).html()
    fits(html)
    assert html.count("data:image/svg+xml") == len(drawn) == 3
    assert all(label in html for label, _ in links_with_memory.ROWS.values())
