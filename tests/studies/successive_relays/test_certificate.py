import numpy as np
import pytest

from heliograph.model.channel import hop
from heliograph.model.plant import LinearPlant
from heliograph.model.relays import RelayNetwork
from heliograph.model.sensor import LinearSensor
from heliograph.random_affine.laws.law import GivenMoments
from heliograph.relays.design import local_error_design
from heliograph.relays.design_for_receiver_error import receiver_error_design
from heliograph_studies.successive_relays.certificate import certify_relays
from tests.relays.relay_problems import example, unusual


@pytest.fixture(scope="module")
def paper():
    return certify_relays(example(), local_error_design(example(), 100).gains)


def scalar(transition, initial, mean=0.5):
    law = GivenMoments([mean, 0.1 + mean**2])
    noisy, quiet = hop(law, 1e6), hop(law, 0.0)
    slots = [
        {"b": {"sensor": noisy, "a": quiet}, "receiver": {"a": noisy}},
        {"a": {"sensor": noisy, "b": quiet}, "receiver": {"b": noisy}},
    ]
    plant = LinearPlant([[transition]], [[1.0]], [0.0], [[initial]])
    return RelayNetwork(plant, LinearSensor([[1.0]], [[1.0]]), ("a", "b"), slots)


@pytest.mark.slow
def test_the_bounds_of_the_example(paper):
    bounds = paper.bounds
    assert paper.constants["tau_upper"] == pytest.approx(1.2616, abs=5e-5)
    assert bounds["state covariance"].applies and bounds["state covariance"].holds
    upper = bounds["Theorem 3, upper"]
    assert upper.applies and upper.holds
    assert upper.values[-1] == pytest.approx(6.18e8, rel=1e-2)  # vacuous: three digits given
    lower = bounds["Theorem 3, lower"]
    assert not lower.applies and lower.holds is None
    assert any("printed form -533.8" in reason for reason in lower.failing)
    assert bounds["Theorem 4, lower"].failing == ("process noise in every direction: smallest eigenvalue 0",)
    for name in ("Lemma 8, upper", "Lemma 8, lower", "Lemma 9, upper", "Lemma 9, lower"):
        assert bounds[name].failing == ("largest eigenvalue of A A' below 1: 1.2616",)


@pytest.mark.slow
def test_tuned_gains_leave_the_bounds_proofs():
    tuned = certify_relays(example(), receiver_error_design(example(), 100, sweeps=20).gains)
    state = tuned.bounds["state covariance"]
    assert not state.applies and state.holds is False
    assert "every gain minimises" in state.failing[0]


def test_corrected_uniform_bounds_hold_where_the_printed_fail():
    net = scalar(0.5, 10.0)
    result = certify_relays(net, local_error_design(net, 60).gains)
    assert all(bound.applies and bound.holds for bound in result.bounds.values())
    last = result.recomputed.covariance["receiver"][-1, 0, 0]
    assert last == pytest.approx(1.333, abs=1e-3)
    # printed: tau p0 + w / (1 - tau), alpha p0 + w / (1 - alpha), with alpha = tau up to 1e-6
    assert pytest.approx(3.833, abs=1e-3) == 0.25 * 10 + 1 / 0.75
    assert last < 3.833 and result.recomputed.covariance["receiver"][0, 0, 0] > 3.833


def test_every_bound_can_fail():
    """Gains that do the opposite of what they should break the upper bounds, and gains are seen not to be greedy."""
    net = scalar(0.9, 1.0)
    gains = {name: np.full((5, 1, 1), 2.0) for name in net.filters}
    bounds = certify_relays(net, gains).bounds
    for name in ("state covariance", "Theorem 3, upper", "Theorem 4, upper", "Lemma 8, upper", "Lemma 9, upper"):
        assert not bounds[name].applies and bounds[name].holds is False


@pytest.mark.slow
def test_a_network_of_another_kind_gets_the_bounds_that_still_make_sense():
    net = unusual()
    bounds = certify_relays(net, local_error_design(net, 9).gains).bounds
    assert bounds["state covariance"].holds and bounds["Theorem 3, upper"].holds
    assert "otherwise" in bounds["Theorem 3, lower"].failing[0]
    assert bounds["Theorem 4, lower"].values is None
