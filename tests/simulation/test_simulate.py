import equinox as eqx
import jax
import numpy as np
import pytest

import heliograph as hg
from heliograph.filters.base import corrects, predicts
from heliograph.testing import check_filter

PLANT = hg.LinearPlant([[0.9, 0.1], [0.0, 0.8]], 0.1, [0.0, 1.0], 0.3, input_matrix=[[1.0], [0.5]])
CHANNEL = hg.amplify_and_forward([hg.hop(hg.Rayleigh(0.7), 0.1), hg.hop(hg.random_affine.bernoulli(0.8), 0.05)])
HORIZON, RUNS = 7, 70  # more than one block of runs, and not a multiple of it
INPUTS = np.linspace(-1, 1, HORIZON)[:, None]


class Silent(hg.filters.AbstractFilter):
    """Gives the initial mean and claims nothing."""

    claim: str = "none"
    states: tuple = eqx.field(static=True, default=("p", "v"))
    inputs: tuple = eqx.field(static=True, default=("u0",))
    received: int = eqx.field(static=True, default=1)

    def init(self):
        return np.zeros(2)

    @predicts
    def predict(self, state, u=(), k=0):
        return state

    @corrects
    def correct(self, state, z, k=0):
        nothing = jax.numpy.where(jax.numpy.isnan(z[0]), 0.0, jax.numpy.nan)
        return state, hg.model.Innovation(z, jax.numpy.full((1, 1), jax.numpy.nan), nothing)

    def estimate(self, state):
        return hg.model.Estimate(jax.numpy.asarray(state), jax.numpy.full((2, 2), jax.numpy.nan), "none")


def node(row, channel=CHANNEL):
    sensor = hg.LinearSensor([row], 0.05)
    filters = {
        "relay_aware": hg.cubature_filter(PLANT, sensor, channel),
        "linear": hg.linear_filter(PLANT, sensor, channel),
        "silent": Silent(),
    }
    return hg.Node(sensor, channel, filters)


NODES = {"b": node([1.0, 0.0]), "a": node([0.5, 1.0]), "direct": node([0.0, 1.0], hg.perfect())}
DEAF = hg.Node(NODES["b"].sensor, hg.model.silent(), {"deaf": NODES["b"].filters["linear"]})
STATIC = {
    "b": hg.fusion.UniformQuantizer(32, 0.8),  # saturates now and then
    "a": hg.fusion.UniformQuantizer(16, 12.0),
    "direct": hg.fusion.UniformQuantizer(64, 10.0),
}
DOUBLED = [hg.fusion.UniformQuantizer(8 * 2 ** (k > 2), 12.0) for k in range(HORIZON)]
FUSED = {
    "plain": hg.Fusion("linear", hg.fusion.WeightedFusion([0.2, 0.3, 0.5])),
    "static": hg.Fusion("linear", hg.fusion.WeightedFusion([0.2, 0.3, 0.5]), STATIC),
    "escape": hg.Fusion("linear", hg.CovarianceIntersection(), hg.fusion.EscapeQuantizer(9, 0.1, 0.6, 0.6, 1e-3)),
    "by component": hg.Fusion(
        "linear", hg.fusion.EqualIntersection(), hg.fusion.EscapeQuantizer(41, [3.0, 2.0], [0.6, 0.5], 0.0, 0.1)
    ),
    "over time": hg.Fusion("linear", hg.fusion.EqualIntersection(), hg.model.over_time(DOUBLED)),
    "mean": hg.Fusion("silent", hg.fusion.WeightedFusion([0.2, 0.3, 0.5])),
}
LINKED = ["static", "escape", "by component", "over time"]
NETWORK = hg.Network(PLANT, {**NODES, "silence": DEAF}, FUSED)


@pytest.fixture(scope="module")
def record():
    return hg.monte_carlo(NETWORK, HORIZON, RUNS, 11, inputs=INPUTS)


@pytest.fixture(scope="module")
def statistics():
    """Of many runs; chunks of at most one block a lane are one program."""
    return hg.monte_carlo(NETWORK, HORIZON, 2048, 3, hg.Statistics(), INPUTS, chunk=256)


def leaves(record):
    return [record.truth, *record.measurements.values(), *jax.tree.leaves(record.estimates)]


def test_shapes_and_order(record):
    assert record.truth.shape == (RUNS, HORIZON, 2)
    assert list(record.measurements) == ["b", "a", "direct", "silence"]
    assert record.measurements["a"].shape == (RUNS, HORIZON, 1)
    assert list(record.estimates["b"]) == ["relay_aware", "linear", "silent"]
    assert all(isinstance(leaf, np.ndarray) and leaf.dtype == np.float64 for leaf in leaves(record))
    assert all(line.startswith("fused/static") for line in record.failures())


@pytest.mark.slow
def test_chunks_change_no_bit(record):
    other = hg.monte_carlo(NETWORK, HORIZON, RUNS, 11, inputs=INPUTS, chunk=64)
    pairs = zip(leaves(record), leaves(other), strict=True)
    assert all(np.array_equal(a, b, equal_nan=True) for a, b in pairs)
    for name, uplink in record.uplinks.items():
        assert np.array_equal(uplink.saturated, other.uplinks[name].saturated)


@pytest.mark.slow
def test_fewer_runs_are_the_first_of_more_runs(record):
    few = hg.monte_carlo(NETWORK, HORIZON, 5, 11, inputs=INPUTS)
    assert np.array_equal(few.truth, record.truth[:5])
    assert np.array_equal(few.measurements["b"], record.measurements["b"][:5])


def test_another_node_and_links_change_nothing_else(record):
    more = {"new": node([1.0, 1.0]), **NODES}
    few = {name: hg.Node(n.sensor, n.channel, {"linear": n.filters["linear"]}) for name, n in more.items()}
    other = hg.monte_carlo(hg.Network(PLANT, few), HORIZON, RUNS, 11, inputs=INPUTS)
    assert np.array_equal(other.truth, record.truth) and other.uplinks == {} and other.failures() == []
    assert list(record.uplinks) == LINKED
    for name in NODES:
        assert np.array_equal(other.measurements[name], record.measurements[name])
        np.testing.assert_allclose(other.estimates[name]["linear"].mean, record.estimates[name]["linear"].mean)


@pytest.mark.slow
def test_a_recording_is_run_step_by_step_and_through_the_same_links(record):
    measurements = {name: z[3].copy() for name, z in record.measurements.items()}
    through = hg.run(NETWORK, measurements, INPUTS)
    for name, uplink in record.uplinks.items():
        assert np.array_equal(through.uplinks[name].symbols, uplink.symbols[3])
        np.testing.assert_allclose(
            through.estimates["fused"][name].mean, record.estimates["fused"][name].mean[3], rtol=0, atol=1e-9
        )
    measurements["a"][2] = np.nan
    result = hg.run(NETWORK, measurements, INPUTS)
    for name, part in NODES.items():
        for label in ("relay_aware", "linear"):
            stream = hg.Stream(part.filters[label])
            for k in range(HORIZON):
                estimate = stream.push(measurements[name][k], INPUTS[k])
                together = result.estimates[name][label]
                # The same arithmetic in another compilation: equal to rounding.
                np.testing.assert_allclose(estimate.mean, together.mean[k], rtol=0, atol=1e-12)
                np.testing.assert_allclose(estimate.covariance, together.covariance[k], rtol=0, atol=1e-12)


def test_the_true_channel_makes_the_data_and_the_filter_believes_another(statistics):
    (observation, error), (deaf, other) = statistics["b"]["linear"].rmse(), statistics["silence"]["deaf"].rmse()
    assert observation < deaf - 4 * np.hypot(error, other)


def test_a_lost_covariance_is_reported_with_its_step():
    plant = hg.Plant(lambda x, u: x**3, 1e-3, [5.0], 1.0)  # leaves the range of numbers after a few steps
    sensor = hg.LinearSensor([[1.0]], 1.0)
    network = hg.Network(
        plant, {"n": hg.Node(sensor, hg.perfect(), {"f": hg.cubature_filter(plant, sensor, hg.perfect())})}
    )
    with pytest.warns(UserWarning, match="the prediction to its time is no finite number"):
        assert not hg.run(network, {"n": np.full((12, 1), np.nan)}).failures()  # refused before it is lost
    with pytest.warns(UserWarning) as said:
        record = hg.monte_carlo(network, 12, 1, 0)
    (line,) = record.failures()
    world = "the true state, which the plant makes: no finite number from step 5 in 1 of 1 runs"
    assert str(said[0].message) == world and str(said[-1].message) == line
    assert line.startswith("n/f: no valid covariance from step ")
    step = int(line.split("step ")[1].split()[0])
    assert 0 < step < 12 and np.all(np.isfinite(record.estimates["n"]["f"].mean[0, : step - 1]))


def sent_step_by_step(fusion, record, run):
    """What each node's quantizer delivers of its filter's means in one run, by a plain loop."""
    delivered = []
    for name in NODES:
        quantizer = fusion.quantizer[name] if isinstance(fusion.quantizer, dict) else fusion.quantizer
        state = quantizer.init(2)
        for k in range(HORIZON):
            state, sent = quantizer.step(state, record.estimates[name][fusion.filter].mean[run, k])
            delivered.append(sent)
    return [
        np.stack([getattr(s, part) for s in delivered]).reshape(3, HORIZON, 2).swapaxes(0, 1)
        for part in ("value", "error", "saturated", "symbols")
    ]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["static", "escape", "by component"])
def test_quantizers_in_the_scan_are_quantizers_in_a_loop(record, name):
    fusion, uplink = FUSED[name], record.uplinks[name]
    for run in (0, 5):
        value, error, saturated, symbols = sent_step_by_step(fusion, record, run)
        np.testing.assert_array_equal(uplink.saturated[run], saturated)
        np.testing.assert_array_equal(uplink.symbols[run], symbols)
        k = int(np.flatnonzero(~saturated.any(axis=(1, 2)))[-1])
        local = []
        for i, node in enumerate(NODES):
            p, d = record.estimates[node][fusion.filter].covariance[run, k], error[k, i]
            s, r = d.sum(), np.sqrt(np.trace(p))
            local.append(hg.model.Estimate(value[k, i], (1 + s / r) * p + (1 + r / s) * s * np.diag(d), "upper"))
        outside, inside = hg.fusion.fuse(fusion.rule, local), record.estimates["fused"][name]
        # The same arithmetic in another compilation; searched weights agree to the root of rounding.
        np.testing.assert_allclose(inside.mean[run, k], outside.mean, rtol=0, atol=1e-7)
        np.testing.assert_allclose(inside.covariance[run, k], outside.covariance, rtol=0, atol=1e-7)


def test_saturation_is_reported_and_nothing_is_claimed_there(record):
    uplink, fused = record.uplinks["static"], record.estimates["fused"]["static"]
    assert uplink.nodes == ("b", "a", "direct") and uplink.saturated.shape == (RUNS, HORIZON, 3, 2)
    count = int(uplink.saturated[:, :, 0].sum())
    assert count > 0 and not uplink.saturated[:, :, 1:].any()
    lines = [line for line in record.failures() if line.startswith("fused/static")]
    assert lines[1] == f"fused/static: the quantizer of node b saturated in {count} of {RUNS * HORIZON * 2} samples"
    assert lines[0].startswith("fused/static: no valid covariance from step ")
    anywhere = uplink.saturated.any(axis=(-1, -2))
    assert np.array_equal(np.isnan(fused.covariance).all(axis=(-1, -2)), anywhere)
    assert np.array_equal(np.isnan(fused.covariance).any(axis=(-1, -2)), anywhere) and np.all(np.isfinite(fused.mean))
    assert uplink.saturated_share()["b"] == count / (RUNS * HORIZON * 2) and uplink.symbols_per_value() == 1
    assert not any("fused/escape" in line for line in record.failures())
    assert 1 < record.uplinks["escape"].symbols_per_value() < 5


@pytest.mark.slow
def test_statistics_count_what_the_record_shows_whatever_the_chunks(record):
    some = [hg.monte_carlo(NETWORK, HORIZON, RUNS, 11, hg.Statistics(), INPUTS, chunk) for chunk in (64, 256)]
    for name in ("outer", "covariance", "nees", "count"):
        assert np.array_equal(*(getattr(s["a"]["linear"], name) for s in some)), name
    for name in record.uplinks:
        a, b = (s["fused"][name].uplink for s in some)
        assert np.array_equal(a.saturated, b.saturated) and np.array_equal(a.symbols, b.symbols)
    result = some[0]["fused"]
    assert result["plain"].uplink is None
    for name in record.uplinks:
        stored, counted = hg.simulation.error_statistics(record, "fused", name).uplink, result[name].uplink
        assert stored.nodes == counted.nodes
        np.testing.assert_allclose(counted.saturated, stored.saturated, rtol=1e-14)
        np.testing.assert_allclose(counted.symbols, stored.symbols, rtol=1e-14)


def test_quantizers_over_time_and_the_bound_of_a_static_one(statistics):
    """A bound through a static quantizer holds where nothing saturates; levels that double halve the errors."""
    result = statistics["fused"]["over time"]
    assert result.claim == "nominal" and result.uplink.saturated.max() == 0 and result.worst_direction().z < 4
    trace = np.trace(result.claimed(), axis1=1, axis2=2)
    assert trace[3] < 0.6 * trace[2]  # the quantizers' share, (r + s)^2 with s halved, outweighs what filters do
    with pytest.raises(ValueError, match="at most 7 steps"):
        hg.monte_carlo(NETWORK, HORIZON + 1, 2, 3, inputs=INPUTS)


def test_a_filter_that_claims_no_covariance_harms_no_other(statistics):
    check_filter(Silent(), [0.0])
    silent, linear = statistics["b"]["silent"], statistics["b"]["linear"]
    assert silent.claim == statistics["fused"]["mean"].claim == "none"
    assert silent.rmse()[0] > linear.rmse()[0] and linear.nees_per_dimension()[0] == pytest.approx(1, abs=0.3)
    assert np.isnan(silent.nees_per_dimension()[0]) and np.isnan(silent.mean_trace())
    assert np.isnan(silent.worst_direction().ratio) and np.isnan(silent.worst_direction().z)
    assert hg.simulation.pool([silent, linear]).claim == "none"
    with pytest.raises(ValueError, match="got the claim 'none'"):
        hg.Network(PLANT, NODES, {"ci": hg.Fusion("silent", hg.CovarianceIntersection())})


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: hg.monte_carlo(NETWORK, 0, 1, 0, inputs=INPUTS), "horizon: expected a positive whole number, got 0"),
        (lambda: hg.monte_carlo(NETWORK, HORIZON, 1, 0), r"inputs: expected an array \(7, 1\) of \['u0'\], got none"),
        (lambda: hg.monte_carlo(NETWORK, HORIZON, 1, 0, inputs=INPUTS[:3]), r"inputs: expected shape \(7, 1\)"),
        (lambda: hg.run(NETWORK, {"b": np.zeros(3)}, np.zeros((3, 1))), "a mismatch in"),
        (
            lambda: hg.run(hg.Network(PLANT, {"b": node([1.0, 0.0])}), {"b": np.zeros(3)}, np.zeros((3, 1)), [0, 2, 1]),
            "do not go backwards, got 1 after 2 in row 3",
        ),
        (lambda: hg.Network(PLANT, {}), "at least one node"),
        (lambda: hg.Network(PLANT, {"b": 3}), "a Node, got 3"),
    ],
)
def test_bad_calls(call, message):
    with pytest.raises(ValueError, match=message):
        call()
