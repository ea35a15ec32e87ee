"""The gallery and README's example as notebooks, whose first cell installs heliograph where it is missing.

`python docs/_site/notebooks.py out/notebooks` writes them; the site has those of the gallery too.
"""

import ast
import json
import re
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
INSTALL = """# Where heliograph is missing: from the checkout around this notebook, else by its name.
import importlib.util
import pathlib
import subprocess
import sys

if importlib.util.find_spec("heliograph") is None:
    folders = pathlib.Path.cwd().resolve().parents
    checkout = next((str(folder) for folder in folders if (folder / "src" / "heliograph").is_dir()), "heliograph")
    command = [sys.executable, "-m", "pip", "install", "--quiet", checkout + "[report,results,recordings]"]
    subprocess.run(command, check=True)"""
BLOCK = re.compile(r"<!-- (?:file|after): my_network.py -->\n```python\n(.*?)```", re.DOTALL)
UNDERLINE = re.compile(r"^(.+)\n=+$", re.MULTILINE)


def notebook(cells: list[tuple[str, str]]) -> dict[str, Any]:
    """A notebook of cells, ("markdown" or "code", text) each, after the one that installs."""
    content = []
    for number, (kind, text) in enumerate([("code", INSTALL), *cells]):
        cell: dict[str, Any] = {"cell_type": kind, "id": f"cell-{number}", "metadata": {}}
        cell["source"] = text.strip("\n").splitlines(keepends=True)
        content.append(cell | ({"outputs": [], "execution_count": None} if kind == "code" else {}))
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    return {"cells": content, "metadata": {"kernelspec": kernel}, "nbformat": 4, "nbformat_minor": 5}


def of_example(path: Path) -> dict[str, Any]:
    """An example of the gallery: its text, then its code, which draws the picture in the notebook."""
    source = path.read_text()
    text = ast.get_docstring(ast.parse(source)) or ""
    first, *others = source.split('"""', 2)[2].split("\n# %%\n")
    cells = [("markdown", UNDERLINE.sub(r"# \1", text)), ("code", first)]
    for part in others:  # each begins with a comment on what follows
        said = re.match(r"(?:# ?.*\n)*", part)
        assert said is not None
        words = "\n".join(line.removeprefix("#").removeprefix(" ") for line in said[0].splitlines())
        cells += [("markdown", words), ("code", part[said.end() :])]
    return notebook(cells)


def of_readme() -> dict[str, Any]:
    """README's example: the network, its errors before there are data, a simulated run with its bands, one sample."""
    network, *others = BLOCK.findall((ROOT / "README.md").read_text())
    shown = "record = hg.simulate(network, horizon=40, key=0, inputs=inputs)\nrecord  # the estimates with their bands"
    first, *more = others
    return notebook(
        [
            ("markdown", "# A cart behind a relay\n\nThe example of heliograph's README."),
            ("code", network),
            ("code", first),
            ("code", shown),
            *(("code", block) for block in more),
        ]
    )


def write(folder: Path) -> list[Path]:
    """Write all notebooks to a folder; return their files."""
    folder.mkdir(parents=True, exist_ok=True)
    made = {path.stem: of_example(path) for path in sorted((ROOT / "docs" / "gallery").glob("plot_*.py"))}
    made["readme"] = of_readme()
    files = [folder / f"{name}.ipynb" for name in made]
    for path, content in zip(files, made.values(), strict=True):
        path.write_text(json.dumps(content, indent=1) + "\n")
    return files


if __name__ == "__main__":
    print(f"{len(write(Path(sys.argv[1])))} notebooks in {sys.argv[1]}")
