import numpy as np
import pytest

from heliograph.relays.design import given_design, local_error_design
from heliograph.relays.design_for_receiver_error import receiver_error_design
from heliograph_studies.successive_relays.raw_moments import recompute
from tests.relays.relay_problems import example, relative, unusual

HORIZON = 100
STEPS, SWEEPS = 6, 300  # of the network that is unusual


@pytest.fixture(scope="module")
def local():
    return local_error_design(example(), HORIZON)


@pytest.fixture(scope="module")
def greedy():
    return local_error_design(unusual(), STEPS)


@pytest.fixture(scope="module")
def free():
    return receiver_error_design(unusual(), STEPS, sweeps=SWEEPS)


def ratio(design, local):
    return design.trace("receiver")[1:] / local.trace("receiver")[1:]


@pytest.mark.slow
def test_tuned_together_the_receiver_errs_less(local):
    tuned = receiver_error_design(example(), HORIZON, sweeps=50)
    assert np.mean(ratio(tuned, local)) <= 0.775  # found: 0.7680
    result = recompute(example(), tuned.gains).covariance["receiver"]
    assert relative(result, tuned.covariance["receiver"]) < 1e-10  # a route that made no gains
    assert 1.0 < np.max(tuned.total_power() / local.total_power()) < 1.5


@pytest.mark.slow
def test_a_tuned_relay_need_not_be_louder_and_nothing_hangs_on_rounding(horizon=40, result=0.8752):
    """Descents that stop after a count of steps differ by what rounding makes of it: 0.1 % of the error."""
    separate = local_error_design(example(), horizon)
    power, noise = separate.total_power(), np.random.default_rng(0).normal(size=horizon)
    for change in (0.0, 1e-12, 1e-7):
        limit = power * (1 + change * noise)
        design = receiver_error_design(example(), horizon, power_limit=limit, sweeps=100)
        assert np.all(design.total_power() <= limit * (1 + 1e-6))  # the stated tolerance
        np.testing.assert_allclose(np.mean(ratio(design, separate)), result, rtol=1e-3)


@pytest.mark.slow
def test_the_same_limit_gives_the_same_bits(horizon=40):
    power = local_error_design(example(), horizon).total_power()
    first, second = (receiver_error_design(example(), horizon, power_limit=power, sweeps=20) for _ in range(2))
    for name, gains in first.gains.items():
        np.testing.assert_array_equal(gains, second.gains[name])


@pytest.mark.slow
def test_a_limit_that_does_not_bind_costs_nothing(greedy, free):
    wide = receiver_error_design(unusual(), STEPS, power_limit=10 * free.total_power().max(), sweeps=100)
    weights = 1 / greedy.trace("receiver")[1:]
    costs = [weights @ design.trace("receiver")[1:] for design in (wide, free)]
    np.testing.assert_allclose(*costs, rtol=1e-4)  # what the last barrier may leave


@pytest.mark.slow
def test_a_limit_just_above_the_power_of_the_mean_is_met(greedy):
    """Nearly all that three relays, one silent in each slot, may send is the mean, which says nothing."""
    net = unusual()
    silent = given_design(net, {name: 0 * gain for name, gain in greedy.gains.items()})
    for room in (1e-4, 0.1):
        limit = silent.total_power() * (1 + room)
        design = receiver_error_design(net, STEPS, power_limit=limit, sweeps=30)
        assert np.all(design.total_power() <= limit * (1 + 1e-6))
        assert np.any(design.total_power() > silent.total_power())


@pytest.mark.slow
def test_steps_without_weight_keep_their_gains(greedy):
    """Nothing hangs on the gains of the last step, whose normal matrix is zero: the others are those without it."""
    net, weights = unusual(), np.arange(1.0, STEPS)
    short = receiver_error_design(net, STEPS - 1, weights=weights, sweeps=SWEEPS)
    weights = np.append(weights, 0.0)
    tuned = receiver_error_design(net, STEPS, weights=weights, sweeps=SWEEPS)
    limited = receiver_error_design(net, STEPS, weights=weights, power_limit=greedy.total_power(), sweeps=20)
    for name, gains in short.gains.items():
        np.testing.assert_allclose(tuned.gains[name][:-1], gains, rtol=1e-9, atol=1e-12)
        np.testing.assert_array_equal(tuned.gains[name][-1], greedy.gains[name][-1])
    costs = [weights @ design.trace("receiver")[1:] for design in (tuned, limited, greedy)]
    assert costs[0] < 0.9999 * costs[2] and costs[1] <= costs[2] * (1 + 1e-12)


def test_limits_that_can_not_be_met_are_refused(local):
    low = 0.5 * local.total_power()
    with pytest.raises(
        ValueError, match=r"power limit: expected more than 0\.2116 at step 0, the power of the mean state"
    ):
        receiver_error_design(example(), HORIZON, power_limit=low)
    with pytest.raises(ValueError, match=r"power limit: expected shape \(100\)"):
        receiver_error_design(example(), HORIZON, power_limit=low[:5])
    with pytest.raises(ValueError, match=r"weights: expected shape \(100\)"):
        receiver_error_design(example(), HORIZON, weights=np.ones(3))
    with pytest.raises(ValueError, match="no negative weight"):
        receiver_error_design(example(), HORIZON, weights=-np.ones(HORIZON))


def test_one_step_ahead_greedy_is_best_for_the_receiver(greedy):
    """With all weight on the last step, that step's receiver gain is the greedy one for the moments it meets."""
    net, weights = unusual(), np.eye(STEPS)[-1]
    tuned = receiver_error_design(net, STEPS, weights=weights, sweeps=SWEEPS)
    assert tuned.trace("receiver")[-1] < greedy.trace("receiver")[-1]
    assert recompute(net, tuned.gains).correlation["receiver"][-1] < 1e-6  # the damping of the gains is 1e-9


@pytest.mark.slow
def test_the_gradient_vanishes_in_every_gain(greedy, free):
    """By central differences of a recursion that made no gains, against the slope at the start of the search."""
    net = unusual()
    weights = 1 / (STEPS * greedy.trace("receiver")[1:])

    def slope(gains, name):
        change = np.random.default_rng(0).normal(size=gains[name].shape) * 1e-4
        ends = [recompute(net, gains | {name: gains[name] + sign * change}).covariance["receiver"] for sign in (1, -1)]
        return abs(weights @ np.trace(ends[0][1:] - ends[1][1:], axis1=1, axis2=2)) / 2e-4

    start = max(slope(greedy.gains, name) for name in net.filters)
    assert max(slope(free.gains, name) for name in net.filters) < 1e-2 * start
