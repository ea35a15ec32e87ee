"""The command, its progress, its figures and its page."""

import pytest

from heliograph import cli
from heliograph.campaign.failed_jobs import FailedJob
from heliograph.campaign.report_page import draw_campaign_figures, make_campaign_page
from heliograph.campaign.summary import read_summary
from heliograph.report.progress import Countdown, format_remaining
from tests.campaign.example import CAMPAIGN, write


@pytest.fixture
def folder(tmp_path, monkeypatch):
    write(tmp_path, CAMPAIGN.replace("[0.5, 0.7, 0.9]", "[0.5]"))
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.slow
def test_sweep(folder, capsys):
    command = ["sweep", "campaign.toml", "--out", "results/a", "--workers", "0"]
    assert cli.main(command) == 0
    said = capsys.readouterr()
    assert "results/a: 4 chunks computed, 0 were already there\nReport: results/a/report.html\n" in said.out
    assert "trusting" in said.out and "100/100" in said.out and said.err == ""
    assert sorted(p.name for p in (folder / "results/a").iterdir()) == ["report.html", "results.zarr", "summary.csv"]
    assert "2 settings, 100 runs each" in (folder / "results/a/report.html").read_text()
    assert cli.main(command) == 0
    assert "results/a: nothing to compute, all 4 chunks are already there" in capsys.readouterr().out
    next((folder / "results/a/results.zarr/error").glob("c.1.*")).unlink()
    assert cli.main(command) == 0
    said = capsys.readouterr()
    assert "1 chunks computed, 3 were already there" in said.out
    assert said.err == "3 of 4 chunks are already there\n"


@pytest.mark.parametrize(
    ("arguments", "fragments"),
    [
        (["no.toml", "--out", "o"], ["campaign no.toml: expected a TOML file, got nothing of that name"]),
        (["campaign.toml"], ["--out"]),
        (["campaign.toml", "--out", "net.py"], ["output folder net.py: expected a folder, got a file"]),
        (["campaign.toml", "--out", "."], ["a new or empty folder"]),
        (["campaign.toml", "--out", "o", "--setting", "2"], ["--setting: expected a number from 0 to 1, got 2"]),
        (["campaign.toml", "--out", "o", "--chunk", "0"], ["--chunk: expected a --setting whose chunk it is"]),
        (["campaign.toml", "--out", "o", "--setting", "1", "--chunk", "2"], ["--chunk: expected a number from 0 to 1"]),
        (["campaign.toml", "--out", "o", "--workers", "-1"], ["workers: expected a whole number of at least 0"]),
    ],
)
def test_bad_sweeps(folder, capsys, arguments, fragments):
    before = sorted(folder.rglob("*"))
    assert cli.main(["sweep", *arguments]) == cli.BAD_INPUT
    said = capsys.readouterr()
    assert said.out == "" and said.err.startswith("heliograph: ") and said.err.count("\n") == 1
    for fragment in fragments:
        assert fragment in said.err
    assert sorted(folder.rglob("*")) == before


def test_the_time_left():
    now = [0.0]
    countdown = Countdown(2, lambda: now[0])
    for second, done in [(0, 10), (30, 11), (31, 12)]:  # each of two workers compiles for half a minute
        now[0] = float(second)
        countdown.note(done)
    assert countdown.left(20) is None
    for second, done in [(33, 13), (35, 14)]:
        now[0] = float(second)
        countdown.note(done)
    assert countdown.left(20) == pytest.approx(2.0 * 6)
    now[0] = 40.0
    assert countdown.left(20) == pytest.approx(2.0 * 6 - 5)
    assert [format_remaining(s) for s in (None, 90.0, 150.0, 9000.0)] == [
        "time left unknown yet",
        "about 90 s left",
        "about 2 min left",
        "about 2 h left",
    ]


def test_figures(tmp_path, finished):
    campaign, scores = write(tmp_path), read_summary(finished / "summary.csv")
    figures = draw_campaign_figures(campaign, scores)
    assert list(figures) == [
        "rmse against gain",
        "rmse against noise",
        "nees_per_dimension against gain",
        "nees_per_dimension against noise",
    ]
    figure = figures["rmse against gain"]
    assert [axes.get_title(loc="left") for axes in figure.axes] == ["near, noise = 0.1", "near, noise = 0.2"]
    (line,) = [line for line in figure.axes[1].lines if len(line.get_xdata()) == 3]
    assert list(line.get_xdata()) == [0.5, 0.7, 0.9]
    assert list(line.get_ydata()) == [scores[i].rmse for i in (1, 3, 5)]


def test_words_make_no_axis(tmp_path, finished):
    text = CAMPAIGN.partition("[grid]")[0] + '[grid]\ngain = [0.5]\nkind = ["one", "two"]\n'
    figures = draw_campaign_figures(write(tmp_path, text), read_summary(finished / "summary.csv")[:2])
    assert list(figures) == ["rmse by setting", "nees_per_dimension by setting"]
    labels = [label.get_text() for label in figures["rmse by setting"].axes[0].get_yticklabels()]
    assert labels == ["gain = 0.5, kind = one", "gain = 0.5, kind = two"]
    six = text.replace('["one", "two"]', '["one", "two", "three", "four", "five", "six"]')
    figures = draw_campaign_figures(write(tmp_path, six), read_summary(finished / "summary.csv"))
    assert len(figures["nees_per_dimension by setting"].axes[0].get_yticklabels()) == 6


@pytest.mark.slow
def test_the_page_says_what_failed(tmp_path, finished, fits):
    entry = FailedJob(3, {"gain": 0.7}, 1, (64, 99), (5, 0, 0), "RuntimeError: <bad> luck", "", "heliograph sweep x")
    html = make_campaign_page(write(tmp_path), read_summary(finished / "summary.csv"), [entry]).html()
    fits(html)
    for text in ("What failed", "RuntimeError: &lt;bad&gt; luck", "heliograph sweep x", "runs 64 to 99"):
        assert text in html
