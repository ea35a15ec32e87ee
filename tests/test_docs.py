"""Every Python example in the docs runs, in the order of its page; the README has a test of its own."""

import re
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGES = sorted((ROOT / "docs").glob("*.md"))
BLOCK = re.compile(r"```python\n(.*?)```", re.DOTALL)


@pytest.mark.parametrize("page", [p for p in PAGES if BLOCK.search(p.read_text())], ids=lambda p: p.name)
def test_examples_run(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # some write files
    scope = {}
    for block in BLOCK.findall(page.read_text()):
        exec(compile(block, page.name, "exec"), scope)


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
