"""Continuous time made discrete, against SciPy's exponential, Lyapunov's equation, FilterPy and a filter by hand."""

import jax
import numpy as np
import pytest
import scipy.linalg
from filterpy.common import Q_continuous_white_noise

import heliograph as hg

SPRING = np.array([[0.0, 1.0], [-2.0, -0.3]])
SHAKEN = np.diag([0.0, 0.5])


@pytest.mark.parametrize("size", [1, 2, 4, 6])
@pytest.mark.parametrize("rate", [0.1, 1.0, 5.0, 40.0])
def test_a_step_is_that_of_other_ways(size, rate):
    """1e-12 of the norm: F by SciPy, Q = P - F P F' of A P + P A' = -S, the input by A^-1 (F - I) B."""
    rng = np.random.default_rng(size)
    a = rate * (rng.normal(size=(size, size)) - 2 * np.eye(size))
    root, b = rng.normal(size=(size, size)), rng.normal(size=(size, 2))
    step = hg.models.discretize(a, root @ root.T, 0.7, b)
    f = scipy.linalg.expm(0.7 * a)
    p = scipy.linalg.solve_continuous_lyapunov(a, -root @ root.T)
    q, driven = p - f @ p @ f.T, np.linalg.solve(a, (f - np.eye(size)) @ b)
    for got, right in ((step.matrix, f), (step.noise, q), (step.input_matrix, driven)):
        assert np.abs(got - right).max() < 1e-12 * np.abs(right).max()


def test_a_known_step_and_one_that_is_an_input_are_the_same():
    """To rounding of matrices of size 1."""
    known = hg.models.continuous_plant(SPRING, SHAKEN, [0, 0], 1.0, [[0], [1]], 0.3, inputs=["force"])
    varying = hg.models.continuous_plant(SPRING, SHAKEN, [0, 0], 1.0, [[0], [1]], inputs=["force"])
    assert known.inputs == ("force",) and varying.inputs == ("force", "dt")
    x, u = np.array([1.0, 2.0]), np.array([0.7, 0.3])
    with jax.enable_x64(True):
        np.testing.assert_allclose(varying.transition(x, u), known.transition(x, u[:1]), atol=1e-15)
        np.testing.assert_allclose(varying.noise_covariance(u), known.noise.covariance, atol=1e-15)


def test_a_filter_over_steps_of_any_length_is_that_by_hand():
    """The recursion in NumPy with matrices of each row; 1e-9 of a log-likelihood of some hundreds."""
    rng = np.random.default_rng(1)
    dt, force, z = rng.exponential(1.0, 50), rng.normal(size=50), rng.normal(size=(50, 1))
    plant = hg.models.continuous_plant(SPRING, SHAKEN, [0, 0], 1.0, [[0], [1]], inputs=["force"])
    found = hg.kalman_filter(plant, hg.LinearSensor([[1.0, 0.0]], 0.1)).run(z, np.stack([force, dt], 1))
    x, p, likelihood = np.zeros(2), np.eye(2), 0.0
    for k in range(50):
        step = hg.models.discretize(SPRING, SHAKEN, dt[k], [[0], [1]])
        x, p = step.matrix @ x + step.input_matrix[:, 0] * force[k], step.matrix @ p @ step.matrix.T + step.noise
        s, e = p[0, 0] + 0.1, z[k, 0] - x[0]
        gain = p[:, 0] / s
        x, p = x + gain * e, p - np.outer(gain, gain) * s
        likelihood -= (np.log(2 * np.pi * s) + e**2 / s) / 2
    assert found.claim == "exact"
    assert abs(found.log_likelihood - likelihood) < 1e-9
    np.testing.assert_allclose(found.means[-1], x, atol=1e-12)


def test_a_step_has_derivatives():
    """By its length and the intensity; differences of 1e-6 are right to 1e-9."""
    with jax.enable_x64(True):
        entry = jax.jit(jax.grad(lambda dt: hg.models.discretize(SPRING, SHAKEN, dt).noise[0, 0]))(1.3)
        ahead, back = (hg.models.discretize(SPRING, SHAKEN, 1.3 + h).noise[0, 0] for h in (1e-6, -1e-6))
        assert abs(entry - (ahead - back) / 2e-6) < 1e-9
        slope = jax.jit(jax.grad(lambda q: hg.models.discretize(SPRING, q * SHAKEN, 1.3).noise[1, 1]))(2.0)
        assert abs(slope - hg.models.discretize(SPRING, SHAKEN, 1.3).noise[1, 1]) < 1e-14


def test_a_runge_kutta_step_is_of_order_four():
    """A linear drift: the local error of half a step is 1/32 of it (within 5 %), and the noise is exact."""
    step = {dt: hg.models.runge_kutta_plant(lambda x, u: SPRING @ x, SHAKEN, [1, 0], 1.0, dt) for dt in (0.2, 0.1)}
    x = np.array([1.0, 2.0])
    with jax.enable_x64(True):
        error = [
            np.abs(p.transition(x, np.zeros(0)) - scipy.linalg.expm(dt * SPRING) @ x).max() for dt, p in step.items()
        ]
        noise = step[0.2].noise_covariance(np.zeros(0))
    assert 32 * 0.95 < error[0] / error[1] < 32 * 1.05
    np.testing.assert_allclose(noise, hg.models.discretize(SPRING, SHAKEN, 0.2).noise, rtol=1e-12)


def test_substeps_are_steps():
    pendulum = lambda x, u: jax.numpy.stack([x[1], -jax.numpy.sin(x[0]) + u[0]])  # noqa: E731
    whole = hg.models.runge_kutta_plant(pendulum, 0.1, [1, 0], 1.0, inputs=["torque"], circular=(), substeps=4)
    single = hg.models.runge_kutta_plant(pendulum, 0.1, [1, 0], 1.0, inputs=["torque"])
    assert whole.inputs == ("torque", "dt")
    x = np.array([1.0, 0.5])
    with jax.enable_x64(True):
        once = np.asarray(whole.transition(x, np.array([0.2, 1.0])))
        for _ in range(4):
            x = np.asarray(single.transition(x, np.array([0.2, 0.25])))
    np.testing.assert_allclose(once, x, atol=1e-14)


def test_limits_of_states_are_handed_on():
    limits, drift = {"x0": (-1, None)}, lambda x, u: SPRING @ x
    for dt in (None, 0.2):
        plants = (
            hg.models.continuous_plant(SPRING, SHAKEN, [0, 0], 1.0, dt=dt, limits=limits),
            (hg.models.runge_kutta_plant(drift, SHAKEN, [0, 0], 1.0, dt, limits=limits)),
        )
        assert [plant.limits for plant in plants] == [(("x0", (-1.0, np.inf)),)] * 2


def test_constant_velocity_is_filterpys():
    noise = hg.models.constant_velocity(0.1, dt=0.5).noise.covariance
    np.testing.assert_allclose(noise, Q_continuous_white_noise(2, 0.5, 0.1), rtol=1e-14)
    noise = hg.models.constant_acceleration(0.1, dt=0.5).noise.covariance
    np.testing.assert_allclose(noise, Q_continuous_white_noise(3, 0.5, 0.1), rtol=1e-14)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda m: m.discretize(SPRING, -1.0, 1.0), "noise intensity: expected a positive semidefinite matrix"),
        (lambda m: m.discretize(SPRING, SHAKEN, -1.0), "length of a step: expected a number of at least 0"),
        (lambda m: m.discretize(SPRING[:1], SHAKEN, 1.0), "matrix of the motion: expected shape"),
        (lambda m: m.continuous_plant(SPRING, SHAKEN, [0, 0], 1.0, [[0], [1]], inputs=["dt"]), "no 'dt'"),
        (lambda m: m.runge_kutta_plant(lambda x, u: x[:1], 1.0, [0, 0], 1.0), "drift.*expected shape"),
        (lambda m: m.continuous_plant(SPRING, SHAKEN, [0, 0], 1.0, limits={"x1": (1, 2)}), "x1"),
        (lambda m: m.constant_velocity(-1.0), "noise intensity: expected a number of at least 0"),
        (lambda m: m.singer(1.0, 0.0), "time: expected a number of at least 1e-100"),
        (lambda m: m.known_turn(1.0, 0.1, axes=["x"]), "axes: expected two"),
    ],
)
def test_what_is_no_motion_is_refused_in_one_line(call, words):
    with pytest.raises(hg.InputError, match=words):
        call(hg.models)
