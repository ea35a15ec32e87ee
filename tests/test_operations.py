"""The counts of docs/operations.md are those of the code."""

import importlib
from pathlib import Path

import pytest

FOLDER = Path(__file__).resolve().parents[1] / "benchmarks"


@pytest.mark.slow
def test_the_page_says_how_many_operations_there_are(monkeypatch):
    """To 3 %: another release of JAX may trace a few more. If not, `python benchmarks/operations.py` writes them."""
    monkeypatch.syspath_prepend(FOLDER)
    module = importlib.import_module("operations")
    _, lines = module.TABLE.search(module.PAGE.read_text())[0].split("\n", 2)[1:]
    said = [line.strip("| ").split(" | ") for line in lines.strip().splitlines()]
    rows = module.table()
    assert [row.name for row in rows] == [name for name, *_ in said]
    for row, (_, *cells) in zip(rows, said, strict=True):
        counts = [None if cell == "–" else int(cell.replace(",", "")) for cell in cells]
        assert [n and pytest.approx(n, rel=0.03) for n in counts] == list(row[1:]), row.name
