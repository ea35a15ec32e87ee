"""Powers of transmitters that add up: closed forms against searches, limits, bounds."""

import numpy as np
import pytest
import scipy

import heliograph as hg
from heliograph.planning import Budget


def network(scales=(1.0, 0.4, 1.6), noises=(0.02, 0.5, 0.1), rows=(1.0, -2.0, 0.5), correlation=0.0, same=False):
    """Sensors of one state behind Rayleigh gains."""
    plant = hg.LinearPlant([[0.9]], [[0.2]], [0.0], [[1.0]])
    root = np.sqrt(noises)
    covariance = np.diag(noises) + correlation * (np.outer(root, root) - np.diag(noises))
    sensor = hg.LinearSensor(np.array(rows)[:, None], covariance)
    if same:
        sensor = hg.LinearSensor([[1.0]], [[0.05]])
    links = [hg.hop(hg.Rayleigh(s), 0.01) for s in scales]
    return hg.Network(plant, {"a": hg.Node(sensor, hg.superposed(links, 0.1, same), {})})


def searched_information(network, total, caps):
    """Largest information of amplitudes within the limits, by descents from random starts, written out."""
    node = network.nodes["a"]
    scale = np.array([float(m.law.scale) for m in node.channel.maps])
    mean, spread = scale * np.sqrt(np.pi / 2), scale**2 * (2 - np.pi / 2)
    places = [at[0] for at in node.channel.places]
    c, r = node.sensor.matrix[places, 0], node.sensor.noise.covariance[np.ix_(places, places)]
    power = c**2 * 0.2 / (1 - 0.9**2) + np.diagonal(r)
    noise = np.outer(mean, mean) * r + np.diag(spread * power)
    floor = 0.1 + 0.01 * len(mean)

    def loss(a):
        return -(((a * mean) @ c) ** 2) / (a @ noise @ a + floor)

    limits = [{"type": "ineq", "fun": lambda a: total - a**2 @ power}] if np.isfinite(total) else []
    most = np.sqrt(np.array(caps) / power)
    bounds = [(-cap, cap) if np.isfinite(cap) else (None, None) for cap in most]
    generator = np.random.default_rng(0)
    results = [
        scipy.optimize.minimize(loss, generator.normal(size=len(mean)) * 0.3, bounds=bounds, constraints=limits,
                                options={"ftol": 1e-14, "maxiter": 500}, method="SLSQP").fun
        for _ in range(8)
    ]  # fmt: skip
    return -min(results)


def error_of(information):
    prior = scipy.linalg.solve_discrete_are([[0.9]], [[1.0]], [[0.2]], [[1 / information]])
    return (1 / (1 / prior + information)).item()


@pytest.mark.parametrize(
    ("budget", "options"),
    [
        (Budget(1.5), {}),
        (Budget(1.5), {"correlation": 0.3}),
        (Budget(0.7), {"same": True}),
        (Budget(per_transmitter=0.5), {}),
        (Budget(per_transmitter={"a.link1.hop1": 0.1, "a.link2.hop1": 5.0, "a.link3.hop1": 0.2}), {}),
        (Budget(0.6, per_transmitter={"a.link1.hop1": 0.1, "a.link2.hop1": 5.0, "a.link3.hop1": 0.2}), {}),
    ],
)
def test_closed_forms_are_the_best_amplitudes(budget, options):
    """No search finds more, to its tolerance of limits, and the filter of the design claims what is designed."""
    made = hg.design(network(**options), budget=budget)
    limits = budget.per_transmitter
    caps = [
        np.inf if limits is None else limits if isinstance(limits, float) else limits[f"a.link{i}.hop1"]
        for i in (1, 2, 3)
    ]
    total = np.inf if budget.total is None else budget.total
    best = error_of(searched_information(made.problem.network, total, caps))
    assert made.error == pytest.approx(best, rel=1e-6)
    assert made.error <= best * (1 + 1e-7)
    assert made.certificate.gap == 0
    assert made.total <= total * (1 + 1e-9)
    assert all(made.powers[f"a.link{i}.hop1"][0] <= cap * (1 + 1e-9) for i, cap in enumerate(caps, 1))
    sent = hg.power(made.network).mean
    for name, power in made.powers.items():
        assert sent[name] == pytest.approx(power[0], rel=1e-9)
    filter = made.network.nodes["a"].filters["best"]
    state = filter.init()
    for _ in range(60):
        state, _ = filter.correct(filter.predict(state), [0.0])
    assert filter.estimate(state).covariance[0, 0] == pytest.approx(made.error, rel=1e-4)


def test_full_power_of_a_poor_transmitter_hurts():
    """b = (1, 1), D = diag(0.01, 10), N = 0.01; of x+ = 0.95 x + w, Var w = 0.1: 0.3696 at full power, 0.0170."""
    from heliograph.planning.network_to_sum_of_links import steady_covariance_with_information
    from heliograph.planning.sum_of_links import SummedLinks, find_amplitudes_by_formula

    links = SummedLinks(np.ones((2, 1)), np.diag([0.01, 10.0]), np.ones(2), 0.01, np.ones(2))
    full = links.information(np.ones(2))[0, 0]
    best = find_amplitudes_by_formula(links, np.inf, np.ones(2))
    np.testing.assert_allclose(best, [1.0, 0.002], rtol=1e-3)
    moves, noise = np.array([[0.95]]), np.array([[0.1]])
    errors = [
        steady_covariance_with_information(moves, noise, np.array([[j]])).item()
        for j in (full, links.information(best)[0, 0])
    ]
    np.testing.assert_allclose(errors, [0.3696, 0.0170], atol=6e-5)


def test_several_states_are_searched_beside_their_bound():
    """Two independent states on one channel: a step sees one row, so that the bound is far."""
    plant = hg.LinearPlant(0.8 * np.eye(2), np.diag([0.3, 0.2]), np.zeros(2), np.eye(2))
    sensor = hg.LinearSensor(np.eye(2), 0.05 * np.eye(2))
    channel = hg.superposed([hg.hop(hg.Rayleigh(1.0), 0.0), hg.hop(hg.Rayleigh(0.7), 0.0)], 0.1)
    made = hg.design(hg.Network(plant, {"a": hg.Node(sensor, channel, {})}), budget=1.0, starts=4)
    assert "nan" not in made.certificate.words
    assert not made.certificate.convex
    assert made.bound < made.error < made.present
    assert made.total <= 1.0 + 1e-9


@pytest.mark.parametrize("options", [{}, {"correlation": 0.3}, {"same": True}])
def test_the_least_power_of_an_error_has_that_error(options):
    """The least error falls with the power, so that the least power of it is the power again; to the halvings' 1e-9."""
    designed = hg.design(network(**options), budget=1.5)
    least = hg.design(network(**options), target_error=designed.error)
    assert least.total == pytest.approx(1.5, rel=1e-9)
    assert least.error == pytest.approx(designed.error, rel=1e-9)
    assert least.certificate.unit == "power"
    assert least.certificate.gap == 0


def test_the_least_power_of_several_states_stands_beside_its_bound():
    """Searched: the power of a design of power 1 is found again to 1e-6, what a descent leaves."""
    plant = hg.LinearPlant(0.8 * np.eye(2), np.diag([0.3, 0.2]), np.zeros(2), np.eye(2))
    sensor = hg.LinearSensor(np.eye(2), 0.05 * np.eye(2))
    channel = hg.superposed([hg.hop(hg.Rayleigh(1.0), 0.0), hg.hop(hg.Rayleigh(0.7), 0.0)], 0.1)
    summed = hg.Network(plant, {"a": hg.Node(sensor, channel, {})})
    target = hg.design(summed, budget=1.0, starts=2).error
    least = hg.design(summed, target_error=target, starts=2)
    assert least.error <= target * (1 + 1e-9)
    assert least.total == pytest.approx(1.0, rel=1e-6)
    assert 0 < least.bound < least.total


def test_links_that_are_not_free_keep_their_power():
    """The best two of three amplitudes, by a fine grid of how they share what is left, to its squared spacing."""
    whole = network()
    sent = hg.power(whole).mean
    made = hg.design(whole, budget=Budget(1.5 + sent["a.link2.hop1"]), free=["a.link1", "a.link3"], starts=4)
    assert made.powers["a.link2.hop1"][0] == pytest.approx(sent["a.link2.hop1"], rel=1e-12)
    assert made.powers["a.link1.hop1"][0] + made.powers["a.link3.hop1"][0] == pytest.approx(1.5, rel=1e-9)
    scale, unit = np.array([1.0, 0.4, 1.6]), np.array(list(sent.values()))
    c, r = whole.nodes["a"].sensor.matrix[:, 0], np.diagonal(whole.nodes["a"].sensor.noise.covariance)
    best = np.inf
    for angle in np.linspace(0, 2 * np.pi, 401):
        a = np.array([np.cos(angle) * np.sqrt(1.5 / unit[0]), 1.0, np.sin(angle) * np.sqrt(1.5 / unit[2])])
        mean = scale * np.sqrt(np.pi / 2) * a
        noise = mean**2 @ r + (2 - np.pi / 2) * (scale * a) ** 2 @ unit + 0.13
        best = min(best, error_of((mean @ c) ** 2 / noise))
    assert made.error == pytest.approx(best, rel=1e-4)
    assert made.error <= best
    assert made.bound < made.error


def test_a_target_that_no_power_reaches_is_refused():
    with pytest.raises(ValueError, match=r"target error: expected at least 0\.0973393"):
        hg.design(network(), target_error=1e-9)
    with pytest.raises(ValueError, match="the least found within the budget"):
        hg.design(network(), target_error=0.1, budget=Budget(0.1))


def test_what_the_formulas_do_not_cover_is_refused():
    with pytest.raises(ValueError, match="design of a sum of links: expected the steady error"):
        hg.design(network(), budget=1.0, error=hg.planning.Error(horizon=3))
    late = hg.superposed([hg.model.delayed(hg.hop(1.0, 0.1), 1)], 0.1)
    plant, sensor = hg.LinearPlant([[0.9]], [[0.2]], [0.0], [[1.0]]), hg.LinearSensor([[1.0]], 0.1)
    with pytest.raises(ValueError, match="else give a function of free numbers"):
        hg.design(hg.Network(plant, {"a": hg.Node(sensor, late, {})}), budget=1.0)
