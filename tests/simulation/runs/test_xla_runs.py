"""Under XLA, what all runs share is computed once."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as hg
from heliograph.files.recordings.recording import read_recording
from heliograph.relays.design import local_error_design, relay_schedules
from heliograph.simulation.runs import simulate_trajectories
from tests.relays.relay_problems import example

STEPS = 7
ROWS = (np.arange(STEPS), np.zeros((STEPS, 0)))


def init(key):
    return jax.random.normal(key), jnp.zeros(()), jnp.ones(())


def step(carry, key, row):
    """A walk, a number of its own that no run changes, and one that a run changes from the second step on."""
    x, shared, later = carry
    noise = jax.random.normal(jax.random.fold_in(key, row[0]))
    after = x + noise, shared + 1.0, later * shared + 0 * later + x
    return after, {"walk": after[0], "shared": after[1], "later": after[2], "noise": noise}


def one_run(key):
    carry, stored = init(key), []
    for k in range(STEPS):
        carry, known = step(carry, key, (k, np.zeros(0)))
        stored.append(known)
    return {name: np.array([t[name] for t in stored]) for name in stored[0]}


def test_every_run_is_the_one_that_a_loop_makes():
    with jax.enable_x64(True):
        keys = jax.random.split(jax.random.key(3), 5)
        result = simulate_trajectories(init, step, keys, tuple(map(jnp.asarray, ROWS)))
        assert result["shared"].shape == (1, STEPS)
        assert all(result[name].shape == (5, STEPS) for name in ("walk", "later", "noise"))
        for run, key in enumerate(keys):
            for name, expected in one_run(key).items():
                got = result[name][0 if name == "shared" else run]
                np.testing.assert_allclose(got, expected, rtol=1e-13, atol=1e-14)


def world(plain):
    """Two nodes that receive everything and one that loses half of it."""
    plant = hg.LinearPlant([[0.9]], 0.1, [0.0], 1.0)
    nodes = {}
    for name, gain, channel in (("a", 1.0, plain), ("b", 0.3, plain), ("lost", 1.0, hg.erasure(plain, 0.5))):
        sensor = hg.LinearSensor([[gain]], 0.1)
        nodes[name] = hg.Node(sensor, channel, {"f": hg.linear_filter(plant, sensor, plain)})
    return hg.Network(plant, nodes)


def test_planned_filters_tell_what_they_would_without_a_plan():
    """Step by step without a plan; a channel that erases takes no plan."""
    network = world(hg.hop(hg.Rayleigh(1.0), 0.1))
    record = hg.monte_carlo(network, 6, 40, 4)
    with jax.enable_x64(True):
        for node in "ab":
            item, result = network.nodes[node].filters["f"], record.estimates[node]["f"]
            for run in (0, 39):
                state = item.init()
                for k, z in enumerate(record.measurements[node][run]):
                    state, estimate = item.step(state, z, (), k)
                    np.testing.assert_allclose(result.mean[run, k], estimate.mean, rtol=1e-12, atol=1e-13)
                    np.testing.assert_allclose(result.covariance[run, k], estimate.covariance, rtol=1e-12)
    assert np.isnan(record.measurements["lost"]).any() and record.failures() == []
    sums = hg.monte_carlo(network, 6, 40, 4, hg.Statistics())["b"]["f"]
    stored = hg.simulation.error_statistics(record, "b", "f")
    for name in ("outer", "covariance", "nees", "count"):
        np.testing.assert_allclose(getattr(sums, name), getattr(stored, name), rtol=1e-10, atol=1e-12)


def test_columns_of_what_relays_received_may_be_left_out():
    net = example()
    schedules = relay_schedules(net, local_error_design(net, 4))
    receivers = {"local": hg.filters.ScheduledFilter(schedules.pop("receiver"))}
    network = hg.Network.of_relays(net, schedules, receivers)
    z = np.linspace(0.1, 0.4, 4)
    columns = {"time": np.arange(4.0), "receiver.y0": z}
    assert list(read_recording(columns, network).measurements) == ["receiver"]
    both = read_recording(columns | {"relay_1.y0": z}, network)
    assert sorted(both.measurements) == ["receiver", "relay_1"]
    with pytest.warns(UserWarning, match=r"relay_1.*rows \(1, 3\).*the model excludes"):  # then it receives nothing
        record = hg.run(network, *both)
    assert sorted(record.estimates) == ["receiver", "relay_1"] and record.time[-1] == 3.0
    with pytest.raises(ValueError, match=r"one column 'receiver.y0'"):
        read_recording({"time": np.arange(4.0), "relay_1.y0": z}, network)


class Counted(hg.random_affine.AbstractNoise):
    """Poisson counts about their mean: loops that hold keys, in single precision."""

    rate: float

    @property
    def dimension(self):
        return 1

    @property
    def mean(self):
        return np.zeros(1)

    @property
    def covariance(self):
        return np.array([[self.rate]])

    def sample(self, key):
        return jax.random.poisson(key, self.rate, (1,)) - self.rate

    def moment(self, powers):
        return {1: 0.0, 2: self.rate, 3: self.rate}[powers[0]]


def test_a_noise_of_counts_is_simulated():
    plant = hg.LinearPlant([[0.9]], 0.1, [0.0], 1.0)
    sensor = hg.LinearSensor([[1.0]], Counted(4.0))
    node = hg.Node(sensor, hg.perfect(1), {"kalman": hg.kalman_filter(plant, sensor)})
    record = hg.monte_carlo(hg.Network(plant, {"a": node}), 20, 64, 0)
    received = record.measurements["a"][:, :, 0] - np.asarray(record.truth)[:, :, 0]
    np.testing.assert_allclose(received + 4.0, np.round(received + 4.0), atol=1e-12)  # whole numbers, to rounding
    assert abs(received.mean()) < 4 * 2 / np.sqrt(received.size)  # four standard errors, the deviation being 2
