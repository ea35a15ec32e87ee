"""The example without a centre: what its network is, and the shape of what it writes."""

import json

import numpy as np
import pytest

import heliograph as hg
from heliograph_studies import without_centre


@pytest.fixture
def outcome():
    """As it would be computed, with other numbers."""
    small = without_centre.Setting(nodes=6, radius=0.8)
    places = without_centre.positions(small)
    near = hg.fusion.neighbours_within(places, small.radius)
    nees = {name: 0.9 + 0.02 * i for i, name in enumerate(places)}
    score = without_centre.Score("upper", 2.5, 2.8, 1.1, (0.9, 1.0), np.linspace(3.0, 2.5, 60), nees)
    bound = np.full(30, 2.2)
    return without_centre.Outcome(
        6, 3.3, 0.3, 2.2, dict.fromkeys(without_centre.RULES, score), bound, places, near, ("n0", "n2", "n4")
    )


def test_half_of_the_nodes_measure_and_every_rule_is_shown():
    network = without_centre.network(without_centre.Setting(nodes=8, radius=0.7))
    assert [isinstance(node, hg.Node) for node in network.nodes.values()] == [True, False] * 4
    assert set(network.meshes) == set(without_centre.RULES)
    assert network.claims()["n1"] == {"best": "exact", "intersection": "upper", "diffusion": "exact"}


def test_the_summary(outcome):
    summary = json.loads(json.dumps(without_centre.example.summary(without_centre.Setting(), outcome, {})))
    assert set(summary["rules"]) == set(without_centre.RULES)
    assert summary["rules"]["best"]["nees"] == [0.9, 1.0] and "positions" not in summary


@pytest.mark.slow
def test_the_page_shows_every_figure_and_rule(outcome, fits):
    pytest.importorskip("jinja2")
    drawn = without_centre.figures(outcome)
    pictures = {name: b"<svg/>" for name in drawn}
    html = without_centre.example.make_page(without_centre.Setting(), outcome, {}, pictures).html()
    fits(html)
    assert html.count("data:image/svg+xml") == len(drawn) == 2
    assert all(label in html for label, _ in without_centre.NAMES.values())


@pytest.mark.slow
def test_numbers_of_a_small_graph():
    small = without_centre.run(without_centre.Setting(nodes=8, radius=0.6, steps=12, runs=64))
    best, meet = small.rules["best"], small.rules["intersection"]
    assert small.best_possible > 1 and 1 - 1e-6 < best.over_best < meet.over_best
    assert meet.error < meet.claimed and best.error == pytest.approx(best.claimed)
