"""Each class that the page of extensions names is made from the page alone, and runs in a network."""

import dataclasses
import re
from pathlib import Path

import pytest

import heliograph as hg

PAGE = Path(__file__).resolve().parents[2] / "docs" / "extend.md"
pytestmark = pytest.mark.skipif(not PAGE.is_file(), reason="a source distribution has no docs")


def parts_of(item, seen):
    """All objects that an object holds."""
    if id(item) in seen:
        return
    seen[id(item)] = item
    inside = list(item.values()) if isinstance(item, dict) else list(item) if isinstance(item, list | tuple) else []
    if dataclasses.is_dataclass(item):
        inside = [getattr(item, field.name, None) for field in dataclasses.fields(item)]
    for part in inside:
        parts_of(part, seen)


@pytest.mark.slow
def test_every_class_that_the_page_names_runs_in_a_network(tmp_path, monkeypatch):
    """Of `hg.ROOM.AbstractNAME` of the page's table some class of the page is part of a run: of its network, or how
    it is smoothed or what is kept of it."""
    ran = []
    for name in ("monte_carlo", "run", "simulate"):
        known = getattr(hg, name)

        def noting(network, *arguments, known=known, **settings):
            ran.extend([network, *settings.values()])
            return known(network, *arguments, **settings)

        monkeypatch.setattr(hg, name, noting)
    monkeypatch.chdir(tmp_path)
    text, scope = PAGE.read_text(), {}
    for block in re.findall(r"```python\n(.*?)```", text, re.DOTALL):
        exec(compile(block, PAGE.name, "exec"), scope)
    named = {getattr(getattr(hg, room), kind) for room, kind in re.findall(r"hg\.(\w+)\.(Abstract\w+)", text)}
    assert len(named) >= 5
    used = {}
    for part in ran:
        parts_of(part, used)
    for kind in named:
        mine = [
            part
            for part in used.values()
            if isinstance(part, kind) and not type(part).__module__.startswith("heliograph")
        ]
        assert mine, f"no network of the page runs a {kind.__name__} of its own"
