"""Ctrl-C at any moment ends with 130, one line at most, and nothing half written."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from heliograph import cli
from heliograph.files.tables.table import read_table
from tests.cli.example import NETWORK, contents, run_arguments, stub_study

START = "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler); sys.argv[0] = 'heliograph'; "


@pytest.mark.parametrize(
    ("signal_number", "code"), [(signal.SIGINT, cli.INTERRUPTED), (signal.SIGTERM, cli.TERMINATED)]
)
def test_nothing_is_left_after_an_interrupt(folder, monkeypatch, signal_number, code):
    before, handler = contents(folder), signal.getsignal(signal.SIGTERM)

    def interrupt(*_):
        assert len(contents(folder)) == len(before) + 1
        signal.raise_signal(signal_number)

    monkeypatch.setattr(os, "replace", interrupt)
    inherited = signal.signal(signal.SIGINT, signal.default_int_handler)  # a background job inherits "ignore"
    try:
        assert cli.main(run_arguments()) == code
    except SystemExit as stopped:
        assert stopped.code == code
    finally:
        signal.signal(signal.SIGINT, inherited)
    assert contents(folder) == before
    assert signal.getsignal(signal.SIGTERM) is handler


def in_a_callback():
    class Removed:
        def __del__(self):
            signal.raise_signal(signal.SIGINT)  # an exception in here is swallowed, with a word on stderr

    item = Removed()
    del item
    for _ in range(500):  # of its own, a sleep of 5 s would be over first
        time.sleep(0.01)
    raise AssertionError("it went on")


def raised_as_something_else():
    try:
        signal.raise_signal(signal.SIGINT)
    except KeyboardInterrupt:
        raise RuntimeError("INTERNAL: KeyboardInterrupt") from None


def swallowing():
    try:
        signal.raise_signal(signal.SIGINT)
    except KeyboardInterrupt:
        return


@pytest.mark.parametrize("interrupt", [in_a_callback, raised_as_something_else, swallowing])
def test_an_interrupt_ends_with_130_whoever_swallows_it(folder, monkeypatch, capsys, interrupt):
    stub_study(monkeypatch, lambda *_: interrupt())
    inherited = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        assert cli.main(["demo", "--out", "results"]) == cli.INTERRUPTED
    finally:
        signal.signal(signal.SIGINT, inherited)
    assert capsys.readouterr().err == ""


@pytest.mark.slow
@pytest.mark.parametrize("delay", [0.0, 0.4, 1.2])
def test_ctrl_c_in_a_process_of_its_own(folder, delay):
    """From when the network's file is read: then all is loaded, traced and compiled."""
    (folder / "net.py").write_text("print('ready', flush=True)\n" + NETWORK)
    before = contents(folder)
    program = START + "from heliograph.__main__ import command; command()"
    process = subprocess.Popen([sys.executable, "-c", program, *run_arguments()], cwd=folder, text=True,
                               stdout=subprocess.PIPE, stderr=subprocess.PIPE)  # fmt: skip
    assert process.stdout.readline() == "ready\n"
    time.sleep(delay)
    process.send_signal(signal.SIGINT)
    said = process.communicate(timeout=60)[1]
    assert process.returncode in (0, cli.INTERRUPTED) and said.count("\n") <= 1
    left = contents(folder)
    assert process.returncode != 0 or "out.csv" in left
    if left.pop("out.csv", None) is not None:  # it was done, or interrupted between its last file and its end
        assert len(read_table(folder / "out.csv")["time"]) == len(read_table(folder / "data.csv")["time"])
    assert left == before


@pytest.mark.parametrize("module", ["cyclopts", "heliograph.cli"])
def test_ctrl_c_while_the_command_is_imported(folder, module):
    program = (
        START
        + f"""
class Interrupted:
    def find_spec(self, name, path=None, target=None):
        if name == "{module}":
            signal.raise_signal(signal.SIGINT)

from heliograph.__main__ import command
sys.meta_path.insert(0, Interrupted())
command()"""
    )
    done = subprocess.run([sys.executable, "-c", program, "--help"], capture_output=True, text=True, cwd=folder)
    assert (done.returncode, done.stderr, done.stdout) == (130, "", "")


@pytest.mark.parametrize("module", ["signal", "contextlib"])
def test_ctrl_c_is_heard_before_the_first_import(module):
    """Python's own start is over: from the first line of `heliograph.__main__` on."""
    program = f"""
import _signal, os, sys
_signal.signal(2, _signal.default_int_handler)  # what runs in the background ignores it
class Interrupted:
    def find_spec(self, name, path=None, target=None):
        if name == "{module}":
            os.kill(os.getpid(), 2)

before = set(sys.modules)
import heliograph
assert set(sys.modules) - before == {{"heliograph"}}, set(sys.modules) - before  # or Ctrl-C meets these imports
sys.meta_path.insert(0, Interrupted())
from heliograph.__main__ import command"""

    environment = {**os.environ, "PYTHONPATH": str(Path(cli.__file__).parents[2])}
    # `-S`: what `site` loads may import both.
    done = subprocess.run([sys.executable, "-S", "-c", program], env=environment, capture_output=True, text=True)
    assert (done.returncode, done.stderr, done.stdout) == (130, "", "")


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_while_a_module_in_c_is_imported_says_nothing(folder, number):
    """JAX has modules in C that import NumPy: they print what is raised in that, or die of it."""
    program = (
        START
        + f"""
from heliograph.__main__ import command

class Interrupted:
    def find_spec(self, name, path=None, target=None):
        if name == "numpy.matrixlib":
            sys.meta_path.remove(self)
            signal.raise_signal({int(number)})

sys.meta_path.insert(0, Interrupted())
command()"""
    )
    done = subprocess.run(
        [sys.executable, "-c", program, "check", "net.py"], capture_output=True, text=True, cwd=folder
    )
    assert (done.returncode, done.stderr, done.stdout) == (128 + number, "", "")
