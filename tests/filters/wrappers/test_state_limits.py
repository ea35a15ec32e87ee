"""Filters of plants with limits, against Bayes' rule on a grid, closed forms of truncated normals, and a battery."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import norm, truncnorm

import heliograph as hg
from tests.export.device import Device, needs_compiler
from tests.follow import apart, follow, follow_each, follow_known

LIMITS = {"level": (0.0, 1.0)}
READ = hg.LinearSensor([[1.0]], 0.04)
PAIR = hg.LinearSensor([[1.0, 0.3]], 0.04)


def walk(noise, limits=(), spread=0.04):
    return hg.LinearPlant([[1.0]], noise, [0.5], spread, states=["level"], limits=limits)


def drifting(limits=()):
    """A level that a rate of its own moves; both have limits."""
    start = np.diag([0.04, 0.01])
    return hg.LinearPlant([[1.0, 0.5], [0.0, 0.9]], np.diag([1e-3, 4e-3]), [0.5, 0.1], start,
                          states=["level", "rate"], limits=limits)  # fmt: skip


def keep_paths(plant_noise, spread, steps, runs, seed):
    """Paths (runs, steps + 1) of a walk from N(0.5, spread), of which all that leave 0 to 1 are left out."""
    rng, kept = np.random.default_rng(seed), []
    while sum(map(len, kept)) < runs:
        start = 0.5 + np.sqrt(spread) * rng.normal(size=(4 * runs, 1))
        path = np.cumsum(np.c_[start, np.sqrt(plant_noise) * rng.normal(size=(4 * runs, steps))], axis=1)
        kept.append(path[(path >= 0).all(axis=1) & (path <= 1).all(axis=1)])
    return np.concatenate(kept)[:runs]


def bayes_on_grid(z, plant_noise, spread):
    """Mean and variance (runs, steps) given all data so far and that all states so far lay within 0 and 1.

    401 points, trapezoidal: 1e-6 of the mean where noises have deviations of ten distances and more.
    """
    x = np.linspace(0, 1, 401)
    weight = np.where((x == 0) | (x == 1), 0.5, 1.0)
    move = norm.pdf(x[:, None], x, np.sqrt(plant_noise)) * weight
    density = np.repeat(norm.pdf(x, 0.5, np.sqrt(spread))[:, None], len(z), axis=1)
    means, variances = [], []
    for row in z.T:
        density = (move @ density) * norm.pdf(row, x[:, None], 0.2)
        share = weight[:, None] * density / (weight @ density)
        means.append(x @ share)
        variances.append(x**2 @ share - means[-1] ** 2)
        density = density / density.max(axis=0)
    return np.stack(means, axis=1), np.stack(variances, axis=1)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("noise", "steps", "mean_off", "variance_off"),
    [(1e-2, 10, 0.05, 0.01), (1e-3, 40, 0.04, 0.01), (2e-4, 80, 0.03, 0.01)],
)
def test_a_bounded_walk_is_that_of_bayes_on_a_grid(noise, steps, mean_off, variance_off):
    """What is not used, that earlier states were within, costs these shares of a deviation and of the variance.

    The root mean square over runs and steps of the mean's difference in deviations of the grid's, and the mean ratio
    of variances. NEES within three deviations of the mean of 400 runs' squares, from the same paths by the grid.
    """
    path = keep_paths(noise, 0.04, steps, 400, 1)
    z = path[:, 1:] + 0.2 * np.random.default_rng(2).normal(size=(400, steps))
    mean, variance = bayes_on_grid(z, noise, 0.04)
    filter = hg.kalman_filter(walk(noise, LIMITS), READ)
    found = follow_each([filter] * len(z), z[..., None])
    off = (found.mean[..., 0] - mean) / np.sqrt(variance)
    ratio = found.covariance[..., 0, 0] / variance
    assert np.sqrt(np.mean(off**2)) < mean_off
    assert 1.0 - 1e-3 < np.mean(ratio) < 1 + variance_off
    nees = np.mean((found.mean[..., 0] - path[:, 1:]) ** 2 / found.covariance[..., 0, 0], axis=1)
    by_grid = np.mean((mean - path[:, 1:]) ** 2 / variance, axis=1)
    assert abs(np.mean(nees) - 1) < 3 * np.std(nees) / 20 + 0.02
    assert abs(np.mean(nees - by_grid)) < 0.03


def test_of_a_state_that_stays_it_is_the_truncated_posterior_however_many_steps():
    """Exact, as scipy's truncated normal has it to nine digits; moments fed back would shrink it."""
    z = np.random.default_rng(0).normal(0.9, 0.2, (60, 1))
    found = follow(hg.kalman_filter(walk(0.0, LIMITS), READ), z)
    precision = 25 + 25 * np.arange(1, 61)
    mean = (0.5 * 25 + 25 * np.cumsum(z[:, 0])) / precision
    assert mean.max() < 1  # never held
    s = precision**-0.5
    expected, variance = truncnorm.stats(-mean / s, (1 - mean) / s, mean, s, moments="mv")
    np.testing.assert_allclose(found.mean[:, 0], expected, rtol=1e-9)
    np.testing.assert_allclose(found.covariance[:, 0, 0], variance, rtol=1e-7)


def test_the_likelihood_is_that_of_data_given_that_the_state_lies_within():
    """A normalised density of each z: P(within | z) N(z) / P(within), summed over z; the static case in closed form."""
    filter = hg.kalman_filter(walk(0.0, LIMITS), READ)
    prior = filter.predict(filter.init())
    z = np.linspace(-1.5, 2.5, 401)
    likelihood = [float(filter.correct(prior, [value])[1].log_likelihood) for value in z[::8]]
    x = np.linspace(0, 1, 2001)
    inside = truncnorm.pdf(x, -2.5, 2.5, 0.5, 0.2)
    expected = np.trapezoid(norm.pdf(z[::8, None], x, 0.2) * inside, x, axis=1)
    reach = np.abs(z[::8] - 0.5) < 1  # beyond it the mean is held
    np.testing.assert_allclose(np.exp(likelihood)[reach], expected[reach], rtol=1e-6)


FAR = {"level": (-50.0, 60.0), "rate": (-40.0, None)}
BURSTS = hg.gilbert_elliott(hg.perfect(1), hg.hop(1.0, 0.1), 0.1, 0.2)
MAKERS = {
    "kalman": lambda plant: hg.kalman_filter(plant, PAIR),
    "extended": lambda plant: hg.extended_filter(plant, PAIR),
    "cubature": lambda plant: hg.cubature_filter(plant, PAIR),
    "unscented": lambda plant: hg.unscented_filter(plant, PAIR),
    "linear": lambda plant: hg.linear_filter(plant, PAIR, hg.hop(hg.Rayleigh(0.8), 0.1)),
    "robust": lambda plant: hg.robust_filter(plant, PAIR, hg.perfect(1), hg.filters.Huber(1.345)),
    "gate": lambda plant: hg.robust_filter(plant, PAIR, hg.perfect(1), hg.filters.Gate(9.0, after=5)),
    "imm": lambda plant: hg.filters.imm_filter(plant, PAIR, BURSTS),
    "gpb2": lambda plant: hg.filters.gpb2_filter(plant, PAIR, BURSTS),
    "modes": lambda plant: hg.filters.particle_filter(plant, PAIR, BURSTS, 20),
    "particles": lambda plant: hg.filters.particle_filter(plant, PAIR, hg.perfect(1), 50),
    "open loop": hg.filters.open_loop_filter,
}  # fmt: skip


NAMES = ["kalman", *(pytest.param(name, marks=pytest.mark.slow) for name in MAKERS if name != "kalman")]


@pytest.mark.parametrize("name", NAMES)
def test_wide_limits_are_none(name):
    """To 1e-12 of a deviation: no operation but those of the truncation, whose moments have 13 digits."""
    z = np.random.default_rng(3).normal(0.7, 0.3, (30, 1))
    z[7:12] = np.nan
    free, limited = MAKERS[name](drifting()), MAKERS[name](drifting(FAR))
    found, expected = follow(limited, z), follow(free, z)
    assert max(apart((found.mean, found.covariance), (expected.mean, expected.covariance))) < 1e-12
    np.testing.assert_allclose(found.innovation.log_likelihood, expected.innovation.log_likelihood, atol=1e-12)
    assert limited.claim == "nominal"


@pytest.mark.parametrize("name", NAMES)
def test_estimates_keep_the_limits(name):
    """Also where the data lie outside of them, and where nothing arrives."""
    limits = {"level": (0.0, 1.0), "rate": (0.0, None)}
    z = np.r_[np.full(12, 1.4), np.full(6, np.nan), np.full(12, -0.3)][:, None]
    found = follow(MAKERS[name](drifting(limits)), z)
    assert np.all((found.mean[:, 0] > 0) & (found.mean[:, 0] < 1) & (found.mean[:, 1] > 0))
    assert np.all(np.linalg.eigvalsh(found.covariance) > 0)
    assert np.all(np.isfinite(found.innovation.log_likelihood))


@pytest.mark.slow
def test_two_correlated_limits_are_near_the_moments_of_many_draws():
    """Correlated by 0.45, limits at half a deviation and one: measured 0.01 deviations and 5.4 % of a variance off.

    One after the other is no exact rule, so that the bounds say how good it is: 0.02 and 6 %, of 1,000,000 draws left.
    """
    mean, covariance = np.array([0.1, 0.2]), np.array([[0.04, 0.02], [0.02, 0.05]])
    plant = hg.LinearPlant(np.eye(2), 0.0, mean, covariance, limits={"x0": (0.0, 1.0), "x1": (0.0, None)})
    filter = hg.kalman_filter(plant, hg.LinearSensor(np.eye(2), 1.0))
    found = filter.estimate(filter.init())
    x = np.random.default_rng(4).multivariate_normal(mean, covariance, 2_000_000)
    x = x[(x > 0).all(axis=1) & (x[:, 0] < 1)]
    deviation = x.std(axis=0)
    assert np.all(np.abs(found.mean - x.mean(axis=0)) < 0.02 * deviation)
    np.testing.assert_allclose(np.diag(found.covariance), deviation**2, rtol=0.06)


@pytest.mark.slow
def test_particles_are_those_of_bayes_on_a_grid():
    """4,000 particles, whose error is 1 / root of their number: 0.05 deviations as the root mean square."""
    noise, steps = 1e-3, 20
    path = keep_paths(noise, 0.04, steps, 10, 5)
    z = path[:, 1:] + 0.2 * np.random.default_rng(6).normal(size=path[:, 1:].shape)
    mean, variance = bayes_on_grid(z, noise, 0.04)
    filter = hg.filters.particle_filter(walk(noise, LIMITS), READ, hg.perfect(1), 4000)
    found = follow_each([filter] * len(z), z[..., None])
    assert np.sqrt(np.mean((found.mean[..., 0] - mean) ** 2 / variance)) < 0.05
    assert np.mean(found.covariance[..., 0, 0] / variance) == pytest.approx(1, abs=0.05)


def test_smoothed_states_are_those_of_the_static_posterior():
    """A state that stays is at each step what it is at the last one, given all data."""
    z = np.random.default_rng(0).normal(0.9, 0.2, (20, 1))
    filter = hg.kalman_filter(walk(0.0, LIMITS), READ)
    smoothed, last = hg.rts_smoother(filter, z), follow(filter, z)
    np.testing.assert_allclose(smoothed.means, np.repeat(last.mean[-1:], 20, axis=0), rtol=1e-9)
    np.testing.assert_allclose(smoothed.covariances[:, 0], np.repeat(last.covariance[-1:, 0], 20, axis=0), rtol=1e-7)
    assert smoothed.claim == "nominal"


@pytest.mark.parametrize("name", ["kalman", pytest.param("imm", marks=pytest.mark.slow)])
def test_smoothed_states_keep_the_limits(name):
    z = np.r_[np.full(12, 1.4), np.full(12, -0.3)][:, None]
    smoothed = hg.rts_smoother(MAKERS[name](drifting({"level": (0.0, 1.0), "rate": (0.0, None)})), z)
    assert np.all((smoothed.means[:, 0] > 0) & (smoothed.means[:, 0] < 1) & (smoothed.means[:, 1] > 0))


@pytest.mark.slow
def test_the_derivative_of_the_likelihood_is_that_of_finite_differences():
    """Also where means are held, as the data lie outside: to 1e-6, of differences over 1e-5."""
    z = np.r_[np.full(5, 0.9), np.full(5, 1.5)][:, None]

    def likelihood(noise):
        filter = hg.kalman_filter(walk(noise, LIMITS), READ)

        def step(state, row):
            after, innovation = filter.correct(filter.predict(state), row)
            return after, innovation.log_likelihood

        return jnp.sum(jax.lax.scan(step, jax.tree.map(jnp.asarray, filter.init()), jnp.asarray(z))[1])

    with jax.enable_x64(True):
        value, slope = jax.jit(jax.value_and_grad(likelihood))(0.01)
        near = [jax.jit(likelihood)(0.01 + side) for side in (-1e-5, 1e-5)]
    assert np.isfinite(value)
    assert float(slope) == pytest.approx((float(near[1]) - float(near[0])) / 2e-5, rel=1e-6)


@pytest.mark.slow
def test_a_battery_that_starts_half_full_by_mistake_is_found():
    """State of charge 0.5 +- 0.2, truth 0.95: the tangent at 0.5 reaches beyond the table, where that is flat.

    Without limits the extended filter stays at 2.6; within them it is right to 0.005 after 100 rows.
    """
    charge = np.array([0.0, 0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 0.8, 0.9, 0.95, 1.0])
    volts = np.array([3.0, 3.3, 3.45, 3.55, 3.6, 3.65, 3.8, 3.9, 4.02, 4.1, 4.2])
    capacity, rng = 9000.0, np.random.default_rng(1)
    sensor = hg.Sensor(lambda x: jnp.interp(x[0], charge, volts)[None], 0.005**2, ["voltage"])
    u = np.full((200, 1), 1.5)
    soc = 0.95 - np.cumsum(u[:, 0]) / capacity
    z = (np.interp(soc, charge, volts) + 0.005 * rng.normal(size=200))[:, None]
    last = {}
    for limits in ((), {"soc": (0, 1)}):
        plant = hg.Plant(lambda x, u: x - u / capacity, 1e-12, [0.5], 0.04, ["soc"], ["current"], limits=limits)
        last[bool(limits)] = hg.extended_filter(plant, sensor).run(z, u).means[:, 0]
    assert last[False][-1] > 1.5
    assert np.all(last[True] <= 1)
    assert np.all(np.abs(last[True][100:] - soc[100:]) < 0.005)


@pytest.mark.slow
@needs_compiler
@pytest.mark.parametrize("name", ["kalman", "cubature", "imm"])
def test_an_exported_step_keeps_them(tmp_path, name):
    """The same numbers, to 1e-12 of a deviation."""
    filter = MAKERS[name](drifting({"level": (0.0, 1.0), "rate": (0.0, None)}))
    z = np.r_[np.full(12, 1.4), np.full(6, np.nan), np.full(12, -0.3)][:, None]
    nothing = np.zeros((len(z), 0))
    device, reference = Device(filter, tmp_path), follow_known(filter, z, nothing)
    assert max(apart(device.follow(z, nothing), (reference.mean, reference.covariance))) < 1e-12


def test_what_gives_no_limits_is_refused_in_one_line():
    with pytest.raises(ValueError, match=r"limits of 'level': expected an initial mean within 2 to 3, got 0\.5"):
        walk(0.1, {"level": (2, 3)})
    with pytest.raises(ValueError, match="limits of states: expected names of states that are no angles"):
        walk(0.1, {"charge": (0, 1)})
    with pytest.raises(ValueError, match="limits of 'level': expected a low end below the high one"):
        walk(0.1, {"level": (1, 0)})
    with pytest.raises(ValueError, match="limits of states: expected a table such as"):
        walk(0.1, 3)
    with pytest.raises(ValueError, match="expected names of states that are no angles"):
        hg.LinearPlant([[1.0]], 0.1, [0.0], 1.0, states=["yaw"], circular=["yaw"], limits={"yaw": (0, 1)})
    with pytest.raises(ValueError, match="beside angles and limits"):
        hg.LinearPlant([[1.0]], 0.1, [0.0], hg.diffuse, limits={"x0": (0, 1)})
    plant = walk(0.1, LIMITS)
    for make in (lambda: hg.polynomial_filter(plant, READ, hg.perfect(1), 2),
                 lambda: hg.event_filter(plant, READ, hg.perfect(1), hg.SendOnDelta([1.0])),
                 lambda: hg.filters.late_filter(hg.kalman_filter(plant, READ), 2)):  # fmt: skip
        with pytest.raises(ValueError, match=r"expected states without limits here .* got limits of \['level'\]"):
            make()
    assert walk(0.1, {"level": (None, None)}).limits == ()
