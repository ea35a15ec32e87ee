"""The command's options, hints, and what it says of itself; what it loads for that."""

import os
import subprocess
import sys

import pytest

import heliograph as h
import heliograph as hg
from heliograph import cli
from tests.cli.example import contents, refused, run_arguments, stub_study


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


def test_demo_takes_folder_and_seed(folder, monkeypatch):
    calls = []
    stub_study(monkeypatch, lambda out, values: calls.append((str(out), values)))
    assert cli.main(["demo", "--out", "results", "--seed", "3"]) == 0
    assert cli.main(["demo", "--out", "results", "--recording", "plaza1"]) == 0
    assert cli.main(["example", "demo", "--out", "results", "--seed", "4"]) == 0
    assert calls == [("results", {"seed": "3"}), ("results", {"recording": "plaza1"}), ("results", {"seed": "4"})]


def test_a_missing_extra_is_named(folder, capsys, monkeypatch):
    def lacking(*_):
        raise ModuleNotFoundError("No module named 'matplotlib'", name="matplotlib.pyplot")

    stub_study(monkeypatch, lacking)
    refused(folder, capsys, ["demo", "--out", "results"], "matplotlib", sys.executable, '[report]"')
    for name in ("pyarrow", "pyarrow.parquet"):
        monkeypatch.setitem(sys.modules, name, None)
    refused(folder, capsys, run_arguments(out="out.parquet"), "pyarrow", ' -m pip install "', '[tables]"')
    assert cli.main(run_arguments()) == 0  # CSV does without


@pytest.mark.parametrize(
    ("arguments", "missing", "extras"),
    [
        (["demo", "--out", "d"], ["jinja2", "matplotlib", "gtsam", "pyarrow"], "recordings,report,tables"),
        (["example", "late-data", "--out", "d"], ["matplotlib", "gtsam"], "recordings,report"),
        (
            ["reproduce", "h-infinity-fusion", "--out", "d"],
            ["matplotlib", "clarabel", "h5netcdf"],
            "lmi,report,results",
        ),
        ([*run_arguments(out="out.parquet"), "--report", "d"], ["pyarrow", "jinja2"], "report,tables"),
        ([*run_arguments(out="out.mcap"), "--report", "d"], ["rosbags", "matplotlib"], "bags,report"),
    ],
)
def test_all_that_is_missing_is_named_at_once_with_one_command(folder, capsys, monkeypatch, arguments, missing, extras):
    for name in missing:
        monkeypatch.setitem(sys.modules, name, None)
    said = refused(folder, capsys, arguments, "got no such packages", f'[{extras}]"')
    assert set(missing) == set(said.removeprefix("heliograph: ").partition(":")[0].split(", "))


def test_a_long_message_stays_on_one_line(folder, capsys, monkeypatch):
    def wrong(*_):
        raise hg.InputError("thing: expected\n  one, got\n  two")

    stub_study(monkeypatch, wrong)
    refused(folder, capsys, ["demo", "--out", "results"], "heliograph: thing: expected one, got two")


def test_version_and_help(capsys):
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out == f"{h.__version__}\n"
    assert cli.main(["run", "--help"]) == 0
    assert "--measurements" in capsys.readouterr().out


def test_an_output_that_takes_nothing_is_named(capsys, monkeypatch):
    with open("/dev/full", "w") as full:
        monkeypatch.setattr(sys, "stdout", full)
        assert cli.main(["--version"]) == 2
        monkeypatch.undo()
        with pytest.raises(OSError, match="No space"):
            full.close()
    assert capsys.readouterr().err == "heliograph: standard output: No space left on device\n"


@pytest.mark.parametrize("arguments", [["--version"], ["run", "--help"]])
@pytest.mark.parametrize("buffered", [True, False])
def test_a_process_whose_output_takes_nothing_says_so_once(arguments, buffered):
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    if not buffered:
        environment["PYTHONUNBUFFERED"] = "1"
    with open("/dev/full", "wb") as full:
        made = subprocess.run(
            [sys.executable, "-m", "heliograph", *arguments], stdout=full, stderr=subprocess.PIPE, env=environment
        )
    assert made.stderr == b"heliograph: standard output: No space left on device\n"
    assert made.returncode == cli.BAD_INPUT


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

    stub_study(monkeypatch, broken)
    with pytest.raises(type(bug), match="bug"):
        cli.main(["demo", "--out", "results"])


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
            "demo",
            "late-data",
            "live",
            "uwb",
            "without-centre",
        )
    ]
    methods = without_jax(["reproduce"]).splitlines()
    assert [line.split()[0] for line in methods] == sorted(line.split()[0] for line in methods)
    assert methods[0].startswith("cubature-fusion ") and len(methods) == 5
    assert all(len(line.split()) > 5 for line in lines + methods)


@pytest.mark.slow
def test_a_refusal_in_a_process_of_its_own(folder):
    (folder / "data.csv").write_text("time,push,poss\n0,0,1\n")
    before = contents(folder)
    command = [sys.executable, "-m", "heliograph", *run_arguments()]
    done = subprocess.run(command, capture_output=True, text=True, cwd=folder)
    assert done.returncode == 2
    assert done.stderr.startswith("heliograph: data.csv, header: expected only the columns time, push, dt, pos, truth.")
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
            ["example: expected one of demo, late-data, live", "without-centre, got 'dmeo'"],
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


@pytest.mark.filterwarnings("always::UserWarning")
def test_a_warning_is_a_line_of_the_command_and_names_no_source(folder, capsys):
    """Once a call, wherever it was given: here by the file of the network."""
    (folder / "warns.py").write_text(
        "import warnings\nwarnings.warn('so\\nand so')\n" + (folder / "net.py").read_text()
    )
    assert cli.main(["check", "warns.py"]) in (0, 1)
    assert [line for line in capsys.readouterr().err.splitlines() if "warning" in line] == [
        "heliograph: warning: so\\nand so"
    ]
