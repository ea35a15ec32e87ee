"""Designs of powers: the example's numbers, certificates, other errors, bad input."""

import numpy as np
import pytest

import heliograph as hg
from heliograph.planning import Budget, Error, paths_of
from heliograph.planning.multihop_paths.model import compute_path_information
from tests.planning.published import FIRST, KAPPA, NAMES, NOISES, ROWS, A, Q, one_hop, path_problem, two_hops


@pytest.fixture(scope="module")
def single():
    return one_hop()


@pytest.fixture(scope="module")
def double():
    return two_hops()


def steady_covariance(item):
    """What a filter claims after 300 steps: the slowest mode of the plant's own moments falls by .95^2 each."""
    return np.asarray(item.planned(np.zeros((300, 0))).covariances[-1])


ONE_HOP = {
    2: (0.91212826, 0.87632288, [0.42275, 0.60692, 0, 0.44522, 0, 0.52510], 1.6200),
    10: (0.61488712, 0.60604045, [2.31412, 1.30339, 2.88693, 1.40284, 1.03043, 1.06228], 9.4720),
}


@pytest.mark.parametrize("total", ONE_HOP)
def test_one_hop_reaches_the_example(single, total):
    equal, best, powers, least = ONE_HOP[total]
    result = hg.design(single, budget=total)
    assert result.error == pytest.approx(best, abs=1e-8)  # printed digits
    np.testing.assert_allclose([result.powers[f"{n}.hop1"][0] for n in NAMES], powers, atol=1e-5)
    assert result.total == pytest.approx(total, rel=1e-12)
    assert result.certificate.convex and result.certificate.gap < 1e-12
    paths, _ = paths_of(single, Error())
    problem = path_problem(paths, Error(), np.eye(3), np.ones(6, dtype=bool), np.zeros((1, 6)))
    even = problem.compute_exact_error(np.full((1, 6), total / 6))
    assert even == pytest.approx(equal, abs=1e-8)
    cheap = hg.design(single, target_error=even)
    assert cheap.error == pytest.approx(even, rel=1e-12) and cheap.total == pytest.approx(least, abs=5e-5)
    assert cheap.certificate.gap < 1e-9 and cheap.certificate.words.startswith("optimal within")


@pytest.mark.slow
def test_two_hops_reach_the_example_where_one_start_does_not(double):
    result = hg.design(double, budget=6)
    assert result.error == pytest.approx(1.36438855, abs=1e-8)
    whole = [sum(result.powers[f"{n}.hop{h}"][0] for h in (1, 2)) for n in NAMES]
    np.testing.assert_allclose(whole, [3.4644, 2.5356, 0, 0, 0, 0], atol=1e-4)
    assert 1.3333 < result.certificate.bound < result.error  # 1.33340 by an envelope that touches exactly
    assert result.certificate.words.startswith("best of 63 starts, stationary within")
    alone = hg.design(double, budget=6, starts=1)
    assert alone.error > 1.38 and alone.certificate.bound == pytest.approx(result.certificate.bound, rel=1e-6)
    assert result.certificate.stationarity < 1e-9
    assert hg.design(result.network, budget=6).present == pytest.approx(result.error, rel=1e-12)  # the network it gives


def test_two_hops_at_more_power(double):
    result = hg.design(double, budget=30, starts=8)
    assert result.error == pytest.approx(0.76036110, abs=1e-8)
    assert result.certificate.bound == pytest.approx(0.75968, abs=5e-6)


def test_least_power_of_two_hops_and_what_no_allocation_undercuts(double):
    result = hg.design(double, target_error=1.56566806, starts=16)
    assert result.error == pytest.approx(1.56566806, rel=1e-10)
    assert result.certificate.bound < result.total < 3.6  # 3.597 with the paths that are best at 6


def test_the_price_is_the_slope_of_the_best_error(single):
    less, middle, more = (hg.design(single, budget=total) for total in (3.99, 4.0, 4.01))
    assert middle.price == pytest.approx((less.error - more.error) / 0.02, rel=1e-4)  # differences of second order
    sending = {name: value for name, value in middle.sensitivity.items() if middle.powers[name][0] > 0}
    np.testing.assert_allclose(list(sending.values()), -middle.price, rtol=1e-9)  # all that send earn the same


def test_the_price_is_that_of_the_total_where_a_peak_binds_as_well():
    """It was the worth of a watt at the peak, .1166, which no watt of the total buys: .05465 by a difference."""
    plant, sensor = hg.LinearPlant([[0.9]], 0.3, [0.0], 1.0), hg.LinearSensor([[1.0]], 0.2)

    def network(a=1.0, b=1.0):
        links = {"a": hg.hop(hg.Discrete([0.5, 1.5], [0.5, 0.5]), 0.3, amplification=a),
                 "b": hg.hop(1.0, 0.5, amplification=b)}  # fmt: skip
        return hg.Network(plant, {name: hg.Node(sensor, link, {}) for name, link in links.items()})

    def found(total, target=None, of=None, **free):
        limits = Budget(total=total, peak={"a.hop1": 0.2})
        return hg.design(of or network(), budget=limits, target_error=target, starts=1, **free)

    less, more = found(1.999).error, found(2.001).error
    assert found(2.0).price == pytest.approx((less - more) / 0.002, rel=1e-5)  # differences of second order
    free = {"a": (0.3, 0.01, 2.0), "b": (0.8, 0.01, 2.0)}
    assert found(2.0, of=network, free=free).price == pytest.approx(found(2.0).price, rel=1e-4)
    for options in ({}, {"of": network, "free": free}):  # of a target it is the error for a watt of the least total
        result = found(9.0, target=found(2.0).error, **options)
        assert result.total == pytest.approx(2.0, rel=1e-5) and result.price == pytest.approx(
            found(2.0).price, rel=1e-4
        )


def test_limits_of_each_and_peaks_hold(single):
    budget = Budget(total=6, per_transmitter={"a.hop1": 0.5}, peak=1.5)
    result = hg.design(single, budget=budget, error=Error(period=2))
    powers = np.array(list(result.powers.values()))
    assert powers.max() <= 1.5 + 1e-9 and result.powers["a.hop1"].mean() <= 0.5 + 1e-9
    assert result.total == pytest.approx(6, rel=1e-9) and result.certificate.gap < 1e-7
    np.testing.assert_allclose(powers[:, 0], powers[:, 1], atol=1e-3)  # convex: one hop gains nothing by bursts


def test_bursts_beat_steady_sending_over_two_hops():
    plant = hg.LinearPlant([[0.99]], [[0.02]], [0.0], [[1.0]])
    chain = hg.amplify_and_forward([hg.hop(1.0, 2.0), hg.hop(1.0, 2.0)])
    network = hg.Network(plant, {"node": hg.Node(hg.LinearSensor([[1.0]], 0.2), chain, {})})
    assert hg.design(network, budget=1).error == pytest.approx(0.5235, abs=5e-5)
    burst = hg.design(network, budget=1, error=Error(period=8), starts=20)
    assert burst.error < 0.4027 and burst.certificate.bound < burst.error  # .4026: all in one step of eight


def test_one_state_the_worst_direction_and_the_end_of_a_horizon(single):
    single_state = hg.design(single, budget=2, error=Error({"x1": 1.0}))
    assert (
        single_state.error == pytest.approx(single_state.covariance[0, 1, 1])
        and single_state.error < hg.design(single, budget=2).covariance[0, 1, 1]
    )
    worst = hg.design(single, budget=2, error=Error(worst=True))
    assert worst.error == pytest.approx(np.linalg.eigvalsh(worst.covariance[0])[-1])
    assert worst.certificate.gap < 4e-5 * worst.error  # n^(1/32768): what smoothing the largest eigenvalue leaves
    end = hg.design(single, budget=2, error=Error(horizon=3, at_end=True))
    early = sum(power[0] for power in end.powers.values())
    assert end.error == pytest.approx(np.trace(end.covariance[-1])) and early < 2 and end.certificate.gap < 1e-8


def test_what_is_not_free_keeps_its_power(single):
    result = hg.design(single, free=["a", "b.hop1"], budget=20)
    before = hg.power(single).mean
    for name in NAMES[2:]:
        assert result.powers[f"{name}.hop1"][0] == pytest.approx(before[f"{name}.hop1"], rel=1e-12)
    assert result.total == pytest.approx(20)
    np.testing.assert_allclose(list(hg.power(result.network).mean.values()), [p[0] for p in result.powers.values()])


def test_one_node_with_parallel_chains_is_the_same(single):
    joint = hg.LinearSensor(ROWS, np.diag(NOISES))
    chains = hg.parallel([node.channel for node in single.nodes.values()])
    whole = hg.Network(single.plant, {"all": hg.Node(joint, chains, {})})
    result = hg.design(whole, budget=2)
    assert result.error == pytest.approx(0.87632288, abs=1e-8)
    assert list(result.powers)[1] == "all.part2.hop1"


def test_the_designed_network_claims_the_designed_error(single):
    result = hg.design(single, budget=10)
    steady = steady_covariance(result.network.fused["best"])
    assert np.trace(steady) == pytest.approx(result.error, rel=1e-9)


def test_drawn_runs_have_the_designed_error_and_power(single):
    """The filter's gain on runs drawn here: hops with gains of two values, noise, and the powers as amplifications."""
    result, runs, draws = hg.design(single, budget=10), 5_000, np.random.default_rng(5)
    p, power = result.covariance[0], np.array([result.powers[f"{n}.hop1"][0] for n in NAMES])
    pi = np.linalg.solve(np.eye(9) - np.kron(A, A), Q.ravel()).reshape(3, 3)
    amplify = np.sqrt(power / (np.einsum("ia,ab,ib->i", ROWS, pi, ROWS) + NOISES))
    paths, _ = paths_of(single, Error())
    information = compute_path_information(paths, power[None]).information[0]
    gain, mean = p @ ROWS.T * information, FIRST**-1.5
    x = draws.multivariate_normal(np.zeros(3), pi, runs)
    e = draws.multivariate_normal(np.zeros(3), p, runs)
    for _ in range(40):  # from the right variance to the right joint law: .95^40
        w = draws.multivariate_normal(np.zeros(3), Q, runs)
        x, e = x @ A.T + w, e @ A.T + w
        y = x @ ROWS.T + draws.normal(size=(runs, 6)) * np.sqrt(NOISES)
        sent = amplify * y
        g = mean * (1 + np.sqrt(KAPPA - 1) * draws.choice([-1, 1], size=(runs, 6)))
        z = (g * sent + draws.normal(size=(runs, 6))) / (mean * amplify)
        e = e - (z - (x - e) @ ROWS.T) @ gain.T
    for drawn, expected in ((np.sum(e**2, axis=1), result.error), (np.sum(sent**2, axis=1), result.total)):
        assert abs(drawn.mean() - expected) < 3 * drawn.std() / np.sqrt(runs)


def test_an_unobserved_loss_is_fading(single):
    node = single.nodes["a"]
    lossy = hg.dropout(node.channel, 0.8)
    network = hg.Network(single.plant, {"a": hg.Node(node.sensor, lossy, {})})
    np.testing.assert_allclose(paths_of(network, Error())[0].kappa, KAPPA[0] / 0.8)
    steady = steady_covariance(hg.linear_filter(single.plant, node.sensor, lossy))
    assert hg.design(network, budget=1).present == pytest.approx(np.trace(steady), rel=1e-9)


def test_a_wire_passes_on_what_its_sensor_measures(single):
    wired = hg.Node(hg.LinearSensor(ROWS[2:3], NOISES[2]), hg.perfect(), {})
    network = hg.Network(single.plant, {"wired": wired, "a": single.nodes["a"]})
    result = hg.design(network, budget=1)
    assert list(result.powers) == ["a.hop1"] and result.certificate.gap < 1e-12
    steady = steady_covariance(result.network.fused["best"])
    assert np.trace(steady) == pytest.approx(result.error, rel=1e-9)


def test_an_error_that_nothing_sent_reaches_costs_nothing(single):
    assert hg.design(single, target_error=5.0).total == 0.0


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({}, "design: expected a budget of power or a target error"),
        ({"budget": 1, "free": []}, "free: expected at least one transmitter"),
        ({"budget": 1, "free": ["z"]}, "free: expected names of transmitters"),
        ({"budget": -1}, "total power: expected a number of at least 0"),
        ({"budget": 1, "free": ["a"]}, "budget: expected a total of at least"),
        ({"target_error": 0.1}, "target error: expected more than 0.3104: unlimited power leaves 0.3104"),
        ({"target_error": 0.5, "budget": 3}, "target error: expected at least 0.80961, the least found within"),
        ({"budget": Budget(per_transmitter={"z": 1.0})}, "limit 'per_transmitter' of the budget"),
        ({"budget": 1, "error": Error({"x0": 0.0})}, "weight of the error: expected one that weighs something"),
        ({"budget": 1, "error": Error({"x7": 1.0})}, "weight of the error: expected numbers for some"),
    ],
)
def test_bad_input_is_one_clear_line(single, given, message):
    with pytest.raises(ValueError, match=message) as error:
        hg.design(single, **given)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("powers", "message"),
    [
        (3, "powers of a network: expected a dictionary of powers by name"),
        ({"z.hop1": [1.0]}, "powers of a network: expected names of transmitters"),
        ({"a.hop1": [1.0, 2.0]}, r"power of 'a.hop1': expected shape \(1\)"),
        ({"a.hop1": [-1.0]}, "power of 'a.hop1': expected numbers of at least 0"),
    ],
)
def test_powers_that_no_transmitter_sends_are_named(single, powers, message):
    with pytest.raises(ValueError, match=message):
        hg.planning.designed_network(single, powers, Error())


def test_an_unstable_plant_needs_a_horizon():
    plant = hg.LinearPlant([[1.1]], [[1.0]], [0.0], [[1.0]])
    network = hg.Network(plant, {"node": hg.Node(hg.LinearSensor([[1.0]], 0.5), hg.hop(1.0, 0.2), {})})
    with pytest.raises(ValueError, match="steady power: expected a stable plant, or a horizon, as what is sent"):
        hg.design(network, budget=1)
    assert hg.design(network, budget=1, error=Error(horizon=5)).certificate.gap < 1e-9


def test_a_sensor_that_varies_sends_its_designed_power_at_every_step():
    """Each step's channel is made for the signal of that step's sensor."""
    plant = hg.LinearPlant([[0.9]], [[0.1]], [1.0], [[1.0]])
    sensor = hg.model.over_time([hg.LinearSensor([[c]], 0.2) for c in (1.0, 3.0, 0.5)])
    network = hg.Network(plant, {"node": hg.Node(sensor, hg.hop(1.0, 0.3), {})})
    best = hg.design(network, budget=1.0, error=Error(horizon=3))
    sent = hg.power(best.network, horizon=3).over_time["node.hop1"]
    np.testing.assert_allclose(sent, best.powers["node.hop1"], rtol=1e-12)


@pytest.mark.parametrize(
    ("options", "got"),
    [
        ({"trigger": hg.Periodic(3)}, "a trigger"),
        ({"encoder": hg.Words(bits=2, low=-8.0, high=8.0)}, "words"),
        ({"filters": "fed back"}, "feedback"),
    ],
)
def test_senders_that_decide_or_round_are_refused(options, got):
    """A design took them for senders of all that they measure: two bits of +-8 said as much as the number itself."""
    plant, sensor = hg.LinearPlant([[0.9]], 0.1, [0.0], 1.0), hg.LinearSensor([[1.0]], 0.05)
    link = hg.perfect()
    fed_back = {"f": hg.filters.fed_back_filter(plant, sensor, link)}
    options = {"filters": fed_back} if "filters" in options else {"filters": {}, **options}

    def build(amplification):
        free = hg.Node(sensor, hg.hop(1.0, 0.2, amplification=amplification), {})
        return hg.Network(plant, {"free": free, "b": hg.Node(sensor, link, **options)})

    message = f"node 'b' of a design: expected a sensor that sends what it measures at each step, got {got}"
    with pytest.raises(hg.InputError, match=message):
        hg.design(build(1.0), budget=1.0)
    with pytest.raises(hg.InputError, match=message):
        hg.design(build, free={"amplification": (0.5, 0.01, 2.0)}, budget=0.3, starts=1)
    with pytest.raises(hg.InputError, match=message.replace("a design:", "a designed network:")):  # the rule was lost
        hg.planning.designed_network(build(1.0), {"free.hop1": [1.0]}, Error())


def test_a_plant_without_noise_has_a_steady_error_of_zero():
    """The certificate divided by the error, 0: ZeroDivisionError."""
    still = hg.LinearPlant([[0.9]], [[0.0]], [0.0], [[1.0]])
    best = hg.design(hg.Network(still, {"a": hg.Node(hg.LinearSensor([[1.0]], 0.2), hg.hop(1.0, 0.1), {})}), budget=1.0)
    assert best.error == best.certificate.gap == best.certificate.stationarity == 0.0
