"""Numbers of any kind: gradients against differences, errors against filters, sites against the closed form."""

from functools import cache

import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as hg
from heliograph.planning import Budget, Error
from heliograph.planning.free_numbers.problem import FreeNumberProblem, make_free_numbers

PLANT = hg.LinearPlant([[0.9, 0.2], [0.0, 0.7]], np.diag([0.1, 0.3]), np.zeros(2), np.eye(2))
BOTH = hg.LinearSensor(np.eye(2), np.diag([0.2, 0.4]))
SUM = hg.LinearSensor([[1.0, 1.0]], 0.2)
FADING = hg.Discrete([0.6, 1.0, 1.4], [0.3, 0.4, 0.3])


def shared(amplifications):
    """One relay gain for both numbers: their noises are correlated."""
    pairs = zip((1.0, FADING), (0.3, 0.2), amplifications, strict=True)
    hops = [hg.hop(g, noise * np.eye(2), amplification=a) for g, noise, a in pairs]
    return hg.Network(PLANT, {"node": hg.Node(BOTH, hg.amplify_and_forward(hops), {})})


def observed_losses(amplification, arrival):
    lossy = hg.erasure(hg.hop(FADING, 0.3, amplification=amplification), arrival)
    nodes = {
        "a": hg.Node(hg.LinearSensor([[1.0, 0.0]], 0.2), lossy, {}),
        "b": hg.Node(hg.LinearSensor([[0.0, 1.0]], 0.4), hg.hop(1.0, 0.1), {}),
    }
    return hg.Network(PLANT, nodes)


def observed_modes(amplification, stays):
    chain = hg.random_affine.MarkovChain(jnp.stack([jnp.stack([0.9, 0.1]), jnp.stack([1 - stays, stays])]))
    modes = hg.random_affine.Modes(chain, [hg.hop(g, 0.3, amplification=amplification) for g in (1.0, 0.3)])
    return hg.Network(PLANT, {"node": hg.Node(SUM, hg.model.with_flag(modes), {})})


def one_hop(amplification):
    return hg.Network(PLANT, {"node": hg.Node(SUM, hg.hop(FADING, 0.3, amplification=amplification), {})})


def uncertain(amplification):
    """The mean gain is anything from .76 to 1.16."""
    law = hg.Discrete([0.6, 1.0, 1.4], [0.3, 0.4, 0.3], radius=[0.1, 0.0, 0.1])
    return hg.Network(PLANT, {"node": hg.Node(SUM, hg.hop(law, 0.3, amplification=amplification), {})})


CASES = {
    "shared gain": (shared, {"amplifications": ([0.7, 1.3], 0.1, 5.0)}),
    "observed losses": (observed_losses, {"amplification": (1.2, 0.1, 5.0), "arrival": (0.6, 0.1, 0.9)}),
    "uncertain": (uncertain, {"amplification": (1.2, 0.1, 5.0)}),
    "observed modes": (observed_modes, {"amplification": (1.2, 0.1, 5.0), "stays": (0.6, 0.1, 0.9)}),
}


def check_gradients(problem, relative=2e-3):
    x = problem.numbers.start
    slopes = problem.solve_at(x).slopes
    for i in range(len(x)):
        h = relative * x[i]
        ends = [problem.solve_at(x + s * h * np.eye(len(x))[i]) for s in (-2, -1, 1, 2)]
        for values, slope in (
            ([p.error for p in ends], slopes.error[i]),
            ([p.powers for p in ends], slopes.powers[..., i]),
        ):
            low, near, far, high = values
            differences = (8 * (far - near) - (high - low)) / (12 * h)
            np.testing.assert_allclose(slope, differences, rtol=1e-8, atol=1e-9)  # fourth order: h^4 and rounding / h


@cache
def problem_of(name):
    build, free = CASES[name]
    return FreeNumberProblem(build, make_free_numbers(free), Error({"x0": 1.0, "x1": 0.5}))


@pytest.fixture(scope="module", params=CASES)
def problem(request):
    return request.param, problem_of(request.param)


@pytest.mark.slow
def test_gradients_are_those_of_differences(problem):
    check_gradients(problem[1])


def first_step(measured):
    return type(measured)(*(None if part is None else part[0] for part in measured))


def test_the_error_is_that_of_the_recursion(problem):
    name, item = problem
    result = item.solve_at(item.numbers.start).covariances[0]
    network = item.network(item.numbers.start)
    if name == "shared gain":
        node = network.nodes["node"]
        best = hg.linear_filter(PLANT, node.sensor, node.channel).planned(np.zeros((200, 0)))
        np.testing.assert_allclose(result, best.covariances[-1], rtol=1e-10)
        powers = item.solve_at(item.numbers.start).powers
        np.testing.assert_allclose(powers[0], list(hg.power(network).mean.values()), rtol=1e-12)
        return
    m = first_step(item.solve_at(item.numbers.start).system)
    parts = m.law[:, None, None] * np.eye(2)
    for _ in range(400):  # the recursion of X_j, as it is written
        after = np.zeros_like(parts)
        for j in range(len(parts)):
            y = m.transition @ np.einsum("i,iab->ab", m.chain[:, j], parts) @ m.transition.T + m.law[j] * m.process
            k = y @ m.output[j].T @ np.linalg.inv(m.output[j] @ y @ m.output[j].T + m.law[j] * m.noise[j])
            after[j] = y - k @ m.output[j] @ y
        parts = after
    np.testing.assert_allclose(result, parts.sum(axis=0), rtol=1e-11)


def test_observed_losses_are_bounded_by_what_drawn_losses_leave():
    problem = problem_of("observed losses")
    result = problem.solve_at(problem.numbers.start)
    p, q = np.diag(result.covariances[0])
    assert result.error == pytest.approx(p + 0.5 * q, rel=1e-12)
    m, runs = first_step(result.system), 200
    draws, covariance, total = np.random.default_rng(0), np.eye(2), []
    for _ in range(200):  # the filters that know which losses there were
        j = draws.choice(2, runs, p=m.law)
        c, y = m.output[j], m.transition @ covariance @ m.transition.T + m.process
        k = y @ c.swapaxes(1, 2) @ np.linalg.inv(c @ y @ c.swapaxes(1, 2) + m.noise[j])
        covariance = y - k @ c @ y
        total.append(np.trace(covariance, axis1=1, axis2=2).mean())
    mean = np.mean(total[100:])
    assert mean <= p + q <= 1.05 * mean


def test_a_bound_holds_for_every_possible_law_and_is_no_looser_than_a_filters():
    """The gain of the bound, run under each extreme law: (x, e) is a linear system with random coefficients."""
    result = hg.design(uncertain, free={"amplification": (1.2, 1.2, 1.2)}, budget=100, starts=1)
    node = result.network.nodes["node"]
    k = problem_of("uncertain").solve_at(np.append(1.2, result.numbers["young"])).solution.gains[0, 0]
    a, q, c = PLANT.matrix, PLANT.noise.covariance, 1.2 * SUM.matrix
    for p in (0.2, 0.3, 0.4):
        values, law = np.array([0.6, 1.0, 1.4]), np.array([p, 0.4, 0.6 - p])
        z = np.zeros((4, 4))
        for _ in range(400):  # E (x, e)(x, e)', e+ = (I - K c) e - K (g - 1) c x - K (g v + n)
            moved = np.block([[a, np.zeros((2, 2))], [np.zeros((2, 2)), a]]) @ z
            moved = moved @ np.block([[a, np.zeros((2, 2))], [np.zeros((2, 2)), a]]).T + np.kron(np.ones((2, 2)), q)
            z = np.zeros((4, 4))
            for g, share in zip(values, law, strict=True):
                f = np.block([[np.eye(2), np.zeros((2, 2))], [-(g - 1) * k @ c, np.eye(2) - k @ c]])
                noise = np.zeros((4, 4))
                noise[2:, 2:] = k @ k.T * (0.2 * (1.2 * g) ** 2 + 0.3)
                z += share * (f @ moved @ f.T + noise)
        assert np.linalg.eigvalsh(result.covariance[0] - z[2:, 2:])[0] > 0
    filters = hg.linear_filter(PLANT, node.sensor, node.channel).planned(np.zeros((300, 0)))
    assert result.error <= np.trace(filters.covariances[-1]) * 1.05


@pytest.mark.slow
def test_a_relay_is_placed_where_the_closed_form_puts_it():
    """One state, two hops, loss d^-3: above rho = 4 the best site leaves the middle, x (1 - x) = 1 / rho."""
    rho = 8.0
    plant = hg.LinearPlant([[0.95]], [[0.1]], [0.0], [[1.0]])
    sensor = hg.LinearSensor([[1.0]], 0.5)
    received = 0.1 / (1 - 0.95**2) + 0.5

    def at(site, first, second):
        hops = [
            hg.hop(site**-1.5, 1.0, amplification=jnp.sqrt(first / received)),
            hg.hop((1 - site) ** -1.5, 1.0, amplification=jnp.sqrt(second / (first * site**-3 + 1.0))),
        ]
        return hg.Network(plant, {"node": hg.Node(sensor, hg.amplify_and_forward(hops), {})})

    power = 1 / rho  # rho = sigma^2 d^e / (nu P)
    free = {"site": (0.4, 0.02, 0.98), "first": (0.05, 1e-4, 1.0), "second": (0.05, 1e-4, 1.0)}
    result = hg.design(at, free=free, budget=power, starts=3)
    site = float(result.numbers["site"])
    assert site * (1 - site) == pytest.approx(1 / rho, abs=1e-4)
    noise = received * rho - (received - 0.5)
    p = 0.1
    for _ in range(500):
        p = 1 / (1 / (0.95**2 * p + 0.1) + 1 / noise)
    assert result.error == pytest.approx(p, rel=1e-7)
    assert result.total == pytest.approx(power, rel=1e-7) and result.certificate.stationarity < 1e-4
    assert result.certificate.words.endswith("no bound is known")
    assert hg.power(result.network).total == pytest.approx(power, rel=1e-7)


def test_powers_and_amplifications_agree():
    """The same network by amplifications, as a function, and by powers, by name."""

    def chain(a, b):
        hops = [hg.hop(FADING, 0.3, amplification=a), hg.hop(FADING, 0.2, amplification=b)]
        return hg.Network(PLANT, {"node": hg.Node(SUM, hg.amplify_and_forward(hops), {})})

    free = {"a": (0.5, 0.01, 9.0), "b": (0.5, 0.01, 9.0)}
    by_number = hg.design(chain, free=free, budget=3, starts=1)
    by_power = hg.design(chain(1.0, 1.0), budget=3)
    assert by_number.error == pytest.approx(by_power.error, rel=1e-9)
    least = hg.design(chain, free=free, target_error=by_power.error, starts=1)
    assert least.total == pytest.approx(3, rel=1e-6)
    capped = hg.design(chain, free=free, budget=Budget(3, per_transmitter={"node.hop1": 0.5}), starts=1)
    assert capped.powers["node.hop1"][0] == pytest.approx(0.5, rel=1e-6) and capped.error > by_power.error


def test_numbers_marked_where_they_stand_are_free():
    def marked():
        law = hg.Discrete([0.6, 1.0, 1.4], [0.3, 0.4, 0.3])
        link = hg.hop(law, 0.3, amplification=hg.free(0.5, "amplification", "positive"))
        return hg.Network(PLANT, {"node": hg.Node(SUM, link, {})})

    result = hg.design(marked, budget=2, starts=1)
    assert result.error == pytest.approx(hg.design(one_hop(1.0), budget=2).error, rel=1e-9)
    assert hg.power(result.network).total == pytest.approx(2, rel=1e-9) and result.numbers["amplification"] > 0.5


@pytest.mark.parametrize(
    ("free", "message"),
    [
        ({}, "free: expected the arguments of the function.*missing a required argument: 'amplification'"),
        (None, "free: expected the arguments of the function"),
        ({"amplification": (1.0, 0.0, 2.0), "b": (1.0, 0.0, 2.0)}, "free: expected .*unexpected keyword argument 'b'"),
        ({"amplification": (3.0, 0.0, 1.0)}, "free number 'amplification': expected a start between its ends"),
        (
            {"amplification": (1.0, "low", 2.0)},
            r"end of 'amplification': expected a number, or numbers of shape \(\), got 'low'",
        ),
        ({"amplification": ([1.0, 1.0], [0.1] * 3, 2.0)}, r"end of 'amplification': .* of shape \(2,\), got"),
        ({"amplification": 3.0}, r"free number 'amplification': expected a list of \(start, low, high\)"),
    ],
)
def test_bad_numbers_are_named(free, message):
    with pytest.raises(ValueError, match=message):
        hg.design(one_hop, free=free, budget=1)


@pytest.mark.parametrize("loss", [hg.erasure, hg.dropout])
@pytest.mark.parametrize("budget", [None, 1.0])
def test_an_arrival_probability_is_free_where_nothing_is_transmitted(loss, budget):
    """The more arrives the better, up to its end; there are no powers."""

    def built(arrival):
        return hg.Network(PLANT, {"a": hg.Node(SUM, loss(hg.perfect(), arrival), {})})

    best = hg.design(built, free={"arrival": (0.5, 0.1, 0.9)}, budget=budget, starts=1)
    assert best.numbers["arrival"] == pytest.approx(0.9, abs=1e-9) and best.powers == {}
    least = hg.design(built, free={"arrival": (0.5, 0.1, 0.9)}, target_error=best.error * 1.1, starts=1)
    assert 0.1 < least.numbers["arrival"] < 0.9 and least.error <= best.error * 1.1 * (1 + 1e-9)


@pytest.mark.parametrize(("low", "high"), [(-1.0, 2.0), (0.1, -np.inf)])
def test_ends_at_which_there_is_no_network_are_refused_before_any_descent(low, high, monkeypatch):
    monkeypatch.setattr("heliograph.planning.free_numbers.design.search_from_starts", None)
    sign, ends = (1, (0.5, low, high)) if high > 0 else (-1, (-0.5, -2.0, 1.0))

    def built(noise):
        return hg.Network(PLANT, {"a": hg.Node(SUM, hg.hop(1.0, sign * noise), {})})

    wrong = r"ends of 'noise': expected numbers between which there is a network, got -?1\.0, where: hop noise"
    with pytest.raises(ValueError, match=wrong):
        hg.design(built, free={"noise": ends}, budget=1.0)


def test_an_end_that_is_never_reached_may_be_none():
    """A transmitter without power is refused; one of any power above zero is not."""

    def built(power):
        return hg.Network(PLANT, {"a": hg.Node(SUM, hg.hop(1.0, 0.3, power=power), {})})

    best = hg.design(built, free={"power": (0.5, 0.0, 2.0)}, budget=1.0, starts=1)
    assert best.numbers["power"] > 0


def test_a_function_that_jax_cannot_follow_is_named():
    with pytest.raises(ValueError, match=r"network of free numbers: expected operations of jax\.numpy .*got Concret"):
        hg.design(lambda a: one_hop(float(a)), free={"a": (1.0, 0.1, 2.0)}, budget=1, starts=1)
