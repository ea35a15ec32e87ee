"""The sizes that decide which engine computes a program, and in which form: few, in two files, each measured."""

import re
from pathlib import Path

import pytest

import heliograph
import straightline

FILES = [Path(package.__file__).parent / path for package, path in
         ((straightline, "size_limits.py"), (heliograph, "engine/size_thresholds.py"))]  # fmt: skip
BLOCK = "BLOCK"  # how many runs are simulated side by side, which decides nothing


def sizes(path):
    """Names and values of the sizes that are numbers, not made of others."""
    return re.findall(r"^([A-Z_]+) = (-?[\d_.]+)$", path.read_text(), re.MULTILINE)


def test_there_are_nine_at_most():
    assert len([name for path in FILES for name, _ in sizes(path) if name != BLOCK]) <= 9


@pytest.mark.parametrize("path", FILES, ids=["straightline", "heliograph"])
def test_each_says_what_was_measured(path):
    """In the comment above it: with a number."""
    lines = path.read_text().splitlines()
    for name, _ in sizes(path):
        place = next(k for k, line in enumerate(lines) if line.startswith(f"{name} = "))
        comment = ""
        while lines[place - 1].startswith("#"):
            place, comment = place - 1, f"{lines[place - 1]}{comment}"
        assert name == BLOCK or re.search(r"\d", comment), name
