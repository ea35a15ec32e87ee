"""A study of another package by the command line: other numbers, bad ones, failure half-way and resumption."""

import json
import sys

import pytest

from heliograph import cli

MODULE = '''
"""A walk that is squared."""

from dataclasses import dataclass
from pathlib import Path

from heliograph_studies.study import Study


@dataclass(frozen=True)
class Step:
    size: float = 0.5
    count: int = 4


@dataclass(frozen=True)
class Setting:
    step: Step = Step()
    seed: int = 0


@dataclass(frozen=True)
class Outcome:
    length: float
    squared: float


def logged(stage, value):
    with Path("log").open("a") as log:
        log.write(stage)
    return value


def square(length):
    if Path("stop").exists():
        raise ArithmeticError("no square")
    return length**2


def compute(setting, stages):
    length = stages("walking", lambda: logged("w", setting.step.size * setting.step.count))
    return Outcome(length, stages("squaring", lambda: square(length)))


example = Study("walk", Setting, compute, 2, lambda outcome: {}, lambda outcome: {})
run = example.run
'''
PAGE = "A study\n\n# {{ length }} squared is {{ squared }}\n\n## Again\n\n```\n{{ command }}\n```\n"


@pytest.fixture
def package(tmp_path, monkeypatch):
    """An installed package with one study."""
    folder, info = tmp_path / "my_walk", tmp_path / "my_walk-1.dist-info"
    folder.mkdir()
    info.mkdir()
    (folder / "__init__.py").write_text(MODULE.strip())
    (folder / "page.md").write_text(PAGE)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: my-walk\nVersion: 1\n")
    (info / "entry_points.txt").write_text("[heliograph.studies]\nwalk = my_walk:example\n")
    monkeypatch.delitem(sys.modules, "my_walk", raising=False)  # another test's, of another folder
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_other_numbers_and_what_is_none(package, capsys):
    assert cli.main(["example", "walk", "--set", "step.size=2", "--out", "out"]) == 0
    assert capsys.readouterr().out.splitlines()[0] == "8.0 squared is 64.0"
    summary = json.loads((package / "out" / "walk" / "summary.json").read_text())
    assert summary["squared"] == 64.0 and summary["changed"] == {"step.size": {"there": "0.5", "here": "2"}}
    page = (package / "out" / "walk" / "report.html").read_text()
    assert "What differs from the example as it stands" in page
    assert "heliograph example walk --out out --set step.size=2" in page
    for change, words in (
        ("step.sise=2", "--set: expected one of step.size, step.count, seed, got 'step.sise'"),
        ("step.count=2.5", "--set step.count: expected a whole number, got '2.5'"),
    ):
        assert cli.main(["example", "walk", "--set", change, "--out", "out"]) == 2
        assert capsys.readouterr().err == f"heliograph: {words}\n"
    assert cli.main(["example", "walk", "--trace", "log", "--out", "out"]) == 2
    assert capsys.readouterr().err == "heliograph: --trace: expected an example that takes it, got 'walk'\n"


def test_it_fails_half_way_and_goes_on_from_there(package, capsys):
    (package / "stop").touch()
    assert cli.main(["example", "walk", "--out", "out"]) == 2
    error = capsys.readouterr().err
    assert error.startswith("heliograph: walk, squaring: expected to be worked out, got ArithmeticError: no square;")
    assert error.count("\n") == 1 and (package / "out" / "walk.stages").is_dir()
    (package / "stop").unlink()
    assert cli.main(["example", "walk", "--out", "out"]) == 0
    assert capsys.readouterr().out.splitlines()[0] == "2.0 squared is 4.0"
    assert (package / "log").read_text() == "w"  # what was done is not done again


def test_stages_are_done_again_if_another_module_of_the_package_changed(package):
    (package / "stop").touch()
    assert cli.main(["example", "walk", "--out", "out"]) == 2
    other = package / "my_walk" / "other_study"
    other.mkdir()
    (other / "compute.py").write_text("STEP = 2")
    assert cli.main(["example", "walk", "--out", "out"]) == 2
    assert (package / "log").read_text() == "ww"
