"""A second process does not compile again what a first one has."""

import os
import subprocess
import sys
from pathlib import Path

import jax
import pytest

import heliograph as hg

PROGRAM = """
import sys, heliograph
heliograph.simulation.keep_compilations(sys.argv[1])
import jax, numpy as np
received = []
jax.monitoring.register_event_listener(lambda name, **_: received.append(name))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
plant = heliograph.LinearPlant([[0.9]], 0.1, [0.0], 1.0)
sensor, channel = heliograph.LinearSensor([[1.0]], 0.1), heliograph.hop(1.0, 0.1)
item = heliograph.cubature_filter(plant, sensor, channel)
network = heliograph.Network(plant, {"a": heliograph.Node(sensor, channel, {"f": item})})
print(repr(float(heliograph.monte_carlo(network, 3, 2, 0).truth.sum())))
print(received.count("/jax/compilation_cache/cache_hits"), received.count("/jax/compilation_cache/cache_misses"))
"""


def clean():
    """Of a process whose simulations XLA compiles, and which nobody gave a folder."""
    ours = "JAX_COMPILATION_CACHE_DIR", "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"
    return {name: value for name, value in os.environ.items() if name not in ours} | {"HELIOGRAPH_ENGINE": "xla"}


@pytest.mark.slow
def test_a_second_process_compiles_nothing(tmp_path):
    def run():
        command = [sys.executable, "-c", PROGRAM, str(tmp_path / "cache")]
        value, counts = subprocess.run(command, env=clean(), capture_output=True, text=True, check=True).stdout.split(
            "\n"
        )[:2]
        return value, *map(int, counts.split())

    first, second = run(), run()
    assert first[0] == second[0]  # bit for bit
    assert first[2] > 0 and second[2] == 0 and second[1] >= first[2]


def test_the_choice_of_the_user_stays(monkeypatch, tmp_path):
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path))
    assert hg.simulation.keep_compilations(tmp_path / "other") == tmp_path
    assert not (tmp_path / "other").exists()


def test_a_folder_that_cannot_be_made_is_refused(monkeypatch, tmp_path):
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR", raising=False)
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match=r"folder .*file/inside: expected one that can be made"):
        hg.simulation.keep_compilations(tmp_path / "file" / "inside")


def test_the_folder_is_its_users_alone(monkeypatch, tmp_path):
    """What is compiled is run: nobody else may write it, whatever the umask."""
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    before = os.umask(0)
    try:
        for folder in (None, tmp_path / "mine"):
            with monkeypatch.context() as patch:
                patch.setattr(jax.config, "update", lambda *_: None)
                made = hg.simulation.keep_compilations(folder)
                assert made.stat().st_mode & 0o777 == 0o700
                made.chmod(0o777)  # as it once was made
                patch.delenv("JAX_COMPILATION_CACHE_DIR")
                hg.simulation.keep_compilations(folder)
                assert made.stat().st_mode & 0o777 == 0o700
            os.environ.pop("JAX_COMPILATION_CACHE_DIR", None)
    finally:
        os.umask(before)


def test_no_home_folder_is_one_line(monkeypatch):
    for name in ("JAX_COMPILATION_CACHE_DIR", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)

    def homeless():
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(Path, "home", homeless)
    with pytest.raises(ValueError, match="folder for compiled programs: expected one, or a home folder to make it in"):
        hg.simulation.keep_compilations()


def test_import_is_lazy_and_changes_no_configuration():
    program = (
        "import sys, heliograph; assert 'jax' not in sys.modules; heliograph.Network; import jax, os; "
        "assert not jax.config.jax_enable_x64 and jax.config.jax_compilation_cache_dir is None"
    )
    subprocess.run([sys.executable, "-c", program], env=clean(), check=True)
