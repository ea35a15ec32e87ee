import json
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from heliograph import cli
from heliograph.campaign import explore_page, load_campaign, open_results
from heliograph.campaign.explore_page import StateScore, list_state_scores
from heliograph.campaign.run import run_campaign
from heliograph.campaign.summary import Score, read_summary
from tests.campaign.example import CAMPAIGN, NETWORK, write

pytest.importorskip("bokeh", reason="the extra `explore`")
HOSTILE = "</script><img src=x onerror=alert(1)> $$x$$"


@pytest.fixture(scope="module")
def campaign(finished):
    return load_campaign(finished.parent / "campaign.toml")


@pytest.fixture(scope="module")
def scores(finished):
    return read_summary(finished / "summary.csv")


@pytest.fixture(scope="module")
def hostile(campaign, scores):
    """The page of two nodes, one of which has markup for a name, and of a number that is none."""
    there = [
        score for single in scores for score in (single, replace(single, node=HOSTILE, nees_per_dimension=float("nan")))
    ]
    return explore_page.make_explore_page_html(campaign, there)


@pytest.fixture(scope="module")
def explored(campaign, scores):
    """The page of two nodes and of four steps of two states."""
    results = [
        StateScore(s.setting, node, s.filter, s.claim, state, step, 1.0 / (step + 1), 0.1, 1.0, 1.0, 0.1, 100)
        for s in scores for node in ("near", HOSTILE) for state in ("x", "y") for step in range(5)
    ]  # fmt: skip
    there = [
        score for single in scores for score in (single, replace(single, node=HOSTILE, nees_per_dimension=float("nan")))
    ]
    return explore_page.make_explore_page_html(
        campaign, there, lambda settings, steps: [d for d in results if d.setting in settings]
    )


def data(html):
    """The tables of a page: of all steps together, and step by step where they were looked at."""
    (result,) = re.findall(r'<script type="application/json" id="data">(.*?)</script>', html, re.DOTALL)
    return json.loads(result)


@pytest.mark.slow
def test_the_page_holds_the_scores(finished, scores, tmp_path, capsys):
    assert cli.main(["explore", str(finished), "--out", str(tmp_path / "new")]) == 0
    path = tmp_path / "new" / "explore.html"
    assert str(path) in capsys.readouterr().out
    table, over_time = data(path.read_text())
    columns = table["columns"]
    assert columns["gain"] == [0.5, 0.5, 0.7, 0.7, 0.9, 0.9] and columns["noise"] == [0.1, 0.2] * 3
    assert columns["rmse"] == pytest.approx([score.rmse for score in scores], rel=1e-5)  # six digits are kept
    assert columns["claim"] == ["nominal"] * 6 and columns["finite_runs"] == [100] * 6
    assert (table["x"], table["panel"], table["colour"]) == ("gain", "noise", "filter")
    assert columns["state"] == ["all together"] * 6  # one state alone needs no telling apart
    assert over_time["columns"]["time"] == [1, 2, 3, 4] * 6 and over_time["columns"]["state"] == ["x"] * 24
    assert over_time["x"] == "time" and "claimed" in over_time["columns"]
    assert path.stat().st_size < 3e6  # Bokeh's 1.4 MB and the fixed pictures; Plotly alone would be 4.8 MB


@pytest.mark.slow
def test_nothing_is_fetched_and_every_text_is_escaped(hostile):
    assert HOSTILE not in hostile and "<img src=x" not in hostile
    (table,) = data(hostile)
    assert set(table["columns"]["node"]) == {"near", HOSTILE} and table["panel"] == "node"
    assert table["columns"]["nees_per_dimension"][1] is None  # JSON has no NaN
    tags = re.findall(r"<(?!/)[a-z][^>]*>", re.sub(r"<script.*?</script>", "", hostile, flags=re.DOTALL))
    addresses = re.findall(r'\b(?:src|href)="([^"]*)', "".join(tags))
    assert addresses and all(address.startswith("data:image/svg+xml;base64,") for address in addresses)
    local = re.sub(
        r"<script>.*?</script>", "", hostile, count=1, flags=re.DOTALL
    )  # without Bokeh, which names addresses
    assert "http" not in local and not re.search(r"<script[^>]+src|@import|url\(", local)


@pytest.mark.slow
def test_the_fixed_pictures_and_the_table_are_there_for_print(hostile):
    assert hostile.count('<section class="static">') == 2
    assert "@media print { #explore { display: none; } }" in hostile and '<section id="explore" hidden>' in hostile


@pytest.mark.slow
def test_a_big_campaign_says_what_is_shown(campaign, scores, monkeypatch):
    monkeypatch.setattr(explore_page, "ROWS", 4)
    html = explore_page.make_explore_page_html(campaign, scores)
    assert len(data(html)[0]["columns"]["rmse"]) == 4
    assert "the first 4 of 6 settings are on this page, 4 of 6 rows" in html


def test_a_campaign_without_numbers_is_drawn_by_setting(campaign):
    named = replace(campaign, settings=[{"kind": ["a", 1]}, {"kind": ["b"]}])
    alike = replace(campaign, settings=[{"kind": "a"}])
    item = [Score(0, "near", "f", "none", 1.0, 0.1, 2.0, 0.1, 3, 3)]
    (table,) = data(explore_page.make_explore_page_html(named, [*item, replace(item[0], setting=1)]))
    assert table["x"] == "kind" and table["columns"]["kind"] == ['["a", 1]', '["b"]']
    assert data(explore_page.make_explore_page_html(alike, item))[0]["x"] == "setting"


@pytest.mark.slow
def test_single_states_add_up_to_the_scores(tmp_path):
    """Of two states at three of six steps: the squares of their RMSEs sum to that of all, and steps average to it."""
    network = NETWORK.replace('[[0.9]], 0.1, [0.0], 0.3, states=["x"]', "[[0.9, 0], [0.1, 0.8]], 0.1, [0.0, 0.0], 0.3")
    plan = write(tmp_path, CAMPAIGN.replace("[0.5, 0.7, 0.9]", "[0.5]").replace("4", "6", 1), network.replace(
        "LinearSensor([[1.0]]", "LinearSensor([[1.0, 0.0]]"))  # fmt: skip
    run_campaign(plan, tmp_path / "out", workers=0)
    scores, results = read_summary(tmp_path / "out" / "summary.csv"), open_results(tmp_path / "out")
    result = list_state_scores(tmp_path / "out" / "results.zarr", plan, [0, 1], [1, 3, 6])
    for score in scores:
        whole = [item for item in result if item.setting == score.setting and not item.step]
        assert sum(item.rmse**2 for item in whole) == pytest.approx(score.rmse**2, rel=1e-12)
        assert np.mean([item.nees_per_dimension for item in whole]) > 0 and {item.finite_runs for item in whole} == {
            100
        }
    error, variance = results.error[1, :, 2, 0, 0, 1].values, results.variance[1, :, 2, 0, 0, 1].values
    (item,) = [d for d in result if (d.setting, d.step, d.state) == (1, 3, results.state.values[1])]
    assert item.rmse == pytest.approx(np.sqrt(np.mean(error**2)), rel=1e-12)
    assert item.claimed == pytest.approx(np.sqrt(np.mean(variance)), rel=1e-12)
    assert item.nees_per_dimension == pytest.approx(np.mean(error**2 / variance), rel=1e-12)
    spread = np.std(error**2 / variance, ddof=1) / 10
    assert item.nees_error == pytest.approx(spread, rel=1e-9)  # from sums of squares
    assert item.rmse_error == pytest.approx(np.std(error**2, ddof=1) / 10 / (2 * item.rmse), rel=1e-9)


@pytest.mark.parametrize("place", ["nowhere", "empty"])
def test_a_folder_without_results_is_one_line(place, tmp_path, capsys):
    (tmp_path / "empty").mkdir()
    assert cli.main(["explore", str(tmp_path / place), "--out", str(tmp_path / "out")]) == cli.BAD_INPUT
    known = capsys.readouterr().err
    assert (
        known.count("\n") == 1 and "expected results.zarr and summary.csv" in known and "got no results.zarr" in known
    )
    assert not (tmp_path / "out").exists()


@pytest.mark.real("browser")
def test_a_browser_draws_what_is_chosen(explored, tmp_path):
    page = tmp_path / "explore.html"
    page.write_text(explored)
    # A process of its own: this one has threads, and the browser is given its pipes by a fork.
    script = [sys.executable, str(Path(__file__).with_name("browse.py")), str(page), HOSTILE]
    completed = subprocess.run(script, capture_output=True, text=True, timeout=120)
    assert completed.returncode == 0, completed.stderr
