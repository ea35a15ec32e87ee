import numpy as np
import pytest

from heliograph.relays.check import recompute
from heliograph.relays.own_error import own_error_design
from heliograph.relays.receiver_error import receiver_error_design
from tests.relays.relay_problems import example, relative, unusual

HORIZON = 100


@pytest.fixture(scope="module")
def own():
    return own_error_design(example(), HORIZON)


def ratio(design, own):
    return design.trace("receiver")[1:] / own.trace("receiver")[1:]


def test_tuned_together_the_receiver_errs_less(own):
    tuned = receiver_error_design(example(), HORIZON, sweeps=50)
    assert np.mean(ratio(tuned, own)) <= 0.775  # found: 0.7680
    found = recompute(example(), tuned.gains).covariance["receiver"]
    assert relative(found, tuned.covariance["receiver"]) < 1e-10  # a route that made no gains
    assert 1.0 < np.max(tuned.total_power() / own.total_power()) < 1.5


def test_a_tuned_relay_need_not_be_louder():
    own = own_error_design(example(), 40)
    power = own.total_power()
    design = receiver_error_design(example(), 40, power_limit=power)
    assert np.all(design.total_power() <= power * (1 + 1.1e-6))  # the stated tolerance
    assert np.mean(ratio(design, own)) < 0.90  # found: 0.8758 at no more power at any step (0.8086 over 100 steps)


def test_limits_that_can_not_be_met_are_refused(own):
    low = 0.5 * own.total_power()
    with pytest.raises(
        ValueError, match=r"power limit: expected at least 0\.2116 at step 0, the power of the mean state"
    ):
        receiver_error_design(example(), HORIZON, power_limit=low)
    with pytest.raises(ValueError, match=r"power limit: expected shape \(100\)"):
        receiver_error_design(example(), HORIZON, power_limit=low[:5])
    with pytest.raises(ValueError, match=r"weights: expected shape \(100\)"):
        receiver_error_design(example(), HORIZON, weights=np.ones(3))
    with pytest.raises(ValueError, match="no negative weight"):
        receiver_error_design(example(), HORIZON, weights=-np.ones(HORIZON))


def test_one_step_ahead_greedy_is_best_for_the_receiver():
    """With all weight on the last step, that step's receiver gain is the greedy one for the moments it meets."""
    net, weights = unusual(), np.array([0.0, 0.0, 0.0, 1.0])
    own, tuned = own_error_design(net, 4), receiver_error_design(net, 4, weights=weights, sweeps=20)
    assert tuned.trace("receiver")[-1] < own.trace("receiver")[-1]
    assert recompute(net, tuned.gains).correlation["receiver"][-1] < 1e-6  # the damping of the gains is 1e-9


def test_the_gradient_vanishes_in_every_gain():
    """By central differences of a recursion that made no gains, against the slope at the start of the search."""
    net = unusual()
    own, tuned = own_error_design(net, 3), receiver_error_design(net, 3, sweeps=300)
    weights = 1 / (3 * own.trace("receiver")[1:])

    def slope(gains, name):
        change = np.random.default_rng(0).normal(size=gains[name].shape) * 1e-4
        ends = [recompute(net, gains | {name: gains[name] + sign * change}).covariance["receiver"] for sign in (1, -1)]
        return abs(weights @ np.trace(ends[0][1:] - ends[1][1:], axis1=1, axis2=2)) / 2e-4

    start = max(slope(own.gains, name) for name in net.filters)
    assert max(slope(tuned.gains, name) for name in net.filters) < 1e-2 * start
