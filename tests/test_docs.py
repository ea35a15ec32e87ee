"""Every Python example in the docs runs, in the order of its page; the README has a test of its own."""

import json
import re
import runpy
import tomllib
from pathlib import Path

import matplotlib
import matplotlib.pyplot as plt
import pytest

ROOT = Path(__file__).parents[1]
PAGES = sorted((ROOT / "docs").glob("*.md"))
GALLERY = sorted((ROOT / "docs" / "gallery").glob("*.py"))
BLOCK = re.compile(r"```python\n(.*?)```", re.DOTALL)


@pytest.mark.parametrize("page", [p for p in PAGES if BLOCK.search(p.read_text())], ids=lambda p: p.name)
def test_examples_run(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # some write files
    scope = {}
    for block in BLOCK.findall(page.read_text()):
        exec(compile(block, page.name, "exec"), scope)


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


def test_speeds_are_those_that_were_measured():
    """Each comparison has its row: ours and the other's nanoseconds, and their ratio, as in benchmarks/results.json."""
    measured = json.loads((ROOT / "benchmarks" / "results.json").read_text())
    page = (ROOT / "docs" / "comparisons.md").read_text()
    for each in measured["comparisons"].values():
        for title, peer in each["peers"].items():
            if "absent" not in peer:
                ours, theirs, ratio = (
                    f"{v:,.0f}" if v >= 100 else f"{v:.1f}" for v in (each["ours"]["best"], peer["best"], peer["ratio"])
                )
                row = f"| {each['title']} | {ours} | {title} ({peer['how']}) | {theirs} | {ratio} |"
                assert row in page, f"docs/comparisons.md lacks: {row}"
    alone = measured["alone"]
    for name, value in {
        "a step of `hg.Stream`": f"{alone['stream']['values']['one sample, median']:.0f} µs in the median",
        "first call": f"{alone['startup']['values']['linear filter, first process']:.1f} s for the first linear filter",
    }.items():
        assert value in page, f"docs/comparisons.md, {name}: expected {value}"


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
