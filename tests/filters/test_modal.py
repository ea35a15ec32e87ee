"""The best linear filter behind links that remember, against all paths of the modes, limits, and simulation."""

from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as hg
from heliograph.random_affine.second_moments import nominal_spread
from tests.oracles import links_with_memory as oracle

Series, Stack, Mixture, Modes = (getattr(hg.random_affine, n) for n in ("Series", "Stack", "Mixture", "Modes"))
EXACT = dict(rtol=1e-11, atol=1e-13)  # sums of a few hundred products

STEPS = 4
A = np.array([[0.9, 0.3], [-0.2, 0.8]])
SHIFT = np.array([0.3, -0.1])
Q, P0, X0 = np.array([[0.2, 0.05], [0.05, 0.3]]), np.array([[1.0, 0.2], [0.2, 0.5]]), np.array([1.0, -0.5])
C, R, V = np.array([[1.0, 0.5]]), np.array([[0.1]]), np.array([0.2])
INPUT = np.array([[0.5], [0.2]])
U = np.array([[1.0], [-0.5], [0.0], [2.0]])
PLANTS = [
    hg.LinearPlant((1 + 0.1 * k) * A, hg.Gaussian((1 + k) * Q, SHIFT), X0, P0, input_matrix=INPUT) for k in range(STEPS)
]
SENSORS = [hg.LinearSensor((1 - 0.2 * k) * C, hg.Gaussian(R, V)) for k in range(STEPS)]
MEASURES = [np.block([[s.matrix, V[:, None]], [np.zeros((1, 2)), np.ones((1, 1))]]) for s in SENSORS]
SECOND = oracle.plant_moments(
    [p.matrix for p in PLANTS], [SHIFT + INPUT @ u for u in U], [p.noise.covariance for p in PLANTS], X0, P0
)

CHAIN_A = [np.array([[0.8, 0.2], [0.4, 0.6]]), np.array([[0.5, 0.5], [0.1, 0.9]]), np.array([[0.9, 0.1], [0.3, 0.7]])]
CHAIN_B = np.array([[0.7, 0.2, 0.1], [0.1, 0.6, 0.3], [0.25, 0.25, 0.5]])
LAW_A, LAW_B = np.array([0.9, 0.1]), np.array([0.2, 0.5, 0.3])  # not stationary
GOOD = hg.hop(hg.Discrete([0.7, 1.1], [0.4, 0.6]), hg.Gaussian([[0.2]], [0.1]))
BAD = hg.hop(hg.Rayleigh(0.2), 0.5)
THREE = [hg.hop(g, 0.1) for g in (0.3, -0.6, 1.2)]
RELAY = hg.hop(hg.Nakagami(2.0), 0.15, amplification=1.4)


def chain_a(k, name=None):
    return hg.random_affine.MarkovChain(CHAIN_A[min(k, 2)], LAW_A, name)


def errors(item, horizon=STEPS):
    """Covariances of the filter's errors, which no data change."""
    state, found = item.init(), []
    for k in range(horizon):
        state = item.predict(state, U[k] if item.inputs else (), k)
        state, _ = item.correct(state, np.ones(item.received), k)
        found.append(item.estimate(state).covariance)
    return np.array(found)


def expected(initial, transitions, maps):
    """maps[k][i]: the channel in mode i at step k, made without any memory."""
    means = [[np.asarray(m.moments(1).mean[:-1]) for m in row] for row in maps]
    spreads = [[nominal_spread(m).center for m in row] for row in maps]
    return oracle.by_all_paths(
        SECOND,
        MEASURES,
        [s.noise.covariance for s in SENSORS],
        initial,
        transitions,
        means,
        spreads,
    )


def filtered(channel):
    return errors(hg.linear_filter(hg.model.over_time(PLANTS), hg.model.over_time(SENSORS), channel))


def constant(maps):
    return [maps] * STEPS


A_AND_B = list(product(range(2), range(3)))
BOTH_LAWS, BOTH_CHAINS = np.kron(LAW_A, LAW_B), [np.kron(a, CHAIN_B) for a in CHAIN_A]


def one_chain(k, name=None):
    return Modes(chain_a(k, name), [GOOD, BAD])


def other(name=None):
    return Modes(hg.random_affine.MarkovChain(CHAIN_B, LAW_B, name), THREE)


CASES = {  # channel at step k; law, transitions and the same channel in each mode, written out
    "a chain that varies": (one_chain, LAW_A, CHAIN_A, [GOOD, BAD]),
    "two hops, chains of their own": (
        lambda k: hg.amplify_and_forward([one_chain(k), RELAY, other()]), BOTH_LAWS, BOTH_CHAINS,
        [Series([[GOOD, BAD][i], RELAY, THREE[j]]) for i, j in A_AND_B],
    ),
    "two hops in one shadow": (
        lambda k: hg.amplify_and_forward([one_chain(k, "a"), Modes(chain_a(k, "a"), [RELAY, BAD])]), LAW_A, CHAIN_A,
        [Series([GOOD, RELAY]), Series([BAD, BAD])],
    ),
    "a direct link in the shadow of the first hop": (
        lambda k: hg.with_direct_link(
            hg.amplify_and_forward([one_chain(k, "a"), other("b")]), Modes(chain_a(k, "a"), [BAD, GOOD])
        ),
        BOTH_LAWS, BOTH_CHAINS,
        [Stack([Series([[GOOD, BAD][i], THREE[j]]), [BAD, GOOD][i]]) for i, j in A_AND_B],
    ),
    "a loss that is not told": (
        lambda k: hg.dropout(hg.with_direct_link(one_chain(k), RELAY), 0.7), LAW_A, CHAIN_A,
        [hg.dropout(Stack([m, RELAY]), 0.7) for m in (GOOD, BAD)],
    ),
    "a choice between two shadows": (
        lambda k: Mixture([one_chain(k), other()], [0.3, 0.7]), BOTH_LAWS, BOTH_CHAINS,
        [Mixture([[GOOD, BAD][i], THREE[j]], [0.3, 0.7]) for i, j in A_AND_B],
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_it_is_the_best_over_all_paths(name):
    at_step, law, transitions, maps = CASES[name]
    channel = hg.model.over_time([at_step(k) for k in range(STEPS)])
    np.testing.assert_allclose(filtered(channel), expected(law, transitions, constant(maps)), **EXACT)


def test_maps_may_vary_while_the_chain_does_not():
    chain = hg.random_affine.MarkovChain(CHAIN_B, LAW_B)
    maps = [[hg.hop((1 + k) * g, 0.1 + 0.1 * k) for g in (0.3, -0.6, 1.2)] for k in range(STEPS)]
    found = filtered(hg.model.over_time([Modes(chain, row) for row in maps]))
    np.testing.assert_allclose(found, expected(LAW_B, [CHAIN_B] * 3, maps), **EXACT)


def drifts(correlations, steps, points):
    """All paths of drifting gains on a grid of what drives them: weight, c of shape (steps, gains).

    Exact to degree 2 `points` - 1 in each drawn number: second moments have degree 2 for each hop that is driven by it.
    """
    nodes, weights = np.polynomial.hermite_e.hermegauss(points)
    weights = weights / weights.sum()
    rho = np.asarray(correlations)
    for choice in product(range(points), repeat=steps * len(rho)):
        e = nodes[np.array(choice)].reshape(steps, len(rho))
        c = [e[0]]
        for row in e[1:]:
            c.append(rho * c[-1] + np.sqrt(1 - rho**2) * row)
        yield float(np.prod(weights[np.array(choice)])), np.array(c)


DRIFTING = {  # gains' correlations, channel, the channel for c
    "one hop": ([0.9], lambda f: f(0), lambda g, c: g(c[0])),
    "two hops and a direct link": (
        [0.9, 0.5],
        lambda f: hg.with_direct_link(hg.amplify_and_forward([f(0), f(1)]), RELAY),
        lambda g, c: Stack([Series([g(c[0]), g(c[1])]), RELAY]),
    ),
    "three hops": (
        [0.9, 0.5, 0.7],
        lambda f: hg.amplify_and_forward([f(0), f(1), f(2)]),
        lambda g, c: Series([g(c[0]), g(c[1]), g(c[2])]),
    ),
    "two hops that drift together": (
        [0.8],
        lambda f: hg.amplify_and_forward([f(0), RELAY, f(0)]),
        lambda g, c: Series([g(c[0]), RELAY, g(c[0])]),
    ),
}


@pytest.mark.parametrize("name", DRIFTING)
def test_drifting_gains_need_no_grid(name):
    """Their covariance is that over all paths of c, though the filter knows but one or two functions of it."""
    correlations, build, at_c = DRIFTING[name]
    steps, total = 3 if len(correlations) == 1 else 2, None
    for weight, c in drifts(correlations, steps, 3 if name == "two hops that drift together" else 2):
        maps = [at_c(lambda value: hg.hop(1.1 + 0.4 * value, 0.2), row) for row in c]
        parts = oracle.path_moments(
            SECOND[:steps, :steps],
            MEASURES,
            [s.noise.covariance for s in SENSORS],
            [np.asarray(m.moments(1).mean[:-1]) for m in maps],
            [nominal_spread(m).center for m in maps],
        )
        total = (
            [weight * p for p in parts]
            if total is None
            else [t + weight * p for t, p in zip(total, parts, strict=True)]
        )
    channel = build(lambda i: hg.autoregressive_fading(1.1, 0.4, correlations[i], 0.2, name=f"drift {i}"))
    found = errors(hg.linear_filter(hg.model.over_time(PLANTS), hg.model.over_time(SENSORS), channel), steps)
    np.testing.assert_allclose(found, oracle.best_linear(SECOND[:steps, :steps], *total), **EXACT)


PLANT = hg.LinearPlant([[0.98]], [[0.04]], [0.0], [[0.04 / (1 - 0.98**2)]])
SENSOR = hg.LinearSensor([[1.0]], 0.05)
BURSTS = np.array([[0.95, 0.05], [0.03, 0.97]])


def bursts(transition=BURSTS):
    return hg.markov_fading([0.2, 1.0], transition, 0.05)


def variances(plant, sensor, channel, steps):
    item = hg.linear_filter(plant, sensor, channel)
    assert item.claim == "exact"
    return np.diagonal(item.planned(np.zeros((steps, 0))).covariances[2::2], axis1=1, axis2=2)


def test_fading_in_bursts():
    """P_1, P_2, P_10, P_inf to the digits given."""
    found = variances(PLANT, SENSOR, bursts(), 400)[[0, 1, 9, -1], 0]
    np.testing.assert_allclose(found, [0.323796, 0.283304, 0.248939, 0.238689], atol=6e-7)


@pytest.mark.parametrize(("shared", "limit"), [(True, 0.227110), (False, 0.148447)])
def test_two_sensors_in_one_shadow_or_in_two(shared, limit):
    two = hg.LinearSensor([[1.0], [1.0]], 0.05 * np.eye(2))
    chain = hg.random_affine.MarkovChain(BURSTS)
    links = hg.parallel([bursts(chain if shared else BURSTS) for _ in range(2)])
    assert variances(PLANT, two, links, 400)[-1, 0] == pytest.approx(limit, abs=6e-7)


def test_two_drifting_hops():
    plant = hg.LinearPlant([[0.98, 0.1], [0, 0.95]], np.diag([0.002, 0.02]), [1.0, 0.0], np.diag([1.0, 0.2]))
    first, second = (hg.autoregressive_fading(m, s, r, 0.05) for m, s, r in ((1.0, 0.4, 0.95), (0.8, 0.3, 0.9)))
    found = variances(plant, hg.LinearSensor([[1.0, 0.0]], 0.05), hg.amplify_and_forward([first, second]), 100)
    known = [[0.444130, 0.200298], [0.393069, 0.199766], [0.293346, 0.179459], [0.299861, 0.158136]]
    np.testing.assert_allclose(found[[0, 1, 9, 99]], known, atol=6e-7)


LIMITS = {  # a channel that remembers, and the same without memory or in other words
    "equal rows": (
        hg.markov_fading([0.2, 1.0], [[0.4, 0.6], [0.4, 0.6]], 0.05),
        hg.hop(hg.Discrete([0.2, 1.0], [0.4, 0.6]), 0.05),
    ),
    "one mode": (hg.markov_fading([hg.hop(hg.Rayleigh(1.0), 0.1)], [[1.0]]), hg.hop(hg.Rayleigh(1.0), 0.1)),
    "equal maps": (hg.markov_fading([RELAY, RELAY], BURSTS), RELAY),
    "no correlation": (
        hg.autoregressive_fading(1.0, 0.4, 0.0, 0.1),
        hg.hop(hg.random_affine.GivenMoments([1, 1.16]), 0.1),
    ),
    "modes in another order": (bursts(), hg.markov_fading([1.0, 0.2], np.array(BURSTS)[::-1, ::-1], 0.05)),
    "a chain with the mean, deviation and correlation of a drift": (
        bursts(),
        hg.autoregressive_fading(0.7, 0.8 * np.sqrt(0.375 * 0.625), 0.92, 0.05),
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", LIMITS)
def test_limits(name):
    one, other = (variances(PLANT, SENSOR, channel, 60) for channel in LIMITS[name])
    np.testing.assert_allclose(one, other, rtol=1e-12)


def test_a_gain_that_never_changes_but_is_unknown():
    """Pi = I against the two known gains weighed, by all paths (there are two)."""
    channel = Modes(hg.random_affine.MarkovChain(np.eye(2), [0.3, 0.7]), [GOOD, BAD])
    np.testing.assert_allclose(filtered(channel), expected([0.3, 0.7], [np.eye(2)] * 3, constant([GOOD, BAD])), **EXACT)


def test_estimates_do_not_depend_on_the_order_of_modes_and_hold_in_simulation():
    """The claimed variance lies within four standard errors of the measured one at each of the last steps."""
    channel = hg.gilbert_elliott(hg.hop(1.0, 0.05), hg.hop(0.2, 0.05), 0.03, 0.05)
    filters = {"exact": hg.linear_filter(PLANT, SENSOR, channel), "turned": hg.linear_filter(PLANT, SENSOR, bursts())}
    record = hg.monte_carlo(hg.Network(PLANT, {"node": hg.Node(SENSOR, channel, filters)}), 40, 4000, 3)
    errors = {f: record.errors("node", f)[..., 0] for f in filters}
    np.testing.assert_allclose(errors["exact"], errors["turned"], atol=1e-10)
    squares = errors["exact"][:, 30:] ** 2
    claimed = record.estimates["node"]["exact"].covariance[0, 30:, 0, 0]
    assert np.all(np.abs(squares.mean(axis=0) - claimed) < 4 * squares.std(axis=0) / np.sqrt(4000))


def test_what_does_not_arrive_is_left_out():
    item = hg.linear_filter(PLANT, SENSOR, bursts())
    state = item.predict(item.init())
    after, heard = item.correct(state, [np.nan])
    np.testing.assert_allclose(after.mean, state.mean, atol=0)
    np.testing.assert_allclose(after.covariance, state.covariance, rtol=1e-15)
    assert heard.log_likelihood == 0


@pytest.mark.parametrize("radius", [0.0, 0.01])
def test_a_mean_far_from_zero_costs_no_digits(radius):
    """Where modes differ in their noise alone, a mean of 1e8 deviations moves all estimates and no covariance."""
    chain = hg.random_affine.MarkovChain(BURSTS, radius=radius)
    channel = hg.markov_fading([hg.hop(0.7, noise) for noise in (0.05, 0.5)], chain)
    z, found = np.random.default_rng(1).normal(size=(8, 1)), []
    for far in (0.0, 1e8):
        plant = hg.LinearPlant(np.eye(2), 0.1 * np.eye(2), [far, 0.0], np.eye(2))
        item = hg.linear_filter(plant, hg.LinearSensor([[1.0, 0.5]], 0.05), channel)
        network = hg.Network(plant, {"node": hg.Node(item.sensor, channel, {"one": item})})
        data = {"node": np.where(np.arange(8)[:, None] == 3, np.nan, z + 0.7 * far)}
        record = hg.run(network, data, smooth=hg.smoothing.FixedInterval())
        each = record.estimates["node"]["one"], record.smoothed.estimates["node"]["one"]
        means, claimed = [one.mean - [far, 0.0] for one in each], [one.covariance for one in each]
        found.append((means, claimed, item.planned(np.zeros((8, 0))).covariances))
    np.testing.assert_allclose(found[1][0], found[0][0], atol=1e-6)  # of 1e8, with rounding of 1e-8 a step
    np.testing.assert_allclose(found[1][1], found[0][1], rtol=1e-12)
    np.testing.assert_allclose(found[1][2], found[0][2], rtol=1e-12)


def test_it_keeps_the_contract_of_filters():
    two = hg.LinearSensor([[1.0], [1.0]], 0.05 * np.eye(2))
    hg.testing.check_filter(hg.linear_filter(PLANT, two, hg.parallel([bursts(), bursts()])))


def test_the_likelihood_has_a_gradient_in_what_the_links_remember():
    """Against central differences of relative error 1e-7."""
    z = np.random.default_rng(0).normal(size=(10, 1))

    def likelihood(p):
        link = hg.gilbert_elliott(hg.hop(p[2], 0.05), hg.hop(0.2, 0.05), p[0], p[1])
        channel = hg.amplify_and_forward([link, hg.autoregressive_fading(1.0, p[3], p[4], 0.05)])
        return hg.log_likelihood(hg.linear_filter(PLANT, SENSOR, channel), z)

    at, steps = np.array([0.05, 0.1, 1.0, 0.3, 0.8]), 1e-5 * np.eye(5)
    with jax.enable_x64(True):
        slopes = jax.jit(jax.grad(likelihood))(jnp.asarray(at))
    expected = [(likelihood(at + d) - likelihood(at - d)) / 2e-5 for d in steps]
    np.testing.assert_allclose(slopes, expected, rtol=1e-6, atol=1e-6)
