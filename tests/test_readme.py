"""Every command and every Python block of the README runs, in its order, with what `make demo` installs alone."""

import json
import re
import runpy
import shlex
import sys
import tomllib
from importlib.metadata import entry_points
from pathlib import Path

import matplotlib
import pytest

from heliograph import cli

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
BLOCK = re.compile(
    r"(?:<!-- (?P<role>file|after): (?P<file>\S+) -->\n)?```(?P<kind>python|sh)\n(?P<text>.*?)```", re.DOTALL
)
TESTS_ITSELF = (["make", "test"], ["make", "check"])
DRIVEN = {
    "relay_aware": "knows its relays",
    "mean_gain": "trusts the mean gain",
    "perfect_channel": "the same ranges without a relay",
}


def recipe(target: str) -> str:
    """The commands that make runs for a target, with the environment's programs by their names."""
    makefile = (ROOT / "Makefile").read_text()
    return (
        re.search(rf"^{target}:.*\n((?:\t.*\n)+)", makefile, re.MULTILINE)[1].replace("$(BIN)/", "").replace("\t", "")
    )


def installed_by_demo() -> set[str]:
    """The extras that `make demo` installs, with those that they name."""
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    result = set(re.search(r"'\.\[(.*?)\]'", recipe(r"\.venv/\.demo"))[1].split(","))
    for item in tuple(result):
        for text in extras[item]:
            result |= set(re.findall(r"heliograph\[(.*)\]", text))
    return result


@pytest.fixture
def after_make_demo(tmp_path, monkeypatch):
    """A folder of one's own, where the packages of all other extras are not installed."""
    matplotlib.use("Agg")
    monkeypatch.chdir(tmp_path)
    there = installed_by_demo()
    assert set(cli.EXTRAS.values()) - there, "expected an extra that the demonstration does without"
    for package, extra in cli.EXTRAS.items():
        if extra not in there:
            monkeypatch.setitem(sys.modules, package, None)
    return tmp_path


@pytest.mark.slow
def test_all_of_it_runs_in_order(after_make_demo):
    scopes: dict[str, dict] = {}
    commands = 0
    for block in BLOCK.finditer(README):
        if block["kind"] == "sh":
            for line in block["text"].splitlines():
                commands += run(shlex.split(line, comments=True))
            continue
        assert block["role"], "expected every Python block to say which file it is, or follows"
        scope = scopes.setdefault(block["file"], {"__name__": "readme"})
        if block["role"] == "file":
            (after_make_demo / block["file"]).write_text(block["text"])
        exec(compile(block["text"], block["file"], "exec"), scope)
    assert commands == len(re.findall(r"^(?:make|heliograph|python) ", README, re.MULTILINE)) - len(TESTS_ITSELF)
    for made in re.findall(r"(?:writes|--out) (?:\S+ )?(out/\S+|\S+\.parquet)", README):
        assert (after_make_demo / made.rstrip(".,`")).exists(), made
    summary = json.loads((after_make_demo / "out" / "demo" / "summary.json").read_text())
    for filter_, title in DRIVEN.items():
        error, claimed, nees = (
            summary[name][filter_] for name in ("position_rmse_m", "claimed_rmse_m", "nees_per_dimension")
        )
        row = f"| {title} | {error:.2f} m | {claimed:.2f} m | {shown(nees)} |"
        assert row.replace("*", "") in README.replace("*", ""), f"README lacks: {row}"
    check_what_else_is_said_of_the_drive(summary)


def check_what_else_is_said_of_the_drive(result: dict) -> None:
    """The README's row beside peers, the start page and the page on learning, by the same summary."""
    aware, mean = (f"{result['position_rmse_m'][name]:.2f} m" for name in ("relay_aware", "mean_gain"))
    row = against_peers()["a sensor behind relays with random gains: error on the recorded drive"]
    assert row[:2] == [f"{mean}: the mean gain, in any package", aware]
    claimed, learned = result["claimed_rmse_m"]["mean_gain"], result["learned"]
    gyro = learned["parameters"]["gyro_rate"]
    said = {
        "index.md": [f"is off by {aware};", f"by {mean}, and believes that it is {claimed:.2f} m."],
        "fit.md": [
            f"is off by {learned['second_half']:.3f} m;",
            f"it is off by {learned['second_half_calibrated']:.3f} m.",
            f"before the robot moved, {learned['gyro_rate_at_rest']:.1e} rad/s.".replace("e-0", "e-"),
            "off by {estimate:.1e} ({low:.1e} to {high:.1e})".format(**gyro).replace("e-0", "e-"),
            f"and {learned['gyro_rate_of_truth']:.1e}, as the true path says.".replace("e-0", "e-"),
        ],
    }
    for page, sentences in said.items():
        text = " ".join((ROOT / "docs" / page).read_text().split())
        assert [s for s in sentences if s not in text] == [], f"docs/{page}"


def shown(number: float) -> str:
    """Three digits at most, as tables have them."""
    return f"{number:,.0f}" if number >= 100 else f"{number:.3g}"


def against_peers() -> dict[str, list[str]]:
    """The rows of the table beside the best peers, by what they are of: others, ours, and the command."""
    section = README.split("## Beside the best peers")[1].split("\n## ")[0]
    rows = [row.strip("| ").split(" | ") for row in section.splitlines() if row.startswith("| ")][1:]
    return {name: cells for name, *cells in rows}


def test_it_is_read_on_a_few_screens():
    assert len(README.splitlines()) <= 150


def test_every_row_of_peers_names_a_command_that_there_is():
    """Times are in test_docs.py, errors in the test above and those of quadratic bias, late data and live."""
    rows = against_peers()
    assert len(rows) == 12
    for others, ours, command in rows.values():
        assert others and ours
        kind, *words = shlex.split(command.strip("`"))
        if kind == "make":
            assert recipe(words[0])
        elif kind == "python":
            assert (ROOT / words[0]).exists()
        else:
            assert kind == "heliograph"  # its words are looked at below, with those of all others in passing


def run(words: list[str]) -> int:
    """Run one command as a shell would, but in this process; whether it was run."""
    if words in TESTS_ITSELF:
        return 0
    if words[0] == "make":
        return sum(run(shlex.split(line)) for line in recipe(words[1]).splitlines())
    if words[0] == "python":
        runpy.run_path(words[1], run_name="__main__")
    else:
        assert words[0] == "heliograph" and cli.main(words[1:]) == 0, words
    return 1


class BegunError(BaseException):
    """The work would begin now: all that it needs is there."""


def test_every_method_finds_what_it_needs(after_make_demo, monkeypatch):
    def begin(target):
        raise BegunError

    monkeypatch.setattr("heliograph.report.results_folder.whole_folder", begin)
    methods = [e.name for e in entry_points(group="heliograph.studies") if e.attr == "publication"]
    assert len(methods) == 5
    for method in methods:
        with pytest.raises(BegunError):
            cli.main(["reproduce", method, "--out", "out"])


def test_its_network_is_as_short_as_it_says():
    block = next(b for b in BLOCK.finditer(README) if b["role"] == "file")
    assert len([line for line in block["text"].splitlines() if line.strip()]) <= 25


def test_every_command_that_it_names_in_passing_is_one():
    """What is too long to run here is at least understood: its options too."""
    from heliograph.cli.app_and_option_types import app

    named = [text for text in re.findall(r"`heliograph ([^`]*)`", README) if "$" not in text]
    assert len(named) >= 2
    for text in named:
        words = shlex.split(text.replace("METHOD", "quadratic-bias").replace("DIR", "out"))
        app.parse_args(words, exit_on_error=False, print_error=False)
