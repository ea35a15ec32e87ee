"""The example of docs/campaigns.md, as a user would run it."""

import re
from pathlib import Path

import pytest

from heliograph import cli

PAGE = (Path(__file__).parents[2] / "docs" / "campaigns.md").read_text()


def block(kind: str) -> str:
    (text,) = re.findall(rf"```{kind}\n(.*?)```", PAGE, re.DOTALL)
    return text


@pytest.mark.slow
def test_the_example_runs(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("my_network.py").write_text(block("python"))
    Path("campaign.toml").write_text(block("toml"))
    program, *arguments = block("sh").split()
    assert program == "heliograph" and cli.main([*arguments, "--workers", "0"]) == 0
    capsys.readouterr()
    exec(compile(block("py"), "campaigns.md", "exec"), {})
    losses, values = re.findall(r"\[(.*?)\]", capsys.readouterr().out)
    assert losses.split() == ["0.", "0.2"]
    assert len(values.split()) == 2 and float(values.split()[0]) < float(values.split()[1])  # losses cost accuracy
    assert sorted(p.name for p in Path("results").iterdir()) == ["report.html", "results.zarr", "summary.csv"]
