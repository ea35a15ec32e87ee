import os
import signal
import subprocess
import sys
import time
from types import ModuleType

import numpy as np
import pytest

import heliograph as h
from heliograph import cli
from heliograph.files.network_file import load_network
from heliograph.files.recording import read_recording
from heliograph.files.table import read_table
from heliograph.numerics.check import InputError

NETWORK = """
import jax.numpy as jnp
import numpy as np

import heliograph as h


def move(x, u):
    return x + u[1] * jnp.array([x[1], u[0]])


plant = h.Plant(move, 0.01 * np.eye(2), [0, 0], np.eye(2), states=["p", "v"], inputs=["push", "dt"])
sensor = h.LinearSensor([[1.0, 0.0]], 0.1, outputs=["pos"])
link = h.hop(h.Discrete([0.8, 1.2], [0.5, 0.5]), 0.1)
filters = {
    "aware": h.cubature_filter(plant, sensor, link),
    "trusting": h.mean_gain_filter(plant, sensor, link),
}
network = h.Network(plant, {"remote": h.Node(sensor, link, filters)})
"""
LOSING = """
import equinox as eqx


class Losing(h.filters.AbstractFilter):
    claim: str = eqx.field(static=True, default="nominal")
    states: tuple = eqx.field(static=True, default=("p", "v"))
    inputs: tuple = eqx.field(static=True, default=("push", "dt"))
    received: int = eqx.field(static=True, default=1)

    def init(self):
        return jnp.ones(2)

    def predict(self, state, u=(), k=0):
        return jnp.stack([1.0, jnp.where(k >= 2, -1.0, 1.0)])

    def correct(self, state, z, k=0):
        return state, h.model.Innovation(z, jnp.eye(1), 0.0)

    def estimate(self, state):
        return h.model.Estimate(0 * state, jnp.diag(state), self.claim)


network = h.Network(plant, {"remote": h.Node(sensor, link, {"losing": Losing()})})
"""
DATA = "time,push,pos\n0,0,0.5\n0.5,1,\n0.5,0,0.7\n2,0.5,nan\n"


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "net.py").write_text(NETWORK)
    (tmp_path / "data.csv").write_text(DATA)
    return tmp_path


def contents(folder):
    return {str(p.relative_to(folder)): p.is_file() and p.read_bytes() for p in folder.rglob("*")}


def run_arguments(network="net.py", measurements="data.csv", out="out.csv") -> list[str]:
    return ["run", network, "--measurements", measurements, "--out", out]


def test_run_writes_what_the_library_computes(folder, capsys):
    assert cli.main(run_arguments()) == 0
    said = capsys.readouterr()
    assert said.out == "out.csv: 4 rows of remote/aware (nominal), remote/trusting (nominal)\n"
    assert said.err == ""
    assert sorted(contents(folder)) == ["data.csv", "net.py", "out.csv"]
    net = load_network("net.py")
    recording, table = read_recording("data.csv", net), read_table("out.csv")
    np.testing.assert_array_equal(table["time"], [0, 0.5, 0.5, 2])
    for name in ("aware", "trusting"):
        stream = h.Stream(net.nodes["remote"].filters[name])
        for k in range(4):
            estimate = stream.push(recording.measurements["remote"][k], recording.inputs[k])
            row = {key: table[f"{name}.{key}"][k] for key in ("p", "v", "p.sd", "v.sd", "cov.p.v", "valid")}
            found = [row["p"], row["v"], row["p.sd"] ** 2, row["v.sd"] ** 2, row["cov.p.v"]]
            bound = estimate.covariance
            expected = [*estimate.mean, bound[0, 0], bound[1, 1], bound[0, 1]]
            # compiled apart, and the variance went through a root and back: rounding only
            np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12)
            assert row["valid"] == 1


def test_run_writes_what_later_rows_say_too(folder, capsys):
    assert cli.main([*run_arguments(), "--smooth", "1", "--report", "page"]) == 0
    assert (folder / "page" / "smoothed_0.png").is_file() and "given later data too" in (
        folder / "page" / "report.html"
    ).read_text()
    net, table = load_network("net.py"), read_table("out.csv")
    found = h.run(net, *read_recording("data.csv", net), smooth=h.smoothing.FixedLag(1)).smoothed
    for name, estimate in found.estimates["remote"].items():
        np.testing.assert_allclose(table[f"{name}.smoothed.p"], estimate.mean[:, 0], rtol=1e-12)
        assert table[f"{name}.smoothed.v.sd"][1] < table[f"{name}.v.sd"][1]
    assert cli.main([*run_arguments(), "--smooth", "soon"]) == 2
    assert "--smooth: expected all, or how many later rows, got 'soon'" in capsys.readouterr().err


def test_names_do_not_act_on_the_terminal(folder, capsys):
    (folder / "net.py").write_text(NETWORK.replace('"aware"', '"\\x1b[31maware"'))
    assert cli.main(run_arguments()) == 0
    said = capsys.readouterr()
    assert "\x1b" not in said.out and "\\x1b[31maware" in said.out


def test_a_lost_covariance_is_said_and_flagged(folder, capsys):
    (folder / "net.py").write_text(NETWORK + LOSING)
    assert cli.main(run_arguments()) == 0
    expected = "heliograph: warning: remote/losing: no valid covariance from step 2 in 1 of 1 runs\n"
    assert capsys.readouterr().err == expected
    table = read_table("out.csv")
    np.testing.assert_array_equal(table["valid"], [1, 1, 0, 0])
    np.testing.assert_array_equal(table["v.sd"], [1, 1, np.nan, np.nan])


def refused(folder, capsys, arguments, *fragments) -> None:
    before = contents(folder)
    assert cli.main(arguments) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.startswith("heliograph: ") and said.err.endswith("\n") and said.err.count("\n") == 1
    for fragment in fragments:
        assert fragment in said.err
    assert contents(folder) == before


LAST = "network = "
MODELS = {
    "wrong shape": ("np.eye(2), states", "np.eye(3), states", ["initial covariance", "(2, 2)", "(3, 3)", "line 12"]),
    "sum of probabilities": ("[0.5, 0.5]", "[0.5, 0.6]", ["gain probabilities", "sum to 1", "1.1", "line 14"]),
    "negative probability": ("[0.5, 0.5]", "[-0.5, 1.5]", ["gain probabilities", "negative", "-0.5", "line 14"]),
    "asymmetric covariance": (
        "np.eye(2), states", "[[1, 0.5], [0, 1]], states", ["initial covariance", "symmetric", "0.5", "line 12"]),
    "indefinite covariance": (
        "np.eye(2), states", "[[1, 2], [2, 1]], states", ["initial covariance", "semidefinite", "eigenvalue -1"]),
    "not finite": ("[0, 0]", "[0, np.nan]", ["initial mean", "finite numbers", "1 that are not finite", "line 12"]),
    "no network": (LAST, "_ = lambda: ", ["net.py", "a heliograph.Network", "none in the module"]),
    "two networks": (LAST, 'other = h.Network(plant, {"a": h.Node(sensor, link, {})})\nnetwork = ', [
        "net.py:other or net.py:network", "2 networks"]),
    "an error": (LAST, "raise OSError('one\\ntwo')\nnetwork = ", ["net.py", "OSError in line 19: one two"]),
    "no filters": ("link, filters", "link, {}", ["net.py", "at least one filter", "none"]),
}  # fmt: skip


@pytest.mark.parametrize("case", MODELS)
def test_a_model_that_is_none(folder, capsys, case):
    old, new, fragments = MODELS[case]
    assert NETWORK.count(old) == 1
    (folder / "net.py").write_text(NETWORK.replace(old, new))
    refused(folder, capsys, run_arguments(), "expected", "got", *fragments)


TABLES = {
    "empty file": ("", ["data.csv", "an empty file"]),
    "no rows": ("time,push,pos\n", ["data.csv", "at least one row", "none"]),
    "unknown column": ("time,push,poss\n0,0,1\n", ["only the columns time, push, dt, pos", "'poss'", "'pos'"]),
    "missing column": ("time,pos\n0,0\n", ["one column 'push'", "only time, pos"]),
    "doubled column": ("time,push,pos,pos\n0,0,0,0\n", ["distinct columns", "'pos'"]),
    "time goes backwards": (
        "time,push,pos\n0,0,1\n2,0,1\n1,0,1\n", ["row 3, column 'time'", "does not go backwards", "1 after 2"]),
    "text in a cell": ("time,push,pos\n0,0,1\n1,0,far\n", ["row 2, column 'pos'", "a number", "'far'"]),
    "infinite": ("time,push,pos\n0,0,inf\n", ["row 1, column 'pos'", "a finite number", "inf"]),
    "missing input": ("time,push,pos\n0,,1\n", ["row 1, column 'push'", "a finite number", "an empty cell"]),
    "short row": ("time,push,pos\n0,0\n", ["row 1", "3 cells", "got 2"]),
}  # fmt: skip


@pytest.mark.parametrize("case", TABLES)
def test_measurements_that_are_none(folder, capsys, case):
    text, fragments = TABLES[case]
    (folder / "data.csv").write_text(text)
    refused(folder, capsys, run_arguments(), "data.csv", "expected", "got", *fragments)


def test_places(folder, capsys):
    (folder / "file").touch()
    refused(folder, capsys, run_arguments(network="no.py"), "no.py", "a Python file", "nothing of that name")
    refused(folder, capsys, run_arguments(measurements="no.csv"), "no.csv", "a file", "nothing of that name")
    refused(folder, capsys, run_arguments(out="no/out.csv"), "output folder no", "existing", "nothing of that name")
    refused(folder, capsys, run_arguments(out="file/out.csv"), "output folder file", "a folder", "a file")
    refused(folder, capsys, run_arguments(out="out.txt"), "out.txt", ".csv or .parquet", "'.txt'")
    refused(folder, capsys, run_arguments(out="./data.csv"), "data.csv", "another file than the measurements")
    refused(folder, capsys, ["demo", "--out", "file"], "output folder", "file", "a folder")


def test_the_output_is_checked_before_the_network_runs(folder, capsys):
    (folder / "net.py").write_text("raise SystemError('ran')")
    refused(folder, capsys, run_arguments(out="no/out.csv"), "output folder no")


def test_nothing_is_left_when_the_disk_fills(folder, capsys, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device", "out.csv")

    (folder / "out.csv").write_text("before")
    monkeypatch.setattr(os, "replace", full)
    refused(folder, capsys, run_arguments(), "out.csv: No space left on device")


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


def told_as_something_else():
    try:
        signal.raise_signal(signal.SIGINT)
    except KeyboardInterrupt:
        raise RuntimeError("INTERNAL: KeyboardInterrupt") from None


def kept_quiet():
    try:
        signal.raise_signal(signal.SIGINT)
    except KeyboardInterrupt:
        return


@pytest.mark.parametrize("interrupt", [in_a_callback, told_as_something_else, kept_quiet])
def test_an_interrupt_ends_with_130_whoever_swallows_it(folder, monkeypatch, capsys, interrupt):
    demo_module(monkeypatch, lambda out, seed, recording: interrupt())
    inherited = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        assert cli.main(["demo", "--out", "results"]) == cli.INTERRUPTED
    finally:
        signal.signal(signal.SIGINT, inherited)
    assert capsys.readouterr().err == ""


START = "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler); sys.argv[0] = 'heliograph'; "


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
    if process.returncode == 0:  # it was done
        assert len(read_table(folder / "out.csv")["time"]) == len(read_table(folder / "data.csv")["time"])
    else:
        assert contents(folder) == before


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


@pytest.mark.parametrize(
    ("arguments", "fragments"),
    [
        (["rnu"], ["rnu", 'Did you mean "run"']),
        (["run", "net.py"], ["--measurements"]),
        (["completion", "csh"], ["csh"]),
        (["new"], ["FILE"]),
        ([*run_arguments(), "--bogus", "3"], ["--bogus"]),
        (["demo", "--out", "out", "--seed", "many"], ["--seed", "many"]),
    ],
)
def test_a_command_line_that_is_none(folder, capsys, arguments, fragments):
    refused(folder, capsys, arguments, *fragments)


def demo_module(monkeypatch, example) -> None:
    module = ModuleType("heliograph.examples.demo")
    module.example = example
    monkeypatch.setitem(sys.modules, "heliograph.examples.demo", module)


def test_demo_takes_folder_and_seed(folder, monkeypatch):
    calls = []
    demo_module(monkeypatch, lambda out, seed, drive="plaza2": calls.append((str(out), seed, drive)))
    assert cli.main(["demo", "--out", "results", "--seed", "3"]) == 0
    assert cli.main(["demo", "--out", "results", "--recording", "plaza1"]) == 0
    assert cli.main(["example", "demo", "--out", "results", "--seed", "4"]) == 0
    assert calls == [("results", 3, "plaza2"), ("results", 0, "plaza1"), ("results", 4, "plaza2")]


def test_a_missing_extra_is_named(folder, capsys, monkeypatch):
    def lacking(*_):
        raise ModuleNotFoundError("No module named 'matplotlib'", name="matplotlib.pyplot")

    demo_module(monkeypatch, lacking)
    refused(folder, capsys, ["demo", "--out", "results"], "matplotlib", sys.executable, '[report]"')
    for name in ("pyarrow", "pyarrow.parquet"):
        monkeypatch.setitem(sys.modules, name, None)
    refused(folder, capsys, run_arguments(out="out.parquet"), "pyarrow", ' -m pip install "', '[tables]"')
    assert cli.main(run_arguments()) == 0  # CSV does without


def test_a_long_message_stays_on_one_line(folder, capsys, monkeypatch):
    def wrong(*_):
        raise InputError("thing: expected\n  one, got\n  two")

    demo_module(monkeypatch, wrong)
    refused(folder, capsys, ["demo", "--out", "results"], "heliograph: thing: expected one, got two")


@pytest.mark.parametrize(
    "bug",
    [
        RuntimeError("bug"),
        ValueError("bug: not said by a check"),
        ModuleNotFoundError("bug", name="heliograph.nowhere"),
    ],
)
def test_a_bug_keeps_its_traceback(folder, monkeypatch, bug):
    def broken(*_):
        raise bug

    demo_module(monkeypatch, broken)
    with pytest.raises(type(bug), match="bug"):
        cli.main(["demo", "--out", "results"])


def test_version_and_help(capsys):
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out == f"{h.__version__}\n"
    assert cli.main(["run", "--help"]) == 0
    assert "--measurements" in capsys.readouterr().out


def without_jax(arguments) -> str:
    """What the command prints in a process of its own, which must not load JAX."""
    code = (
        f"import sys; from heliograph.cli import main; code = main({arguments}); "
        "assert not {'jax', 'numpy', 'equinox', 'scipy'} & set(sys.modules); sys.exit(code)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout


def test_help_does_not_load_jax():
    said = without_jax(["--help"])
    assert "run" in said and "demo" in said and "example" in said


def test_lists_do_not_load_jax():
    lines = without_jax(["example"]).splitlines()
    assert [line.split()[0] for line in lines] == [
        *(
            "delays",
            "demo",
            "fusion",
            "late-data",
            "learning",
            "links-with-memory",
            "live",
            "motor-drive",
            "network-design",
            "range-bearing",
            "smoothing",
        )
    ]
    assert all(len(line.split()) > 5 for line in lines)
    assert "cubature-fusion" in without_jax(["reproduce"]).splitlines()


def test_a_refusal_in_a_process_of_its_own(folder):
    (folder / "data.csv").write_text("time,push,poss\n0,0,1\n")
    before = contents(folder)
    command = [sys.executable, "-m", "heliograph", *run_arguments()]
    done = subprocess.run(command, capture_output=True, text=True, cwd=folder)
    assert done.returncode == 2
    assert done.stderr.startswith("heliograph: data.csv, header: expected only the columns time, push, dt, pos, got")
    assert done.stderr.count("\n") == 1 and done.stdout == ""
    assert contents(folder) == before


@pytest.mark.parametrize(
    ("arguments", "fragments"),
    [
        (["reproduce", "cubatur", "--out", "o"], ["method: expected one of cubature-fusion", "or all, got 'cubatur'"]),
        (["reproduce", "cubature-fusion"], ["reproduce: expected a folder for the results (--out DIR), got none"]),
        (["reproduce", "all", "--out", "o", "--runs", "0"], ["--runs: expected a positive whole number, got 0"]),
        (["reproduce", "all", "--out", "net.py"], ["output folder net.py: expected a folder, got a file"]),
        (
            ["example", "dmeo", "--out", "o"],
            ["example: expected one of delays, demo, fusion, late-data", "smoothing, got 'dmeo'"],
        ),
        (["demo", "--out", "o", "--seed", "1" * 23], ["--seed: expected a whole number from 0 to 4294967295, got 111"]),
        (["demo", "--out", "o", "--seed", "-1"], ["--seed: expected a whole number from 0 to 4294967295, got -1"]),
        (["reproduce", "all", "--out", "o", "--seed", "1" * 23], ["--seed: expected a whole number from 0"]),
        (["reproduce", "all", "--out", "o", "--runs", "1" * 23], ["--runs: expected at most 4294967295, got 111"]),
        (["reproduce", "all", "--out", "o", "--runs", "150.7"], ["--runs: expected a whole number, got '150.7'"]),
        (["reproduce", "all", "--out", "o", "--runs", "1_000"], ["--runs: expected a whole number, got '1_000'"]),
        (["reproduce", "all", "--out", "o", "--runs", "0x100"], ["--runs: expected a whole number, got '0x100'"]),
        (["demo", "--out", ""], ["--out: expected a path, got ''"]),
        (["demo", "--out", "o\0"], ["--out: expected a path, got 'o\\x00'"]),
        (["run", "\x1b[31m.py", "--measurements", "data.csv", "--out", "o.csv"], ["network \\x1b[31m.py: expected"]),
        (["example", "demo"], ["example: expected a folder for the results (--out DIR), got none"]),
        (["example", "demo", "--out", "net.py"], ["output folder net.py: expected a folder, got a file"]),
    ],
)
def test_bad_reproductions_and_examples(folder, capsys, arguments, fragments):
    refused(folder, capsys, arguments, *fragments)
