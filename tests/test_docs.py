"""Every Python example in the README and the docs runs, in the order of its page."""

import re
from pathlib import Path

import pytest

import heliograph as hg

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
BLOCK = re.compile(r"```python\n(.*?)```", re.DOTALL)


@pytest.mark.parametrize("page", [p for p in PAGES if BLOCK.search(p.read_text())], ids=lambda p: p.name)
def test_examples_run(page):
    scope = {}
    for block in BLOCK.findall(page.read_text()):
        exec(compile(block, page.name, "exec"), scope)


def test_the_readmes_network_is_as_short_as_it_says():
    block = next(b for b in BLOCK.findall((ROOT / "README.md").read_text()) if "hg.Network" in b)
    assert len([line for line in block.splitlines() if line.strip()]) <= 25
    scope = {}
    exec(block, scope)
    assert isinstance(scope["network"], hg.Network)
