"""Every Python example in the docs runs, in the order of its page; the README has a test of its own."""

import importlib
import json
import re
import runpy
import tomllib
from pathlib import Path

import matplotlib
import matplotlib.pyplot as plt
import pytest

from heliograph import cli

ROOT = Path(__file__).parents[1]
PAGES = sorted((ROOT / "docs").glob("*.md"))
GALLERY = sorted((ROOT / "docs" / "gallery").glob("*.py"))
BLOCK = re.compile(r"```python\n(.*?)```", re.DOTALL)


@pytest.mark.slow
@pytest.mark.parametrize("page", [p for p in PAGES if BLOCK.search(p.read_text())], ids=lambda p: p.name)
def test_examples_run(page, tmp_path, monkeypatch):
    """A network that several pages draw with one horizon and as many runs is compiled once."""
    monkeypatch.chdir(tmp_path)  # some write files
    scope = {}
    for block in BLOCK.findall(page.read_text()):
        try:
            exec(compile(block, page.name, "exec"), scope)
        except ModuleNotFoundError as error:
            if error.name not in cli.EXTRAS:
                raise
            pytest.skip(f"{error.name}: the extra `{cli.EXTRAS[error.name]}`")


@pytest.mark.slow
@pytest.mark.parametrize("example", GALLERY, ids=lambda p: p.stem)
def test_the_gallery_runs(example):
    """Each example draws one picture."""
    matplotlib.use("Agg")
    plt.close("all")
    try:
        runpy.run_path(str(example))
        assert len(plt.get_fignums()) == 1
    finally:
        plt.close("all")


def test_the_gallery_is_one():
    assert len(GALLERY) >= 12


def test_every_page_stands_in_the_contents():
    """The site's build would say so too; here it is said at once: a new page is a line in one of the toctrees."""
    listed = {
        re.sub(r".*<(.*)>", r"\1", line)
        for page in PAGES
        for block in re.findall(r"```\{toctree\}\n(.*?)```", page.read_text(), re.DOTALL)
        for line in block.splitlines()
    }
    missing = sorted({page.stem for page in PAGES} - listed - {"index"})
    assert not missing, f"docs: no toctree has {missing}; docs/guide.md is the place for most"


@pytest.fixture
def pages(monkeypatch):
    """benchmarks/pages.py, imported as it is when run."""
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    return importlib.import_module("pages")


def test_times_are_those_that_were_measured(pages):
    """README and docs say what benchmarks/results.json does: if not, `python benchmarks/pages.py` writes them."""
    for page, text in pages.written(json.loads(pages.RESULTS.read_text())).items():
        assert (ROOT / page).read_text() == text, f"{page}: run python benchmarks/pages.py"


def test_a_time_has_one_place(pages):
    place = pages.Place("a step takes {} ns, theirs {} ns", ("57", "2,485"))
    assert pages.with_figures("Here a step takes 1.5 ns, theirs 12,000 ns.", place) == (
        "Here a step takes 57 ns, theirs 2,485 ns."
    )
    for text in ("a step takes long", "a step takes 1 ns, theirs 2 ns; a step takes 1 ns, theirs 2 ns"):
        with pytest.raises(ValueError, match="expected once in the page"):
            pages.with_figures(text, place)


def test_long_runs_are_of_numbers_that_a_page_sets(monkeypatch):
    """`python benchmarks/long_run.py PAGE NAME=NUMBER`, where a page says it, finds NAME in the blocks of PAGE."""
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    long_run = importlib.import_module("long_run")
    commands = [c for page in PAGES for c in re.findall(r"benchmarks/long_run\.py ([^`]*)`", page.read_text())]
    assert commands
    for command in commands:
        page, *changes = command.split()
        blocks = "\n".join(BLOCK.findall((ROOT / "docs" / f"{page}.md").read_text()))
        assert long_run.with_numbers(blocks, dict(change.split("=") for change in changes)) != blocks, command
    with pytest.raises(ValueError, match="walks: expected a number that the page sets once"):
        long_run.with_numbers("runs = 3\n", {"walks": "4"})


def test_a_source_distribution_holds_all_but_what_a_clone_needs():
    """Tests read the docs and the benchmarks, and pages link to them."""
    table = tomllib.loads((ROOT / "pyproject.toml").read_text())
    included = table["tool"]["hatch"]["build"]["targets"]["sdist"]["include"]
    there = {f"/{path.name}" for path in ROOT.iterdir() if not path.name.startswith(".")}
    always = {"/README.md", "/LICENSE", "/pyproject.toml"}  # by the builder itself
    assert {"/docs", "/benchmarks", "/src", "/tests"} <= set(included)
    assert all((ROOT / name[1:]).exists() for name in included)
    assert {name for name in there if name.endswith((".md", ".cff", ".txt")) or name == "/Makefile"} <= set(
        included
    ) | always
