"""The command line finds studies by entry points, those of other packages too."""

import json
from pathlib import Path

import pytest

from heliograph import cli

ROOT = Path(__file__).parents[2]
MODULE = '''
"""Says a number.

More of it.
"""

{imports}


class Number:
    def settings(self, values):
        return dict(values)

    def run(self, setting, out):
        (out / "number").mkdir(parents=True)
        (out / "number" / "summary.json").write_text(json.dumps(setting))


example = Number()
'''
ENTRY = "[heliograph.studies]\nnumber = my_study:example\n"


@pytest.fixture
def package(tmp_path, monkeypatch):
    """A package that is installed: a module, and what its installer wrote."""
    (tmp_path / "my_study.py").write_text(MODULE.strip().format(imports="import json"))
    info = tmp_path / "my_package-1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: my-package\nVersion: 1\n")
    (info / "entry_points.txt").write_text(ENTRY)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def listed(capsys, command):
    """The names that a command lists when it is given none, with what they say."""
    assert cli.main([command]) == 0
    return dict(line.split(maxsplit=1) for line in capsys.readouterr().out.splitlines() if len(line.split()) > 1)


def test_a_study_of_another_package_is_listed_and_runs(package, capsys):
    assert listed(capsys, "example")["number"] == "Says a number."
    assert "number" not in listed(capsys, "reproduce")
    assert cli.main(["example", "number", "--seed", "3", "--set", "mean=0.3", "--out", "out"]) == 0
    assert json.loads((package / "out" / "number" / "summary.json").read_text()) == {"seed": "3", "mean": "0.3"}


def test_a_list_runs_no_study(package, capsys):
    (package / "my_study.py").write_text(MODULE.strip().format(imports="raise RuntimeError"))
    assert listed(capsys, "example")["number"] == "Says a number."


def test_one_name_has_one_study(package, capsys):
    (package / "my_package-1.dist-info" / "entry_points.txt").write_text("[heliograph.studies]\ndemo = other:example\n")
    assert cli.main(["demo", "--out", "out"]) == 2
    said = capsys.readouterr().err
    assert said.startswith("heliograph: study demo: expected one package that offers it, got ")
    assert "heliograph_studies.demo:example" in said and "other:example" in said and said.count("\n") == 1


def test_every_study_says_what_it_shows(capsys):
    known = listed(capsys, "example") | listed(capsys, "reproduce")
    assert "demo" in known and "quadratic-bias" in known and "hello" not in known
    with pytest.raises(ValueError, match=r"example: expected one of .*demo, .*, got 'nothing'"):
        cli.studies.run_studies(["nothing"], None, {}, "example")


def test_what_is_a_page_now_is_named(capsys):
    examples = listed(capsys, "example")
    for name, page in cli.studies.PAGES.items():
        assert name not in examples and (ROOT / "docs" / page).exists()
        assert cli.main(["example", name, "--out", "out"]) == 2
        said = capsys.readouterr().err
        assert said.endswith(f"got '{name}', a page now: docs/{page}\n") and said.count("\n") == 1


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (["mean"], "--set: expected name=value, such as seed=1, got 'mean'"),
        (["=3"], "--set: expected name=value, such as seed=1, got '=3'"),
        (["a=1", "a=2"], "--set: expected a once, got twice"),
        (["seed=1"], "--set: expected seed once, got twice"),
    ],
)
def test_changes_that_are_none(capsys, changes, words):
    options = [part for text in changes for part in ("--set", text)]
    assert cli.main(["example", "number", "--seed", "3", *options, "--out", "out"]) == 2
    assert capsys.readouterr().err == f"heliograph: {words}\n"
