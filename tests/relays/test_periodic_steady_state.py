"""The steady state, against the recursion run long enough and against the figures found by other means."""

import equinox as eqx
import numpy as np
import pytest

from heliograph.filters.linear.linear import linear_filter
from heliograph.model.channel import hop
from heliograph.model.over_time import over_time
from heliograph.model.plant import LinearPlant
from heliograph.model.relays import RelayNetwork
from heliograph.model.sensor import LinearSensor
from heliograph.random_affine.laws.fading import Rayleigh
from heliograph.relays.bfgs import bfgs
from heliograph.relays.design import given_design, local_error_design, relay_schedules
from heliograph.relays.periodic_steady_state import (
    periodic_behind_relays,
    periodic_given_design,
    periodic_local_error_design,
    periodic_receiver_error_design,
    periodic_relays_for_best_receiver,
)
from heliograph.relays.receiver import receiver_behind_relays
from tests.relays.relay_problems import example, relative

PAPER = 1.066244e-5  # steady sum of even and odd tr P, by the oracle's 4000 steps


@pytest.fixture(scope="module")
def local():
    return periodic_local_error_design(example())


def traces(covariance):
    return np.trace(covariance, axis1=1, axis2=2)


@pytest.mark.slow
def test_the_steady_state_is_where_the_recursion_stays(local):
    odd, even = local.trace("receiver")[1:]
    assert (even, odd) == pytest.approx((5.307279e-6, 5.355157e-6), rel=1e-6)  # digits given
    long = local_error_design(example(), 1500)  # the plant forgets by 0.98 a step
    assert relative(local.moments[1:], long.moments[-2:]) < 1e-9
    given = periodic_given_design(example(), local.gains)
    assert relative(given.moments, local.moments) < 1e-9  # of a linear solve: condition about 1e3


@pytest.mark.slow
def test_tuned_together_at_no_more_power(local):
    """The reproduction's tests have the designs without a limit."""
    quiet = periodic_receiver_error_design(example(), power_limit=local.total_power())
    assert np.all(quiet.total_power() <= local.total_power() * (1 + 1e-6))
    assert np.sum(quiet.trace("receiver")[1:]) < 1.054e-5  # found: 1.05271e-5, against 1.06624e-5
    gains = {name: np.tile(gain, (1000, 1, 1)) for name, gain in quiet.gains.items()}
    assert relative(given_design(example(), gains).moments[-2:], quiet.moments[1:]) < 1e-6  # what 0.974 a period leaves


@pytest.mark.slow
def test_the_best_receiver_behind_given_relays(local):
    behind = periodic_behind_relays(example(), local.gains)
    assert np.sum(traces(behind)) == pytest.approx(1.05316e-5, rel=1e-5)  # digits given
    long = receiver_behind_relays(example(), {f: np.tile(g, (1000, 1, 1)) for f, g in local.gains.items()})
    assert relative(long.gains.covariance[-2:], behind) < 1e-9


def test_without_relays_it_is_the_linear_filter():
    full = example()
    direct = full.slots[1]["relay_1"]["sensor"]
    net = RelayNetwork(full.plant, full.sensor, (), ({"receiver": {"sensor": direct}},))
    steady = periodic_local_error_design(net).covariance["receiver"][-1]
    filter_ = linear_filter(full.plant, full.sensor, direct)
    state = filter_.init()
    for k in range(800):
        state, estimate = filter_.step(state, np.zeros(1), (), k)
    assert relative(steady, estimate.covariance) < 1e-8
    assert np.trace(steady) == pytest.approx(1.0790e-6, rel=1e-4)


def taking_turns(noise=0.3):
    """A relay that listens in one slot and transmits in the next, in which alone the receiver receives."""
    plant, sensor = LinearPlant([[0.8]], noise, [2.0], 1.0), LinearSensor([[1.0]], 0.1)
    first, second = hop(Rayleigh(0.9), 0.05), hop(Rayleigh(0.7), 0.05)
    return RelayNetwork(plant, sensor, ("relay",), ({"relay": {"sensor": first}}, {"receiver": {"relay": second}}))


@pytest.mark.slow
def test_a_receiver_that_receives_nothing_in_some_slot():
    net = taking_turns()
    design = periodic_local_error_design(net)
    behind = periodic_behind_relays(net, design.gains)
    times = {name: np.tile(gain, (60, 1, 1)) for name, gain in design.gains.items()}
    long = receiver_behind_relays(net, times).gains.covariance[-2:]
    np.testing.assert_allclose(behind, long, rtol=1e-11)  # the rounding of a linear solve
    # Behind one relay the receiver's own best next error is that of the best linear receiver.
    np.testing.assert_allclose(behind, design.covariance["receiver"][1:], rtol=1e-11)
    # Limits hold for slots in which relays send; 0 in the first, in which none does, forbids nothing.
    limit = 1.2 * design.total_power()
    loud = periodic_receiver_error_design(net, power_limit=limit)
    assert limit[0] == 0 < limit[1]
    assert np.sum(loud.trace("receiver")[1:]) < 0.993 * np.sum(design.trace("receiver")[1:])  # measured: .9915
    np.testing.assert_allclose(loud.total_power(), limit, rtol=3e-5)  # the search aims 1e-5 below


def test_a_plant_without_noise_comes_to_rest():
    design = periodic_local_error_design(taking_turns(noise=0.0))
    assert all(np.all(covariance == 0) for covariance in design.covariance.values())


def test_relays_that_receive_only_each_other_learn_nothing():
    """Their innovations are zero, computed from large numbers: what rounding leaves of them is no information."""
    plant = LinearPlant([[0.5, 0.4], [-0.3, 0.6]], [[0.3, 0.1], [0.1, 0.2]], np.zeros(2), np.eye(2))
    sensor, free = LinearSensor([[1.0, 0.3], [-0.2, 1.0]], 0.1 * np.eye(2)), np.zeros((2, 2))
    both = {"a": {"b": hop(Rayleigh(0.9), free)}, "b": {"a": hop(0.7, free)}}
    slots = (both | {"receiver": {"sensor": hop(1.0, 0.1 * np.eye(2))}}, {"a": {"a": hop(0.6, free)}})
    design = periodic_local_error_design(RelayNetwork(plant, sensor, ("a", "b"), slots))
    deaf = RelayNetwork(plant, sensor, (), ({"receiver": {"sensor": hop(0.0, np.eye(2))}},))
    still = periodic_local_error_design(deaf)
    assert all(np.all(design.gains[name] == 0) for name in ("a", "b"))
    for name in ("a", "b"):
        np.testing.assert_allclose(design.covariance[name][-1], still.covariance["receiver"][-1], rtol=1e-11)


def test_a_periodic_design_is_no_schedule_from_the_start(local):
    """Its covariances are those after long, not those of the first period."""
    net = example()
    with pytest.raises(ValueError, match=r"the network's start on, got a periodic one \(use given_design"):
        relay_schedules(net, local)
    other = RelayNetwork(eqx.tree_at(lambda p: p.initial_covariance, net.plant, 4 * np.eye(3)), net.sensor, net.relays,
                         net.slots)  # fmt: skip
    with pytest.raises(ValueError, match="the network's start on, got one from another start"):
        relay_schedules(other, local_error_design(net, 3))
    repeated = {name: np.tile(gain, (2, 1, 1)) for name, gain in local.gains.items()}
    assert {s.horizon for s in relay_schedules(net, given_design(net, repeated)).values()} == {4}


@pytest.mark.slow
def test_what_has_no_steady_state_is_refused(local):
    net = example()
    unstable = LinearPlant(1.1 * np.eye(3), np.eye(3), np.zeros(3), np.eye(3))
    with pytest.raises(ValueError, match="spectral radius below 1"):
        periodic_local_error_design(RelayNetwork(unstable, net.sensor, net.relays, net.slots))
    varying = RelayNetwork(over_time([net.plant] * 4), net.sensor, net.relays, net.slots)
    with pytest.raises(ValueError, match="varies with its slots only"):
        periodic_local_error_design(varying)
    loud = {name: 30 * gain for name, gain in local.gains.items()}
    with pytest.raises(ValueError, match="second moments that converge, got growth by"):
        periodic_given_design(net, loud)
    with pytest.raises(ValueError, match="some under which they diverge"):
        periodic_receiver_error_design(net, start=loud)
    with pytest.raises(ValueError, match="one for each of the 2 slots"):
        periodic_given_design(net, {name: np.tile(gain, (2, 1, 1)) for name, gain in local.gains.items()})
    alone = RelayNetwork(net.plant, net.sensor, (), ({"receiver": {"sensor": hop(1.0, 1e-6)}},))
    with pytest.raises(ValueError, match="no relays"):
        periodic_relays_for_best_receiver(alone)


def test_descent_finds_the_bottom_of_a_curved_valley_next_to_a_cliff():
    def rosenbrock(x):
        if x[0] > 1.5:
            return np.inf, np.zeros(2)
        a, b = 1 - x[0], x[1] - x[0] ** 2
        return a**2 + 100 * b**2, np.array([-2 * a - 400 * x[0] * b, 200 * b])

    result = bfgs(rosenbrock, np.array([-1.2, 1.0]))
    np.testing.assert_allclose(result, [1.0, 1.0], atol=1e-6)  # of a value flat to 1e-12
