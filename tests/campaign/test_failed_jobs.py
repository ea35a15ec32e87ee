import json
import shlex

import numpy as np
import pytest

from heliograph import cli
from heliograph.campaign import jobs
from heliograph.campaign.job_engines import run_in_processes
from heliograph.campaign.jobs import Job
from heliograph.campaign.run import run_campaign
from heliograph.campaign.summary import open_results, read_summary
from tests.campaign.example import CAMPAIGN, CHUNKS, chunk_files, contents, write


@pytest.fixture
def trouble(tmp_path, monkeypatch):
    """A file that makes the settings with gain 0.7 fail, in the way that is written in it."""
    path = tmp_path / "trouble"
    monkeypatch.setenv("TROUBLE", str(path))
    jobs._build_network.cache_clear()
    yield path
    jobs._build_network.cache_clear()


def fail_chunk(monkeypatch, times: int) -> list[tuple[int, int]]:
    """Make chunk 1 of setting 4 fail so many times; returns what was tried."""
    tried, compute = [], jobs.compute_chunk

    def failing(campaign, network, chunk, store):
        tried.append((chunk.setting, chunk.number))
        if tried[-1] == (4, 1) and tried.count((4, 1)) <= times:
            raise RuntimeError("bad luck\nin two lines")
        compute(campaign, network, chunk, store)

    monkeypatch.setattr(jobs, "compute_chunk", failing)
    return tried


@pytest.mark.slow
def test_a_chunk_is_tried_again(tmp_path, expected, monkeypatch):
    tried = fail_chunk(monkeypatch, 2)
    result = run_campaign(write(tmp_path), tmp_path / "out", workers=0)
    assert (result.computed, result.failures) == (CHUNKS, [])
    assert tried.count((4, 1)) == 3 and len(tried) == CHUNKS + 2 and tried[-2:] == [(4, 1)] * 2
    assert contents(tmp_path / "out") == expected
    assert not (tmp_path / "out" / "failures.json").exists()


@pytest.mark.slow
def test_a_chunk_that_fails_is_reported_and_runs_alone(tmp_path, expected, monkeypatch, capsys):
    tried = fail_chunk(monkeypatch, 3)
    campaign, out = write(tmp_path), tmp_path / "out"
    result = run_campaign(campaign, out, workers=0)
    assert result.computed == CHUNKS - 1 and tried.count((4, 1)) == 3
    (entry,) = json.loads((out / "failures.json").read_text())
    assert entry["setting"] == 4 and entry["chunk"] == 1 and entry["runs"] == [64, 99]
    assert entry["parameters"] == {"gain": 0.9, "noise": 0.1} and entry["key"] == [5, *campaign.words(4)]
    assert (
        entry["error"] == "RuntimeError: bad luck in two lines" and 'raise RuntimeError("bad luck' in entry["traceback"]
    )
    assert str(result.failures[0]) == (
        "setting 4 (gain=0.9, noise=0.1), runs 64 to 99: RuntimeError: bad luck in two lines"
    )
    assert read_summary(out / "summary.csv")[4].runs == 64
    missing = np.isnan(open_results(out).error).all(("time", "node", "filter", "state"))
    assert missing.sum() == 36 and missing.sel(setting=4)[64:].all()

    program, *arguments = shlex.split(entry["command"])
    assert program == "heliograph"
    assert cli.main(arguments) == 0
    assert tried[-1] == (4, 1) and len(tried) == CHUNKS + 3
    assert "1 chunks computed, 0 were already there" in capsys.readouterr().out
    assert not (out / "failures.json").exists()
    assert contents(out) == expected


@pytest.mark.slow
def test_a_setting_that_cannot_be_built(tmp_path, expected, trouble):
    campaign, out = write(tmp_path), tmp_path / "out"
    trouble.write_text("raise")
    result = run_campaign(campaign, out, workers=0)
    assert [(f.setting, f.chunk, f.runs) for f in result.failures] == [(2, None, (0, 99)), (3, None, (0, 99))]
    assert "RuntimeError in line 40: no such gain" in result.failures[0].error
    assert result.computed == len(chunk_files(out)) == CHUNKS - 4
    assert [score.setting for score in read_summary(out / "summary.csv")] == [0, 1, 4, 5]
    assert run_campaign(campaign, out, workers=0, only=[(0, 0)]).already == 1
    assert len(json.loads((out / "failures.json").read_text())) == 2  # what was not tried stays
    trouble.unlink()
    result = run_campaign(campaign, out, workers=0)
    assert (result.already, result.computed, result.failures) == (CHUNKS - 4, 4, [])
    assert contents(out) == expected and not (out / "failures.json").exists()


def test_no_setting_can_be_built(tmp_path, trouble):
    trouble.write_text("raise")
    campaign = write(tmp_path, CAMPAIGN.replace("[0.5, 0.7, 0.9]", "[0.7]"))
    with pytest.raises(ValueError, match=r"can be built, got none: setting 0 gave .*no such gain"):
        run_campaign(campaign, tmp_path / "out", workers=0)
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_a_worker_that_dies_is_replaced(tmp_path, trouble):
    trouble.write_text("die")
    campaign = write(tmp_path)
    with run_in_processes(campaign.as_json(), tmp_path / "no store", 1) as engine:
        (died, described) = (dict(engine([Job(setting)]))[Job(setting)] for setting in (2, 0))
    assert died.error == "WorkerDied: the worker process ended with exit code 9"
    assert described.error == "" and described.value["labels"]["nodes"] == ["near"]
