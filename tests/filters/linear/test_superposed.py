"""Filters behind links that add up: known numbers, and claims that are exact, by enumeration."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as hg
from heliograph.numerics.float64 import in_float64
from heliograph.random_affine.noises.noise import FiniteSupport
from heliograph.simulation.description.doubts import doubts_before_data

STEADY = 0.1 / (1 - 0.95**2)
PLANT = hg.LinearPlant([[0.95]], [[0.1]], [0.0], [[STEADY]])

# Steady variance of x+ = 0.95 x + w of M sensors of noise 0.05 behind Rayleigh gains of scale 0.8, noise 0.1, by the
# number of transmitters: added up and on channels of their own, with amplitude 1 each.
ADDED = {1: 0.156073, 2: 0.095735, 4: 0.057353, 16: 0.018426, 64: 0.005133, 256: 0.001327}
APART = {1: 0.156073, 2: 0.103221, 4: 0.065302, 16: 0.022524, 64: 0.006502, 256: 0.001703}
ONE_SIGNAL = {4: 0.079619, 16: 0.049181, 64: 0.039728}  # relays of one measurement, amplitude M^(-1/2) each


@in_float64
def steady_variance(sensor, channel, steps=200):
    made = hg.linear_filter(PLANT, sensor, channel)
    assert made.claim == "exact"

    def step(state, _):
        state, _ = made.correct(made.predict(state), jnp.zeros(1))
        return state, made.estimate(state).covariance[0, 0]

    return jax.lax.scan(step, made.init(), None, length=steps)[1][-1]


def added(count, amplitude=1.0, same=False):
    hops = [hg.hop(hg.Rayleigh(0.8), 0.0, amplification=amplitude) for _ in range(count)]
    return hg.superposed(hops, 0.1, same)


def sensors(count):
    return hg.LinearSensor(np.ones((count, 1)), 0.05 * np.eye(count))


@pytest.mark.parametrize("count", [1, 2, 16, pytest.param(4, marks=pytest.mark.slow), *(
    pytest.param(m, marks=pytest.mark.slow) for m in (64, 256))])  # fmt: skip
def test_added_up_signals_of_full_power_have_known_errors(count):
    """To six digits behind the point, as the numbers are known."""
    assert steady_variance(sensors(count), added(count)) == pytest.approx(ADDED[count], abs=5.1e-7)


@pytest.mark.parametrize("count", [2, pytest.param(64, marks=pytest.mark.slow)])
def test_added_up_at_a_total_power_are_channels_of_that_power_each(count):
    assert steady_variance(sensors(count), added(count, count**-0.5)) == pytest.approx(APART[count], abs=5.1e-7)


@pytest.mark.parametrize(
    "count", [4, pytest.param(16, marks=pytest.mark.slow), pytest.param(64, marks=pytest.mark.slow)]
)
def test_relays_of_one_measurement_stop_at_its_noise(count):
    sensor = hg.LinearSensor([[1.0]], [[0.05]])
    assert steady_variance(sensor, added(count, count**-0.5, same=True)) == pytest.approx(ONE_SIGNAL[count], abs=5.1e-7)


def draw_law(generator):
    values, weights = generator.normal(size=2), generator.dirichlet([2.0, 2.0])
    return hg.Discrete(values, weights), list(zip(weights, values, strict=True))


def draw_link(generator):
    """A hop, two hops or a hop that may be lost, and its atoms (probability, gain, noise variance)."""
    (law, gains), noise = draw_law(generator), generator.uniform(0.0, 0.3)
    atoms = [(p, g, noise) for p, g in gains]
    kind = generator.integers(3)
    if kind == 0:
        return hg.hop(law, noise), atoms
    if kind == 1:
        return hg.dropout(hg.hop(law, noise), 0.7), [(0.7 * p, g, r) for p, g, r in atoms] + [(0.3, 0.0, 0.0)]
    (second, factors), more = draw_law(generator), generator.uniform(0.0, 0.3)
    two = hg.amplify_and_forward([hg.hop(law, noise), hg.hop(second, more)])
    return two, [(p * q, g * f, f**2 * r + more) for p, g, r in atoms for q, f in factors]


def check_claim(seed):
    """The covariance of the linear filter is the least error of linear estimates, from the moments of all that comes.

    E[z_k z_l] of all steps by enumeration of the gains, then one projection.
    """
    generator = np.random.default_rng(seed)
    n, count, same, steps = 2, int(generator.integers(1, 4)), bool(generator.integers(2)), 3
    move, start = 0.6 * generator.normal(size=(n, n)), np.diag(generator.uniform(0.5, 2.0, n))
    root = generator.normal(size=(n, n))
    rows = 1 if same else count
    c, noise = generator.normal(size=(rows, n)), np.diag(generator.uniform(0.05, 0.5, rows))
    mean = generator.normal(size=n)
    drawn = [draw_link(generator) for _ in range(count)]
    channel = hg.superposed([link for link, _ in drawn], 0.1, same)
    # Second moments of the states of all steps.
    moment = [start + np.outer(mean, mean)]
    for _ in range(steps):
        moment.append(move @ moment[-1] @ move.T + root @ root.T)
    power = np.linalg.matrix_power

    def between(k, i):
        return power(move, k - i) @ moment[i] if k >= i else (power(move, i - k) @ moment[k]).T

    gain, square = np.zeros((1, rows)), np.zeros((rows, rows))
    variance = 0.1
    for atoms in itertools.product(*(cases for _, cases in drawn)):
        p = np.prod([q for q, _, _ in atoms])
        row = np.array([g for _, g, _ in atoms])
        row = np.array([row.sum()]) if same else row
        gain, square = gain + p * row, square + p * np.outer(row, row)
        variance += p * sum(r for _, _, r in atoms)
    # Projection of x on (1, z_1, ..., z_steps).
    gram, cross = np.eye(steps + 1), np.zeros((n, steps + 1))
    means = [power(move, k) @ mean for k in range(steps + 1)]
    for k in range(1, steps + 1):
        gram[0, k] = gram[k, 0] = (gain @ c @ means[k]).item()
        cross[:, k] = between(steps, k) @ c.T @ gain[0]
        for i in range(1, steps + 1):
            gram[k, i] = (gain @ c @ between(k, i) @ c.T @ gain.T).item()
        gram[k, k] = np.trace(square @ (c @ moment[k] @ c.T + noise)) + variance
    cross[:, 0] = means[steps]
    expected = moment[steps] - cross @ np.linalg.solve(gram, cross.T)
    made = hg.linear_filter(hg.LinearPlant(move, root @ root.T, mean, start), hg.LinearSensor(c, noise), channel)
    assert made.claim == "exact"
    with jax.enable_x64(True):
        state = made.init()
        for _ in range(steps):
            state, _ = made.correct(made.predict(state), jnp.zeros(1))
        np.testing.assert_allclose(made.estimate(state).covariance, expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("seed", range(2))
def test_the_claim_is_exact_on_random_networks(seed):
    check_claim(seed)


@pytest.mark.slow
def test_the_claim_is_exact_on_a_hundred_random_networks():
    for seed in range(100, 200):
        check_claim(seed)


def test_a_filter_of_degree_two_hears_a_sum_of_links_by_the_links():
    """Its lifted system is that of the joint sensor, though its moments are those of links of x."""
    coin = FiniteSupport([[1.2], [-0.4]], [0.25, 0.75])
    plant = hg.LinearPlant([[0.8]], coin, [0.3], [[1.0]])
    noise = hg.random_affine.Independent([coin, hg.Gaussian([[0.1]])])
    channel = hg.superposed([hg.hop(hg.Discrete([0.5, 1.5], [0.4, 0.6]), 0.1), hg.hop(hg.Rayleigh(0.7), 0.0)], 0.05)
    sensor = hg.LinearSensor([[1.0], [0.5]], noise)
    seen = hg.linear.lifted_system(plant, sensor, channel, 2, 4).steps
    joint = hg.linear.lifted_system(plant, sensor, channel.as_stack, 2, 4).steps
    for mine, other in zip(seen, joint, strict=True):
        np.testing.assert_allclose(mine, other, rtol=1e-10, atol=1e-12)


def test_what_no_linear_filter_hears_is_said():
    """Mean gains that cancel; one link of mean zero among others."""

    def words(*gains):
        links = [hg.hop(hg.Discrete([g - 0.5, g + 0.5], [0.5, 0.5]), 0.0) for g in gains]
        channel = hg.superposed(links, 0.1)
        network = hg.Network(PLANT, {"a": hg.Node(sensors(len(links)), channel, {})})
        return [(doubt.serious, doubt.words) for doubt in doubts_before_data(network) if "unheard" in doubt.words]

    [(serious, said)] = words(1.0, -1.0)
    assert serious
    assert "'a' has mean gain 0" in said
    [(serious, said)] = words(1.0, 0.0, 2.0)
    assert not serious
    assert "link2 at 'a'" in said
    assert not words(1.0, 2.0)


COIN = FiniteSupport([[1.2], [-0.4]], [0.25, 0.75])


def small(arrival=0.8, radius=0.0, late=0):
    """Two sensors of one state: a gain of two values, perhaps late, and a link that may be lost unseen."""
    first = hg.hop(hg.Discrete([0.5, 1.5], [0.4, 0.6]), 0.1)
    first = hg.model.delayed(first, late) if late else first
    return hg.superposed([first, hg.dropout(hg.hop(hg.Rayleigh(0.7), 0.0), arrival, radius=radius)], 0.05)


def test_a_filter_of_degree_three_hears_a_sum_of_links_by_the_links():
    """Its lifted system is that of the stack, moments of order 6 included."""
    plant = hg.LinearPlant([[0.8]], COIN, [0.3], [[1.0]])
    sensor = hg.LinearSensor([[1.0], [0.5]], hg.random_affine.Independent([COIN, hg.Gaussian([[0.1]])]))
    seen = hg.linear.lifted_system(plant, sensor, small(), 3, 2).steps
    joint = hg.linear.lifted_system(plant, sensor, small().as_stack, 3, 2).steps
    for mine, other in zip(seen, joint, strict=True):
        np.testing.assert_allclose(mine, other, rtol=1e-9, atol=1e-11)


@pytest.mark.parametrize("arrival", [0.7, 0.9])
def test_the_claim_behind_a_sum_of_uncertain_links_is_a_bound(arrival):
    """For both ends of the probability that a link's signal arrives; known laws of it are within 1/4."""
    made = hg.linear_filter(PLANT, sensors(2), small(radius=0.1))
    assert made.claim == "upper"
    error = hg.filters.true_error(made, PLANT, sensors(2), small(arrival), horizon=8)
    assert np.all(error.true <= error.claimed * (1 + 1e-9))


def test_links_of_a_sum_may_be_late():
    """The claim is the error of what the filter does, and that behind the stack of the same links."""
    made, stacked = (hg.linear_filter(PLANT, sensors(2), c) for c in (small(late=1), small(late=1).as_stack))
    assert made.claim == "exact"
    error, other = (hg.filters.true_error(f, PLANT, sensors(2), small(late=1), horizon=6) for f in (made, stacked))
    np.testing.assert_allclose(error.true, error.claimed, rtol=1e-9)
    np.testing.assert_allclose(error.claimed, other.claimed, rtol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("arrival", [1.0, 0.7])
def test_filters_of_every_kind_claim_the_error_that_they_have_behind_a_sum(arrival):
    """Mean squared errors of 4,000 runs within five of their own standard deviations of the mean covariance.

    Also where the whole sum is lost, of which the receiver knows; a filter of degree three needs all that is sent.
    """
    sensor, channel = sensors(2), small()
    filters = {"linear": hg.linear_filter, "cubature": hg.cubature_filter, "extended": hg.extended_filter}
    made = {name: build(PLANT, sensor, channel) for name, build in filters.items()}
    if arrival == 1:
        made["degree 3"] = hg.polynomial_filter(PLANT, sensor, channel, horizon=8, degree=3)
    received = channel if arrival == 1 else hg.erasure(channel, arrival)
    record = hg.monte_carlo(hg.Network(PLANT, {"a": hg.Node(sensor, received, made)}), horizon=8, runs=4000, key=1)
    for estimate in record.estimates["a"].values():
        squares = (record.truth - estimate.mean)[:, -1, 0] ** 2 - np.asarray(estimate.covariance)[:, -1, 0, 0]
        assert abs(squares.mean()) < 5 * squares.std() / np.sqrt(len(squares))


@pytest.mark.slow
@pytest.mark.parametrize(("count", "expected"), [(2, (0.02329, 0.02183)), (16, (0.003792, 0.003213))])
def test_told_gains_of_little_noise_are_worth_more_on_channels_of_their_own(count, expected):
    """Amplitudes of a sum are set before the gains are known: mean claims, of a receiver that is told every gain.

    Noise 0.001 each; 1,000 runs of 40 steps give four standard errors of 0.3 %, and the start is forgotten in ten.
    """
    hops = [hg.hop(hg.Rayleigh(0.8), noise, known=True) for noise in (0.0, 0.001) for _ in range(count)]
    channels = hg.superposed(hops[:count], 0.001), hg.parallel(hops[count:])
    for channel, known in zip(channels, expected, strict=True):
        filter = hg.linear_filter(PLANT, sensors(count), channel)
        assert filter.claim == "exact"
        network = hg.Network(PLANT, {"receiver": hg.Node(sensors(count), channel, {"told": filter})})
        told = hg.monte_carlo(network, 50, 1000, key=1, keep=hg.Statistics())["receiver"]["told"]
        claimed = np.trace(told.claimed(), axis1=-2, axis2=-1)[10:]
        assert np.mean(claimed) == pytest.approx(known, rel=0.003)
