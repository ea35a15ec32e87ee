"""Particles of one run, a lane each: the numbers of the same filter by XLA, which takes all of them at once."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as hg

PLANT = hg.LinearPlant([[1.0, 0.1], [0.0, 0.9]], np.diag([0.01, 0.1]), [0.0, 1.0], np.eye(2))
SENSOR = hg.LinearSensor([[1.0, 0.0], [1.0, 1.0]], [[0.5, 0.1], [0.1, 0.3]])
COUNT = 1003  # no multiple of what a lane adds up


def drive(x, u):
    """Move a position by a heading and a speed, which the input turns and changes."""
    step = jnp.stack([0.1 * x[2] * jnp.cos(x[1]), u[0], 0.1 * u[1]])
    return x + step


TURNING = hg.Plant(
    drive, np.diag([1e-4, 1e-2, 1e-2]), [0.0, 3.0, 1.0], np.diag([0.1, 0.2, 0.1]), inputs=["turn", "push"],
    states=["x", "heading", "speed"], circular=["heading"],
)  # fmt: skip
COMPASS = hg.Sensor(lambda x: jnp.stack([x[1], x[0]]), np.diag([0.05, 0.01]), outputs=["heading", "x"],
                    circular=["heading"])  # fmt: skip
STEPPING = hg.LinearPlant([[0.9]], hg.random_affine.FiniteSupport([[-1.0], [1.0]], [0.5, 0.5]), [0.0], [[1.0]])
EDGE = hg.Sensor(lambda x: jnp.sqrt(x), 0.1)  # no number for half of the particles
LOSSY = hg.erasure(hg.hop(hg.Discrete([0.5, 1.0], [0.3, 0.7]), 0.05), 0.8)
WALK = hg.Plant(lambda x, u: 0.9 * x + jnp.sin(x), 0.25, [0.0], [[1.0]])
MODES = hg.markov_plant([PLANT, hg.LinearPlant([[1.0, 0.1], [0.0, 0.5]], np.diag([0.1, 1.0]), [0.0, 1.0], np.eye(2))],
                        [[0.9, 0.1], [0.3, 0.7]])  # fmt: skip
FADING = hg.erasure(hg.gilbert_elliott(hg.perfect(1), hg.hop(1.0, 4.0), 0.1, 0.2), 0.8)
ROWS = np.array([[0.3, 1.0], [0.2, 0.9], [np.nan, np.nan], [0.5, np.nan], [0.7, 1.1], [0.9, 1.3]])

CASES = {
    "prior": (PLANT, SENSOR, hg.perfect(2), ROWS, {"proposal": "prior"}),
    "optimal": (PLANT, SENSOR, hg.perfect(2), ROWS, {}),
    "angles, inputs": (TURNING, COMPASS, hg.perfect(2), ROWS[:, ::-1] + [2.5, 0.0], {}),
    "two values": (STEPPING, hg.LinearSensor([[1.0]], 1.0), hg.perfect(), ROWS[:, :1], {"proposal": "prior"}),
    "no number": (WALK, EDGE, hg.perfect(), ROWS[:, 1:], {}),
    "atoms": (WALK, hg.Sensor(lambda x: x**2 / 3, 0.1), LOSSY, ROWS[:, 1:], {}),
    "an angle drawn": (TURNING, COMPASS, hg.perfect(2), ROWS[:, ::-1] + [2.5, 0.0], {"drawn": ["heading"]}),
    "modes": (MODES, SENSOR, hg.perfect(2), ROWS, {"drawn": []}),
    "modes and a state": (MODES, SENSOR, hg.perfect(2), ROWS, {"drawn": ["x0"], "proposal": "prior"}),
    "modes of a link": (WALK, hg.Sensor(lambda x: x**2 / 3, 0.1), FADING, ROWS[:, 1:], {"drawn": ["x0"]}),
}  # fmt: skip


def by_xla(monkeypatch, run):
    """Return what XLA computes."""
    with monkeypatch.context() as patch:
        patch.setenv("HELIOGRAPH_ENGINE", "xla")
        return run()


def assert_equal(got, right):
    """Assert that two filtered recordings are the same, and the states after them."""
    # Sums of 1,003 numbers in another order, and functions two roundings apart; squared in the covariance.
    for name in ("means", "covariances", "innovations", "innovation_covariances", "log_likelihoods"):
        np.testing.assert_allclose(getattr(got, name), getattr(right, name), rtol=1e-9, atol=1e-11, err_msg=name)
    np.testing.assert_allclose(got.effective_numbers, right.effective_numbers, rtol=1e-9)
    assert (got.modes is None) == (right.modes is None)
    if right.modes is not None:
        np.testing.assert_allclose(got.modes, right.modes, rtol=1e-9)
    states = got.origin.state, right.origin.state
    for name in ("position", "gaussian", "log_mode", "weight"):
        parts = zip(*(jax.tree.leaves(getattr(state, name, ())) for state in states), strict=True)
        for one, other in parts:
            np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-11, err_msg=name)
    np.testing.assert_array_equal(np.asarray(states[0].key), np.asarray(states[1].key))


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_estimates_are_those_of_xla(name, monkeypatch):
    plant, sensor, channel, z, options = CASES[name]
    filter = hg.filters.particle_filter(plant, sensor, channel, COUNT, **options)
    u = np.tile([0.1, -0.2], (len(z), 1)) if filter.inputs else None
    assert_equal(filter.run(z, u), by_xla(monkeypatch, lambda: filter.run(z, u)))


@pytest.mark.filterwarnings("ignore:particle_filter")
def test_a_row_that_no_particle_explains_is_not_used(monkeypatch):
    sensor = hg.Sensor(lambda x: jnp.sqrt(x[:1] - 50), 0.1)  # no number where the particles are
    filter = hg.filters.particle_filter(PLANT, sensor, hg.perfect(), COUNT, proposal="prior")
    z = [[1.0], [np.nan], [2.0]]
    got, right = filter.run(z), by_xla(monkeypatch, lambda: filter.run(z))
    np.testing.assert_array_equal(got.log_likelihoods, [-np.inf, 0, -np.inf])
    assert_equal(got, right)
    assert np.isfinite(got.means).all() and np.all(got.effective_numbers > COUNT - 1e-6)


def test_many_particles_draw_single_precision_and_tend_to_the_kalman_filter():
    """10,000 particles, of which half count: means err by .014 deviations; four of those."""
    z = np.random.default_rng(0).normal(size=(12, 2))
    right = hg.kalman_filter(PLANT, SENSOR).run(z)
    deviation = np.sqrt(np.diagonal(right.covariances, axis1=1, axis2=2))
    for proposal in ("prior", "optimal"):
        got = hg.filters.particle_filter(PLANT, SENSOR, hg.perfect(2), 10_000, proposal=proposal).run(z)
        assert np.max(np.abs(got.means - right.means) / deviation) < 0.056
        assert np.max(np.abs(got.covariances - right.covariances) / (deviation[:, :, None] * deviation[:, None])) < 0.08
        assert abs(got.log_likelihood - right.log_likelihood) < 0.1
        assert got.claim == "nominal"


def test_rows_in_two_parts_are_those_of_one_run():
    filter = hg.filters.particle_filter(PLANT, SENSOR, hg.perfect(2), COUNT, proposal="prior")
    whole, early = filter.run(ROWS), filter.run(ROWS[:2])
    late = filter.run(ROWS[2:], after=early)
    for name in ("means", "covariances", "log_likelihoods", "effective_numbers"):
        both = np.concatenate([getattr(early, name), getattr(late, name)])
        np.testing.assert_allclose(both, getattr(whole, name), rtol=1e-12, atol=1e-13, err_msg=name)
    np.testing.assert_array_equal(late.origin.state.position, whole.origin.state.position)
