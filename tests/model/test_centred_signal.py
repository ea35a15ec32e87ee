"""What is taken off before sending and added back after: the same mean, less power, less of the gain's noise."""

import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import heliograph as hg
from heliograph.model import centred, delayed, expected_signal
from heliograph.random_affine.moments.second_moments import second_order
from tests.random_affine.conditional import conditional_moments

HORIZON, RUNS = 8, 4000
Z_LIMIT = 4.0  # one number in 30,000 beyond it by chance; the seed is fixed and a few dozen numbers are compared
PLANT = hg.LinearPlant([[0.95, 0.2], [-0.2, 0.9]], 0.05, [8.0, -4.0], [[0.5, 0.1], [0.1, 0.4]], [[0.5], [0.0]])
SENSOR = hg.LinearSensor([[1.0, 0.5]], 0.1)
INPUTS = np.linspace(0.0, 3.0, HORIZON)[:, None]
GAIN = hg.Discrete([0.7, 1.0, 1.1], [0.3, 0.4, 0.3])
HOPS = [hg.hop(GAIN, 0.1), hg.hop(hg.Rayleigh(0.6), 0.02)]
RELAYED = hg.amplify_and_forward(HOPS)
numbers = st.floats(-50.0, 50.0)


@given(y=numbers, r=numbers)
def test_the_mean_stays_and_the_spread_is_that_of_what_is_sent(y: float, r: float) -> None:
    """E[z | y] as without, Var(z | y) as of y - r: of any hops, from their moments."""
    result, plain = (conditional_moments(item, [y], 2) for item in (centred(RELAYED, r), RELAYED))
    sent = conditional_moments(RELAYED, [y - r], 2)
    variance = sent[0] - sent[1] ** 2
    size = 1 + y**2 + r**2  # rounding of differences of squares
    np.testing.assert_allclose(result[1], plain[1], rtol=0, atol=1e-12 * size)
    np.testing.assert_allclose(result[0] - result[1] ** 2, variance, rtol=0, atol=1e-12 * size)


def test_the_expected_signal_is_the_mean() -> None:
    mean, results = np.array([8.0, -4.0]), []
    for u in INPUTS[:, 0]:
        mean = np.array(PLANT.matrix) @ mean + [0.5 * u, 0.0]
        results.append(mean @ [1.0, 0.5])
    np.testing.assert_allclose(expected_signal(PLANT, SENSOR, HORIZON, INPUTS)[:, 0], results, rtol=1e-14)
    moving = hg.Plant(lambda x, u: jnp_sine(x), 0.1, [0.3], [[1.0]])
    curved = expected_signal(moving, hg.Sensor(lambda x: x**2, 0.1), 2)
    np.testing.assert_allclose(curved[:, 0], [np.sin(0.3) ** 2, np.sin(np.sin(0.3)) ** 2], rtol=1e-14)


def jnp_sine(x: object) -> object:
    import jax.numpy as jnp

    return jnp.sin(jnp.asarray(x))


@pytest.fixture(scope="module")
def result() -> dict[str, dict[str, hg.Statistics]]:
    """The plain relay, less the trajectory, less a constant between the hops, and a bursty link less a constant."""
    bursts = hg.gilbert_elliott(hg.hop(GAIN, 0.1), hg.hop(0.1, 0.4), 0.3, 0.2)
    channels = {
        "plain": centred(RELAYED, hg.model.OverTime(np.zeros((HORIZON, 1)))),  # less nothing, as one program with
        "trajectory": centred(RELAYED, hg.model.OverTime(expected_signal(PLANT, SENSOR, HORIZON, INPUTS))),
        "relay": hg.amplify_and_forward([HOPS[0], centred(HOPS[1], 6.0)]),
        "bursts": centred(bursts, 7.0),
    }
    nodes = {
        name: hg.Node(SENSOR, channel, {"linear": hg.linear_filter(PLANT, SENSOR, channel)})
        for name, channel in channels.items()
    }
    return hg.monte_carlo(hg.Network(PLANT, nodes), HORIZON, RUNS, 3, keep=hg.Statistics(), inputs=INPUTS)


@pytest.mark.parametrize("name", ["plain", "trajectory", "relay", "bursts"])
def test_claims_are_exact(result: dict[str, dict[str, hg.Statistics]], name: str) -> None:
    s = result[name]["linear"]
    assert s.claim == "exact"
    batch = s.outer / s.count[:, None, None, None]
    error = batch.std(axis=0, ddof=1) / np.sqrt(len(batch))
    assert np.max(np.abs(s.actual() - s.claimed()) / error) < Z_LIMIT


@pytest.mark.slow
@pytest.mark.parametrize(("name", "sent"), [("plain", 1.0), ("trajectory", 0.0)])
def test_the_error_is_that_of_the_power_that_is_sent(
    result: dict[str, dict[str, hg.Statistics]], name: str, sent: float
) -> None:
    """P^-1 = (A P A' + Q)^-1 + c' c / N, N = (nu_1 nu_2 s + nu_2 .1 + .02) / (mu_1 mu_2)^2 - s + .1."""
    a, c, q = np.array(PLANT.matrix), np.array([[1.0, 0.5]]), 0.05 * np.eye(2)
    (mu_1, nu_1), (mu_2, nu_2) = ((float(h.law.moment(1)), float(h.law.moment(2))) for h in HOPS)
    p = values = np.array(PLANT.initial_covariance)
    claims = []
    for mean in expected_signal(PLANT, SENSOR, HORIZON, INPUTS)[:, 0]:
        p, values = a @ p @ a.T + q, a @ values @ a.T + q
        variance = (c @ values @ c.T).item()
        second = variance + 0.1 + sent * mean**2
        noise = (nu_1 * nu_2 * second + nu_2 * 0.1 + 0.02) / (mu_1 * mu_2) ** 2 - (second - 0.1)
        p = np.linalg.inv(np.linalg.inv(p) + c.T @ c / noise)
        claims.append(p)
    np.testing.assert_allclose(result[name]["linear"].claimed(), claims, rtol=1e-9)


def test_the_gain_noise_of_one_path_of_many_is_that_of_the_path() -> None:
    """Each number of several with a reference of its own, as each path with its own."""
    together = second_order(centred(hg.parallel([RELAYED, HOPS[0]]), [3.0, -2.0]))
    apart = second_order(hg.parallel([centred(RELAYED, 3.0), centred(HOPS[0], -2.0)]))
    np.testing.assert_allclose(together.mean_gain, apart.mean_gain, atol=1e-14)
    np.testing.assert_allclose(together.offset, apart.offset, atol=1e-14)
    np.testing.assert_allclose(together.spread.center, apart.spread.center, atol=1e-12)


def test_less_nothing_is_plain() -> None:
    for less, plain in zip(*(jax.tree.leaves(second_order(c)) for c in (centred(RELAYED, 0.0), RELAYED)), strict=True):
        np.testing.assert_allclose(less, plain, rtol=0, atol=1e-15)


def test_angles_stay_angles() -> None:
    compass = hg.Sensor(lambda x: x[:1], 0.01, outputs=("heading",), circular=("heading",))
    plant = hg.Plant(lambda x, u: x, 0.01, [0.0], [[0.1]], states=("heading",), circular=("heading",))
    link = hg.hop(1.0, 0.02)
    plain, less = (hg.cubature_filter(plant, compass, item) for item in (link, centred(link, 0.4)))
    for z in (0.1, 3.1, -3.1, 6.3):  # without a random gain nothing changes
        (_, single), (_, other) = (item.step(item.init(), [z]) for item in (plain, less))
        np.testing.assert_allclose(other.mean, single.mean, atol=1e-14)
        np.testing.assert_allclose(other.covariance, single.covariance, rtol=1e-12)
    with pytest.raises(ValueError, match="gain 1 on circular outputs"):
        hg.cubature_filter(plant, compass, centred(hg.hop(GAIN, 0.1), 0.4))


def test_bad_references_are_one_clear_line() -> None:
    with pytest.raises(ValueError, match=r"reference: expected shape \(1\), got shape \(2,\)"):
        centred(RELAYED, [1.0, 2.0])
    for item in (delayed(RELAYED, 1), hg.erasure(RELAYED, 0.5)):
        with pytest.raises(ValueError, match="put `centred` inside"):
            centred(item, 1.0)
    with pytest.raises(ValueError, match="inputs: expected an array"):
        expected_signal(PLANT, SENSOR, 3)
    inside = delayed(centred(RELAYED, 2.0), 1)  # what the message says
    assert hg.linear_filter(hg.LinearPlant([[0.9]], 0.1, [2.0], [[1.0]]), hg.LinearSensor([[1.0]], 0.1), inside)
