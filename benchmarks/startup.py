"""What a user waits for before anything runs: help, import, and the first call of each method, which compiles.

Run: python benchmarks/startup.py. Seconds, each in a process of its own; "again" is a second process that finds the
first one's compiled programs on disk. Sources of Python are compiled before, as after any process that may write: else
each would compile those of JAX too, 1.8 s.
"""

import os
import subprocess
import sys
import tempfile
import time
from typing import Any

from alone import show

REPEATS = 3
NETWORK = """
plant = hg.{plant}
sensor, channel = hg.LinearSensor([[1.0, 0.0]], 0.1), hg.amplify_and_forward([hg.hop(hg.Rayleigh(1.0), 0.1)] * 2)
network = hg.Network(plant, {{"a": hg.Node(sensor, channel, {{"f": {filter}}})}})
hg.monte_carlo(network, 20, 64, 0, hg.Statistics())
"""
LINEAR = "LinearPlant([[0.9, 0.1], [0.0, 0.8]], 0.1, [0.0, 0.0], 1.0)"
NONLINEAR = "Plant(lambda x, u: x - 0.1 * jnp.sin(x), 0.1 * np.eye(2), [0.0, 0.0], np.eye(2))"
METHODS = {
    "linear filter": NETWORK.format(plant=LINEAR, filter="hg.linear_filter(plant, sensor, channel)"),
    "extended filter": NETWORK.format(plant=NONLINEAR, filter="hg.extended_filter(plant, sensor, channel)"),
    "cubature filter": NETWORK.format(plant=NONLINEAR, filter="hg.cubature_filter(plant, sensor, channel)"),
    "quadratic filter": NETWORK.format(plant=LINEAR, filter="hg.polynomial_filter(plant, sensor, channel, 20)"),
}
BEFORE = """import sys, time; import heliograph as hg, jax.numpy as jnp, numpy as np
hg.simulation.keep_compilations(sys.argv[1])
"""


def seconds(command: list[str]) -> float:
    """Time of a process, without settings that would share compiled programs, or leave sources of Python uncompiled."""
    left_out = ("JAX_", "PYTHONDONTWRITEBYTECODE")
    environment = {name: value for name, value in os.environ.items() if not name.startswith(left_out)}
    begun = time.perf_counter()
    subprocess.run(command, check=True, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    return time.perf_counter() - begun


def measure() -> dict[str, Any]:
    """Best of several for help and import; first and second process for each method, imports included."""
    help_command = [sys.executable, "-c", "from heliograph.cli import main; main(['--help'])"]
    import_command = [sys.executable, "-c", "import heliograph; heliograph.Network"]
    for program in METHODS.values():  # compiles the sources
        with tempfile.TemporaryDirectory() as folder:
            seconds([sys.executable, "-c", BEFORE + program, folder])
    values = {
        "heliograph --help": min(seconds(help_command) for _ in range(REPEATS)),
        "import heliograph, and use it": min(seconds(import_command) for _ in range(REPEATS)),
    }
    for name, program in METHODS.items():
        with tempfile.TemporaryDirectory() as folder:
            command = [sys.executable, "-c", BEFORE + program, folder]
            values[f"{name}, first process"] = seconds(command)
            values[f"{name}, again"] = seconds(command)
    return {"unit": "s", "values": values, "at_most": {"heliograph --help": 0.5, "import heliograph, and use it": 1.5}}


if __name__ == "__main__":
    show(measure())
