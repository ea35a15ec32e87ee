"""The conda recipe, built by rattler-build from a channel of stand-ins, and tested as the recipe says."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
RECIPE = ROOT / "integrations" / "conda" / "recipe.yaml"


@pytest.mark.real("rattler-build")
def test_the_recipe_builds_and_its_tests_pass(tmp_path, monkeypatch):
    """With the package's own requirements solved, its modules imported, and its command run, where it is installed."""
    from rattler_build import Stage0Recipe, ToolConfiguration

    from tests.integrations.conda_channel import Channel

    for name in ("XDG_CACHE_HOME", "RATTLER_CACHE_DIR", "HOME"):
        monkeypatch.setenv(name, str(tmp_path / "cache"))
    monkeypatch.delenv("PYTHONPATH", raising=False)
    recipe = Stage0Recipe.from_file(RECIPE)
    needed = recipe.to_dict()["requirements"]["run"]
    names = [re.split(r"[ >=<]", line)[0] for line in needed if not line.startswith("python ")]
    channel = Channel(tmp_path, names)
    (built,) = recipe.run_build(
        tool_config=ToolConfiguration(test_strategy="native"), output_dir=tmp_path / "out", channels=[channel.url]
    )
    (package,) = built.packages
    assert package.name.startswith("heliograph-0.5.0-py") and package.parent.name == "noarch"
    log = "\n".join(built.log)
    assert "python imports test passed" in log and "+ heliograph --version\n0.5.0\n" in log
    assert "all tests passed" in log
