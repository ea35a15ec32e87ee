"""A fork of a process that has run something says so, where it would hang."""

import subprocess
import sys

PROGRAM = """
import multiprocessing, warnings
import heliograph as hg

def step(_):
    try:
        KALMAN.init()
    except ValueError as error:
        return str(error)

warnings.simplefilter("ignore")
KALMAN = hg.kalman_filter(hg.LinearPlant([[0.9]], 0.1, [0.0], 1.0), hg.LinearSensor([[1.0]], 0.1))
for compute in (False, True):
    if compute:
        KALMAN.init()
    with multiprocessing.get_context("fork").Pool(1) as pool:
        print(pool.map_async(step, [0]).get(60)[0])
"""
REFUSED = (
    'process: expected one started anew (multiprocessing.get_context("spawn")), got a fork of one in which JAX has '
    "run, which would hang"
)


def test_a_fork_is_said_before_it_hangs():
    completed = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, timeout=120)
    assert completed.stdout.splitlines() == ["None", REFUSED], completed.stderr
