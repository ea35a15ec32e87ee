"""What a filter that assumes no memory claims, and its true error before any data."""

import numpy as np
import pytest

import heliograph as hg
from tests.filters.modal_problems import BAD as LINK
from tests.filters.modal_problems import BURSTS, GOOD, PLANT, RELAY, SENSOR, bursts, chain_a

true_error, without_memory, memory_matters = hg.filters.true_error, hg.model.without_memory, hg.model.memory_matters
Modes = hg.random_affine.Modes
CONVERGED = 200  # steps, after which nothing of what is looked at changes
HOPS = [hg.model.autoregressive_fading(m, s, r, 0.05) for m, s, r in ((1.0, 0.4, 0.95), (0.8, 0.3, 0.9))]


def memoryless(plant, sensor, channel):
    return hg.filters.memoryless_filter(plant, sensor, channel)


def test_the_filter_without_memory_claims_less_than_half_of_its_error():
    result = true_error(memoryless(PLANT, SENSOR, bursts()), PLANT, SENSOR, bursts(), CONVERGED)
    assert result.claimed[-1, 0, 0] == pytest.approx(0.113530, abs=6e-7)
    assert result.true[-1, 0, 0] == pytest.approx(0.276761, abs=6e-7)


def test_a_filter_that_takes_signals_as_current_ignores_memory_too():
    """Without any delay it is the filter without memory, and claims no more of itself."""
    current = hg.filters.as_current_filter(PLANT, SENSOR, bursts())
    assert current.claim == "nominal"
    assert hg.filters.as_current_filter(PLANT, SENSOR, hg.hop(1.0, 0.1)).claim == "exact"


@pytest.mark.parametrize("delay", [1, hg.Discrete([0, 1], [0.5, 0.5])])
def test_behind_delays_that_remember_nothing_no_memory_is_missing(delay):
    channel = hg.hop(1.0, 0.1, delay=delay)
    blind, best = memoryless(PLANT, SENSOR, channel), hg.linear_filter(PLANT, SENSOR, channel)
    assert blind.claim == "exact"
    z = [[0.3], [0.1]]
    np.testing.assert_array_equal(blind.run(z).covariances, best.run(z).covariances)  # the same computation


def test_delays_that_last_are_taken_as_drawn_anew():
    lasting = hg.hop(1.0, 0.1, delay=hg.random_affine.MarkovChain([[0.9, 0.1], [0.1, 0.9]]))
    anew = hg.hop(1.0, 0.1, delay=hg.Discrete([0, 1], [0.5, 0.5]))
    blind, best = memoryless(PLANT, SENSOR, lasting), hg.linear_filter(PLANT, SENSOR, anew)
    assert (blind.claim, best.claim) == ("nominal", "exact")
    z = [[0.3], [0.1], [0.4]]
    np.testing.assert_allclose(blind.run(z).covariances, best.run(z).covariances, rtol=1e-12)  # the same law


def test_two_hops_that_drift():
    plant = hg.LinearPlant([[0.98, 0.1], [0, 0.95]], np.diag([0.002, 0.02]), [1.0, 0.0], np.diag([1.0, 0.2]))
    sensor, channel = hg.LinearSensor([[1.0, 0.0]], 0.05), hg.amplify_and_forward(HOPS)
    result = true_error(memoryless(plant, sensor, channel), plant, sensor, channel, 100)
    np.testing.assert_allclose(np.diag(result.claimed[-1]), [0.084914, 0.138575], atol=6e-7)
    np.testing.assert_allclose(np.diag(result.true[-1]), [0.382477, 0.176031], atol=6e-7)
    np.testing.assert_allclose(result.ratio[-1], np.diag(result.true[-1]) / np.diag(result.claimed[-1]))


def test_a_filter_for_two_fadings_in_one():
    two = hg.LinearSensor([[1.0], [1.0]], 0.05 * np.eye(2))
    apart, together = (hg.parallel([link] * 2) for link in (bursts(), hg.shared(bursts(), "road")))
    result = true_error(hg.linear_filter(PLANT, two, apart), PLANT, two, together, CONVERGED)
    assert result.claimed[-1, 0, 0] == pytest.approx(0.148447, abs=6e-7)
    assert result.true[-1, 0, 0] == pytest.approx(0.238690, abs=6e-7)


@pytest.mark.parametrize("lag", [0.3, 0.5, 0.7, 0.9, 0.95, 0.99])
def test_the_excess_grows_with_the_correlation_as_in_closed_form(lag):
    """Scalar and stationary: true = claim + D 2 c lambda a / (1 - c lambda a), D = K^2 Var(g) E x^2 / (1 - c^2)."""
    p = np.array([0.375, 0.625])
    channel = bursts(lag * np.eye(2) + (1 - lag) * p)
    item = memoryless(PLANT, SENSOR, channel)
    result = true_error(item, PLANT, SENSOR, channel, CONVERGED)
    gain = float(item.planned(np.zeros((CONVERGED, 0))).steps.values.gain[-1, 0, 0])
    c, power = (1 - gain * 0.7) * 0.98, 0.04 / (1 - 0.98**2)
    share = gain**2 * (0.8**2 * p[0] * p[1]) * power / (1 - c**2)
    claim, moved = result.claimed[-1, 0, 0], c * lag * 0.98
    assert result.true[-1, 0, 0] == pytest.approx(claim + share * 2 * moved / (1 - moved), rel=1e-9)
    known = {0.3: 1.20, 0.5: 1.40, 0.7: 1.73, 0.9: 2.35, 0.95: 2.59, 0.99: 2.83}
    assert result.ratio[-1, 0] == pytest.approx(known[lag], abs=0.006)


@pytest.mark.slow
@pytest.mark.parametrize(
    "channel", [bursts(), hg.amplify_and_forward(HOPS), hg.model.with_direct_link(bursts(), HOPS[0])]
)
def test_the_exact_filter_claims_its_truth(channel):
    result = true_error(hg.linear_filter(PLANT, SENSOR, channel), PLANT, SENSOR, channel, 60)
    np.testing.assert_allclose(result.claimed, result.true, rtol=1e-12)


NOISE_ONLY = Modes(hg.random_affine.MarkovChain(BURSTS), [hg.hop(1.0, 0.05), hg.hop(1.0, 0.5)])
ONE_MEAN = Modes(
    hg.random_affine.MarkovChain(BURSTS), [hg.hop(1.0, 0.05), hg.hop(hg.Discrete([0.5, 1.5], [0.5, 0.5]), 0.05)]
)


@pytest.mark.parametrize(
    ("channel", "matters"),
    [
        (bursts(), True),
        (NOISE_ONLY, False),
        (ONE_MEAN, False),
        (HOPS[0], True),
        (RELAY, False),
        (bursts([[0.375, 0.625]] * 2), False),
        (hg.model.over_time([Modes(chain_a(k), [GOOD, LINK]) for k in range(4)]), True),
    ],
)
def test_a_claim_is_lowered_where_memory_matters_and_only_there(channel, matters):
    """Cov(Hbar_k, Hbar_(k+t)) = 0 for all t: noise may be louder in bursts, and the claim is the truth still."""
    assert memory_matters(channel) == matters
    assert memoryless(PLANT, SENSOR, channel).claim == ("nominal" if matters else "exact")
    if not isinstance(channel, hg.model.OverTime):
        result = true_error(memoryless(PLANT, SENSOR, channel), PLANT, SENSOR, channel, 30)
        assert np.allclose(result.claimed, result.true, rtol=1e-12) != matters


def test_in_a_world_without_memory_the_claim_is_the_truth():
    world = without_memory(bursts())
    item = hg.linear_filter(PLANT, SENSOR, world)
    result = true_error(item, PLANT, SENSOR, world, 30)
    assert item.claim == "exact"
    np.testing.assert_allclose(result.claimed, result.true, rtol=1e-12)


def test_claims_of_filters_that_assume_no_memory():
    assert hg.cubature_filter(PLANT, SENSOR, bursts()).claim == "nominal"
    assert hg.extended_filter(PLANT, SENSOR, bursts()).claim == "nominal"
    assert hg.filters.mixture_filter(PLANT, SENSOR, bursts()).claim == "nominal"
    assert hg.mean_gain_filter(PLANT, SENSOR, bursts()).claim == "nominal"
    assert hg.cubature_filter(PLANT, SENSOR, NOISE_ONLY).claim == "exact"
    assert hg.linear_filter(PLANT, SENSOR, bursts()).claim == "exact"


def test_of_a_channel_that_varies_each_step_keeps_its_law():
    """Without memory the modes have at step k the law that they have there with it: the first step is the same."""
    with_it = hg.model.over_time([Modes(chain_a(k), [GOOD, LINK]) for k in range(4)])
    item = memoryless(PLANT, SENSOR, with_it)
    result, alone = (true_error(item, PLANT, SENSOR, c, 4) for c in (with_it, without_memory(with_it)))
    np.testing.assert_allclose(alone.true, alone.claimed, rtol=1e-12)
    np.testing.assert_allclose(result.true[0], result.claimed[0], rtol=1e-12)
    assert result.true[-1, 0, 0] > 1.01 * result.claimed[-1, 0, 0]


def test_a_start_that_is_not_stationary_is_no_claim_of_the_long_run():
    late = Modes(hg.random_affine.MarkovChain(BURSTS, [1.0, 0.0]), [hg.hop(1.0, 0.05), hg.hop(1.0, 0.5)])
    assert memory_matters(late) and hg.cubature_filter(PLANT, SENSOR, late).claim == "nominal"


def test_gains_that_depend_on_data_have_no_truth_before_data():
    with pytest.raises(ValueError, match=r"^filter: expected one whose gains depend on no data, got GaussianFilter"):
        true_error(hg.cubature_filter(PLANT, SENSOR, bursts()), PLANT, SENSOR, bursts(), 5)
