"""`heliograph design`: a file that asks, a page that answers, and a network that runs."""

import json

import numpy as np
import pytest

import heliograph as hg
from heliograph import cli
from heliograph.planning import DesignProblem, worth_of_changes

NETWORK = """
import heliograph as hg

plant = hg.LinearPlant([[0.9, 0.1], [0.0, 0.8]], 0.1, [0.0, 0.0], [[1.0, 0.0], [0.0, 1.0]])


def place(x=1.0, y=0.0):
    far = hg.hop(hg.Discrete([0.5 / (1 + x**2 + y**2), 1.0 / (1 + x**2 + y**2)], [0.5, 0.5]), 0.2)
    near = hg.hop(0.8, 0.2)
    sensors = {"near": hg.LinearSensor([[1.0, 0.0]], 0.2), "far": hg.LinearSensor([[0.0, 1.0]], 0.1)}
    return hg.Network(plant, {"near": hg.Node(sensors["near"], near, {}), "far": hg.Node(sensors["far"], far, {})})


network = place()
"""
REQUESTED = """
network = "yard.py"
budget = 2.0
path_loss_exponent = 2.0
front = [1.0, 2.0, 4.0]
[map]
network = "yard.py:place"
x = [0.0, 1.0]
y = [0.0, 1.0]
points = 2
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    here = tmp_path_factory.mktemp("yard")
    (here / "yard.py").write_text(NETWORK)
    (here / "design.toml").write_text(REQUESTED)
    assert cli.main(["design", str(here / "design.toml"), "--out", str(here / "out")]) == 0
    return here


@pytest.fixture(scope="module")
def summary(folder):
    return json.loads((folder / "out" / "design" / "summary.json").read_text())


@pytest.mark.slow
def test_the_page_tells_the_design(folder, summary, fits):
    fits(folder / "out" / "design" / "report.html")
    result = hg.design(hg.files.load_network(str(folder / "yard.py")), budget=2.0)
    assert summary["error"] == pytest.approx(result.error, rel=1e-12)
    assert summary["total"] == pytest.approx(2.0, rel=1e-9)
    assert summary["certificate"]["gap"] < 1e-9
    page = (folder / "out" / "design" / "report.html").read_text()
    for words in ("optimal within", "One more watt", "heliograph run designed.py", "far.hop1"):
        assert words in page
    assert page.count("<img") == 3


def test_the_front_falls_and_nothing_is_below_its_bound(summary):
    errors, bounds = np.array(summary["front"]["errors"]), np.array(summary["front"]["bounds"])
    assert np.all(np.diff(errors) < 0) and np.all(bounds <= errors)
    assert errors[1] == pytest.approx(summary["error"], rel=1e-9)


def test_the_map_is_best_where_the_gain_is(summary, folder):
    assert (summary["map"]["x"], summary["map"]["y"]) == (0.0, 0.0)
    closer = hg.files.load_network(str(folder / "yard.py") + ":place")  # at (1, 0)
    assert summary["map"]["error"] < hg.design(closer, budget=2.0).error == pytest.approx(summary["error"], rel=1e-9)


def test_the_designed_network_runs(folder, summary):
    place = folder / "out" / "design" / "designed.py"
    designed = hg.files.load_network(str(place))
    sent = hg.power(designed).mean
    assert sent == pytest.approx({name: power[0] for name, power in summary["powers"].items()}, rel=1e-9, abs=1e-12)
    rows = "time,near.y0,far.y0\n" + "".join(f"{k},0.1,{0.2 * k}\n" for k in range(3))
    (folder / "data.csv").write_text(rows)
    out = folder / "estimates.csv"
    assert cli.main(["run", str(place), "--measurements", str(folder / "data.csv"), "--out", str(out)]) == 0
    assert len(out.read_text().splitlines()) == 4


def test_what_more_buys_is_the_design_made_again(summary, folder):
    network = hg.files.load_network(str(folder / "yard.py"))
    twice = hg.Network(network.plant, {**network.nodes, "again": network.nodes["far"]})
    saved = summary["error"] - hg.design(twice, budget=2.0).error
    assert summary["changes"]["one more far"]["saved"] == pytest.approx(saved, rel=1e-6)
    alone = hg.Network(network.plant, {"near": network.nodes["near"]})
    assert summary["changes"]["without far"]["value"] == pytest.approx(hg.design(alone, budget=2.0).error, rel=1e-9)
    # halfway, of a power gain that falls with the square of the distance: two hops of twice the amplitude
    hops = [hg.hop(1.6, 0.2), hg.hop(1.6, 0.2)]
    relayed = hg.Node(network.nodes["near"].sensor, hg.amplify_and_forward(hops), {})
    halfway = hg.design(hg.Network(network.plant, {**network.nodes, "near": relayed}), budget=2.0).error
    assert summary["changes"]["a relay halfway of near.hop1"]["value"] == pytest.approx(halfway, rel=1e-6)


def test_changes_of_a_target_error_are_worth_power(folder):
    network = hg.files.load_network(str(folder / "yard.py"))
    best = hg.design(DesignProblem(network, target_error=0.3, free=("near", "far")))
    worth = {change.name: change for change in worth_of_changes(best)}
    assert set(worth) == {"one more near", "one more far"}  # without one of them the error may be out of reach
    assert 0 < worth["one more far"].saved < best.total


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("network = 3", "network: expected a Python file"),
        ("network = 'no.py'\nbudget = 1.0", "expected a Python file in its folder"),
        ("network = 'yard.py'", "expected a budget of power or a target error, got neither"),
        ("network = 'yard.py'\nbugdet = 1.0", "closest: 'budget'"),
        ("network = 'yard.py'\nbudget = {totl = 1.0}", "closest: 'total'"),
        ("network = 'yard.py'\nbudget = 1.0\nfree = 'near'", "free: expected a list of names"),
        ("network = 'yard.py'\nbudget = 1.0\nfront = [-1.0]", "budgets of the front: expected positive numbers"),
        ("network = 'yard.py'\ntarget_error = 0.001", "unlimited power leaves"),
        ("network =", "expected TOML"),
    ],
)
def test_bad_input_is_one_line(folder, capsys, text, words):
    (folder / "bad.toml").write_text(text)
    assert cli.main(["design", str(folder / "bad.toml"), "--out", str(folder / "bad")]) == 2
    summary = capsys.readouterr().err
    assert words in summary and summary.count("\n") == 1
