"""Doors between rooms: the map is what the code says, and the names that cross a border may only become fewer."""

import ast
import re
from importlib import import_module
from inspect import ismodule
from pathlib import Path

import pytest

from tests.map import (
    BORDERS,
    ROOMS,
    SOURCE,
    at_borders,
    border_of,
    crossing,
    imports_line,
    map_of_rooms,
    parsed,
    statements,
)
from tests.test_structure import PUBLIC

ALL = [room for rooms in ROOMS.values() for room in rooms]
MADE_BY_EXPORT = {"step.h", "step.c"}  # files that users get


def test_every_room_is_on_the_map():
    assert sorted(ALL) == sorted(p.name for p in SOURCE.iterdir() if (p / "__init__.py").exists())
    page = (SOURCE / "README.md").read_text()
    assert map_of_rooms() in page, "write it by: python -m tests.map"


@pytest.mark.parametrize("room", ALL)
def test_the_readme_of_a_room_is_true(room):
    """It says what the room imports, and names no file that is gone."""
    text = (SOURCE / room / "README.md").read_text()
    assert text.splitlines()[1] == imports_line(room), "write it by: python -m tests.map"
    named = set(re.findall(r"`(?!test_|tests/)([\w/]+\.(?:py|c|h))`", text)) - MADE_BY_EXPORT
    places = (SOURCE / room, SOURCE, SOURCE.parent)
    gone = [name for name in named if not any((place / name).exists() for place in places)]
    assert not gone, f"{room}/README.md names {gone}"


def test_the_map_names_no_file_that_is_gone():
    for name in re.findall(r"`([\w/]+\.py)`", (SOURCE / "README.md").read_text().split("<!--")[0]):
        assert (SOURCE / name).exists(), name


@pytest.mark.parametrize(
    ("above", "below", "most"),
    [
        (("design", "application"), "estimation", 42),
        (("application",), "estimation", 28),
    ],
)
def test_few_names_cross(above, below, most):
    """Lower the numbers as fewer cross; never raise them."""
    names = crossing([room for part in above for room in ROOMS[part]], ROOMS[below])
    assert len(names) <= most, f"lower the number to {len(names)}, or take fewer than {sorted(names)}"


def test_few_names_cross_that_are_not_public():
    public = {name for _, name in PUBLIC}
    names = crossing(ROOMS["design"] + ROOMS["application"], ROOMS["estimation"])
    inside = sorted(name for name in names if name.split(".")[-1] not in public)
    assert not inside, f"make public, or take instead what is public: {inside}"


@pytest.mark.parametrize("folder", BORDERS)
def test_a_border_lists_names_that_cross_it(folder):
    """No name for tests alone."""
    listed = (SOURCE / folder / "__init__.pyi").read_text().splitlines()
    alone = set(listed) - set(border_of(folder).splitlines())
    assert not alone, f"nothing else takes {sorted(alone)}: python -m tests.map"
    package = import_module(f"heliograph.{folder.replace('/', '.')}")
    for name in package.__all__:
        assert not ismodule(getattr(package, name)), f"{name}: expected no file of this name beside it"


def test_tests_take_few_names_from_inside():
    """Lower the number as they take fewer, never raise it: a test asks a room at its border.

    That is by its public names, or by those that other folders of the library take (python -m tests.map lists them).
    """
    public, border = {name for _, name in PUBLIC}, at_borders()
    names = set()
    for path in Path(__file__).parent.rglob("*.py"):
        for node in statements(parsed(path)):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("heliograph."):
                taken = {f"{node.module}.{alias.name}" for alias in node.names if alias.name not in public}
                names |= taken - border
            elif isinstance(node, ast.Import):
                names |= {alias.name for alias in node.names if alias.name.startswith("heliograph.")}
    assert len(names) <= 145, f"lower the number to {len(names)}, or take fewer than {sorted(names)}"
