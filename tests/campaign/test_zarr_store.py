"""A store notices what befell it: another campaign at once, damaged files, settings that hang, other flags."""

import fcntl
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from threading import Timer

import pytest

from heliograph import cli
from heliograph.campaign import job_engines
from heliograph.campaign.job_engines import run_in_processes
from heliograph.campaign.jobs import Job
from heliograph.campaign.run import run_campaign
from heliograph.disk import lock_folder
from heliograph.disk.atomic_files import try_lock
from tests.campaign.example import CAMPAIGN, CHUNKS, NETWORK, contents, write

LOCK = ".lock"
HOLD = """
import sys, time
from pathlib import Path
from heliograph.disk.atomic_files import lock_folder
with lock_folder(Path(sys.argv[1])) as alone:
    print(alone, flush=True)
    time.sleep(60)
"""


def holder(folder):
    process = subprocess.Popen([sys.executable, "-c", HOLD, str(folder)], stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "True\n"
    return process


@pytest.mark.slow
def test_one_campaign_a_folder_and_a_killed_one_holds_nothing(tmp_path, expected):
    campaign, out = write(tmp_path), tmp_path / "out"
    process = holder(out)
    with pytest.raises(ValueError, match=r"results folder .*out: expected no other campaign at work in it, got one"):
        run_campaign(campaign, out, workers=0)
    process.send_signal(signal.SIGKILL)
    process.wait()
    process.stdout.close()
    assert [path.name for path in out.iterdir()] == [LOCK]  # the file is left, the lock is not
    run_campaign(campaign, out, workers=0)
    assert contents(out) == expected and not (out / LOCK).exists()


def test_a_folder_made_for_the_lock_alone_goes_with_it(tmp_path):
    with lock_folder(tmp_path / "a" / "b") as alone, lock_folder(tmp_path / "a" / "b") as again:
        assert alone and not again
    assert not (tmp_path / "a").exists()
    with lock_folder(tmp_path / "a") as alone:
        assert alone
        (tmp_path / "a" / "results").touch()
    assert [path.name for path in (tmp_path / "a").iterdir()] == ["results"]


def test_a_lock_whose_file_was_removed_by_its_last_holder_is_taken_on_a_new_one(tmp_path, monkeypatch):
    lock, real = fcntl.flock, []

    def flock(handle, how):
        if not real:
            (tmp_path / LOCK).unlink()  # between our opening the file and locking it
        real.append(handle)
        lock(handle, how)

    monkeypatch.setattr(fcntl, "flock", flock)
    with lock_folder(tmp_path) as alone:
        assert alone and len(real) == 2
        with try_lock(tmp_path / LOCK) as ours:
            assert not ours


def spoil(path, how):
    data = path.read_bytes()
    if how == "cut":
        path.write_bytes(data[: len(data) // 2])
    elif how == "empty":
        path.write_bytes(b"")
    else:
        half = len(data) // 2
        path.write_bytes(data[:half] + bytes([data[half] ^ 1]) + data[half + 1 :])


@pytest.mark.slow
def test_a_damaged_chunk_is_named_and_computed_again(tmp_path, finished, expected, capsys, monkeypatch):
    write(tmp_path)
    monkeypatch.chdir(tmp_path)
    shutil.copytree(finished, tmp_path / "out")
    for setting, how in enumerate(("cut", "empty", "flipped")):
        spoil(tmp_path / f"out/results.zarr/error/c.{setting}.1.0.0.0.0", how)
        spoil(tmp_path / f"out/results.zarr/claim/c.{3 + setting}.0.0", how)
    assert cli.main(["sweep", "campaign.toml", "--out", "out", "--workers", "0"]) == 0
    said = capsys.readouterr()
    assert f"3 chunks computed, {CHUNKS - 3} were already there" in said.out
    for setting in range(3):
        for name in (f"error/c.{setting}.1.0.0.0.0", f"claim/c.{3 + setting}.0.0"):
            assert (
                f"heliograph: damaged, so it does not count as done: {tmp_path}/out/results.zarr/{name}\n" in said.err
            )
    assert contents(tmp_path / "out") == expected


def test_a_damaged_store_is_one_line(tmp_path):
    campaign, out = write(tmp_path), tmp_path / "out"
    run_campaign(campaign, out, workers=0, only=[(0, 0)])
    spoil(out / "results.zarr" / "zarr.json", "cut")
    with pytest.raises(ValueError, match=r"zarr.json: expected a store that can be read, or another folder, got a dam"):
        run_campaign(campaign, out, workers=0)


HANGING = NETWORK.replace(
    "    plant = hg", '    if gain == 0.7:\n        Path("hangs").touch()\n        time.sleep(600)\n    plant = hg', 1
)
READING = NETWORK.replace("    plant = hg", "    if gain == 0.7:\n        input()\n    plant = hg", 1)


@pytest.fixture
def out_of_time_where_it_hangs(tmp_path, monkeypatch):
    """The time of a job is over as soon as it hangs, and not before; gives what a job may take, as it was asked for."""
    requested = []

    class Hanging(Timer):
        def run(self):
            requested.append(self.interval)
            while not self.finished.wait(0.01):
                if (tmp_path / "hangs").exists():
                    (tmp_path / "hangs").unlink()
                    self.function()
                    return

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(job_engines, "Timer", Hanging)
    return requested


@pytest.mark.slow
@pytest.mark.parametrize(
    ("network", "error", "jobs"),
    [
        (HANGING, "TimedOut: no answer within 20 s, the campaign's timeout", 7),  # what is late is not tried again
        (READING, "InputError: network net.py:build: expected Python that runs, got EOFError", 9),
    ],
)
def test_a_setting_that_hangs_or_reads_is_a_failure_like_any_other(
    tmp_path, out_of_time_where_it_hangs, network, error, jobs
):
    text = CAMPAIGN.replace("seed = 5", "seed = 5\ntimeout = 20").replace("[0.1, 0.2]", "[0.1]")
    result = run_campaign(write(tmp_path, text, network), tmp_path / "out", workers=1)
    assert [failure.setting for failure in result.failures] == [1] and result.computed == 4
    assert result.failures[0].error.startswith(error)
    assert out_of_time_where_it_hangs == [20] * jobs  # 3 settings and 4 chunks
    assert json.loads((tmp_path / "out" / "failures.json").read_text())[0]["setting"] == 1


def test_seconds_are_counted(tmp_path):
    campaign = write(tmp_path)
    begun = time.monotonic()
    with run_in_processes(campaign.as_json(), tmp_path / "no store", 1, timeout=0.1) as engine:
        ((_, reply),) = engine([Job(0)])  # a process needs longer to import JAX
    assert reply.late and reply.error == "TimedOut: no answer within 0.1 s, the campaign's timeout"
    assert 0.1 <= time.monotonic() - begun < 20


@pytest.mark.parametrize("timeout", ["0", "-1", '"long"', "true", "inf", "nan"])
def test_a_timeout_is_a_positive_number(tmp_path, timeout):
    with pytest.raises(ValueError, match=r"campaign.toml, timeout: expected a positive number of seconds, got "):
        write(tmp_path, CAMPAIGN.replace("seed = 5", f"timeout = {timeout}"))


def test_a_timeout_decides_about_no_byte(tmp_path, finished):
    campaign = write(tmp_path, CAMPAIGN.replace("seed = 5", "seed = 5\ntimeout = 7"))
    assert run_campaign(campaign, finished, workers=0).computed == 0


def test_flags_that_decide_about_bytes_are_versions(tmp_path, finished, monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", "--xla_cpu_enable_fast_math=true")
    with pytest.raises(ValueError, match="got XLA_FLAGS --xla_cpu_enable_fast_math=true \\(was "):
        run_campaign(write(tmp_path), finished, workers=0)
    assert {"XLA_FLAGS", "device", "jax_default_matmul_precision", "jax"} <= write(tmp_path).versions.keys()


@pytest.mark.parametrize("address", ["nonsense", "tcp://127.0.0.1:1", "", "8786", "http://127.0.0.1:1"])
def test_no_scheduler_is_one_line(tmp_path, address, capfd, monkeypatch):
    write(tmp_path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(job_engines, "CONNECT", 1)
    begun = time.monotonic()
    assert cli.main(["sweep", "campaign.toml", "--out", "out", "--scheduler", address]) == cli.BAD_INPUT
    said = capfd.readouterr()
    assert said.err.startswith(f"heliograph: scheduler {address}".rstrip()) and said.err.count("\n") == 1
    assert time.monotonic() - begun < 40 and not (tmp_path / "out").exists()


@pytest.mark.slow
@pytest.mark.filterwarnings("default")  # of the cluster's own end
def test_a_scheduler_that_dies_is_one_line_and_the_next_run_goes_on(tmp_path, expected, monkeypatch):
    from dask import config
    from distributed import LocalCluster

    monkeypatch.setenv("PAUSE", "0.1")
    monkeypatch.setattr(job_engines, "CONNECT", 1)
    campaign, out = write(tmp_path), tmp_path / "out"
    impatient = config.set({"distributed.comm.timeouts.connect": "0.5s"})  # a worker that looks for its scheduler
    with impatient, LocalCluster(n_workers=1, threads_per_worker=1, processes=False, dashboard_address=None) as cluster:

        def end(what, done, total):
            if what == "simulating" and done == 2:
                cluster.sync(cluster.scheduler.close)

        with pytest.raises(ValueError, match="scheduler: expected one that goes on to the end, got a lost connection"):
            run_campaign(campaign, out, scheduler=cluster.scheduler_address, progress=end)
    monkeypatch.delenv("PAUSE")
    result = run_campaign(campaign, out, workers=0)
    assert result.already >= 2 and contents(out) == expected


def test_a_client_that_cannot_close_does_not_hide_why_the_work_ended(tmp_path, monkeypatch):
    import distributed

    class Ending:
        def __init__(self, *args, **options):
            pass

        def close(self, timeout):
            raise RuntimeError("Cannot change state of expiring Timeout")

    monkeypatch.setattr(distributed, "Client", Ending)
    with job_engines.run_on_cluster("", tmp_path, "tcp://127.0.0.1:1"):
        pass
    with pytest.raises(ValueError, match="the reason"), job_engines.run_on_cluster("", tmp_path, "tcp://127.0.0.1:1"):
        raise ValueError("the reason")


def test_leftovers_of_killed_processes_go_with_the_next_run(tmp_path, expected):
    campaign, out = write(tmp_path), tmp_path / "out"
    run_campaign(campaign, out, workers=0, only=[(0, 0)])
    for name in (".failures.json.partial", ".summary.csv.partial", LOCK):
        (out / name).write_text("half")
    (out / ".results.zarr-abcd1234" / "new").mkdir(parents=True)
    run_campaign(campaign, out, workers=0)
    assert contents(out) == expected
    assert sorted(path.name for path in out.iterdir()) == ["results.zarr", "summary.csv"]


NAMES = NETWORK.replace('"near"', 'r"[/red]$\\bad{$"').replace('"trusting"', "\"=cmd|' /C calc'!A0\\x1b[31m\"")


@pytest.mark.slow
def test_names_end_no_campaign_and_act_in_no_page(tmp_path, capsys, monkeypatch):
    write(tmp_path, CAMPAIGN.replace("[0.5, 0.7, 0.9]", '[0.5, 0.9]\nkind = ["@one"]'), NAMES)
    monkeypatch.chdir(tmp_path)
    assert cli.main(["sweep", "campaign.toml", "--out", "out", "--workers", "0"]) == 0
    said = capsys.readouterr()
    assert "\x1b[31m" not in said.out
    table = (tmp_path / "out" / "summary.csv").read_text()
    assert ",'=cmd|" in table and ",'@one," in table and "\x1b" not in table
    page = (tmp_path / "out" / "report.html").read_text()
    assert "\x1b" not in page and "[/red]" in page


@pytest.mark.slow
def test_a_worker_that_is_late_is_replaced(tmp_path, out_of_time_where_it_hangs):
    campaign = write(tmp_path, network=HANGING)
    with run_in_processes(campaign.as_json(), tmp_path / "no store", 1, timeout=15) as engine:
        late, described = (dict(engine([Job(setting)]))[Job(setting)] for setting in (2, 0))
    assert late.late and late.error.startswith("TimedOut")
    assert not described.late and described.value["labels"]["nodes"] == ["near"]


def test_the_process_that_is_killed_while_it_writes_leaves_only_what_the_next_clears(tmp_path):
    assert os.name == "posix"
    left = tmp_path / ".o.csv.999999999.partial"
    left.write_text("half")
    mine = tmp_path / f".o.csv.{os.getppid()}.partial"  # of a process that lives
    mine.write_text("half")
    import numpy as np

    from heliograph.files.tables.table import write_table

    write_table({"x": np.zeros(1)}, tmp_path / "o.csv")
    assert not left.exists() and mine.exists()
