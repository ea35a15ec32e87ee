"""Relays that filter: their gains are a design with a budget."""

import numpy as np
import pytest

import heliograph as hg
from heliograph.planning import Budget

PLANT = hg.LinearPlant([[0.9]], [[0.19]], [0.0], [[1.0]])
HOP = hg.hop(hg.Discrete([0.5, 1.5], [0.5, 0.5]), 0.3)


@pytest.fixture(scope="module")
def relays():
    pairs = [("north", "south"), ("south", "north")]
    slots = [{receiving: {"sensor": HOP}, "receiver": {sends: HOP}} for receiving, sends in pairs]
    return hg.model.RelayNetwork(PLANT, hg.LinearSensor([[1.0]], 0.5), ["north", "south"], slots)


@pytest.fixture(scope="module")
def design(relays):
    return hg.design(relays, budget=0.5)


@pytest.mark.slow
def test_gains_are_those_of_the_tuning_within_the_budget(relays, design):
    tuned = hg.relays.periodic_relays_for_best_receiver(relays, power_limit=0.5)
    for name, gain in tuned.items():
        np.testing.assert_array_equal(design.numbers[name], gain)
    assert np.all(design.powers["north"] + design.powers["south"] <= 0.5 * (1 + 1e-6))
    assert design.powers["sensor"] == pytest.approx([1.5, 1.5], rel=1e-9)
    assert design.error == pytest.approx(np.mean(design.covariance[:, 0, 0]))
    assert design.certificate.words == "best of the one start; no bound is known"


@pytest.mark.slow
def test_the_network_it_gives_sends_and_errs_as_designed(design):
    sent = hg.power(design.network)
    for name in ("north", "south"):
        np.testing.assert_allclose(sent.over_time[name][-2:], design.powers[name], rtol=1e-6)
    claimed = design.network.nodes["receiver"].filters["best"].covariances
    np.testing.assert_allclose(
        claimed[[-3, -1], 0, 0], design.covariance[:, 0, 0], rtol=1e-6
    )  # converged after 100 steps


def test_what_relays_that_filter_do_not_take_is_named(relays):
    for given in (
        {"free": ["north"]},
        {"target_error": 0.1},
        {"budget": Budget(per_transmitter=1.0)},
        {"error": hg.planning.Error(period=2)},
    ):
        with pytest.raises(ValueError, match="relays that filter: expected"):
            hg.design(relays, **given)


@pytest.mark.slow
def test_a_network_of_relays_that_filter_is_refused(design):
    with pytest.raises(ValueError, match="network: expected a RelayNetwork alone"):
        hg.design(design.network, budget=1)
