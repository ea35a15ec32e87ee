"""The gallery and README's example as notebooks: valid, complete, and their cells run one after the other."""

import ast
import importlib
import json
from pathlib import Path

import matplotlib
import matplotlib.pyplot as plt
import pytest

ROOT = Path(__file__).parents[1]
GALLERY = sorted((ROOT / "docs" / "gallery").glob("plot_*.py"))


@pytest.fixture
def notebooks(monkeypatch):
    """docs/_site/notebooks.py, imported as it is when run."""
    monkeypatch.syspath_prepend(ROOT / "docs" / "_site")
    return importlib.import_module("notebooks")


def code(content):
    """The cells of code of a notebook."""
    return ["".join(cell["source"]) for cell in content["cells"] if cell["cell_type"] == "code"]


def test_each_example_is_a_notebook_whose_first_cell_installs(notebooks, tmp_path):
    files = notebooks.write(tmp_path)
    assert [path.stem for path in files] == [*(path.stem for path in GALLERY), "readme"]
    for path, source in zip(files, GALLERY, strict=False):
        content = json.loads(path.read_text())
        assert (content["nbformat"], content["nbformat_minor"]) == (4, 5)
        identities = [cell["id"] for cell in content["cells"]]
        assert len(set(identities)) == len(identities)
        first, *rest = code(content)
        assert "pip" in first and "find_spec" in first
        # The cells together are the code of the example, but for its words.
        whole = [ast.dump(part) for part in ast.parse(source.read_text()).body[1:]]
        assert [ast.dump(part) for cell in rest for part in ast.parse(cell).body] == whole
        title = "".join(content["cells"][1]["source"]).splitlines()[0]
        assert title.startswith("# ") and len(title) > 5


@pytest.mark.slow
@pytest.mark.parametrize("name", ["readme", GALLERY[0].stem])
def test_the_cells_run(notebooks, tmp_path, monkeypatch, name):
    """Of README's example and of one of the gallery; test_docs.py runs all of the gallery."""
    monkeypatch.chdir(tmp_path)
    matplotlib.use("Agg")
    notebooks.write(tmp_path)
    scope = {}
    cells = code(json.loads((tmp_path / f"{name}.ipynb").read_text()))
    for cell in cells:
        exec(compile(cell, name, "exec"), scope)
    plt.close("all")
    if name == "readme":
        assert "<svg" in scope["record"]._repr_html_()
