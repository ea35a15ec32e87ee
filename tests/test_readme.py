"""Every command and every Python block of the README runs, in its order, with what `make demo` installs alone."""

import json
import re
import runpy
import shlex
import sys
import tomllib
from pathlib import Path

import matplotlib
import pytest

from heliograph import cli
from heliograph.papers import METHODS

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
BLOCK = re.compile(
    r"(?:<!-- (?P<role>file|after): (?P<file>\S+) -->\n)?```(?P<kind>python|sh)\n(?P<text>.*?)```", re.DOTALL
)
TESTS_ITSELF = ["make", "test"]
DRIVEN = {
    "relay_aware": "knows its relays",
    "mean_gain": "trusts the mean gain",
    "perfect_channel": "the same ranges without a relay",
}
FILTERPY = {"FilterPy, a loop": "FilterPy"}
SPEEDS = {  # how a row begins: the comparison, and how the row calls its peers
    "a Kalman step": ("kalman", {"cuthbert, vectorised": "cuthbert"} | FILTERPY),
    "a cubature step": (
        "cubature",
        {"jax.numpy.linalg, vectorised": "`jax.numpy.linalg`", "FilterPy, mean gain only": "FilterPy"},
    ),
    "a step of multiple models": ("modes", FILTERPY),
    "a step of smoothing": ("smoothing", {"cuthbert, vectorised": "cuthbert", "pykalman, a loop": "pykalman"}),
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
    found = set(re.search(r"'\.\[(.*?)\]'", recipe(r"\.venv/\.demo"))[1].split(","))
    for each in tuple(found):
        for text in extras[each]:
            found |= set(re.findall(r"heliograph\[(.*)\]", text))
    return found


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
    assert commands == len(re.findall(r"^(?:make|heliograph|python) ", README, re.MULTILINE)) - 1  # make test
    for made in re.findall(r"(?:writes|--out) (?:\S+ )?(out/\S+|\S+\.parquet)", README):
        assert (after_make_demo / made.rstrip(".,`")).exists(), made
    found = json.loads((after_make_demo / "out" / "demo" / "summary.json").read_text())
    for filter_, title in DRIVEN.items():
        error, claimed, nees = (
            found[name][filter_] for name in ("position_rmse_m", "claimed_rmse_m", "nees_per_dimension")
        )
        row = f"| {title} | {error:.2f} m | {claimed:.2f} m | {shown(nees)} |"
        assert row.replace("*", "") in README.replace("*", ""), f"README lacks: {row}"


def shown(number: float) -> str:
    """Three digits at most, as tables have them."""
    return f"{number:,.0f}" if number >= 100 else f"{number:.3g}"


def test_its_speeds_are_those_that_were_measured():
    """Each number in nanoseconds of the rows that `make bench` shows."""
    measured = json.loads((ROOT / "benchmarks" / "results.json").read_text())
    rows = {row.split(" | ")[0]: row for row in README.splitlines() if row.endswith("| `make bench` |")}
    assert len(rows) == 1 + len(SPEEDS)
    for begin, (name, peers) in SPEEDS.items():
        (row,) = (row for title, row in rows.items() if title.startswith(f"| {begin}"))
        found = measured["comparisons"][name]
        assert f"| {found['ours']['best']:,.0f} ns |" in row, row
        for peer, title in peers.items():
            assert f"{title} {found['peers'][peer]['best']:,.0f} ns" in row, row
    design = measured["alone"]["network_design"]["values"]["two hops, 20 sensors, 30 starts"]
    assert f"| {design / 1000:.2f} s |" in next(row for title, row in rows.items() if "powers" in title)


def run(words: list[str]) -> int:
    """Run one command as a shell would, but in this process; whether it was run."""
    if words == TESTS_ITSELF:
        return 0
    if words[0] == "make":
        return sum(run(shlex.split(line)) for line in recipe(words[1]).splitlines())
    if words[0] == "python":
        runpy.run_path(words[1], run_name="__main__")
    else:
        assert words[0] == "heliograph" and cli.main(words[1:]) == 0, words
    return 1


class BegunError(Exception):
    """The work would begin now: all that it needs is there."""


def test_every_method_finds_what_it_needs(after_make_demo, monkeypatch):
    def begin(target):
        raise BegunError

    monkeypatch.setattr("heliograph.report.results.whole_folder", begin)
    for method in METHODS:
        with pytest.raises(BegunError):
            cli.main(["reproduce", method, "--out", "out"])


def test_its_network_is_as_short_as_it_says():
    block = next(b for b in BLOCK.finditer(README) if b["role"] == "file")
    assert len([line for line in block["text"].splitlines() if line.strip()]) <= 25


def test_every_command_that_it_names_in_passing_is_one():
    """What is too long to run here is at least understood: its options too."""
    from heliograph.cli.app import app

    named = [text for text in re.findall(r"`heliograph ([^`]*)`", README) if "$" not in text]
    assert len(named) >= 2
    for text in named:
        words = shlex.split(text.replace("METHOD", "quadratic-bias").replace("DIR", "out"))
        app.parse_args(words, exit_on_error=False, print_error=False)
