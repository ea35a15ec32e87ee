"""Kill and restart, any number of workers, a cluster that loses a worker: the same bytes."""

import os
import signal
import subprocess
import sys
import time

import pytest

from heliograph.campaign.run import run_campaign
from heliograph.campaign.summary import open_results
from tests.campaign.example import CHUNKS, chunk_files, contents, write

pytestmark = pytest.mark.slow

DRIVER = """
import sys
import heliograph as hg
hg.campaign.run_campaign(hg.campaign.load_campaign("campaign.toml"), "out", workers=int(sys.argv[1]))
"""


def start_and_kill(folder, workers: int, chunks: int) -> int:
    """Start a campaign in a process of its own, kill it once so many chunks are there; return how many there are.

    The workers are groups of their own: they end when the chunk that they compute is written.
    """
    process = subprocess.Popen(
        [sys.executable, "-c", DRIVER, str(workers)],
        cwd=folder,
        env=os.environ | {"PAUSE": "0.3"},  # at each of the 6 settings, so that the campaign cannot be done yet
        stderr=subprocess.PIPE,  # inherited by the workers: it ends when the last of them is dead and writes no more
    )
    deadline = time.monotonic() + 60
    while not (folder / "out").is_dir() or len(chunk_files(folder / "out")) < chunks:
        assert process.poll() is None, "the campaign ended before it could be killed"
        assert time.monotonic() < deadline
        time.sleep(0.01)
    process.kill()
    process.communicate()
    return len(chunk_files(folder / "out"))


def test_kill_and_restart(tmp_path, expected):
    campaign = write(tmp_path)
    there = start_and_kill(tmp_path, 2, 3)
    assert 3 <= there < CHUNKS and not (tmp_path / "out" / "summary.csv").exists()
    result = run_campaign(campaign, tmp_path / "out", workers=0)
    # A chunk whose first file is there may lack the others: at most one for each worker.
    assert there - 2 <= result.already <= there and result.computed == CHUNKS - result.already
    assert contents(tmp_path / "out") == expected


def test_a_chunk_half_written_is_written_again(tmp_path, expected):
    campaign, out = write(tmp_path), tmp_path / "out"
    named_twice = [(0, 0), (0, 1), (5, 0), (0, 0)]
    assert run_campaign(campaign, out, workers=0, only=named_twice).computed == len(chunk_files(out)) == 3
    (out / "results.zarr" / "variance" / "c.0.1.0.0.0.0").unlink()
    (out / "results.zarr" / "variance" / "c.0.1.0.0.0.0123abcd.partial").write_bytes(b"half")
    (out / ".results.zarr-killed_1").mkdir()
    result = run_campaign(campaign, out, workers=0)
    assert (result.already, result.computed) == (2, CHUNKS - 2)
    assert contents(out) == expected


def test_killed_before_the_store_is_whole(tmp_path, expected):
    campaign, out = write(tmp_path), tmp_path / "out"
    (out / ".results.zarr-killed_1" / "new").mkdir(parents=True)
    run_campaign(campaign, out, workers=0)
    assert contents(out) == expected and not list(out.glob(".*"))


def test_two_workers_one_of_which_dies(tmp_path, expected, monkeypatch):
    trouble = tmp_path / "trouble"
    trouble.write_text("die once")
    monkeypatch.setenv("TROUBLE", str(trouble))
    result = run_campaign(write(tmp_path), tmp_path / "out", workers=2)
    assert not trouble.exists() and (result.computed, result.failures) == (CHUNKS, [])
    assert contents(tmp_path / "out") == expected


@pytest.mark.filterwarnings("default")  # of the cluster's own shutdown, after a worker was killed
def test_a_cluster_whose_worker_is_killed(tmp_path, expected, monkeypatch):
    from distributed import LocalCluster

    monkeypatch.setenv("PAUSE", "0.1")  # inherited by the workers
    killed = []
    with LocalCluster(n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None) as cluster:
        pids = [worker.pid for worker in cluster.workers.values()]

        def kill_one(what, done, total):
            if what == "simulating" and done == 3 and not killed:
                killed.append(pids[0])
                os.kill(pids[0], signal.SIGKILL)

        result = run_campaign(write(tmp_path), tmp_path / "out", scheduler=cluster.scheduler_address, progress=kill_one)
    assert killed and (result.computed, result.failures) == (CHUNKS, [])
    assert contents(tmp_path / "out") == expected
    assert open_results(tmp_path / "out").error.notnull().all()
