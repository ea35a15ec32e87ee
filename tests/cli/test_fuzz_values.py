"""Commands with values that are huge, tiny, quoted or of another kind: they work, or say one line."""

import inspect
import io
import sys

import pytest

from heliograph import cli
from heliograph.cli import studies
from heliograph.cli.command import COMMANDS
from tests.junk import ending

WORDS = {  # words with which a command works, or with which it says what is not there
    "new": ["made.py"],
    "check": ["net.py"],
    "inspect": ["nothing.mcap"],
    "run": ["net.py", "--measurements", "data.csv", "--out", "o.csv"],
    "fit": ["net.py", "--measurements", "data.csv", "--out", "o"],
    "backtest": ["net.py", "--measurements", "data.csv", "--horizons", "1", "--out", "b"],
    "serve": ["net.py", "--store", "none"],
    "replay": ["data.csv", "--network", "net.py"],
    "export": ["net.py", "--out", "o"],
    "demo": ["--out", "o"],
    "example": ["demo", "--out", "o"],
    "reproduce": ["cubature-fusion", "--out", "o"],
    "sweep": ["nothing.toml", "--out", "o"],
    "explore": ["nothing", "--out", "p"],
    "design": ["nothing.toml", "--out", "d"],
    "completion": ["csh"],
}
STARTS = {"serve": {"--page", "--broker"}}  # what would wait for others, and is tried in tests/serving


def options_of(command):
    """Its options by its signature, so that a new one is tried by being there."""
    names = [p.name for p in inspect.signature(command).parameters.values() if p.kind is p.KEYWORD_ONLY]
    return [f"--{name.replace('_', '-')}" for name in names]


VALUES = ["1e308", "5e-324", "-1", "1" * 25, '"0.1"', "", "/dev/full"]
PLACES = [
    (command.__name__, option)
    for command in COMMANDS
    for option in ["", *options_of(command)]
    if option not in STARTS.get(command.__name__, ())
]


class Untried:
    """A study that takes settings and computes nothing."""

    def __init__(self, study):
        self.settings = study.settings

    def run(self, setting, out):
        pass


@pytest.mark.slow
@pytest.mark.parametrize(("name", "option"), PLACES)
def test_a_value_is_used_or_refused_in_one_line(folder, capsys, monkeypatch, name, option):
    monkeypatch.setattr(studies, "load_study", lambda entry: Untried(entry.load()))
    for picture in ("png", "svg"):  # drawn seven times they are most of what a report costs
        monkeypatch.setattr(f"heliograph.report.figures.{picture}", lambda figure: b"<svg></svg>")
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(b"")))
    for value in VALUES:
        words = list(WORDS[name])
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
        refused = [line for line in said.splitlines() if not line.startswith("heliograph: warning: ")]
        if code:
            assert len(refused) == 1 and refused[0].startswith("heliograph: "), (words, said)
        assert "Traceback" not in said, (words, said)


def test_every_command_is_tried():
    assert list(WORDS) == [command.__name__ for command in COMMANDS]
