"""Commands with values that are huge, tiny, quoted or of another kind: they work, or say one line."""

import pytest

from heliograph import cli
from heliograph.cli import studies
from tests.junk import ending

COMMANDS = {  # words that work, and options whose values are replaced
    "replay": (
        ["data.csv", "--network", "net.py"],
        ["--speed", "--plant", "--loss", "--run", "--delay", "--duplicates", "--trace", "--seed"],
    ),
    "design": (["nothing.toml", "--out", "d"], ["--out"]),
    "sweep": (["nothing.toml", "--out", "o"], ["--workers", "--setting", "--chunk"]),
    "explore": (["nothing", "--out", "p"], ["--out"]),
    "completion": (["csh"], []),
    "demo": (["--out", "o"], ["--seed", "--recording"]),
    "example": (["demo", "--out", "o"], ["--seed", "--trace"]),
}
VALUES = ["1e308", "5e-324", "-1", "1" * 25, '"0.1"', "", "/dev/full"]
PLACES = [(name, option) for name, (_, options) in COMMANDS.items() for option in ["", *options]]


class Untried:
    """A study that takes settings and computes nothing."""

    def __init__(self, study):
        self.settings = study.settings

    def run(self, setting, out):
        pass


@pytest.mark.parametrize(("name", "option"), PLACES)
def test_a_value_is_used_or_refused_in_one_line(folder, capsys, monkeypatch, name, option):
    monkeypatch.setattr(studies, "load", lambda entry: Untried(entry.load()))
    for value in VALUES:
        words = list(COMMANDS[name][0])
        if not option:
            words[0] = value
        elif option in words:
            words[words.index(option) + 1] = value
        else:
            words += [option, value]
        capsys.readouterr()
        with ending(60.0):
            code = cli.main([name, *words])
        said = capsys.readouterr().err
        assert code in (0, cli.BAD_INPUT), (words, code)
        assert said.count("\n") == (code != 0) and said.startswith("heliograph: " * (code != 0)), (words, said)
