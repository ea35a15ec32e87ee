import numpy as np
import pytest

from heliograph.linear.system import load_schedule
from heliograph.model.channel import hop
from heliograph.model.over_time import over_time
from heliograph.model.plant import LinearPlant, Plant
from heliograph.model.relays import RelayNetwork
from heliograph.model.sensor import LinearSensor
from heliograph.random_affine.laws.law import bernoulli
from heliograph.relays.design import given_design, local_error_design, relay_schedules
from tests.relays.relay_problems import example, unusual

PLANT = LinearPlant([[0.9]], [[1.0]], [0.0], [[1.0]])
SENSOR = LinearSensor([[1.0]], [[1.0]])
LINK = hop(0.8, 0.1)


def network(slots, relays=("a",), plant=PLANT, sensor=SENSOR):
    return RelayNetwork(plant, sensor, relays, slots)


@pytest.mark.parametrize(
    ("slots", "message"),
    [
        ([], "slots: expected at least one"),
        (
            [{"a": {}, "receiver": {}}],
            "relay 'a': expected to receive the sensor or another relay in some slot, got nobody",
        ),
        ([{"a": {"sensor": LINK}}], "somebody transmits to the receiver, got a schedule in which nobody does"),
        ([{"a": {"a": LINK}, "receiver": {"a": LINK}}], "relay 'a': expected to receive .* got itself only"),
        ([{"b": {"sensor": LINK}}], "listener in slot 0: expected one of .* got 'b'"),
        ([{"a": {"sensor": LINK}, "receiver": {"receiver": LINK}}], "sender: expected one of .* got 'receiver'"),
        ([{"a": {"sensor": hop(0.8, 0.1, dimension=2)}}], "one that takes 1 numbers, got one that takes 2"),
        ([{"a": {"sensor": 0.8}}], "expected a random affine map, got float"),
    ],
)
def test_a_schedule_that_can_not_work_is_refused(slots, message):
    with pytest.raises(ValueError, match=message):
        network(slots)


def test_names_plants_and_horizons_are_checked():
    slots = [{"a": {"sensor": LINK}, "receiver": {"a": LINK}}]
    with pytest.raises(ValueError, match="distinct names"):
        network(slots, relays=("a", "sensor"))
    with pytest.raises(ValueError, match="LinearPlant"):
        network(slots, plant=Plant(lambda x, u: x, [[1.0]], [0.0], [[1.0]]))
    with pytest.raises(ValueError, match="no inputs"):
        network(slots, plant=LinearPlant([[0.9]], [[1.0]], [0.0], [[1.0]], input_matrix=[[1.0]]))
    with pytest.raises(ValueError, match="sensor matrix: expected 1 columns"):
        network(slots, sensor=LinearSensor([[1.0, 2.0]], [[1.0]]))
    with pytest.raises(ValueError, match="horizon: expected at most 3 steps"):
        network(slots, plant=over_time([PLANT] * 3)).steps(4)
    with pytest.raises(ValueError, match="known probabilities"):
        network([{"receiver": {"sensor": hop(bernoulli(0.5, 0.1), 0.1)}}], relays=()).steps(1)


@pytest.mark.parametrize("wrong", [{"relay_1": (4, 3, 2)}, {"receiver": (5, 3, 1)}])
def test_gains_of_the_wrong_shape_are_refused(wrong):
    shapes = {"relay_1": (4, 3, 1), "relay_2": (4, 3, 1), "receiver": (4, 3, 1)} | wrong
    with pytest.raises(ValueError, match=r"gains of .*: expected shape \(4, 3, 1\)"):
        given_design(example(), {name: np.zeros(shape) for name, shape in shapes.items()})
    with pytest.raises(ValueError, match="gains: expected those of"):
        given_design(example(), {"relay_1": np.zeros((4, 3, 1))})


def test_a_link_over_time_is_read_at_the_step():
    links = [hop(0.1 * k, 0.1) for k in range(1, 5)]
    slots = [{"a": {"sensor": over_time(links)}, "receiver": {"a": LINK}}, {"receiver": {"a": LINK}}]
    gain = network(slots).steps(4).gain[:, 0, 0]
    np.testing.assert_allclose(gain, [0.1, 0.0, 0.3, 0.0], rtol=1e-15)


def test_a_network_without_noise_has_the_limits_design_and_one_that_diverges_is_named():
    def designed(noise, growth=0.9, steps=3):
        sensor, plant = LinearSensor([[1.0]], [[noise]]), LinearPlant([[growth]], [[noise]], [1.0], [[1.0]])
        relays = [{"a": {"sensor": hop(1.0, noise)}, "receiver": {"a": LINK}}]
        return local_error_design(network(relays, plant=plant, sensor=sensor), steps)

    exact, near = designed(0.0), designed(1e-10)
    for name in exact.covariance:
        np.testing.assert_allclose(exact.covariance[name], near.covariance[name], atol=1e-8)
    with np.errstate(all="ignore"), pytest.raises(ValueError, match="finite second moments"):
        designed(1.0, 1e200, 4)


def test_schedules_are_saved_and_read_back(tmp_path):
    net = unusual()
    schedules = relay_schedules(net, local_error_design(net, 6))
    for name, schedule in schedules.items():
        schedule.save(tmp_path / name)
        again = load_schedule(tmp_path / name)
        assert all(np.array_equal(a, b) for a, b in zip(schedule.gains, again.gains, strict=True))
