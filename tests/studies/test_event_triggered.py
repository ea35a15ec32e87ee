"""The example of the house that reports on change: its recipes in one room, its page and its summary."""

import json

import pytest

from heliograph_studies import event_triggered
from heliograph_studies.event_triggered import ROOMS, Setting, rooms

pytestmark = pytest.mark.slow


def test_in_a_room_the_last_value_is_too_sure_and_the_event_filter_is_not():
    scores, sent = event_triggered.room(Setting(hours=4, runs=16), rooms()["kitchen"], 1)
    assert scores["last"].nees > 2 and scores["last"].error > scores["sum"].error
    assert scores["sum"].nees == pytest.approx(1, abs=0.15)
    assert scores["missing"].error > scores["sum"].error
    assert 0 < (sent != 0).mean() < 0.4 and (sent < 0).any()


def test_messages_that_are_saved_are_those_of_a_schedule_of_the_same_error():
    curves = {
        "periodic": {"messages": [20.0, 10.0, 5.0], "error": [0.1, 0.2, 0.4]},
        "on change": {"messages": [5.0], "error": [0.2]},
    }
    assert event_triggered.messages_saved(curves) == pytest.approx(0.5)


@pytest.fixture
def outcome():
    """As it would be computed, with other numbers."""
    scores = {name: event_triggered.Score(0.4, 1.0) for name in event_triggered.RECIPES}
    curves = {name: {"messages": [1.0, 10.0], "error": [0.5, 0.2]} for name in event_triggered.RULES}
    return event_triggered.Outcome(scores, dict.fromkeys(ROOMS, scores), 7.0, 0.2, curves, [0.4, 0.1], 0.5)


def test_the_summary_and_the_page(outcome, fits):
    summary = json.loads(json.dumps(event_triggered.example.summary(Setting(), outcome, {})))
    assert set(summary["scores"]) == set(event_triggered.ROWS) and set(summary["rooms"]) == set(ROOMS)
    pytest.importorskip("jinja2")
    drawn = event_triggered.figures(outcome)
    html = event_triggered.example.make_page(Setting(), outcome, {}, {name: b"<svg/>" for name in drawn}).html()
    fits(html)
    assert html.count("data:image/svg+xml") == len(drawn) == 2
    assert all(label in html for label, _ in event_triggered.ROWS.values())
