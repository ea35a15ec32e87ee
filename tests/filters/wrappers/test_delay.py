"""Links that are late: stamped, not stamped and taken as current, against the moments of all that was sent."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import heliograph as hg
from heliograph.testing import check_filter
from tests.as_code import printing
from tests.oracles import delays as oracle

A, C, R, N = np.array([[1.0, 1.0], [0.0, 0.95]]), np.array([[1.0, 0.0]]), np.array([[0.3]]), np.array([[0.05]])
Q, START, SPREAD = 0.05 * np.array([[1 / 3, 1 / 2], [1 / 2, 1.0]]), [1.0, 0.5], np.diag([1.0, 0.2])
PLANT, SENSOR = hg.LinearPlant(A, Q, START, SPREAD), hg.LinearSensor(C, R)
WEIGHTS, STEPS = np.array([0.4, 0.35, 0.25]), 30
LAW = hg.Discrete([0, 1, 2], WEIGHTS)
LINK = hg.hop(1.0, N)
UNKNOWN, KNOWN, FIXED = (
    hg.hop(1.0, N, delay=LAW),
    hg.model.delayed(LINK, LAW, timestamped=True),
    hg.hop(1.0, N, delay=2),
)
PARTS = oracle.signals(A, Q, C, R, START, SPREAD, STEPS)
delayed, true_error = hg.model.delayed, hg.filters.true_error


def independent(weights):
    """P(d_k, d_l) of delays drawn anew at each step."""
    return lambda k, j: np.diag(weights) if k == j else np.outer(weights, weights)


def in_chain(initial, rows):
    """P(d_k, d_l) of a chain."""

    def pair(k, j):
        if k > j:
            return pair(j, k).T
        law = initial @ np.linalg.matrix_power(rows, k - 1)
        return law[:, None] * np.linalg.matrix_power(rows, j - k)

    return pair


@pytest.fixture(scope="module")
def filters():
    """One of each kind."""
    chosen = {"uninformed": UNKNOWN, "informed": KNOWN, "fixed": FIXED}
    results = {name: hg.linear_filter(PLANT, SENSOR, channel) for name, channel in chosen.items()}
    return results | {"as_current": hg.filters.as_current_filter(PLANT, SENSOR, UNKNOWN)}


def test_unknown_the_claim_is_the_error_and_the_usual_mistake_claims_a_fifth(filters):
    received = oracle.of_unknown(PARTS, independent(WEIGHTS), 1.0, 1.0, N)
    result = true_error(filters["uninformed"], PLANT, SENSOR, UNKNOWN, STEPS)
    best = np.array([oracle.best_linear(PARTS, received, k) for k in range(1, STEPS + 1)])
    np.testing.assert_allclose(result.claimed, best, rtol=1e-11, atol=1e-11 * np.abs(best).max())
    np.testing.assert_allclose(result.true, best, rtol=1e-9, atol=1e-11 * np.abs(best).max())
    assert result.true[-1, 0, 0] == pytest.approx(0.649, abs=5e-4)
    wrong = true_error(filters["as_current"], PLANT, SENSOR, UNKNOWN, STEPS)
    weights, offset, claimed = oracle.kalman(A, Q, C, R + N, START, SPREAD, STEPS)
    np.testing.assert_allclose(wrong.claimed[-1], claimed, rtol=1e-11)
    np.testing.assert_allclose(wrong.true[-1], oracle.error_of(PARTS, received, weights, offset, STEPS), rtol=1e-10)
    assert wrong.claimed[-1, 0, 0] == pytest.approx(0.199, abs=5e-4)
    assert wrong.true[-1, 0, 0] == pytest.approx(0.896, abs=5e-4)
    assert [filters[name].claim for name in ("uninformed", "informed", "fixed")] == ["exact"] * 3
    assert filters["as_current"].claim == "nominal"


def test_past_states_in_place_of_past_signals_claim_too_little():
    """One y received twice has one sensor noise: with x_{k-d} as states it would count as two."""
    moved = np.block([[A, np.zeros((2, 4))], [np.eye(4), np.zeros((4, 2))]])
    noise, spread = np.zeros((6, 6)), np.zeros((6, 6))
    noise[:2, :2], spread[:2, :2] = Q, SPREAD
    plant = hg.LinearPlant(moved, noise, [*START, *np.zeros(4)], spread)
    choice = [hg.random_affine.known(np.eye(1, 3, d)) for d in range(3)]
    trap = hg.amplify_and_forward([hg.random_affine.Mixture(choice, WEIGHTS), LINK])
    three = hg.LinearSensor(np.kron(np.eye(3), C), 0.3 * np.eye(3))
    claimed = hg.linear_filter(plant, three, trap).planned(np.zeros((STEPS, 0))).covariances[-1, 0, 0]
    assert claimed == pytest.approx(0.598, abs=2e-3)


@eqx.filter_jit
def claimed(a, c, r, q, weights, gains, noise):
    """Covariances of the filter for a plant and a link of these numbers, over 8 steps."""
    plant, sensor = hg.LinearPlant(a, q, START, SPREAD), hg.LinearSensor(c, r)
    link = hg.amplify_and_forward(
        [hg.hop(1.0, noise, delay=hg.Discrete([0, 1, 3], weights)), hg.hop(hg.Discrete(gains, [0.5, 0.5]), noise)]
    )
    return jnp.asarray(hg.linear_filter(plant, sensor, link).planned(jnp.zeros((8, 0))).covariances)


numbers = st.floats(-1.0, 1.0)


@settings(max_examples=25, deadline=None)
@given(st.lists(numbers, min_size=4, max_size=4), st.lists(numbers, min_size=2, max_size=2), st.integers(0, 2**32 - 1))
def test_unknown_the_claim_is_the_best_linear_error_of_any_problem(a, c, seed):
    """Two hops, the first late by 0, 1 or 3 steps: z = g (y + m) + n, so that g m + n is noise of N (E g^2 + 1)."""
    generator = np.random.default_rng(seed)
    a, c, r, q = (
        np.reshape(a, (2, 2)),
        np.reshape(c, (1, 2)),
        [[generator.uniform(0.01, 1)]],
        np.diag(generator.random(2)),
    )
    weights, gains, noise = generator.dirichlet(np.ones(3)), generator.normal(size=2), generator.uniform(0.01, 1)
    drawn = {"a": a, "c": c, "r": np.array(r), "q": q, "weights": weights, "gains": gains, "noise": noise}
    with printing(**drawn):
        check_that_it_is_the_best(**drawn)


def check_that_it_is_the_best(a, c, r, q, weights, gains, noise):
    with jax.enable_x64(True):
        result = np.asarray(claimed(a, c, r, q, weights, gains, np.array([[noise]])))[2::2]
    law = np.insert(weights, 2, 0.0)
    parts, second = oracle.signals(a, q, c, r, START, SPREAD, 8), np.mean(gains**2)
    received = oracle.of_unknown(parts, independent(law), np.mean(gains), second, noise * (second + 1))
    best = np.array([oracle.best_linear(parts, received, k) for k in range(1, 9)])
    np.testing.assert_allclose(result, best, rtol=1e-10, atol=1e-11 * np.abs(best).max())


def test_delays_that_are_a_chain():
    rows, initial = np.array([[0.8, 0.2, 0.0], [0.1, 0.7, 0.2], [0.0, 0.3, 0.7]]), np.array([0.5, 0.3, 0.2])
    channel = hg.hop(hg.Discrete([0.5, 1.0], [0.5, 0.5]), N, delay=hg.random_affine.MarkovChain(rows, initial))
    result = true_error(hg.linear_filter(PLANT, SENSOR, channel), PLANT, SENSOR, channel, 10)
    received = oracle.of_unknown(PARTS, in_chain(initial, rows), 0.75, 0.625, N)
    best = np.array([oracle.best_linear(PARTS, received, k) for k in range(1, 11)])
    np.testing.assert_allclose(result.claimed, best, rtol=1e-10, atol=1e-11 * np.abs(best).max())
    np.testing.assert_allclose(result.true, best, rtol=1e-9, atol=1e-11 * np.abs(best).max())


@pytest.mark.parametrize("seed", [0, 1])
def test_known_the_claim_is_the_best_linear_error_given_the_delays(filters, seed):
    """Values received twice, out of order, lost, and too late to be of any step."""
    generator = np.random.default_rng(seed)
    delays = generator.choice(3, p=WEIGHTS, size=12)
    parts, state = oracle.signals(A, Q, C, R, START, SPREAD, 12), filters["informed"].init()
    received = oracle.of_known(parts, delays, 1.0, 1.0, N)
    for k, d in enumerate(delays):
        state, estimate = filters["informed"].step(state, [generator.normal(), float(d)], k=k)
        best = oracle.best_linear(parts, received, k + 1)
        np.testing.assert_allclose(estimate.covariance, best, rtol=1e-10, atol=1e-11 * np.abs(best).max())
    unknown = filters["informed"].correct(state, [0.3, np.nan], k=12)[0]
    np.testing.assert_array_equal(unknown.gaussian.mean, state.gaussian.mean)


def test_a_constant_delay_is_predicted_over(filters):
    """Against the filter of all that was sent, which has the same through gaps; with an input, and its innovation."""
    plant = hg.LinearPlant(A, Q, START, SPREAD, input_matrix=[[0.0], [1.0]])
    late = hg.linear_filter(plant, SENSOR, FIXED)
    larger = hg.filters.part_filter(hg.linear_filter(*hg.model.with_past(plant, SENSOR, FIXED)), 2)
    generator = np.random.default_rng(0)
    z, u = generator.normal(size=(12, 1)), generator.normal(size=(12, 1))
    z[[4, 7, 8]] = np.nan
    both = [item.init() for item in (late, larger)]
    for k in range(12):
        pairs = [item.step(state, z[k], u[k], k) for item, state in zip((late, larger), both, strict=True)]
        both = [state for state, _ in pairs]
        (single, other) = (estimate for _, estimate in pairs)
        np.testing.assert_allclose(single.mean, other.mean, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(single.covariance, other.covariance, rtol=1e-12, atol=1e-13)


def test_a_delay_of_no_step_is_none():
    item = hg.linear_filter(PLANT, SENSOR, hg.perfect())
    stream, late = hg.Stream(item), hg.Stream(hg.filters.late_filter(item, 0))
    for z in (0.1, np.nan, 0.4):
        expected, result = stream.push([z]), late.push([z])
        np.testing.assert_allclose(result.mean, expected.mean, rtol=1e-14)
        np.testing.assert_allclose(result.covariance, expected.covariance, rtol=1e-14)


def test_what_could_not_yet_arrive_is_no_silence():
    """Before the first message that a link can deliver, the law of x is that before any data."""
    plant, sensor = hg.LinearPlant([[0.95]], [[0.1]], [0.0], [[1.0]]), hg.LinearSensor([[1.0]], [[0.01]])
    item = hg.filters.late_filter(hg.event_filter(plant, sensor, hg.perfect(), hg.SendOnDelta([0.5])), 3)
    assert item.silence_tells
    state, variance = item.init(), 1.0
    for k in range(3):
        state, estimate = item.step(state, [np.nan], (), k)
        variance = 0.95**2 * variance + 0.1
        np.testing.assert_allclose(estimate.covariance, [[variance]], rtol=1e-12)
    _, estimate = item.step(state, [np.nan], (), 3)
    assert estimate.covariance[0, 0] < 0.95**2 * variance + 0.1, "what could arrive and did not is silence"


LATE = [0.5, 0.3, 0.2]  # a relay's own delay
RELAYS = [
    hg.hop(hg.Discrete([0.6, 1.2], [0.5, 0.5]), N, delay=hg.Discrete([0, 1], [0.7, 0.3])),
    hg.hop(hg.Discrete([0.8, 1.1], [0.4, 0.6]), 2 * N, delay=hg.Discrete([0, 1, 2], LATE)),
    hg.hop(1.0, N, delay=1),
]


@pytest.fixture(scope="module")
def simulated(filters):
    """A network of all of them and of late relays, and its record."""
    relayed = hg.amplify_and_forward(RELAYS)
    nodes = {
        "uninformed": hg.Node(SENSOR, UNKNOWN, {name: filters[name] for name in ("uninformed", "as_current")}),
        "informed": hg.Node(SENSOR, KNOWN, {"informed": filters["informed"]}),
        "fixed": hg.Node(SENSOR, FIXED, {}),
        "relayed": hg.Node(SENSOR, relayed, {"exact": hg.linear_filter(PLANT, SENSOR, relayed)}),
    }
    network = hg.Network(PLANT, nodes)
    return network, hg.monte_carlo(network, STEPS, 1024, key=0)


def test_simulated_errors_are_as_known_before(simulated):
    _, record = simulated
    errors = {(n, f): record.errors(n, f)[:, -1, 0] ** 2 for n, estimate in record.estimates.items() for f in estimate}
    known = {("uninformed", "uninformed"): 0.649, ("uninformed", "as_current"): 0.896, ("informed", "informed"): 0.460}
    for name, expected in known.items():
        assert abs(errors[name].mean() - expected) < 3 * errors[name].std() / 32
    published = record.estimates["informed"]["informed"].covariance[:, -1, 0, 0]
    assert abs(published.mean() - 0.460) < 3 * published.std() / 32


@pytest.mark.slow
def test_relays_that_are_late_by_chance(simulated):
    """What a relay forwards twice has one noise: the relay's signal stands in the oracle as the sensor's does."""
    (network, record), generator = simulated, np.random.default_rng(0)
    item = network.nodes["relayed"].filters["exact"]
    relay = oracle.of_unknown(PARTS, independent([0.7, 0.3]), 0.9, 0.9, N)
    stage = (PARTS[0], relay[0], PARTS[2], *relay[1:])
    gains = np.array([0.98, 0.4 * 0.64 + 0.6 * 1.21])
    received = oracle.of_unknown(stage, independent([0.0, *LATE]), *gains, 2 * N + N)
    best = np.array([oracle.best_linear(PARTS, received, k) for k in range(1, 13)])
    result = np.asarray(item.planned(np.zeros((12, 0))).covariances)[2::2]
    np.testing.assert_allclose(result, best, rtol=1e-10, atol=1e-11 * np.abs(best).max())
    assert hg.filters.as_current_filter(PLANT, SENSOR, network.nodes["relayed"].channel).claim == "nominal"
    squares = record.errors("relayed", "exact")[:, 11] ** 2
    assert np.all(np.abs(squares.mean(axis=0) - np.diag(best[-1])) < 3 * squares.std(axis=0) / 32)
    state = item.init()
    for k in range(4):  # not planned, with a gap
        state, estimate = item.step(state, [np.nan] if k == 2 else generator.normal(size=1), k=k)
    assert np.all(np.diag(estimate.covariance) > np.diag(best[3]))


@pytest.mark.slow
def test_a_record_as_events(simulated):
    """Each value under the step that it is of; a value that is received twice comes under one number twice."""
    network, record = simulated
    known = hg.Record(record.time, record.states, None, {n: record.measurements[n] for n in ("informed", "fixed")}, {})
    events = hg.simulation.arrivals(known, network, run=3)
    published, z = [event for event in events if event[0] == "informed"], record.measurements["informed"][3]
    assert [event[-1] for event in events] == sorted(event[-1] for event in events)
    assert [event[2] for event in published] == [k - d for k, d in enumerate(z[:, 1]) if k >= d]
    np.testing.assert_array_equal([event[3][0] for event in published], [v for k, (v, d) in enumerate(z) if k >= d])
    assert len({event[1] for event in published}) < len(published)
    assert [(event[1], event[-1]) for event in events if event[0] == "fixed"] == [(k, k + 2.0) for k in range(28)]
    with pytest.raises(ValueError, match="delays of node 'uninformed'"):
        hg.simulation.arrivals(record, network)


@pytest.mark.parametrize("name", ["informed", "fixed"])
def test_the_contract(filters, name):
    check_filter(filters[name])


REFUSED = {
    "one without delays": lambda: hg.cubature_filter(PLANT, SENSOR, UNKNOWN),
    "a LinearPlant": lambda: hg.linear_filter(hg.Plant(lambda x, u: x, Q, START, SPREAD), SENSOR, UNKNOWN),
    "one that forgets": lambda: hg.linear_filter(
        PLANT, SENSOR, delayed(hg.gilbert_elliott(LINK, LINK, 0.1, 0.2), LAW, timestamped=True)
    ),
    "at most the filter's 2": lambda: hg.filters.part_filter(hg.linear_filter(PLANT, SENSOR, LINK), 3),
    "delay: expected a whole number": lambda: hg.filters.late_filter(hg.linear_filter(PLANT, SENSOR, LINK), -1),
    "depends on no data": lambda: true_error(hg.linear_filter(PLANT, SENSOR, KNOWN), PLANT, SENSOR, KNOWN, 3),
}


@pytest.mark.parametrize("expected", REFUSED)
def test_refusals(expected):
    with pytest.raises(ValueError, match=expected.replace("depends", "depend")):
        REFUSED[expected]()


def test_a_link_of_the_last_two_signals():
    """Their mean, through a hop: the linear filter knows it exactly, and the diagram says what it is."""
    channel = hg.random_affine.DelayLine(hg.random_affine.Series([hg.random_affine.known([[0.5, 0.5]]), LINK]), 1)
    item = hg.linear_filter(PLANT, SENSOR, channel)
    network = hg.Network(PLANT, {"node": hg.Node(SENSOR, channel, {"linear": item})})
    found = hg.monte_carlo(network, horizon=20, runs=1024, key=3, keep=hg.Statistics())["node"]["linear"]
    _, low, high = found.nees_per_dimension()
    assert found.claim == "exact" and low < 1 < high and channel.in_words().endswith("of the last 2 signals")
    with pytest.raises(ValueError, match="link: expected inputs of 3 signals of one length, got 2"):
        hg.random_affine.DelayLine(hg.random_affine.known([[0.5, 0.5]]), 2)


def test_a_robust_filter_behind_a_delay_tells_what_it_weighed_down():
    """As it does of the same values in time, two rows before."""
    robust = hg.robust_filter(PLANT, SENSOR, LINK, hg.filters.Gate())
    z = np.full((12, 1), 0.3)
    z[6] = 40.0
    at_once, late = robust.run(z), hg.filters.late_filter(robust, 2).run(np.vstack([np.full((2, 1), np.nan), z]))
    assert at_once.weights[6] < 1e-3 and np.isnan(late.weights[:2]).all()
    np.testing.assert_allclose(late.weights[2:], at_once.weights, rtol=1e-12)
