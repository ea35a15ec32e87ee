import numpy as np
import pyarrow.parquet as pq
import pytest

import heliograph as h
from heliograph.files.recording import (
    estimate_columns,
    read_recording,
    write_estimates,
)
from heliograph.files.table import write_table
from heliograph.simulation.results.record import Record

NAN = np.nan
TIME = [0.0, 0.5, 0.5, 2.0]


def tracked(inputs=("dt",)) -> h.Plant:
    def move(x, u):
        return x + u[0] * np.array([[0.0, 1.0], [0.0, -0.1]]) @ x

    return h.Plant(move, 0.01 * np.eye(2), [0.0, 1.0], np.eye(2), states=["p", "v"], inputs=inputs)


def sensed(*outputs: str) -> h.LinearSensor:
    return h.LinearSensor(np.eye(2)[: len(outputs)], 0.1, outputs=outputs)


def relayed(dimension: int) -> h.random_affine.AbstractRandomAffine:
    gain = h.Discrete([0.8, 1.2], [0.5, 0.5])
    return h.amplify_and_forward([h.hop(gain, 0.1, dimension=dimension), h.hop(gain, 0.1, dimension=dimension)])


def network(nodes: dict[str, tuple[str, ...]], inputs=("dt",), filters=("aware",)) -> h.Network:
    plant, members = tracked(inputs), {}
    for name, outputs in nodes.items():
        sensor, channel = sensed(*outputs), relayed(len(outputs))
        built = {key: h.cubature_filter(plant, sensor, channel) for key in filters}
        members[name] = h.Node(sensor, channel, built)
    return h.Network(plant, members)


def columns(**others) -> dict[str, np.ndarray]:
    return {key.replace("__", "."): np.array(value) for key, value in {"time": TIME, **others}.items()}


def refused(data, net, *fragments: str) -> None:
    with pytest.raises(ValueError) as caught:
        read_recording(data, net, "data.csv")
    message = str(caught.value)
    assert "\n" not in message
    assert ": expected " in message and ", got " in message
    for fragment in fragments:
        assert fragment in message


def test_columns_find_their_place():
    net = network({"a": ("pos", "vel")}, inputs=("push", "dt"))
    measured = read_recording(columns(vel=[1, 2, 3, 4], pos=[5, NAN, 7, 8], dt=[9, 9, 9, 9], push=[0, 1, 0, 1]), net)
    np.testing.assert_array_equal(measured.time, TIME)
    np.testing.assert_array_equal(measured.measurements["a"], [[5, 1], [NAN, 2], [7, 3], [8, 4]])
    np.testing.assert_array_equal(measured.inputs, [[0, 9], [1, 9], [0, 9], [1, 9]])


def test_time_step_is_filled():
    measured = read_recording(columns(pos=[1, 2, 3, 4]), network({"a": ("pos",)}))
    np.testing.assert_array_equal(measured.inputs, [[0.0], [0.5], [0.0], [1.5]])


def test_no_inputs():
    plant = h.LinearPlant(np.eye(2), 0.1, [0, 0], 1.0)
    net = h.Network(plant, {"a": h.Node(sensed("pos"), h.perfect(), {})})
    assert read_recording(columns(pos=[1, 2, 3, 4]), net).inputs.shape == (4, 0)


def test_names_of_what_is_received():
    sensor, plant = sensed("pos", "vel"), tracked()
    assert h.Node(sensor, relayed(2), {}).received_names == ("pos", "vel")
    both = h.model.with_direct_link(relayed(2), h.perfect(2))
    assert h.Node(sensor, both, {}).received_names == ("z0", "z1", "z2", "z3")
    net = h.Network(plant, {"a": h.Node(sensor, both, {})})
    measured = read_recording(columns(z0=TIME, z1=TIME, z2=TIME, z3=[1, 2, 3, 4]), net)
    np.testing.assert_array_equal(measured.measurements["a"][:, 3], [1, 2, 3, 4])


def test_nodes_and_their_names():
    net = network({"a": ("pos", "vel"), "b": ("pos",)})
    data = columns(a__pos=[1, 1, 1, 1], vel=[2, 2, 2, 2], b__pos=[3, 3, 3, 3])
    measured = read_recording(data, net)
    np.testing.assert_array_equal(measured.measurements["a"][0], [1, 2])
    np.testing.assert_array_equal(measured.measurements["b"][0], [3])
    refused(columns(pos=TIME, vel=TIME), net, "header", "time, dt, a.pos, a.vel, b.pos", "unknown 'pos'")
    refused({**data, "a.vel": data["vel"]}, net, "one column 'a.vel'", "both 'a.vel' and 'vel'")


def test_a_measurement_named_like_an_input_needs_its_node():
    net = network({"a": ("speed",)}, inputs=("speed",))
    measured = read_recording(columns(speed=[1, 1, 1, 1], a__speed=[2, 2, 2, 2]), net)
    assert measured.inputs[0] == 1 and measured.measurements["a"][0] == 2
    refused(columns(speed=[1, 1, 1, 1]), net, "one column 'a.speed'", "only time, speed")


@pytest.mark.parametrize(
    ("change", "fragments"),
    [
        ({"poss": TIME}, ["header", "time, push, pos", "unknown 'poss'", "closest: 'pos'"]),
        ({"pos": None}, ["header", "one column 'pos'", "only time, push"]),
        ({"push": None}, ["header", "one column 'push'", "only time, pos"]),
        ({"time": None}, ["header", "one column 'time'", "only pos, push"]),
        ({"push": [1, NAN, 1, 1]}, ["row 2, column 'push'", "a finite number", "an empty cell"]),
        ({"time": [0, 1, 2, NAN]}, ["row 4, column 'time'", "a finite number", "an empty cell"]),
        ({"time": [0, 1, np.inf, 3]}, ["row 3, column 'time'", "a finite number", "inf"]),
        ({"pos": [1, 2, -np.inf, 4]}, ["row 3, column 'pos'", "a finite number", "-inf"]),
        ({"time": [0, 2, 1.5, 3]}, ["row 3, column 'time'", "does not go backwards", "1.5 after 2"]),
    ],
)
def test_what_is_refused(change, fragments):
    data = {**columns(pos=[1, 2, 3, 4], push=[0, 0, 0, 0]), **change}
    stored = {name: np.array(values) for name, values in data.items() if values is not None}
    refused(stored, network({"a": ("pos",)}, inputs=("push",)), "data.csv", *fragments)


def test_an_input_may_not_be_called_time():
    refused(columns(pos=TIME), network({"a": ("pos",)}, inputs=("time",)), "input names", "'time'")


@pytest.mark.parametrize("name", ["data.csv", "data.parquet"])
def test_a_recording_run_at_once_and_sample_by_sample(tmp_path, name):
    rng = np.random.default_rng(0)
    steps = 30
    time = np.cumsum(rng.exponential(0.2, steps))
    cells = rng.normal(size=(steps, 3))
    cells[rng.random((steps, 3)) < 0.4] = NAN
    cells[7] = NAN  # a row in which nothing arrived
    data = dict(zip(["a.pos", "a.vel", "b.pos"], cells.T, strict=True))
    write_table({"time": time, **data}, tmp_path / name)
    net = network({"a": ("pos", "vel"), "b": ("pos",)})
    recording = read_recording(tmp_path / name, net)
    record = h.run(net, *recording)
    np.testing.assert_array_equal(record.time, time)
    for node in net.nodes:
        stream = h.Stream(net.nodes[node].filters["aware"])
        for k in range(steps):
            estimate = stream.push(recording.measurements[node][k], recording.inputs[k])
            whole = record.estimates[node]["aware"]
            # one sample and a scan are compiled apart, so sums may be taken in another order: rounding only
            np.testing.assert_allclose(whole.mean[k], estimate.mean, rtol=1e-12, atol=1e-12)
            np.testing.assert_allclose(whole.covariance[k], estimate.covariance, rtol=1e-12, atol=1e-12)


def record_of(*filters: str, nodes=("a",), states=("p", "v")) -> Record:
    bound = np.array([[[4.0, 1.0], [1.0, 9.0]], [[1.0, 2.0], [2.0, 1.0]], [[-1.0, 0.0], [0.0, 1.0]]])
    estimate = h.model.Estimate(np.array([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]]), bound, "upper")
    estimates = {node: {name: estimate for name in filters} for node in nodes}
    return Record(np.array([0.0, 0.5, 0.7]), states, None, {}, estimates)


def test_columns_of_estimates():
    result = estimate_columns(record_of("aware"))
    assert list(result) == ["time", "p", "p.sd", "v", "v.sd", "cov.p.v", "valid"]
    np.testing.assert_array_equal(result["v"], [2, 4, 6])
    np.testing.assert_array_equal(result["p.sd"], [2, 1, NAN])
    np.testing.assert_array_equal(result["v.sd"], [3, 1, 1])
    np.testing.assert_array_equal(result["cov.p.v"], [1, 2, 0])
    np.testing.assert_array_equal(result["valid"], [True, False, False])


def test_no_columns_for_a_covariance_that_is_not_claimed():
    record = record_of("silent")
    means = record.estimates["a"]["silent"].mean
    record.estimates["a"]["silent"] = h.model.Estimate(means, np.full((3, 2, 2), np.nan), "none")
    result = estimate_columns(record)
    assert list(result) == ["time", "p", "v", "valid"]
    np.testing.assert_array_equal(result["valid"], np.isfinite(means).all(axis=1))


def test_prefixes_of_nodes_and_filters():
    assert list(estimate_columns(record_of("aware", "other")))[1] == "aware.p"
    assert list(estimate_columns(record_of("aware", nodes=("a", "b"))))[1] == "a.p"
    named = list(estimate_columns(record_of("aware", "other", nodes=("a", "b"))))
    assert named[1:3] == ["a.aware.p", "a.aware.p.sd"] and named[-1] == "b.other.valid"


def test_estimates_that_cannot_be_a_table():
    with pytest.raises(ValueError, match=r"^columns of the estimates: expected distinct names, got 'time' more"):
        estimate_columns(record_of("aware", states=("time", "v")))
    net = network({"a": ("pos",)})
    several = h.monte_carlo(net, 2, 3, 0, inputs=np.ones((2, 1)))
    with pytest.raises(ValueError, match=r"^record: expected the run over one recording, got .*\(3, 2, 2\)"):
        estimate_columns(several)


def test_estimates_in_both_formats(tmp_path):
    record = record_of("aware")
    write_estimates(record, tmp_path / "e.parquet")
    write_estimates(record, tmp_path / "e.csv")
    table = pq.read_table(tmp_path / "e.parquet")
    assert table.column("valid").to_pylist() == [True, False, False]
    assert (tmp_path / "e.csv").read_text().splitlines() == [
        "time,p,p.sd,v,v.sd,cov.p.v,valid",
        "0.0,1.0,2.0,2.0,3.0,1.0,1",
        "0.5,3.0,1.0,4.0,1.0,2.0,0",
        "0.7,5.0,nan,6.0,1.0,0.0,0",
    ]
    assert sorted(p.name for p in tmp_path.iterdir()) == ["e.csv", "e.parquet"]
