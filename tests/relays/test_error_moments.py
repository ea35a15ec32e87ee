"""The general recursion against the printed lemmas (corrected), a second route, and the limits that are known."""

import numpy as np
import pytest

from heliograph.model.relays import RelayNetwork
from heliograph.relays.design import given_design, local_error_design, relay_schedules
from heliograph_studies.successive_relays.raw_moments import recompute
from tests.oracles import successive_relays as oracle
from tests.relays.relay_problems import example, gains_of, network_of, relative, unusual

TOLERANCE = 1e-10  # relative; sums of few terms lose 1e-14

PROBLEMS = {
    "example": lambda: oracle.section_iv(100),
    "random, n = 3, m = 2": lambda: oracle.random_problem(0, horizon=20),
    "random, n = 4, m = 3": lambda: oracle.random_problem(1, horizon=12, n=4, m=3),
}


def blocks(design, n):
    m = design.moments
    return m.reshape(len(m), 4, n, 4, n).swapaxes(2, 3)


def compare(p, design, solution):
    n, s = p.Gam.shape[1], solution
    m, mean = blocks(design, n), [p.xbar0]
    for a in p.Gam:
        mean.append(a @ mean[-1])
    outer = np.einsum("ki,kj->kij", mean, mean)  # the lemmas have E x x', the design its covariance
    pairs = [(m[:, 0, 0] + outer, s.Pi), (m[:, 1, 1], s.Xi[:, 0]), (m[:, 2, 2], s.Xi[:, 1]), (m[:, 1, 2], s.Xi_12),
             (m[:, 0, 1], s.Xi_x[:, 0]), (m[:, 0, 2], s.Xi_x[:, 1]), (m[:, 3, 1], s.P_i[:, 0]),
             (m[:, 3, 2], s.P_i[:, 1]), (m[:, 3, 3], s.P)]  # fmt: skip
    return max(relative(a, b) for a, b in pairs)


@pytest.mark.parametrize("name", PROBLEMS)
def test_lemmas_and_gains_agree_with_the_oracle(name):
    p = PROBLEMS[name]()
    solution = oracle.solve(p)
    design = local_error_design(network_of(p), len(p.Gam))
    assert compare(p, design, solution) < TOLERANCE
    expected = gains_of(solution.K, solution.L)
    for filter_, gain in design.gains.items():
        largest = np.abs(expected[filter_]).max()
        assert np.abs(gain - expected[filter_]).max() < TOLERANCE * largest


def test_any_gains_agree_with_the_oracle():
    p, rng = oracle.random_problem(2, horizon=20), np.random.default_rng(0)
    gains = rng.normal(size=(21, 3, 2)) * 0.3, rng.normal(size=(21, 3, 2)) * 0.3
    design = given_design(network_of(p), gains_of(*gains))
    assert compare(p, design, oracle.solve(p, gains)) < TOLERANCE


def test_slots_in_turn_are_the_same_as_listed_slots():
    listed = local_error_design(network_of(oracle.section_iv(20)), 20)
    assert relative(local_error_design(example(), 20).moments, listed.moments) < TOLERANCE


@pytest.mark.parametrize("scale", [0.0, 0.2])
def test_a_network_of_another_kind_agrees_with_raw_moments(scale):
    """Three relays, full duplex, self-interference, direct and dependent links, noise means; greedy or other gains."""
    net, rng = unusual(), np.random.default_rng(1)
    design = local_error_design(net, 9)
    gains = {name: gain + scale * rng.normal(size=gain.shape) for name, gain in design.gains.items()}
    design, result = given_design(net, gains), recompute(net, gains)
    for name in net.filters:
        assert relative(design.covariance[name], result.covariance[name]) < TOLERANCE
        largest = result.correlation[name].max()
        assert largest < 1e-10 if scale == 0.0 else largest > 1e-3


def test_gains_on_what_nobody_transmits_are_not_used():
    """With them a schedule would miss what never comes, and claim nothing."""
    net, random = example(), np.random.default_rng(0)
    gains = {
        name: random.normal(size=(4, len(net.states), size))
        for name, size in zip(net.filters, net.received, strict=True)
    }
    idle = {name: [not net.slots[k % 2].get(name) for k in range(4)] for name in net.filters}
    used = {name: np.where(np.array(idle[name])[:, None, None], 0.0, gain) for name, gain in gains.items()}
    schedules, without = (relay_schedules(net, given_design(net, g)) for g in (gains, used))
    assert any(np.any(gains[name] != used[name]) for name in gains)
    for name, schedule in schedules.items():
        for of_all, of_used in zip(schedule.gains, without[name].gains, strict=True):
            np.testing.assert_array_equal(of_all, of_used)


def test_the_next_trace_is_quadratic_about_the_gain():
    """tr P(K + D) - tr P(K) = tr D M D', M the innovation moment of the oracle, exactly."""
    p, rng = oracle.random_problem(1, horizon=10), np.random.default_rng(0)
    net, solution = network_of(p), oracle.solve(p)
    for k, name, moment in ((7, "relay_2", solution.M_K), (8, "relay_1", solution.M_K), (8, "receiver", solution.M_L)):
        gains = gains_of(solution.K, solution.L)
        before = given_design(net, gains).trace(name)[k]
        change = rng.normal(size=gains[name].shape[1:])
        gains[name] = gains[name].copy()
        gains[name][k - 1] += change
        after = given_design(net, gains).trace(name)[k]
        assert after - before == pytest.approx(np.trace(change @ moment[k] @ change.T), rel=1e-9)  # a difference


# The limits that are known.


def problem(**changes):
    p = oracle.random_problem(3, horizon=14)
    return p._replace(**{k: v(getattr(p, k).copy()) for k, v in changes.items()})


def zero(columns):
    def change(a):
        a[:, columns] = 0.0
        return a

    return change


def design_of(p):
    return local_error_design(network_of(p), len(p.Gam))


def open_loop(p):
    c = [p.P0]
    for a, s, w in zip(p.Gam, p.Sigma, p.W, strict=True):
        c.append(a @ c[-1] @ a.T + s @ w @ s.T)
    return np.array(c)


@pytest.mark.parametrize("fading", [True, False])
def test_without_interference_a_relay_is_a_kalman_filter_every_other_step(fading):
    p = problem(mean=zero([2]), var=zero([2] if fading else slice(None)))
    design, x = design_of(p), [p.P0, p.P0]
    state = p.P0 + np.outer(p.xbar0, p.xbar0)
    for k in range(1, len(p.Gam) + 1):
        i, _ = oracle.turns(k)
        a, c, q = p.Gam[k - 1], p.Psi[k], p.Sigma[k - 1] @ p.W[k - 1] @ p.Sigma[k - 1].T
        r = p.Theta[k] @ p.V[k] @ p.Theta[k].T
        state, x = a @ state @ a.T + q, [a @ e @ a.T + q for e in x]
        h, m, v = p.mean[k, i] * c, p.mean[k, i], p.var[k, i]
        noise = m**2 * r + v * (c @ state @ c.T + r) + p.G[k, i]
        x[i] = x[i] - x[i] @ h.T @ np.linalg.solve(h @ x[i] @ h.T + noise, h @ x[i])
        for f in (0, 1):
            assert relative(design.covariance[f"relay_{f + 1}"][k], x[f]) < TOLERANCE


def test_a_receiver_that_receives_only_noise_predicts():
    p = problem(mean=zero([3, 4]))
    design = design_of(p)
    assert np.abs(design.gains["receiver"]).max() == 0.0
    assert relative(design.covariance["receiver"], open_loop(p)) < TOLERANCE


def test_relays_that_hear_only_noise_predict():
    p = problem(mean=zero([0, 1, 2]))
    design = design_of(p)
    assert max(np.abs(gain).max() for gain in design.gains.values()) < TOLERANCE
    for name in ("relay_1", "relay_2", "receiver"):
        assert relative(design.covariance[name], open_loop(p)) < TOLERANCE


def test_the_first_receiver_gain_is_zero():
    assert np.abs(design_of(problem()).gains["receiver"][0]).max() < TOLERANCE


def test_without_fading_the_initial_mean_does_not_matter():
    p = problem(var=zero(slice(None)))
    a, b = design_of(p), design_of(p._replace(xbar0=7 * p.xbar0 + 1))
    assert relative(a.moments, b.moments) < TOLERANCE


def test_exchanging_relays_and_parity():
    p, names = problem(), {"relay_1": "relay_2", "relay_2": "relay_1", "receiver": "receiver", "sensor": "sensor"}
    net, design = network_of(p), design_of(p)
    slots = [
        {names[listener]: {names[s]: link for s, link in links.items()} for listener, links in slot.items()}
        for slot in net.slots
    ]
    exchanged = local_error_design(RelayNetwork(net.plant, net.sensor, net.relays, slots), len(p.Gam))
    for name in net.filters:
        assert relative(exchanged.covariance[names[name]], design.covariance[name]) < TOLERANCE


def test_orthogonal_coordinates():
    p = problem()
    t = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    turned = p._replace(Gam=t @ p.Gam @ t.T, Sigma=t @ p.Sigma, Psi=p.Psi @ t.T, xbar0=t @ p.xbar0, P0=t @ p.P0 @ t.T)
    a, b = design_of(turned).covariance["receiver"], design_of(p).covariance["receiver"]
    assert relative(a, t @ b @ t.T) < TOLERANCE


def test_all_moments_times_nine():
    p = problem()
    larger = p._replace(W=9 * p.W, V=9 * p.V, G=9 * p.G, O=9 * p.O, P0=9 * p.P0, xbar0=3 * p.xbar0)
    a, b = design_of(larger), design_of(p)
    assert relative(a.moments, 9 * b.moments) < TOLERANCE
    assert max(np.abs(a.gains[f] - b.gains[f]).max() for f in a.gains) < TOLERANCE


def test_a_receiver_that_copies_its_relay():
    """Psi = I, gamma_4 = gamma_5 = 1, L = Gam: P+ = Gam (X_j + O) Gam' + Q."""
    p = oracle.random_problem(4, horizon=10, n=2, m=2)
    mean, var = p.mean.copy(), p.var.copy()
    mean[:, 3:], var[:, 3:] = 1.0, 0.0
    p = p._replace(Psi=np.tile(np.eye(2), (11, 1, 1)), mean=mean, var=var)
    net = network_of(p)
    gains = local_error_design(net, 10).gains | {"receiver": p.Gam}
    design = given_design(net, gains)
    for k in range(1, 11):
        j = oracle.turns(k)[1]
        a, q = p.Gam[k - 1], p.Sigma[k - 1] @ p.W[k - 1] @ p.Sigma[k - 1].T
        expected = a @ (design.covariance[f"relay_{j + 1}"][k - 1] + p.O[k, j]) @ a.T + q
        assert relative(design.covariance["receiver"][k], expected) < TOLERANCE
