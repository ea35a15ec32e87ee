"""What its README and its page say: examples run, and times are those that were measured."""

import json
import re
from pathlib import Path

import pytest

import straightline

ROOT = Path(__file__).parents[2]
README = Path(straightline.__file__).parent / "README.md"
PAGE = (ROOT / "docs" / "straightline.md").read_text()


@pytest.mark.slow
def test_the_examples_of_the_readme_run():
    """Those of the page run with all pages (tests/test_docs.py)."""
    scope: dict = {}
    for block in re.findall(r"```python\n(.*?)```", README.read_text(), re.DOTALL):
        exec(compile(block, README.name, "exec"), scope)


def test_the_page_has_the_ratios_that_were_measured():
    results = json.loads((ROOT / "benchmarks" / "native_code.json").read_text())
    rows = [row.split("|")[1:-1] for row in PAGE.splitlines() if row.startswith("| ") and "example" not in row]
    examples = ("ode", "ns_per_particle_step"), ("option", "ns_per_draw"), ("controller", "ns_per_step")
    for (name, unit), row in zip(examples, rows, strict=True):
        times = results[name][unit]
        ours = times["compile_one" if name == "controller" else "straightline"]
        for other, cell in zip(("c", "numba", "jax", "float32"), row[1:], strict=True):
            if cell.strip():
                ratio = times[other] / ours
                assert cell.strip() == (f"{ratio:.0f}" if ratio >= 10 else f"{ratio:.1f}"), (name, other)
    times = results["controller"]["ns_per_step"]
    assert f"takes {times['to_c'] / times['c']:.1f} times as long as C by hand" in PAGE


def test_every_name_is_listed_and_on_the_page():
    names = (ROOT / "docs" / "names.md").read_text().split("## straightline")[1].split("\n## ")[0]
    for name in straightline.__all__:
        first = (getattr(straightline, name).__doc__ or "").splitlines()[0]
        assert f"| `{name}` | {re.split(r'[.:,]', first)[0]}" in names, name
        assert name in PAGE and name in README.read_text(), name


def test_every_parameter_is_described():
    for name in set(straightline.__all__) - {"Unsupported"}:
        function = getattr(straightline, name)
        code = function.__code__
        for parameter in code.co_varnames[: code.co_argcount + code.co_kwonlyargcount]:
            assert f"    {parameter}: " in function.__doc__, (name, parameter)
