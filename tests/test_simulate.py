import jax
import numpy as np
import pytest

import heliograph as hg

PLANT = hg.LinearPlant([[0.9, 0.1], [0.0, 0.8]], 0.1, [0.0, 1.0], 0.3, input_matrix=[[1.0], [0.5]])
CHANNEL = hg.amplify_and_forward([hg.hop(hg.Rayleigh(0.7), 0.1), hg.hop(hg.bernoulli(0.8), 0.05)])
HORIZON, RUNS = 7, 70  # more than one block of runs, and not a multiple of it
INPUTS = np.linspace(-1, 1, HORIZON)[:, None]


def node(row, channel=CHANNEL):
    sensor = hg.LinearSensor([row], 0.05)
    filters = {
        "relay_aware": hg.cubature_filter(PLANT, sensor, channel),
        "linear": hg.linear_filter(PLANT, sensor, channel),
    }
    return hg.Node(sensor, channel, filters)


NETWORK = hg.Network(PLANT, {"b": node([1.0, 0.0]), "a": node([0.5, 1.0]), "direct": node([0.0, 1.0], hg.perfect())})


@pytest.fixture(scope="module")
def record():
    return hg.monte_carlo(NETWORK, HORIZON, RUNS, 11, inputs=INPUTS)


def leaves(record):
    return [record.truth, *record.measurements.values(), *jax.tree.leaves(record.estimates)]


def test_shapes_and_order(record):
    assert record.truth.shape == (RUNS, HORIZON, 2)
    assert list(record.measurements) == ["b", "a", "direct"] and record.measurements["a"].shape == (RUNS, HORIZON, 1)
    assert list(record.estimates["b"]) == ["relay_aware", "linear"]
    assert all(isinstance(leaf, np.ndarray) and leaf.dtype == np.float64 for leaf in leaves(record))
    assert record.failures() == []


def test_chunks_change_no_bit(record):
    other = hg.monte_carlo(NETWORK, HORIZON, RUNS, 11, inputs=INPUTS, chunk=64)
    assert all(np.array_equal(a, b) for a, b in zip(leaves(record), leaves(other), strict=True))


def test_chunks_change_no_bit_of_the_statistics():
    some = [hg.monte_carlo(NETWORK, 3, 140, 11, hg.Statistics(), INPUTS[:3], chunk) for chunk in (64, 256)]
    for name in ("outer", "bound", "nees", "count"):
        assert np.array_equal(*(getattr(s["a"]["linear"], name) for s in some)), name


def test_fewer_runs_are_the_first_of_more_runs(record):
    few = hg.monte_carlo(NETWORK, HORIZON, 5, 11, inputs=INPUTS)
    assert np.array_equal(few.truth, record.truth[:5])
    assert np.array_equal(few.measurements["b"], record.measurements["b"][:5])


def test_another_node_changes_no_draw(record):
    more = hg.Network(PLANT, {"new": node([1.0, 1.0]), **NETWORK.nodes})
    other = hg.monte_carlo(more, HORIZON, RUNS, 11, inputs=INPUTS)
    assert np.array_equal(other.truth, record.truth)
    for name in NETWORK.nodes:
        assert np.array_equal(other.measurements[name], record.measurements[name])


def test_run_equals_step_by_step(record):
    measurements = {name: z[3].copy() for name, z in record.measurements.items()}
    measurements["a"][2] = np.nan
    result = hg.run(NETWORK, measurements, INPUTS)
    for name, part in NETWORK.nodes.items():
        for label, item in part.filters.items():
            stream = hg.Stream(item)
            for k in range(HORIZON):
                estimate = stream.push(measurements[name][k], INPUTS[k])
                together = result.estimates[name][label]
                # The same arithmetic in another compilation: equal to rounding.
                np.testing.assert_allclose(estimate.mean, together.mean[k], rtol=0, atol=1e-12)
                np.testing.assert_allclose(estimate.bound, together.bound[k], rtol=0, atol=1e-12)


def test_the_true_channel_makes_the_data_and_the_filter_believes_another():
    sensor = hg.LinearSensor([[1.0, 0.0]], 0.05)
    item = hg.linear_filter(PLANT, sensor, CHANNEL)
    worlds = [hg.Network(PLANT, {"n": hg.Node(sensor, c, {"f": item})}) for c in (CHANNEL, hg.silent())]
    rmse = [
        hg.monte_carlo(w, HORIZON, 500, 1, hg.Statistics(), INPUTS)["n"]["f"].rmse()[0] for w in worlds
    ]  # fmt: skip
    assert rmse[0] < rmse[1]


def test_a_lost_covariance_is_reported_with_its_step():
    plant = hg.Plant(lambda x, u: x**3, 1e-3, [5.0], 1.0)  # leaves the range of numbers after a few steps
    sensor = hg.LinearSensor([[1.0]], 1.0)
    network = hg.Network(
        plant, {"n": hg.Node(sensor, hg.perfect(), {"f": hg.cubature_filter(plant, sensor, hg.perfect())})}
    )
    record = hg.run(network, {"n": np.full((12, 1), np.nan)})
    (line,) = record.failures()
    assert line.startswith("n/f: no valid covariance from step ")
    step = int(line.split("step ")[1].split()[0])
    assert 0 < step < 12 and np.all(np.isfinite(record.estimates["n"]["f"].mean[: step - 1]))


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
        (lambda: hg.Network(PLANT, {"b": 3}), "a Node, got int"),
    ],
)
def test_bad_calls(call, message):
    with pytest.raises(ValueError, match=message):
        call()
