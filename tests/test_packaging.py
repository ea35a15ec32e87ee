"""What installers read: the wheel works elsewhere, and the conda recipe asks for what pyproject.toml does."""

import re
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
RECIPE = (ROOT / "integrations" / "conda" / "recipe.yaml").read_text()
USE = """
import sys
import heliograph as hg

plant, sensor = hg.LinearPlant([[1.0]], 0.1, [0.0], 1.0), hg.LinearSensor([[1.0]], 0.1)
network = hg.Network(plant, {"n": hg.Node(sensor, hg.perfect(), {"k": hg.kalman_filter(plant, sensor)})})
assert hg.run(network, {"n": [[1.0], [2.0]]}).estimates["n"]["k"].mean.shape == (2, 1)
from heliograph import cli
assert cli.main(["new", "cart.py"]) == 0
print(hg.__file__)
"""


def test_the_conda_recipe_asks_for_what_the_package_needs():
    run = RECIPE.partition("  run:\n")[2].partition("\n\n")[0]
    asked = sorted(re.sub(r"[ _]", lambda m: "-" if m[0] == "_" else "", line).strip("- ") for line in run.splitlines())
    needed = [f"python{PROJECT['project']['requires-python']}", *PROJECT["project"]["dependencies"]]
    assert asked == sorted(needed)
    assert re.findall(r'version: "(.*)"', RECIPE) == [PROJECT["project"]["version"]]
    scripts = [f"{name} = {value}" for name, value in PROJECT["project"]["scripts"].items()]
    assert re.findall(r"      - (heliograph = .*)", RECIPE) == scripts


def test_tools_are_groups_and_not_extras():
    """PEP 735: who installs the package is not offered what develops it."""
    assert set(PROJECT["dependency-groups"]) == {"dev", "docs"}
    assert not {"dev", "docs"} & set(PROJECT["project"]["optional-dependencies"])


@pytest.mark.slow
def test_the_wheel_works_outside_of_the_checkout(tmp_path):
    """Built by the build backend alone, unpacked, and used from a folder of its own."""
    pytest.importorskip("hatchling")
    build = f"from hatchling.build import build_wheel; print(build_wheel({str(tmp_path)!r}))"
    subprocess.run([sys.executable, "-c", build], cwd=ROOT, check=True, capture_output=True)
    (wheel,) = tmp_path.glob("*.whl")
    site, away = tmp_path / "site", tmp_path / "away"
    away.mkdir()
    with zipfile.ZipFile(wheel) as packed:
        names = packed.namelist()
        packed.extractall(site)
    for name in ("heliograph/py.typed", "heliograph/__init__.pyi", "heliograph/cli/my_network.py.txt",
                 "heliograph/serving/observation/browser/page.js", "heliograph_studies/demo/page.md"):  # fmt: skip
        assert name in names, name
    assert not [name for name in names if name.startswith(("tests/", "docs/", "integrations/"))]
    command = [sys.executable, "-c", USE]
    done = subprocess.run(
        command, cwd=away, env={"PYTHONPATH": str(site), "HOME": str(away)}, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == str(site / "heliograph" / "__init__.py") and (away / "cart.py").is_file()


FIRST = """
import sys
import numpy as np
import heliograph as hg
plant, sensor = hg.LinearPlant([[0.9]], 0.1, [0.0], 1.0), hg.LinearSensor([[1.0]], 0.1)
link = hg.hop(hg.Rayleigh(1.0), 0.1)
hg.monte_carlo(hg.Network(plant, {"a": hg.Node(sensor, link, {"f": hg.linear_filter(plant, sensor, link)})}), 2, 8, 0)
print(*(name for name in ("special", "linalg", "sparse", "stats", "optimize") if f"scipy.{name}" in sys.modules))
"""


def test_a_first_monte_carlo_waits_for_no_part_of_scipy():
    """All of heliograph and JAX take 1.0 s of processor to import, and scipy.stats 0.8 more, scipy.special 0.1."""
    completed = subprocess.run([sys.executable, "-c", FIRST], check=True, capture_output=True, text=True)
    assert completed.stdout.split() == []
