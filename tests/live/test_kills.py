"""A stream in a process that is killed with -9 goes on from its file with the same bits."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import heliograph as hg

STEPS, KILLS, BETWEEN = 120, 2, 40


def stream_filter():
    plant = hg.LinearPlant([[0.9, 0.1], [0.0, 0.8]], np.diag([0.1, 0.2]), [1.0, 0.0], np.eye(2))
    return hg.linear_filter(plant, hg.LinearSensor([[1.0, 0.5]], 0.3), hg.hop(hg.Rayleigh(0.8), 0.02))


def measurements():
    z = np.random.default_rng(2).normal(size=(STEPS, 1))
    return np.where(np.random.default_rng(3).random(z.shape) < 0.1, np.nan, z)


def go_on(path: Path) -> None:
    """Push what is left, and keep the stream after each row; say so."""
    stream = hg.Stream.restore(stream_filter(), path.read_bytes()) if path.exists() else hg.Stream(stream_filter())
    for z in measurements()[stream.steps :]:
        stream.push(z)
        path.with_suffix(".new").write_bytes(stream.save())
        path.with_suffix(".new").replace(path)
        print(stream.steps, flush=True)


@pytest.mark.slow
def test_a_stream_that_is_killed_goes_on_with_the_same_bits(tmp_path):
    path = tmp_path / "stream"
    code = "import sys; from tests.live.test_kills import *; go_on(Path(sys.argv[1]))"
    command = [sys.executable, "-c", code, str(path)]
    for kill in range(KILLS):
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        assert process.stdout is not None
        for line in process.stdout:
            if int(line) >= BETWEEN * (kill + 1):
                os.kill(process.pid, signal.SIGKILL)
                break
        process.communicate()
        assert process.returncode == -signal.SIGKILL
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    undisturbed = hg.Stream(stream_filter())
    for z in measurements():
        undisturbed.push(z)
    resumed = hg.Stream.restore(stream_filter(), path.read_bytes())
    assert resumed.steps == STEPS
    for a, b in zip(resumed._stepper.state, undisturbed._stepper.state, strict=True):
        np.testing.assert_array_equal(a, b)
