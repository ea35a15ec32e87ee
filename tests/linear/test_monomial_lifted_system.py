"""The lift against the printed Lemma 4 (corrected), against all atoms, and in the limits that have a known answer."""

import time
from dataclasses import replace
from itertools import pairwise

import jax
import numpy as np
import pytest

import heliograph as hg
from heliograph.linear import lifted_system, lmmse
from tests.oracles import quadratic_bias as oracle
from tests.relay_bias import half, model, random_law, scalar_system, two_sensors

EXAMPLE = oracle.paper_example()
ONE_VALUE = oracle.Atoms(np.array([[1.3]]), np.array([1.0]))


def designed(system, degree, horizon=20):
    return hg.linear.lmmse(hg.linear.lifted_system(*model(system, horizon), degree, horizon)).gains.covariance


@pytest.mark.parametrize(("system", "horizon"), [(EXAMPLE, 10), (two_sensors(), 10)], ids=["example", "two sensors"])
def test_system_is_lemmas_3_and_4(system, horizon):
    ours = hg.linear.lifted_system(*model(system, horizon), 2, horizon)
    steps, means, seconds = oracle.lifted(system, horizon)
    (x, spread), (z, _) = half(len(system.F) + system.C.shape[1]), half(len(system.C))
    before = hg.linear.state_moments(ours)
    for k in range(horizon):
        plant, received, s = steps[k], steps[k + 1], ours.step(k)
        scale = np.abs(seconds[k + 1]).max()
        pairs = [
            (s.transition, plant.A[x] @ spread), (s.drift, plant.M[x]), (s.process, plant.R_W[np.ix_(x, x)]),
            (s.output, received.C_c[z] @ spread), (s.offset, received.N_c[z]), (s.noise, received.R_Vc[np.ix_(z, z)]),
            (before.mean[k + 1], means[k + 1][x]),
        ]  # fmt: skip
        for mine, printed in pairs:
            np.testing.assert_allclose(mine, printed, rtol=0, atol=1e-12 * max(scale, np.abs(printed).max()))


@pytest.mark.parametrize("system", [EXAMPLE, two_sensors()], ids=["example", "two sensors"])
def test_half_vectorised_filter_is_the_full_one_with_pseudo_inverse(system):
    n = len(system.F) + system.C.shape[1]
    expected = oracle.quadratic(system, 20, repaired=True)
    scale = np.abs(expected.true).max()
    np.testing.assert_allclose(designed(system, 2), expected.true[1:, :n, :n], rtol=0, atol=1e-12 * scale)
    linear = oracle.linear(system, 20).true[1:, :n, :n]
    np.testing.assert_allclose(designed(system, 1), linear, rtol=0, atol=1e-12 * scale)


def test_noise_covariances_have_the_rank_they_can():
    """Half-vectorised R_V and P are positive definite where the full ones never are; R_W lacks what B lacks."""
    system = two_sensors()
    s = hg.linear.lifted_system(*model(system, 5), 2, 5).step(4)
    assert np.linalg.matrix_rank(s.noise, 1e-10 * np.abs(s.noise).max()) == 5
    assert np.linalg.matrix_rank(oracle.lifted(system, 5)[0][5].R_Vc, 1e-10) == 5  # of 6
    example = hg.linear.lifted_system(*model(EXAMPLE, 5), 2, 5).step(4)
    assert (
        np.linalg.matrix_rank(example.process, 1e-10) == 12
    )  # of 14: B is 2 x 1, so k + k (k + 1) / 2 = 2 are missing


def test_error_is_that_of_regression_on_all_paths():
    """Every path of two steps, then least squares of the state on 1, z_1, z_1^2, z_2, z_2^2."""
    s = scalar_system()
    x, p = oracle.independent(s.x0, s.eps0)
    features = np.ones((len(p), 1))
    received = oracle.independent(s.l, s.m, s.v, s.varpi, s.sigma)
    for t in range(2):
        a, b, w = oracle.augmented(s, t)
        pairs = np.array(
            [(i, j, k) for i in range(len(p)) for j in range(len(w.chance)) for k in range(len(received.chance))]
        )
        i, j, k = pairs.T
        x, p = x[i] @ a.T + w.points[j] @ b.T, p[i] * w.chance[j] * received.chance[k]
        power, relay, v, varpi, sigma = received.points[k].T
        y = x[:, 0] * s.C[0, 0] + s.D[0, 0] * v
        z = s.theta * np.sqrt(relay) * (np.sqrt(power) * y + varpi) + sigma
        features = np.column_stack([features[i], z, z**2])
    root = np.sqrt(p)[:, None]
    for columns, degree in (([0, 1, 2, 3, 4], 2), ([0, 1, 3], 1)):
        used = features[:, columns]
        weights = np.linalg.lstsq(root * used, root * x, rcond=None)[0]
        residual = x - used @ weights
        np.testing.assert_allclose(designed(s, degree, 2)[1], (residual.T * p) @ residual, rtol=0, atol=1e-13)
    assert p.sum() == pytest.approx(1.0, abs=1e-12)


def symmetric(size):
    return oracle.Atoms(np.array([[-2 * size], [0.0], [2 * size]]), np.array([0.1, 0.8, 0.1]))


def test_no_third_moments_no_gain_from_squares_but_from_cubes():
    s = replace(
        EXAMPLE, eps0=oracle.independent(symmetric(1.0), symmetric(0.5)), v=symmetric(1.0), varpi=symmetric(0.7),
        xi=oracle.independent(symmetric(0.8), symmetric(0.4)), sigma=symmetric(0.5),
    )  # fmt: skip
    linear, quadratic, cubic = (designed(s, d) for d in (1, 2, 3))
    np.testing.assert_allclose(quadratic, linear, rtol=0, atol=1e-14)
    assert cubic[-1, 0, 0] < 0.95 * linear[-1, 0, 0]


def test_without_coupling_the_bias_does_not_matter():
    alone = replace(EXAMPLE, E=lambda t: np.zeros((2, 2)))
    horizon = 20
    s = model(alone, horizon)
    shaped = hg.random_affine.Shaped(EXAMPLE.B, hg.random_affine.FiniteSupport(*EXAMPLE.w))
    plants = [
        hg.LinearPlant(EXAMPLE.A(t), shaped, np.zeros(2), hg.random_affine.FiniteSupport(*EXAMPLE.x0))
        for t in range(horizon)
    ]
    sensor = hg.LinearSensor(EXAMPLE.C, s.sensor.noise)
    by_itself = hg.linear.lmmse(
        hg.linear.lifted_system(hg.model.over_time(plants), sensor, s.channel, 2, horizon)
    ).gains.covariance
    np.testing.assert_allclose(designed(alone, 2)[:, :2, :2], by_itself, rtol=0, atol=1e-14)


def test_a_sensor_that_sees_nothing_leaves_the_open_loop():
    system = hg.linear.lifted_system(*model(replace(EXAMPLE, C=np.zeros((1, 2))), 20), 2, 20)
    spread = hg.linear.state_moments(system).covariance[1:]
    expected = system.projection @ spread @ system.projection.T
    np.testing.assert_allclose(hg.linear.lmmse(system).gains.covariance, expected, rtol=0, atol=1e-14)


@pytest.mark.parametrize("mix", [3.7 * np.eye(2), np.diag([3.0, -0.2]), np.eye(2)[::-1], [[1.0, 0.4], [-0.3, 2.0]]])
def test_any_invertible_mix_of_the_measurements_gives_the_same_filter(mix):
    s = model(two_sensors(), 10)
    mixed = hg.random_affine.Series([s.channel, hg.random_affine.known(mix)])
    expected = hg.linear.lmmse(hg.linear.lifted_system(*s, 2, 10)).gains.covariance
    result = hg.linear.lmmse(hg.linear.lifted_system(s.plant, s.sensor, mixed, 2, 10)).gains.covariance
    np.testing.assert_allclose(result, expected, rtol=0, atol=1e-11 * np.abs(expected).max())


def test_the_sign_of_all_sources_does_not_matter():
    s = two_sensors()
    names = ("x0", "eps0", "w", "xi", "v", "varpi", "sigma")
    flipped = replace(s, **{n: oracle.Atoms(-getattr(s, n).points, getattr(s, n).chance) for n in names})
    expected = designed(s, 2, 10)
    np.testing.assert_allclose(designed(flipped, 2, 10), expected, rtol=0, atol=1e-12 * np.abs(expected).max())


def test_higher_degrees_are_never_worse():
    by_degree = [designed(two_sensors(), d, 10) for d in (1, 2, 3)]
    for low, high in pairwise(by_degree):
        assert np.linalg.eigvalsh(low - high).min() >= -1e-10 * np.abs(low).max()
    assert by_degree[2][-1, 0, 0] < 0.999 * by_degree[0][-1, 0, 0]


def test_a_mean_in_everything_moves_nothing_but_the_offsets():
    """Noises and start with means: the error covariance of known gains is that of the centred system."""
    s = replace(scalar_system(), l=ONE_VALUE, m=ONE_VALUE)
    moved = replace(s, **{n: oracle.Atoms(getattr(s, n).points + 0.7, getattr(s, n).chance)
                          for n in ("x0", "eps0", "w", "xi", "v", "varpi", "sigma")})  # fmt: skip
    np.testing.assert_allclose(designed(moved, 2, 10), designed(s, 2, 10), rtol=1e-10)


def test_a_large_lift_is_refused_with_the_number_and_what_to_do():
    plant = hg.LinearPlant(0.5 * np.eye(16), 1.0, np.zeros(16), 1.0)
    sensor = hg.LinearSensor(np.ones((1, 16)), 1.0)
    with pytest.raises(
        ValueError, match=r"at most 50,000,000 entries, got .*,.* \(4844 monomials .*; use a lower degree"
    ):
        hg.linear.lifted_system(plant, sensor, hg.perfect(), 4, 100)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"degree": 0}, "degree of the lift: expected a positive whole number, got 0"),
        ({"horizon": 0}, "horizon: expected a positive whole number, got 0"),
        ({"horizon": 7}, "at most 5 steps"),
        ({"channel": hg.perfect(2)}, "2"),
        ({"plant": hg.LinearPlant(np.eye(3), 1.0, np.zeros(3), 1.0, np.ones((3, 1)))}, "without inputs"),
        ({"plant": hg.Plant(lambda x, u: x, 1.0, np.zeros(3), 1.0)}, "LinearPlant"),
    ],
)
def test_bad_input_is_named(change, message):
    plant = hg.model.over_time([hg.LinearPlant(np.eye(3), 1.0, np.zeros(3), 1.0)] * 5)
    usual = {"plant": plant, "sensor": hg.LinearSensor(np.ones((1, 3)), 1.0), "channel": hg.perfect(), "degree": 2,
             "horizon": 5}  # fmt: skip
    with pytest.raises(ValueError, match=message):
        hg.linear.lifted_system(**(usual | change))


def test_skewed_vector_noise_gains_in_every_direction():
    g = np.random.default_rng(1)
    law = random_law(g, 2, 5)
    plant = hg.LinearPlant(0.7 * np.eye(2), hg.random_affine.FiniteSupport(*law), np.zeros(2), np.eye(2))
    sensor = hg.LinearSensor(np.eye(2), hg.random_affine.FiniteSupport(*law))
    both = [
        hg.linear.lmmse(hg.linear.lifted_system(plant, sensor, hg.perfect(2), d, 10)).gains.covariance[-1]
        for d in (1, 2)
    ]
    assert np.linalg.eigvalsh(both[0] - both[1]).min() > 0


@pytest.mark.slow
def test_steps_after_the_moments_have_come_to_stay_are_copied():
    """To rounding they are what is computed step by step, which a model in `over_time` is."""
    plant, sensor = hg.LinearPlant([[0.5]], 0.1, [1.0], 1.0), hg.LinearSensor([[1.0]], 0.1)
    hop = hg.hop(hg.Rayleigh(1.0), 0.1)
    burst = hg.gilbert_elliott(hop, hg.hop(0.2, 0.1), 0.2, 0.2)
    for channel in (hop, burst):
        still = lifted_system(plant, sensor, channel, 2, 200)
        items = lifted_system(plant, sensor, hg.model.over_time([channel] * 200), 2, 200)
        assert still.steady_from < 150
        for gain, two in zip(lmmse(still).gains, lmmse(items).gains, strict=True):
            np.testing.assert_allclose(gain, two, rtol=1e-13, atol=1e-15)
    begun = time.process_time()
    item = hg.polynomial_filter(plant, sensor, hop, horizon=20_000)
    assert time.process_time() - begun < 6  # 1 s; step by step it was 12 s
    assert item.horizon is None


def test_what_no_double_can_hold_is_refused():
    plant, sensor = hg.LinearPlant([[1e4]], 0.1, [1.0], 1.0), hg.LinearSensor([[1.0]], 0.1)
    burst = hg.gilbert_elliott(hg.hop(1.0, 0.1), hg.hop(0.2, 0.1), 0.2, 0.2)
    for channel in (hg.perfect(), burst):  # E x^4 is 10 at the start and grows by 1e16 a step
        with pytest.raises(ValueError, match=r"moments of the state up to order 4: expected finite ones .* at step 20"):
            lifted_system(plant, sensor, channel, 2, 30)
    for degree in (32, 50, 10**9):
        with pytest.raises(ValueError, match=f"degree of the lift: expected at most 31, got {degree}"):
            hg.polynomial_filter(plant, sensor, hg.perfect(), 5, degree)


def test_traced_numbers_are_refused_in_one_line():
    """Moments are NumPy's: under jax.grad, JAX's own error came out."""
    sensor, link = hg.LinearSensor([[1.0]], 0.2), hg.hop(hg.Discrete([0.5, 1.5], [0.5, 0.5]), 0.1)
    for make in (
        hg.polynomial_filter,
        hg.filters.scheduled_polynomial_filter,
        hg.filters.memory_filter,
        lifted_system,
    ):
        more = (2,) if make is lifted_system else ()
        with pytest.raises(ValueError, match="polynomial filter: expected known numbers") as error:
            jax.grad(lambda q, make=make, more=more: make(
                hg.LinearPlant([[0.9]], q * np.eye(1), [0.0], 1.0), sensor, link, *more, 4))(0.5)  # fmt: skip
        assert "\n" not in str(error.value)
