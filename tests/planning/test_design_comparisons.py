"""Designs compared, with a budget in whichever form `design` takes."""

import numpy as np
import pytest

import heliograph as hg
from heliograph.planning import Budget, DesignProblem, error_over_power, worth_of_changes
from tests.planning.example import direct_paths


def network():
    plant = hg.LinearPlant([[0.9]], [[0.1]], [0.0], [[1.0]])
    return hg.Network(plant, {"a": hg.Node(hg.LinearSensor([[1.0]], 0.3), hg.hop(1.0, 0.2), {})})


def test_a_budget_may_be_a_number():
    front = error_over_power(DesignProblem(network(), budget=1.0), [1.0, 2.0])
    assert np.diff(front.errors)[0] < 0
    best = hg.design(DesignProblem(network(), budget=Budget(1.0)))
    assert front.errors[0] == pytest.approx(best.error, rel=1e-12)
    assert best.problem == DesignProblem(network(), budget=Budget(1.0))


def test_what_is_no_problem_is_named():
    with pytest.raises(ValueError, match="design of a DesignProblem: expected no further arguments"):
        hg.design(DesignProblem(network(), budget=1.0), budget=2.0)
    with pytest.raises(ValueError, match="problem: expected a DesignProblem"):
        error_over_power(network(), [1.0])
    with pytest.raises(ValueError, match="network of the design: expected a Network"):
        worth_of_changes(hg.design(direct_paths(), budget=1.0))


def test_changes_have_the_limits_by_name_of_what_they_change():
    """A sensor that was doubled had no limit, one that was left out ended all, and a free name was read by letters."""
    plant, sensor = hg.LinearPlant([[0.9]], 0.1, [0.0], 1.0), hg.LinearSensor([[1.0]], 0.3)
    links = {"north": hg.amplify_and_forward([hg.hop(1.0, 0.2), hg.hop(1.0, 0.1)]), "south": hg.hop(1.0, 0.3)}
    nodes = {name: hg.Node(sensor, link, {}) for name, link in links.items()}
    limits = Budget(total=6.0, peak={"north.hop1": 0.2, "north.hop2": 0.5, "south.hop1": 1.0})  # south sends .83
    best = hg.design(hg.Network(plant, nodes), free="north", budget=limits, starts=2)
    found = {change.name: change.value for change in worth_of_changes(best, exponent=0.0)}
    # A relay halfway of the south would send 1.13, above its limit: it cannot be designed.
    relays = {f"a relay halfway of {hop}" for hop in ("north.hop1", "north.hop2")}
    assert set(found) == {"one more north", "one more south", "without south", *relays}

    def error(nodes, peaks, free="north"):
        return hg.design(hg.Network(plant, nodes), free=free, budget=Budget(6.0, peak=peaks), starts=2).error

    a, b, c = limits.peak.values()
    again = {"north again.hop1": a, "north again.hop2": b}
    twice = error({**nodes, "north again": nodes["north"]}, limits.peak | again, free=["north", "north again"])
    assert found["one more north"] == pytest.approx(twice, rel=1e-9)
    alone = error({"north": nodes["north"]}, {"north.hop1": a, "north.hop2": b})
    assert found["without south"] == pytest.approx(alone, rel=1e-9)
    # Of exponent 0 a relay halfway is one more hop with the gain and noise of the first, and the first one's limit.
    chain = hg.Node(sensor, hg.amplify_and_forward([hg.hop(1.0, 0.2), hg.hop(1.0, 0.2), hg.hop(1.0, 0.1)]), {})
    halved = error({**nodes, "north": chain}, {"north.hop1": a, "north.hop2": a, "north.hop3": b, "south.hop1": c})
    assert found["a relay halfway of north.hop1"] == pytest.approx(halved, rel=1e-9)
