import numpy as np
import pytest

from heliograph.filters.linear.scheduled_gains import ScheduledFilter
from heliograph.relays.design import local_error_design
from heliograph.relays.receiver import receiver_behind_relays
from tests.oracles import successive_relays as oracle
from tests.relays.relay_problems import example, network_of, relative, unusual


def best_from_all_measurements(p, gains):
    """Error covariance of x_k given z_1 .. z_k at once, from joint moments grown step by step with the oracle."""
    n, m = p.Gam.shape[1], p.Psi.shape[1]
    start = np.tile(p.xbar0, 3)
    second = np.outer(start, start)
    second[:n, :n] += p.P0
    mean, result = start, []
    for k in range(1, len(p.Gam) + 1):
        i, j = oracle.turns(k)
        size, covariances = len(second), oracle.noise_covariances(p, k)
        total = size + sum(map(len, covariances))
        unit = np.eye(total)
        noise = np.split(unit[:, size:], np.cumsum([len(c) for c in covariances])[:-1], axis=1)
        gain = np.zeros((k + 1, n, m))
        gain[k] = gains[f"relay_{i + 1}"][k - 1]

        def matrix(gamma, k=k, j=j, unit=unit, noise=noise, gain=gain, size=size):
            rows = np.tile(gamma, (len(unit), 1))
            state = unit[:, :n], unit[:, n : 2 * n], unit[:, 2 * n : 3 * n], np.zeros((len(unit), n))
            moved = oracle.step(p, gain, 0 * gain, k, state, tuple(noise), rows)
            z = rows[:, [3 + j]] * (state[1 + j] @ p.Psi[k].T) + noise[3]
            return np.hstack([*moved[:3], unit[:, 3 * n : size], z]).T

        known = matrix(p.mean[k])
        changes = [matrix(p.mean[k] + e) - known for e in np.eye(5)]
        full = np.zeros((total, total))
        full[:size, :size], place = second, size
        for c in covariances:
            full[place : place + len(c), place : place + len(c)] = c
            place += len(c)
        second = known @ full @ known.T + sum(v * d @ full @ d.T for v, d in zip(p.var[k], changes, strict=True))
        mean = known[:, :size] @ mean
        spread = second - np.outer(mean, mean)
        x, z = slice(0, n), slice(3 * n, None)
        result.append(spread[x, x] - spread[x, z] @ np.linalg.solve(spread[z, z], spread[z, x]))
    return np.array(result)


def test_it_is_the_best_linear_function_of_everything_received():
    p = oracle.random_problem(2, horizon=6)
    net = network_of(p)
    gains = local_error_design(net, 6).gains
    result = receiver_behind_relays(net, gains).gains.covariance
    assert relative(result, best_from_all_measurements(p, gains)) < 1e-9  # of the batch solve


def test_it_is_at_least_as_good_as_the_greedy_receiver():
    for net, horizon in ((example(), 100), (unusual(), 9)):
        design = local_error_design(net, horizon)
        best = np.trace(receiver_behind_relays(net, design.gains).gains.covariance, axis1=1, axis2=2)
        assert np.all(best <= design.trace("receiver")[1:] * (1 + 1e-9))
        assert best[-1] < 0.999 * design.trace("receiver")[-1]


def test_bad_gains_are_refused():
    with pytest.raises(ValueError, match=r"relay gains: expected those of .* none for \['relay_2'\]"):
        receiver_behind_relays(example(), {"relay_1": np.zeros((4, 3, 1))})
    with pytest.raises(ValueError, match="gains of 'relay_2': expected shape"):
        receiver_behind_relays(example(), {"relay_1": np.zeros((4, 3, 1)), "relay_2": np.zeros((4, 3, 2))})


def test_it_runs_as_a_filter():
    schedule = receiver_behind_relays(example(), local_error_design(example(), 3).gains)
    filter_ = ScheduledFilter(schedule)
    _, estimate = filter_.step(filter_.init(), [0.5], (), 0)
    assert estimate.mean.shape == (3,) and estimate.claim == "exact"
