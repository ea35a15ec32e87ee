"""Linear plants whose matrices depend on known inputs, against the same plants given step by step."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as hg

STEPS = 12
DT = np.random.default_rng(1).uniform(0.1, 1.5, size=(STEPS, 1))
RNG = np.random.default_rng(2)
Z = RNG.normal(size=(STEPS, 1))
Z[[3, 7]] = np.nan
SENSOR = hg.LinearSensor([[1.0, 0.0]], 0.2)
LINK = hg.hop(hg.Discrete([0.6, 1.2], [0.4, 0.6]), 0.1)
BURSTS = hg.gilbert_elliott(hg.hop(1.0, 0.1), hg.hop(0.3, 0.1), 0.1, 0.3)


def moves(u):
    return jnp.stack([jnp.stack([1.0, u[0]]), jnp.stack([0.0, jnp.exp(-0.1 * u[0])])])


def shakes(u):
    return 0.3 * jnp.stack([jnp.stack([u[0] ** 3 / 3, u[0] ** 2 / 2]), jnp.stack([u[0] ** 2 / 2, u[0]])])


def pushes(u):
    return jnp.stack([u[0], 1.0]).reshape(2, 1)


PLANT = hg.LinearPlant(matrix=moves, noise=shakes, initial_mean=[0.0, 1.0], initial_covariance=np.eye(2), inputs=["dt"])
PUSHED = hg.LinearPlant(moves, shakes, [0.0, 1.0], np.eye(2), pushes, inputs=["dt"])


def by_step(pushed):
    """The plant at each step as a constant one with B u for an input of 1."""
    plants = []
    with jax.enable_x64(True):
        for u in jnp.asarray(DT):
            entry = np.asarray(pushes(u) @ u)[:, None] if pushed else np.zeros((2, 1))
            plants.append(hg.LinearPlant(np.asarray(moves(u)), np.asarray(shakes(u)), [0.0, 1.0], np.eye(2), entry))
    return hg.model.over_time(plants)


FILTERS = {
    "kalman": hg.kalman_filter,
    "linear": lambda plant, sensor: hg.linear_filter(plant, sensor, LINK),
    "memory": lambda plant, sensor: hg.linear_filter(plant, sensor, BURSTS),
    "mixture": lambda plant, sensor: hg.filters.mixture_filter(plant, sensor, LINK),
    "cubature": lambda plant, sensor: hg.cubature_filter(plant, sensor, LINK),
    "factored": lambda plant, sensor: hg.filters.imm_filter(plant, sensor, BURSTS),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", FILTERS)
@pytest.mark.parametrize(("plant", "pushed"), [(PLANT, False), (PUSHED, True)], ids=["moved", "pushed"])
def test_a_filter_is_that_of_the_plant_step_by_step(name, plant, pushed):
    varying, given = FILTERS[name](plant, SENSOR), FILTERS[name](by_step(pushed), SENSOR)
    results = varying.run(Z, DT), given.run(Z, np.ones((STEPS, 1)))
    for field in ("means", "covariances", "innovations", "log_likelihoods"):
        close = dict(rtol=1e-12, atol=1e-12)  # numbers of size one
        np.testing.assert_allclose(getattr(results[0], field), getattr(results[1], field), **close)
    assert varying.claim == given.claim
    if name in ("kalman", "linear"):
        assert varying.claim == "exact"
        planned = varying.planned(DT).run(np.nan_to_num(Z), DT)
        np.testing.assert_allclose(planned.covariances, varying.run(np.nan_to_num(Z), DT).covariances, rtol=1e-12)
    if name != "factored" and not pushed:  # the data are not such as a pushed plant gives: smoothing would warn
        smoothed = hg.rts_smoother(varying, Z, DT), hg.rts_smoother(given, Z, np.ones((STEPS, 1)))
        np.testing.assert_allclose(smoothed[0].means, smoothed[1].means, atol=1e-11)


def test_it_agrees_with_a_plant_of_any_function():
    """The same plant as a nonlinear one: equal to rounding, and its claim is exact where cubature's is nominal."""
    loose = hg.Plant(lambda x, u: moves(u) @ x, shakes, [0.0, 1.0], np.eye(2), inputs=["dt"])
    exact, nominal = hg.kalman_filter(PLANT, SENSOR), hg.cubature_filter(loose, SENSOR, hg.perfect())
    assert (exact.claim, nominal.claim) == ("exact", "nominal")
    both = exact.run(Z, DT), nominal.run(Z, DT)
    np.testing.assert_allclose(both[0].means, both[1].means, atol=1e-13, rtol=1e-13)
    np.testing.assert_allclose(both[0].covariances, both[1].covariances, atol=1e-13, rtol=1e-13)


def test_what_is_claimed_is_the_error():
    """2,000 runs behind a random gain: NEES per state within its interval, no direction worse than sampling error."""
    node = hg.Node(SENSOR, LINK, {"f": hg.linear_filter(PLANT, SENSOR, LINK)})
    network = hg.Network(PLANT, {"a": node})
    statistics = hg.monte_carlo(network, STEPS, 2000, 0, hg.Statistics(), inputs=DT)["a"]["f"]
    assert statistics.claim == "exact"
    actual, claimed = np.trace(statistics.actual(), axis1=1, axis2=2), np.trace(statistics.claimed(), axis1=1, axis2=2)
    np.testing.assert_allclose(actual, claimed, rtol=0.15)  # 2,000 squares of heavy tails: 4 deviations of 3.5 %
    assert statistics.worst_direction().z < 4


def test_the_true_error_is_the_claim():
    truth = hg.filters.true_error(hg.linear_filter(PLANT, SENSOR, LINK), PLANT, SENSOR, LINK, STEPS, DT)
    np.testing.assert_allclose(truth.true, truth.claimed, rtol=1e-10)


def test_units_do_not_matter():
    node = hg.Node(SENSOR, hg.perfect(), {"f": hg.kalman_filter(PUSHED, SENSOR)})
    hg.testing.check_scaling(hg.Network(PUSHED, {"a": node}), inputs=DT[:5])


def test_it_takes_events_at_any_time_where_a_constant_plant_names_it():
    """The step is the time since the event before; a plant without one counts whole steps, and says what to do."""
    kalman = hg.kalman_filter(PLANT, SENSOR)
    network = hg.Network(PLANT, {"a": hg.Node(SENSOR, hg.perfect(), {"f": kalman})})
    with pytest.warns(UserWarning, match="transition over 0.25 and then 0.75 differs"):  # this plant's, and it is said
        timeline = hg.Timeline(network, window=5.0)
    times, z = np.array([0.5, 0.7, 2.5]), np.array([0.1, 0.3, 1.0])
    for number in (0, 2, 1):
        assert timeline.push("a", number, times[number], [z[number]], arrival=2.5) == "used"
    steps = np.diff(times, prepend=0.0)[:, None]  # the timeline starts at 0
    expected = kalman.run(z, steps)
    np.testing.assert_allclose(timeline.estimates()["a"]["f"].mean, expected.means[-1], rtol=1e-9)
    plant, sensor = hg.state_space([[0.9]], [[1.0]], 1.0, 1.0, [0.0], 1.0)
    node = hg.Node(sensor, hg.perfect(), {"f": hg.kalman_filter(plant, sensor)})
    constant = hg.Timeline(hg.Network(plant, {"a": node}), window=5)
    with pytest.raises(ValueError, match=r"got 2.5 \(any times: a plant with the input 'dt', such as"):
        constant.push("a", 0, 2.5, [0.1])


@pytest.mark.parametrize(
    "planned",
    [
        lambda: hg.steady_state(PLANT, SENSOR),
        lambda: hg.linear.critical_arrival(PLANT, SENSOR),
        lambda: hg.linear.gain_over_linear(PLANT, SENSOR, LINK, 5),
        lambda: hg.polynomial_filter(PLANT, SENSOR, LINK, 2, 5),
        lambda: hg.linear_filter(PLANT, SENSOR, hg.model.delayed(LINK, hg.Discrete([0, 1], [0.5, 0.5]))),
        lambda: hg.simulation.certify_boundedness(hg.Network(PLANT, {"a": hg.Node(SENSOR, LINK, {})})),
        lambda: hg.design(hg.Network(PLANT, {"a": hg.Node(SENSOR, LINK, {})}), budget=1.0),
        lambda: hg.power(hg.Network(PLANT, {"a": hg.Node(SENSOR, LINK, {})})),
    ],
)
def test_what_is_computed_before_data_refuses_in_one_line(planned):
    with pytest.raises(ValueError) as caught:
        planned()
    assert "\n" not in str(caught.value) and "expected" in str(caught.value), caught.value


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (
            dict(matrix=moves),
            "inputs: expected the names of those that plant matrices depend on, such as .'dt'., got none",
        ),
        (dict(matrix=lambda u: u, inputs=["dt"]), r"plant matrix\(u\): expected shape \(2, 2\), got shape \(1,\)"),
        (dict(matrix=np.eye(2), noise=lambda u: u, inputs=["dt"]), r"process noise covariance\(u\): expected shape"),
        (dict(matrix=moves, inputs=["dt"], input_matrix=np.eye(2)), "input matrix: expected"),
    ],
)
def test_what_does_not_fit_is_refused(arguments, words):
    given = dict(noise=np.eye(2), initial_mean=[0.0, 0.0], initial_covariance=np.eye(2)) | arguments
    with pytest.raises(ValueError, match=words):
        hg.LinearPlant(**given)
