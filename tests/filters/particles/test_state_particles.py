"""Particle filter of the state: against the Kalman filter, a grid, and what cannot be."""

import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as hg

MATRIX, NOISE = np.array([[1.0, 1.0], [0.0, 0.9]]), np.diag([0.1, 0.2])
PLANT = hg.LinearPlant(MATRIX, NOISE, [0.0, 0.0], np.eye(2))
SENSOR = hg.LinearSensor([[1.0, 0.0]], 0.5)
MANY = 20_000
STEPPING = hg.LinearPlant([[1.0]], hg.random_affine.FiniteSupport([[-1.0], [1.0]], [0.5, 0.5]), [0.0], [[1.0]])
GRID = np.linspace(-6, 6, 2401)


def rows(count, seed=0):
    """Return measurements of PLANT, one of them missing."""
    rng, x, z = np.random.default_rng(seed), np.zeros(2), []
    for _ in range(count):
        x = MATRIX @ x + rng.normal(size=2) * np.sqrt([0.1, 0.2])
        z.append([x[0] + rng.normal() * np.sqrt(0.5)])
    return np.array([*z[:4], [np.nan], *z[5:]])


@pytest.mark.slow
@pytest.mark.parametrize("proposal", ["optimal", "prior"])
def test_it_tends_to_the_kalman_filter(proposal):
    z = rows(20)
    right = hg.kalman_filter(PLANT, SENSOR).run(z)
    got = hg.filters.particle_filter(PLANT, SENSOR, hg.perfect(), MANY, proposal=proposal).run(z)
    deviation = np.sqrt(np.diagonal(right.covariances, axis1=1, axis2=2))
    # The mean of 20,000 particles, of which 7,000 count on average, errs by .012 deviations; five of those. A second
    # moment by root 2 more.
    assert np.max(np.abs(got.means - right.means) / deviation) < 0.06
    scale = deviation[:, :, None] * deviation[:, None]
    assert np.max(np.abs(got.covariances - right.covariances) / scale) < 0.085
    # log sum W w errs by root((N / N_eff - 1) / N), at most .01 a row, of 19 rows .04; three of those.
    assert abs(got.log_likelihood - right.log_likelihood) < 0.13
    assert got.log_likelihoods[4] == 0


def test_by_steps_is_the_run_and_another_seed_draws_others():
    filters = [hg.filters.particle_filter(PLANT, SENSOR, hg.perfect(), 50, seed=seed) for seed in (0, 0, 1)]
    z = rows(6)
    runs = [filter.run(z) for filter in filters]
    np.testing.assert_array_equal(runs[0].means, runs[1].means)
    assert np.any(runs[0].means != runs[2].means)
    state = filters[0].init()
    for k, row in enumerate(z):
        state, estimate = filters[0].step(state, row, k=k)
        np.testing.assert_allclose(estimate.mean, runs[0].means[k], rtol=1e-12)  # one program or six: rounding
    assert 1 <= state.effective_number <= 50
    np.testing.assert_allclose(state.effective_number, runs[0].effective_numbers[-1], rtol=1e-9)


def test_weights_that_collapse_are_warned_of():
    sensor = hg.LinearSensor([[1.0, 0.0]], 1e-8)
    filter = hg.filters.particle_filter(PLANT, sensor, hg.perfect(), 100, proposal="prior")
    with pytest.warns(UserWarning, match="fewer than 10 particles count after 2 of the rows, first row 2"):
        result = filter.run([[np.nan], [0.3], [0.2]])
    assert result.effective_numbers[0] == pytest.approx(100)
    assert max(result.effective_numbers[1:]) < 10
    assert hg.kalman_filter(PLANT, sensor).run([[0.3]]).effective_numbers is None
    with pytest.warns(UserWarning, match="first row 4"):
        filter.run([[0.3]], after=result)


def on_grid(z, noise_density):
    """Filter x+ = .9 x + sin x + w, z = x^2 / 3 + v on a grid: means, and the log-likelihood."""
    law = np.exp(-(GRID**2) / 2)
    law /= law.sum()
    move = np.exp(-((GRID[:, None] - 0.9 * GRID - np.sin(GRID)) ** 2) / (2 * 0.25))
    move /= move.sum(axis=0)
    means, total = [], 0.0
    for row in z[:, 0]:
        law = move @ law
        law = law * noise_density(row - GRID**2 / 3)
        total += np.log(law.sum())
        law /= law.sum()
        means.append(law @ GRID)
    return np.array(means), total


def curved(noise):
    plant = hg.Plant(lambda x, u: 0.9 * x + jnp.sin(x), 0.25, [0.0], [[1.0]])
    return plant, hg.Sensor(lambda x: x**2 / 3, noise)


def gaussian(variance):
    return lambda e: np.exp(-(e**2) / (2 * variance)) / np.sqrt(2 * np.pi * variance)


@pytest.mark.slow
@pytest.mark.parametrize("proposal", ["optimal", "prior"])
def test_a_curved_scalar_is_that_of_a_grid(proposal):
    z = np.array([[0.4], [1.1], [0.9], [1.5], [2.0], [1.2]])
    means, total = on_grid(z, gaussian(0.1))
    filter = hg.filters.particle_filter(*curved(0.1), hg.perfect(), MANY, proposal=proposal)
    got = filter.run(z)
    # Two places, at +- root(3 z): a deviation of 2, of 20,000 particles of which at least 2,000 count: .045; four.
    assert np.max(np.abs(got.means[:, 0] - means)) < 0.18
    assert abs(got.log_likelihood - total) < 0.06  # six rows, each .01; two and a half of those


@pytest.mark.slow
def test_atoms_of_gain_are_summed_and_losses_need_no_row():
    plant, sensor = curved(0.1)
    z = np.array([[0.4], [np.nan], [0.1], [1.5]])
    link = hg.erasure(hg.hop(hg.Discrete([0.5, 1.0], [0.3, 0.7]), 0.05), 0.8)

    def density(row, y):
        branches = ((0.3, 0.5), (0.7, 1.0))
        return sum(p * gaussian(g * g * 0.1 + 0.05)(row - g * y) for p, g in branches)

    law, total = np.exp(-(GRID**2) / 2), 0.0
    law /= law.sum()
    move = np.exp(-((GRID[:, None] - 0.9 * GRID - np.sin(GRID)) ** 2) / (2 * 0.25))
    move /= move.sum(axis=0)
    for row in z[:, 0]:
        law = move @ law
        if not np.isnan(row):
            law = law * density(row, GRID**2 / 3)
            total += np.log(law.sum())
            law /= law.sum()
    got = hg.filters.particle_filter(plant, sensor, link, MANY).run(z)
    assert abs(got.log_likelihood - total) < 0.06  # as above
    assert abs(got.covariances[-1, 0, 0] + got.means[-1, 0] ** 2 - law @ GRID**2) < 0.1  # 3 of .03: E x^2 of 2.6


def test_a_precise_first_measurement_leaves_many_particles():
    sensor = hg.LinearSensor([[1.0, 0.0]], 1e-8)
    numbers = {}
    for proposal in ("optimal", "prior"):
        filter = hg.filters.particle_filter(PLANT, sensor, hg.perfect(), 1000, proposal=proposal)
        state, _ = filter.step(filter.init(), [0.3])
        numbers[proposal] = float(state.effective_number)
    assert numbers["prior"] < 10
    assert numbers["optimal"] > 999  # x_0 and w are drawn together: all weights are equal to rounding


def test_an_angle_has_its_mean_direction():
    plant = hg.Plant(lambda x, u: x, 1e-4, [np.pi], [[0.04]], states=["heading"], circular=["heading"])
    sensor = hg.Sensor(lambda x: jnp.stack([jnp.cos(x[0]), jnp.sin(x[0])]), np.eye(2))
    filter = hg.filters.particle_filter(plant, sensor, hg.perfect(2), 4000, proposal="prior")
    estimate = filter.estimate(filter.init())
    # +-pi is one place: 4,000 draws of deviation .2 have a mean within .0095 (three deviations), a variance within 7 %.
    assert abs(abs(estimate.mean[0]) - np.pi) < 0.0095
    assert abs(estimate.covariance[0, 0] - 0.04) < 0.003


def test_a_row_that_no_particle_explains_is_not_used_and_named():
    plant = hg.Plant(lambda x, u: x, 0.1, [1.0], [[0.1]])
    sensor = hg.Sensor(lambda x: jnp.sqrt(x - 50), 0.1)  # no number where the particles are
    filter = hg.filters.particle_filter(plant, sensor, hg.perfect(), 12, proposal="prior")
    state = filter.predict(filter.init())
    after, innovation = filter.correct(state, [1.0])
    np.testing.assert_array_equal(after.position, state.position)
    np.testing.assert_array_equal(after.weight, state.weight)
    assert innovation.log_likelihood == -np.inf
    with pytest.warns(UserWarning, match="1 of the rows are not used, first row 2: no particle explains"):
        filter.run([[np.nan], [1.0]])
    network = hg.Network(plant, {"node": hg.Node(sensor, hg.perfect(), {"particles": filter})})
    with pytest.warns(UserWarning, match="excludes"):
        record = hg.run(network, {"node": [[1.0], [np.nan]]})
    assert np.isfinite(record.estimates["node"]["particles"].mean).all()


@pytest.mark.parametrize(
    ("build", "said"),
    [
        (lambda f: f(PLANT, hg.LinearSensor([[1.0, 0.0]], 0.0), hg.perfect()), "output of particles: expected noise"),
        (lambda f: f(PLANT, SENSOR, hg.hop(hg.Rayleigh(1.0), 0.1)), "channel of particles: expected gains of finitely"),
        (lambda f: f(PLANT, SENSOR, hg.perfect(), proposal="bootstrap"), "proposal: expected 'optimal' or 'prior'"),
        (lambda f: f(PLANT, SENSOR, hg.perfect(), resample=1.5), "resample: expected"),
        (lambda f: f(PLANT, SENSOR, hg.perfect(), 0), "particles: expected a positive whole number"),
        (lambda f: f(STEPPING, hg.LinearSensor([[1.0]], 1.0), hg.perfect()), "proposal='prior' takes any"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_refused_in_one_line(build, said):
    with pytest.raises(ValueError, match=said) as error:
        build(hg.filters.particle_filter)
    assert "\n" not in str(error.value)


def heading():
    """Return a plant that drives where its heading points, which nothing measures, and a sensor of its speed."""

    def move(x, u):
        return jnp.stack([x[0] + 0.1 * x[3] * jnp.cos(x[2]), x[1] + 0.1 * x[3] * jnp.sin(x[2]), x[2], x[3]])

    noise, spread = np.diag([1e-6, 1e-6, 1e-8, 1e-6]), np.diag([1e-4, 1e-4, 4, 1e-4])
    plant = hg.Plant(move, noise, [0, 0, 0, 1.0], spread, states=["x", "y", "yaw", "v"], circular=["yaw"])
    return plant, hg.LinearSensor([[0, 0, 0, 1.0]], 1e-4, outputs=["speed"])


@pytest.mark.slow
def test_a_heading_that_nothing_measures():
    parts = (*heading(), hg.perfect())  # the same functions for all keys: one program
    runs = [hg.filters.particle_filter(*parts, seed=key).run(np.ones((600, 1))) for key in range(30)]
    means = np.array([run.means[-1] for run in runs])
    second = np.mean([run.covariances[-1] for run in runs], axis=0) + np.cov(means.T)
    # Means of 30 keys; between keys x varies by some 7 (1,000 particles), so its mean by 1.3: three of those.
    assert abs(means[:, 0].mean() - 8.12) < 3.9
    assert abs(np.sqrt(second[0, 0]) - 41.65) < 2 and abs(np.sqrt(second[1, 1]) - 42.4) < 2
    assert abs(np.mean([np.sqrt(run.covariances[-1, 2, 2]) for run in runs]) - 1.66) < 0.12


def test_it_runs_in_a_network():
    plant, sensor = curved(0.1)
    filters = {"particles": hg.filters.particle_filter(plant, sensor, hg.perfect(), 12)}
    network = hg.Network(plant, {"node": hg.Node(sensor, hg.perfect(), filters)})
    record = hg.monte_carlo(network, horizon=5, runs=4, key=0)
    assert np.isfinite(record.estimates["node"]["particles"].mean).all()
    assert len({float(m) for m in record.estimates["node"]["particles"].mean[:, 0, 0]}) == 4  # runs draw independently
