import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import heliograph as hg
from heliograph.fusion.quantizer import widen_by_quantization
from heliograph.testing import check_quantizer

ESCAPE = hg.fusion.EscapeQuantizer(9, 1.0, 0.6, 0.6, 1e-3)
QUANTIZERS = {
    "uniform": hg.fusion.UniformQuantizer(8, 3.0),
    "uniform by component": hg.fusion.UniformQuantizer(5, [1.0, 2.0], [0.5, 2.0]),
    "escape": ESCAPE,
    "escape with an interval": hg.fusion.EscapeQuantizer(9, 1.0, 0.6, 0.6, 1e-3, interval=3),
    "escape by component": hg.fusion.EscapeQuantizer(3, [1e-2, 10.0], [0.3, 0.9], 0.0, [1e-3, 1.0]),
}
ROUNDING = 1e-15  # a few operations on numbers of the size of the amplitude


@pytest.mark.slow
@pytest.mark.parametrize("name", QUANTIZERS)
def test_contract(name):
    check_quantizer(QUANTIZERS[name])


def printed(x, d, p):
    """Equation (11) case by case."""
    if x < -d:
        return -d
    if x >= d:
        return d
    for n in range(1, p + 1):
        if -d + 2 * (n - 1) * d / p <= x < -d + 2 * n * d / p:
            return -d + (2 * n - 1) * d / p
    raise AssertionError("no segment")


@settings(max_examples=100)
@given(x=st.floats(-5, 5), levels=st.integers(2, 12), amplitude=st.floats(0.1, 4), scale=st.floats(0.2, 3))
def test_uniform_is_the_printed_one(x, levels, amplitude, scale):
    sent = hg.fusion.UniformQuantizer(levels, amplitude, scale).step((), [x])[1]
    boundary = (x / scale / amplitude + 1) * levels / 2
    if abs(boundary - round(boundary)) > 1e-9:  # on a boundary rounding decides
        assert sent.value[0] == pytest.approx(scale * printed(x / scale, amplitude, levels), abs=20 * ROUNDING)
    assert sent.saturated[0] == (abs(x / scale) > amplitude)
    if not sent.saturated[0]:
        assert sent.error[0] == scale * amplitude / levels
        assert abs(sent.value[0] - x) <= sent.error[0] + 100 * ROUNDING


def test_the_bound_is_attained():
    sent = hg.fusion.UniformQuantizer(4, 2.0).step((), [0.0, 1.0, -2.0])[1]
    np.testing.assert_array_equal(np.abs(sent.value - [0.0, 1.0, -2.0]), sent.error)


def test_many_levels_clip():
    x = np.linspace(-5, 5, 101)
    sent = hg.fusion.UniformQuantizer(10**9, 3.0).step((), x)[1]
    np.testing.assert_allclose(sent.value, np.clip(x, -3, 3), rtol=0, atol=3e-9 + 3 * ROUNDING)  # d / p


@pytest.mark.slow
@settings(max_examples=30)
@given(
    values=st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=12),
    levels=st.sampled_from([3, 9, 41]),
    growth=st.sampled_from([0.0, 0.6]),
)
def test_a_receiver_of_symbols_alone_knows_value_and_amplitude(values, levels, growth):
    quantizer = hg.fusion.EscapeQuantizer(levels, 1.0, 0.6, growth, 1e-3)
    here, there, stepped = quantizer.init(1), quantizer.init(1), quantizer.init(1)
    for x in values:
        symbols = quantizer.encode(here, [x])
        over_the_link = type(symbols)(*([int(s[0])] for s in symbols))  # whole numbers, nothing else
        there, received = quantizer.decode(there, over_the_link)
        here, sent = quantizer.decode(here, symbols)
        stepped, known = quantizer.step(stepped, [x])
        for mine, other in ((here, sent), (stepped, known)):
            assert np.array_equal(mine, there)  # the same operations one after another: the same bits
            assert np.array_equal(other.value, received.value) and np.array_equal(other.error, received.error)
        assert 0 <= over_the_link.segment[0] < levels and not received.saturated[0]
        assert abs(received.value[0] - x) <= received.error[0] * (1 + 1e-12)
        assert here.amplitude[0] >= 1e-3 and here.number[0] == there.number[0]


def test_an_amplitude_off_by_rounding_does_not_lose_the_receiver():
    """Where the receiver was compiled otherwise: it takes no decision by its amplitude, so rounding stays rounding."""
    rng = np.random.default_rng(0)
    here, there = ESCAPE.init(1), ESCAPE.init(1)
    there = there._replace(amplitude=there.amplitude * (1 + 1e-15))
    for x in rng.normal(size=200) * 10 ** rng.uniform(-2, 2, 200):
        symbols = ESCAPE.encode(here, [x])
        (here, sent), (there, received) = ESCAPE.decode(here, symbols), ESCAPE.decode(there, symbols)
        np.testing.assert_allclose(received.value, sent.value, rtol=1e-13)


@pytest.mark.parametrize(
    ("x", "symbols"), [(0.0, 1), (0.3, 1), (1.0, 1), (1.001, 2), (-2.0, 2), (2.1, 3), (1024.0, 11)]
)
def test_an_escape_doubles_the_amplitude(x, symbols):
    sent = ESCAPE.step(ESCAPE.init(1), [x])[1]
    assert sent.symbols[0] == symbols
    assert sent.error[0] == 2.0 ** (symbols - 1) / 9
    assert x != 0 or sent.value[0] == 0


@pytest.mark.parametrize("name", ["uniform", "escape"])
def test_what_is_no_number_arrives_as_such_and_does_no_harm(name):
    check_no_number(QUANTIZERS[name])


def check_no_number(quantizer):
    """NaN arrives as NaN and leaves the state of its component alone; what is out of reach has no bound."""
    start = quantizer.init(2)
    after, sent = quantizer.step(start, [np.nan, 0.5])
    assert np.isnan(sent.value[0]) and np.isnan(sent.error[0]) and not sent.saturated[0]
    assert np.isfinite(sent.value[1]) and np.isfinite(sent.error[1])
    assert all(
        leaf[0] == before[0] for leaf, before in zip(jax.tree.leaves(after), jax.tree.leaves(start), strict=True)
    )
    beyond = quantizer.step(start, [np.inf, -1.7e308])[1]
    assert np.isnan(beyond.error[0])


def sent_over(quantizer, values, arrives, restart=lambda k: False):
    """What a receiver delivers that knows nothing of what did not arrive, and the states of both ends."""
    here, there = quantizer.init(1), quantizer.init(1)
    for k, x in enumerate(values):
        symbols = quantizer.encode(here, [x], restart=restart(k))
        here = quantizer.decode(here, symbols)[0]
        if arrives[k]:
            there, received = quantizer.decode(there, symbols)
            yield k, x, received, there
    assert np.all(here.synchronised)


@settings(max_examples=10)
@given(seed=st.integers(0, 10**6), interval=st.integers(1, 7), loss=st.floats(0, 0.5))
def test_a_bound_that_is_said_holds_whatever_was_lost_and_is_published_again_within_the_interval(seed, interval, loss):
    rng = np.random.default_rng(seed)
    values, arrives = rng.normal(size=25) * 10 ** rng.uniform(-4, 4, 25), rng.random(25) > loss
    quantizer = hg.fusion.EscapeQuantizer(9, 1.0, 0.6, 0.6, 1e-3, interval=interval)
    missed = [k for k in range(25) if not arrives[k]]
    for k, x, received, state in sent_over(quantizer, values, arrives):
        known = np.isfinite(received.error[0])
        assert known == state.synchronised[0] == np.isfinite(received.value[0])
        assert not known or abs(received.value[0] - x) <= received.error[0] * (1 + 1e-12)
        start = k - k % interval  # the last value that began from the first amplitude
        assert known or any(start <= lost <= k for lost in missed)  # the values since then have not all arrived


def test_without_an_interval_a_loss_is_said_and_a_request_mends_it():
    values = [0.3, 40.0, 0.1, 0.2, 0.3, 0.4]
    results = {k: (r.error[0], s.synchronised[0]) for k, _, r, s in
             sent_over(ESCAPE, values, [True, False, True, True, True, True], lambda k: k == 4)}  # fmt: skip
    assert (
        [k for k, (error, _) in results.items() if np.isnan(error)]
        == [2, 3]
        == [k for k, (_, synchronised) in results.items() if not synchronised]
    )


def test_nothing_that_is_no_number_counts_as_lost():
    results = [s.synchronised[0] for *_, s in sent_over(ESCAPE, [0.1, np.nan, 0.2], [True, False, True])]
    assert results == [True, True]


@settings(max_examples=40)
@given(
    x=st.floats(allow_nan=False, allow_infinity=True),
    amplitude=st.floats(1e-290, 1e308),
    levels=st.sampled_from([3, 10**9 + 1]),
)
def test_at_the_edge_of_numbers_a_value_saturates_with_a_flag(x, amplitude, levels):
    escape = hg.fusion.EscapeQuantizer(levels, amplitude, 0.5, 0.1, 1e-290)
    quantizers = [escape, hg.fusion.UniformQuantizer(levels, amplitude)]
    for quantizer in quantizers:
        state, sent = quantizer.step(quantizer.init(1), [x])
        assert np.isfinite(sent.value[0]) and np.isnan(sent.error[0]) == sent.saturated[0]
        if not sent.saturated[0]:  # by thirds, since the difference of two numbers may be none; to rounding
            rounding = 1e-15 * abs(x) + np.finfo(float).tiny
            assert abs(sent.value[0] / 3 - x / 3) <= sent.error[0] / 3 * (1 + 1e-12) + rounding
        assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(state))
    assert escape.step(escape.init(1), [x])[1].saturated[0] <= (abs(x) > 1e307)


def dominates(bound, p, d, directions):
    """sup over e, mu of E[(a'(e - mu))^2] = (sqrt(a'Pa) + sum |a_j| D_j)^2, since e and mu may be of one sign."""
    worst = (np.sqrt(np.einsum("ki,ij,kj->k", directions, p, directions)) + np.abs(directions) @ d) ** 2
    return worst <= np.einsum("ki,ij,kj->k", directions, bound, directions) * (1 + 1e-12)


@settings(max_examples=40)
@given(seed=st.integers(0, 10**6), n=st.integers(1, 4))
def test_the_widened_bound_dominates_every_correlation(seed, n):
    rng = np.random.default_rng(seed)
    root, d = rng.normal(size=(n, n)), rng.exponential(size=n)
    p = root @ root.T
    with jax.enable_x64(True):
        bound = np.asarray(widen_by_quantization(p, d))
    assert np.all(dominates(bound, p, d, rng.normal(size=(200, n))))
    assert np.trace(bound) == pytest.approx((np.sqrt(np.trace(p)) + d.sum()) ** 2, rel=1e-12)  # the best t
    if n == 1:
        assert bound[0, 0] == pytest.approx((np.sqrt(p[0, 0]) + d[0]) ** 2, rel=1e-12)  # attained


def test_widening_at_its_limits():
    p, d = np.array([[2.0, 0.3], [0.3, 1.0]]), np.array([0.1, 0.2])
    with jax.enable_x64(True):
        np.testing.assert_array_equal(widen_by_quantization(p, 0 * d), p)
        np.testing.assert_allclose(widen_by_quantization(0 * p, d), 0.3 * np.diag(d), rtol=1e-15)
        assert np.all(np.isnan(np.diag(widen_by_quantization(p, np.array([0.1, np.nan])))))


def test_an_amplitude_that_follows_the_data_can_understate():
    """Why such quantizers claim "nominal": errors are rare and large, and the quantizer is coarse just then.

    e = K with probability q, else 0, and mu = -D with D = K and 0: E[(e - mu)^2] = 4 q K^2, and for every fixed D the
    bound holds. Yet the mean of the bounds (sqrt(q) K + D)^2 is (q (1 + sqrt q)^2 + (1 - q) q) K^2.
    """
    q, k = 0.01, 1.0
    with jax.enable_x64(True):
        bounds = [float(widen_by_quantization(np.array([[q * k**2]]), np.array([d]))[0, 0]) for d in (k, 0.0)]
    assert q * bounds[0] + (1 - q) * bounds[1] < 0.6 * 4 * q * k**2
    assert hg.fusion.UniformQuantizer(8, 1.0).claim("exact") == "nominal"
    assert ESCAPE.claim("upper") == "nominal"
    assert {item.claim("none") for item in QUANTIZERS.values()} == {"none"}


def test_a_bound_does_not_hold_of_what_a_saturated_quantizer_leaves():
    """Small estimates are those after a loss, x = 0 + e with the variance before data, of which the claim is a mean.

    Behind a gain of 0 or 10, each with 1/2, the best linear filter claims about 1 - 5^2 / 50 = 1/2. Within an amplitude
    that only estimates without a signal fit into, errors are the state itself, of variance 1, to 10 %.
    """
    plant, sensor = hg.LinearPlant([[0.5]], 0.75, [0.0], 1.0), hg.LinearSensor([[1.0]], 0.01)
    link = hg.hop(hg.Discrete([0.0, 10.0], [0.5, 0.5]), 0.01)
    node = hg.Node(sensor, link, {"f": hg.linear_filter(plant, sensor, link)})
    fusion = hg.Fusion("f", hg.CovarianceIntersection(), hg.fusion.UniformQuantizer(64, 0.05))
    with pytest.warns(UserWarning, match="no valid covariance"):
        record = hg.monte_carlo(hg.Network(plant, {"a": node, "b": node}, {"c": fusion}), 1, 4000, 0)
    fused = record.estimates["fused"]["c"]
    there = np.isfinite(fused.covariance[:, 0, 0, 0])
    error = (record.truth - fused.mean)[there, 0, 0]
    assert fused.claim == "nominal" and 0.2 < there.mean() < 0.4
    assert np.mean(error**2) > 1.5 * fused.covariance[there, 0, 0, 0].max()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: hg.fusion.UniformQuantizer(1, 1.0), "levels: expected a whole number of at least 2, got 1"),
        (lambda: hg.fusion.UniformQuantizer(2.5, 1.0), "levels: expected a whole number of at least 2"),
        (lambda: hg.fusion.UniformQuantizer(8, 0.0), "amplitude: expected positive numbers, got 0.0"),
        (lambda: hg.fusion.UniformQuantizer(8, [1.0, np.inf]), "amplitude: expected finite numbers"),
        (lambda: hg.fusion.UniformQuantizer(8, [[1.0], [2.0, 3.0]]), "amplitude: expected an array of numbers"),
        (lambda: hg.fusion.UniformQuantizer(8, 1.0, -1.0), "scale: expected positive numbers"),
        (lambda: hg.fusion.UniformQuantizer(8, "wide"), "amplitude: expected an array of numbers"),
        (lambda: hg.fusion.UniformQuantizer(9, 5e-324), r"amplitude times scale: expected from 2e-307 to 1.8e\+308"),
        (lambda: hg.fusion.UniformQuantizer(9, 1e200, 1e200), "amplitude times scale: expected from 2e-307"),
        (lambda: hg.fusion.EscapeQuantizer(9, 1.0, 0.5, 0.1, 1e-320), "smallest amplitude: expected from 2e-307"),
        (lambda: hg.fusion.EscapeQuantizer(9, 1.0, 0.5, 0.1, 1e-3, 0), "interval: expected a positive whole number"),
        (lambda: hg.fusion.EscapeQuantizer(9, 1.0, 1.0, 0.1, 1e-3), "decay: expected numbers between 0 and 1, got 1.0"),
        (lambda: hg.fusion.EscapeQuantizer(9, 1.0, 0.5, -0.1, 1e-3), "growth: expected no negative number"),
        (
            lambda: hg.fusion.EscapeQuantizer(8, 1.0, 0.5, 0.1, 1e-3),
            "levels: expected an odd number, so that zero is a level",
        ),
        (lambda: hg.fusion.EscapeQuantizer(9, 1.0, 0.5, 0.1, 0.0), "smallest amplitude: expected positive numbers"),
        (lambda: hg.fusion.UniformQuantizer(8, [1.0, 2.0]).check(3), r"quantizer: expected numbers or shape \(3,\)"),
    ],
)
def test_bad_quantizers(call, message):
    with pytest.raises(ValueError, match=message):
        call()


class _Optimist(hg.fusion.UniformQuantizer):
    """A quantizer that states half its error."""

    def step(self, state, value):
        state, sent = super().step(state, value)
        return state, sent._replace(error=sent.error / 2)


def test_the_check_finds_a_bound_that_does_not_hold():
    with pytest.raises(AssertionError, match="error: expected a bound, exceeded by"):
        check_quantizer(_Optimist(8, 3.0))
