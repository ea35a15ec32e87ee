"""The example of learned links: its rows, one small batch of them, and the shape of what it writes."""

import json

import numpy as np
import pytest

import heliograph as hg
from heliograph_studies import learning
from heliograph_studies.learning import LAWS, METHODS, ROWS, Setting, learned, true_values, world
from heliograph_studies.outcome import summary
from heliograph_studies.stages import Stages
from heliograph_studies.study import no_progress

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
        assert world(row).nodes["node"].received == (1 if row.law == "uninformed" else 2)


def stages(folder):
    return Stages("learning", no_progress, folder, "the same setting")


def test_a_batch_is_counted_once_and_stored(tmp_path, monkeypatch):
    """Few and short recordings: intervals by cosines cover most of the truth, and the second call computes nothing."""
    row, setting = ROWS[3]._replace(steps=200), Setting(batches=1, batch=32)
    assert row.name == "two_point" and row.form == "conditional"
    first = learning.table(setting, stages(tmp_path), (row,))

    def again(*_):
        raise AssertionError("counted twice")

    monkeypatch.setattr(learning, "counts", again)
    assert learning.table(setting, stages(tmp_path), (row,)) == first
    result = first["two_point"]["conditional"]
    assert result.recordings == 32 and result.left_out < 0.5
    assert min(result.covered["cosines"].values()) > 75  # 95 less four standard errors of 32
    assert set(result.covered) == set(METHODS)


@pytest.fixture
def outcome():
    """As it would be counted, with other numbers."""
    names = {"uninformed": ("plant_noise", "hop_noise", "arrival")}
    usual = ("mean_gain", "gain_variance", "hop_noise", "plant_noise", "sensor_noise")
    rng, recordings = np.random.default_rng(0), {}
    for row in ROWS:
        covered = {m: {n: float(rng.uniform(40, 99)) for n in names.get(row.name, usual)} for m in METHODS}
        recordings.setdefault(row.name, {})[row.form] = learning.Coverage(640, 0.01, covered)
    coverage = {law: {form: c.covered for form, c in forms.items()} for law, forms in recordings.items()}
    drive = {"rmse": 0.3, "calibrated": 0.35, "second_half": 0.31, "second_half_calibrated": 0.34}
    relayed = {"seed": [0, 1], "rmse": [0.8, 0.9], "calibrated": [1.2, 1.4]}
    return learning.Outcome(95.0, 64, coverage, recordings, {"direct": drive, "relayed": relayed})


def test_the_summary(outcome):
    summary_ = json.loads(json.dumps(summary(outcome)))
    assert set(summary_["coverage"]) == {row.name for row in ROWS}
    assert set(summary_["coverage"]["rare"]) == {"linear", "conditional"}
    assert set(summary_["coverage"]["uninformed"]["conditional"]["cosines"]) == {"plant_noise", "hop_noise", "arrival"}
    assert summary_["recordings"]["rare"]["linear"] == {"recordings": 640, "left_out": 0.01}
    assert summary_["plaza"] == outcome.plaza


def test_the_page_shows_every_row_and_the_recorded_drive(outcome, fits):
    drawn = learning.figures(outcome)
    assert len(drawn) == 1
    page = learning.example.make_page(Setting(), outcome, {}, {name: b"<svg/>" for name in drawn})
    html = page.html()
    fits(html)
    assert html.count("data:image/svg+xml") == 1
    for words in (*learning.labelled(outcome), "On a recorded drive", "relayed, mean", "0.85", "1.30", "0.310"):
        assert words in html


def test_pieces_of_the_drive_are_computed_once_and_stored(tmp_path, monkeypatch):
    pytest.importorskip("gtsam")
    calls = []
    monkeypatch.setattr(learning, "of_direct", lambda recording: calls.append("direct") or {"rmse": 0.3})
    monkeypatch.setattr(learning, "of_relayed", lambda _, seed: calls.append(seed) or {"seed": seed, "rmse": 0.8})
    first = learning.plaza(Setting(), stages(tmp_path))
    assert first == {"direct": {"rmse": 0.3}, "relayed": {"seed": [0, 1, 2, 3, 4], "rmse": [0.8] * 5}}
    assert learning.plaza(Setting(), stages(tmp_path)) == first
    assert calls == ["direct", 0, 1, 2, 3, 4]
