"""`heliograph backtest`: a page by horizon; horizons that are none, or longer than the data, are one line."""

import json

import numpy as np
import pytest

import heliograph as hg
from heliograph import cli

NETWORK = """
import heliograph as hg
plant = hg.LinearPlant([[0.9]], 0.5, [0.0], 2.0, states=["level"])
sensor = hg.LinearSensor([[1.0]], 0.5, outputs=["height"])
network = hg.Network(plant, {"a": hg.Node(sensor, hg.perfect(1), {"f": hg.kalman_filter(plant, sensor)})})
"""


@pytest.fixture
def call(tmp_path):
    (tmp_path / "level.py").write_text(NETWORK)
    draws = np.random.default_rng(0).normal(size=(2, 60))
    level, rows = 0.0, []
    for k in range(60):
        level = 0.9 * level + 0.5**0.5 * draws[0, k]
        rows.append(f"{k},{level + 0.5**0.5 * draws[1, k]}\n")
    (tmp_path / "data.csv").write_text("time,height\n" + "".join(rows))
    out = str(tmp_path / "results")
    return ["backtest", str(tmp_path / "level.py"), "--measurements", str(tmp_path / "data.csv"), "--out", out]


@pytest.mark.slow
def test_a_backtest_is_a_page_by_horizon(call, tmp_path, capsys):
    assert cli.main([*call, "--horizons", "1,5"]) == 0
    folder = tmp_path / "results" / "backtest"
    summary = json.loads((folder / "summary.json").read_text())
    assert [score["horizon"] for score in summary["scores"]] == [1, 5]
    assert "a/f received height, 5 ahead" in capsys.readouterr().out
    assert "By horizon" in (folder / "report.html").read_text()
    assert cli.main([*call, "--horizons", "80"]) == 2
    assert "end within the 60 rows of data" in capsys.readouterr().err


@pytest.mark.slow
def test_the_headline_is_what_each_filters_forecasts_are_worth(call, tmp_path):
    """The right filter holds; one that believes a hundredth of the noises is too sure, which is said once."""
    told = NETWORK.replace(
        '{"f": hg.kalman_filter(plant, sensor)}',
        """{
        "right": hg.kalman_filter(plant, sensor),
        "sure": hg.kalman_filter(hg.LinearPlant([[0.9]], 0.005, [0.0], 2.0, states=["level"]), sensor),
    }""",
    )
    (tmp_path / "level.py").write_text(told)
    assert cli.main([*call, "--horizons", "1,5"]) == 0
    page = (tmp_path / "results" / "backtest" / "report.html").read_text()
    assert "Forecasts of a/right hold, those of a/sure are too sure" in page
    assert page.count("furthest off") == 1 and "a/right: all 6 intervals held" in page


def test_horizons_are_rows(call, capsys):
    assert cli.main([*call, "--horizons", "5s"]) == 2
    assert "--horizons: expected numbers of rows" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--horizons", "0,5"], "--horizons: expected"),
        (["--skip", "-1"], "--skip: expected"),
        (["--skip", "0", "--refit", "20"], "--skip: expected"),
    ],
)
def test_counts_are_checked_before_anything_is_read(call, tmp_path, options, said, capsys):
    (tmp_path / "data.csv").unlink()
    assert cli.main([*call, *options]) == 2
    assert said in capsys.readouterr().err


@pytest.mark.slow
def test_refits_are_those_of_the_library(call, tmp_path, capsys):
    """`--refit 20`: scores as of `hg.backtest` with fits to the rows before; without free numbers a line."""
    assert cli.main([*call, "--horizons", "1", "--refit", "20"]) == 2
    assert "free" in capsys.readouterr().err
    (tmp_path / "level.py").write_text(NETWORK.replace("0.5, [0.0]", "hg.free(0.1, 'q'), [0.0]"))
    assert cli.main([*call, "--horizons", "1", "--skip", "30", "--refit", "20"]) == 0
    folder = tmp_path / "results" / "backtest"
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["refit"] == 20
    assert "fitted every 20 rows, to those before" in (folder / "report.html").read_text()

    def build():
        return hg.files.load_network(str(tmp_path / "level.py"))

    z = {"a": hg.files.read_table(tmp_path / "data.csv")["height"][:, None]}

    def refit(rows):
        return hg.fit(build, {"a": z["a"][:rows]}).network

    (score,) = hg.backtest(build(), z, [1], skip=30, refit=refit, every=20).scores
    assert summary["scores"][0]["log score"] == pytest.approx(score.log_score.value, rel=1e-9)


def test_a_refit_is_a_number_of_rows(call, capsys):
    assert cli.main([*call, "--refit", "-1"]) == 2
    assert "--refit: expected" in capsys.readouterr().err
