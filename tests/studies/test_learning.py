"""The example of learned links: its rows, one small batch of them, and the shape of what it writes."""

import json

import numpy as np
import pytest

import heliograph as hg
from heliograph_studies.learning import compute, page, plaza, run
from heliograph_studies.learning.setting import LAWS, METHODS, ROWS, learned, true_values, world

pytestmark = pytest.mark.slow


def test_the_laws_have_the_moments_that_are_to_be_learned():
    for name, law in LAWS.items():
        assert law.moment(1) == pytest.approx(0.8)
        if name != "rayleigh":
            assert law.moment(2) - law.moment(1) ** 2 == pytest.approx(0.16)


def test_what_is_learned_starts_at_the_truth():
    for row in ROWS:
        result = hg.learning.describe(lambda row=row: learned(row)).parameters
        assert {item.name: float(item.start) for item in result.every} == pytest.approx(true_values(row))
        assert world(row).nodes["node"].received == (1 if row.law == "untold" else 2)


def test_a_batch_is_counted_once_and_kept(tmp_path, monkeypatch):
    """Few and short recordings: intervals by cosines cover most of the truth, and the second call computes nothing."""
    row = ROWS[3]._replace(steps=200)
    assert row.name == "two_point" and row.form == "conditional"
    monkeypatch.setattr(compute, "BATCH", 32)
    monkeypatch.setattr(compute, "ROWS", (row,))
    first = compute.compute(tmp_path, 0, 1, lambda what: None)

    def again(*_):
        raise AssertionError("counted twice")

    monkeypatch.setattr(compute, "counts", again)
    assert compute.compute(tmp_path, 0, 1, lambda what: None) == first
    (result,) = first.values()
    assert result.recordings == 32 and result.left_out < 0.5
    assert min(result.covered["cosines"].values()) > 75  # 95 less four standard errors of 32
    assert set(result.covered) == set(METHODS)


@pytest.fixture
def coverage():
    """As it would be counted, with other numbers."""
    names = {"untold": ("plant_noise", "hop_noise", "arrival")}
    usual = ("mean_gain", "gain_variance", "hop_noise", "plant_noise", "sensor_noise")
    rng = np.random.default_rng(0)
    return {
        f"{row.name}.{row.form}": compute.Coverage(
            640, 0.01, {m: {n: float(rng.uniform(40, 99)) for n in names.get(row.name, usual)} for m in METHODS}
        )
        for row in ROWS
    }


def test_the_summary(coverage):
    summary = json.loads(json.dumps(run.summary(coverage)))
    assert set(summary["coverage"]) == {row.name for row in ROWS}
    assert set(summary["coverage"]["rare"]) == {"linear", "conditional"}
    assert set(summary["coverage"]["untold"]["conditional"]["cosines"]) == {"plant_noise", "hop_noise", "arrival"}
    assert summary["recordings"]["rare"]["linear"] == {"recordings": 640, "left_out": 0.01}


def test_the_page_shows_every_row(coverage):
    pytest.importorskip("jinja2")
    figures = page.learning_figures(coverage)
    html = page.learning_page(coverage, {name: b"<svg/>" for name in figures}).html()
    assert html.count("data:image/svg+xml") == len(figures) == 1
    assert all(page.labelled(key) in html for key in coverage)


def drive_numbers():
    item = {"rmse": 0.3, "calibrated": 0.35, "second_half": 0.31, "second_half_calibrated": 0.34}
    items = {"seed": [0, 1], "rmse": [0.8, 0.9], "calibrated": [1.2, 1.4]}
    return {"direct": item, "relayed": items}


def test_the_recorded_drive_stands_in_summary_and_page(coverage, fits):
    pytest.importorskip("jinja2")
    known = run.results(run.Outcome(coverage, drive_numbers()))
    assert known.summary["plaza"] == drive_numbers() and "coverage" in known.summary
    html = known.page({name: b"<svg/>" for name in known.figures}).html()
    fits(html)
    for words in ("On a recorded drive", "relayed, mean", "0.85", "1.30", "0.310"):
        assert words in html


def test_pieces_of_the_drive_are_found_once_and_kept(tmp_path, monkeypatch):
    pytest.importorskip("gtsam")
    calls = []
    monkeypatch.setattr(plaza, "of_direct", lambda recording: calls.append("direct") or {"rmse": 0.3})
    monkeypatch.setattr(plaza, "of_relayed", lambda recording, seed: calls.append(seed) or {"seed": seed, "rmse": 0.8})
    first = plaza.plaza(tmp_path, lambda what: None)
    assert first == {"direct": {"rmse": 0.3}, "relayed": {"seed": [0, 1, 2, 3, 4], "rmse": [0.8] * 5}}
    assert plaza.plaza(tmp_path, lambda what: None) == first
    assert calls == ["direct", 0, 1, 2, 3, 4]
