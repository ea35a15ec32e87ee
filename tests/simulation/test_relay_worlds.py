import jax
import numpy as np
import pytest
from scipy import stats

from heliograph.filters.linear.scheduled_gains import ScheduledFilter
from heliograph.model.channel import hop
from heliograph.model.plant import LinearPlant
from heliograph.model.relays import RelayNetwork
from heliograph.model.sensor import LinearSensor
from heliograph.relays.design import local_error_design, relay_schedules
from heliograph.relays.receiver import receiver_behind_relays
from heliograph.simulation.network import Network
from heliograph.simulation.node import Node
from heliograph.simulation.recordings.filter_recording import run
from heliograph.simulation.results.error_sums import Statistics, error_statistics
from heliograph.simulation.simulate import monte_carlo
from tests.relays.relay_problems import example, unusual

pytestmark = pytest.mark.slow

FALSE_ALARM = 1e-4  # of each comparison over all its steps


def world(net, design):
    schedules = relay_schedules(net, design)
    receivers = {
        "local": ScheduledFilter(schedules.pop("receiver")),
        "best": ScheduledFilter(receiver_behind_relays(net, design.gains)),
    }
    return schedules, receivers


def relays(net, design):
    return Network.of_relays(net, *world(net, design))


RUNS, CHUNK = 3072, 256  # one block for each lane at a time: any number of runs is one program


@pytest.fixture(scope="module")
def designed():
    return local_error_design(example(), 20)


@pytest.fixture(scope="module")
def recorded(designed):
    return monte_carlo(relays(example(), designed), 20, RUNS, 1, chunk=CHUNK)


def worst(record, node, name):
    """Largest |z| over the steps of the squared error against the claimed trace, and what chance would give."""
    statistics = error_statistics(record, node, name)
    batches = np.trace(statistics.outer, axis1=2, axis2=3) / statistics.count[:, None]
    error = batches.std(axis=0, ddof=1) / np.sqrt(len(batches))
    claimed = np.trace(statistics.claimed(), axis1=1, axis2=2)
    limit = stats.t.isf(FALSE_ALARM / 2 / len(claimed), len(batches) - 1)
    return np.max(np.abs(batches.mean(axis=0) - claimed) / error), limit


@pytest.mark.parametrize("kind", ["greedy", "another kind"])
def test_designed_and_simulated_errors_agree_at_every_step(kind, request):
    if kind == "another kind":
        network = relays(unusual(), local_error_design(unusual(), 7))
        record = monte_carlo(network, 7, RUNS, 1, chunk=CHUNK)
    else:
        record = request.getfixturevalue("recorded")
    for node, filters in record.estimates.items():
        for name in filters:
            largest, limit = worst(record, node, name)
            assert largest < limit, (node, name)


def test_a_wrong_design_is_seen(designed):
    """Claims for twice the gains that run: the comparison above can fail."""
    schedules, receivers = world(example(), designed)
    gains = schedules["relay_2"].gains
    short = 0.5 * gains.gain
    moved = gains._replace(gain=short, direct=short, transition=gains.transition + 0.5 * gains.gain @ gains.expected,
                           output=gains.transition + 0.5 * gains.gain @ gains.expected)  # fmt: skip
    schedules["relay_2"] = type(schedules["relay_2"])(moved, schedules["relay_2"].start, "exact")
    record = monte_carlo(Network.of_relays(example(), schedules, receivers), 20, RUNS, 1, chunk=CHUNK)
    largest, limit = worst(record, "relay_2", "local")
    assert largest > 2 * limit


def test_runs_do_not_depend_on_chunks_or_on_other_receivers(designed, recorded):
    net = example()
    other = monte_carlo(Network.of_relays(net, world(net, designed)[0], {}), 4, 70, 1, chunk=32)
    assert np.array_equal(recorded.truth[:70, :4], other.truth)
    for name in net.filters:
        np.testing.assert_array_equal(recorded.measurements[name][:70, :4], other.measurements[name])
    received = recorded.measurements
    assert np.all(np.isnan(received["relay_1"][:, 0])) and not np.any(np.isnan(received["receiver"]))


def test_what_holds_for_every_network_holds_for_relays(designed, recorded):
    """A first run, chunks of statistics, and a record's statistics."""
    network = relays(example(), designed)
    whole, part = monte_carlo(network, 20, 96, 1), monte_carlo(network, 20, 32, 1, first_run=64)
    for item, runs in ((whole, slice(96)), (part, slice(64, 96))):
        np.testing.assert_array_equal(
            recorded.estimates["receiver"]["best"].mean[runs], item.estimates["receiver"]["best"].mean
        )
    assert recorded.failures() == []
    outputs = []
    sums = [
        monte_carlo(network, 20, 96, 1, Statistics(), chunk=c, progress=lambda *n: outputs.append(n)) for c in (32, 96)
    ]
    assert outputs == [(32, 96), (64, 96), (96, 96), (96, 96)]
    single, other = (s["relay_2"]["local"] for s in sums)
    np.testing.assert_array_equal(single.outer, other.outer)
    stored = error_statistics(whole, "relay_2", "local")
    np.testing.assert_allclose(stored.outer, single.outer, rtol=1e-12)
    np.testing.assert_allclose(stored.covariance, single.covariance, rtol=1e-12)
    np.testing.assert_allclose(stored.nees, single.nees, rtol=1e-9)


def quiet():
    """One relay, which listens and talks in turn, so that the receiver receives it every other step."""
    hops = hop(0.9, 0.1), hop(0.8, 0.2)
    slots = [{"a": {"sensor": hops[0]}}, {"receiver": {"a": hops[1]}}]
    plant = LinearPlant([[0.95]], [[1.0]], [1.0], [[2.0]])
    return RelayNetwork(plant, LinearSensor([[1.0]], [[0.3]]), ("a",), slots)


@pytest.fixture(scope="module")
def quietly():
    return local_error_design(quiet(), 12)


@pytest.fixture(scope="module")
def silences(quietly):
    """The network, and its record."""
    network = relays(quiet(), quietly)
    return network, monte_carlo(network, 12, RUNS, 2, chunk=CHUNK)


def test_single_precision_tells_the_same_story_behind_relays(silences):
    """Other draws of the same laws: RMSE within 4 standard errors of their difference."""
    network, record = silences
    single = monte_carlo(network, 12, RUNS, 2, Statistics(), chunk=CHUNK, precision="float32")
    for node, name in (("a", "local"), ("receiver", "local"), ("receiver", "best")):
        (a, a_error), (b, b_error) = (s.rmse() for s in (single[node][name], error_statistics(record, node, name)))
        assert a != b and abs(a - b) < 4 * np.hypot(a_error, b_error)


def test_a_planned_silence_is_no_gap_and_a_loss_is_one(silences):
    network, record = silences
    received = record.measurements["receiver"]
    assert np.all(np.isnan(received[:, ::2])) and np.all(np.isfinite(received[:, 1::2]))
    assert record.failures() == []
    for name in ("local", "best"):
        claimed = record.estimates["receiver"][name].covariance
        assert np.all(np.isfinite(claimed)) and np.array_equal(claimed[0], claimed[-1])
    largest, limit = worst(record, "receiver", "local")
    assert largest < limit
    lost = received[3].copy()
    lost[5] = np.nan
    with pytest.warns(UserWarning, match="no valid covariance from step 5 in 1 of 1 runs"):
        bound = run(network, {"receiver": lost}).estimates["receiver"]["local"].covariance
    assert np.all(np.isfinite(bound[:5])) and np.all(np.isnan(bound[5:]))


def test_a_recording_needs_what_the_receiver_received_alone(silences):
    network, record = silences
    z = {name: values[0] for name, values in record.measurements.items()}
    alone, whole = run(network, {"receiver": z["receiver"]}), run(network, z)
    assert list(alone.estimates) == ["receiver"] and list(whole.estimates) == ["a", "receiver"]
    for node, item in (("receiver", alone), ("receiver", whole), ("a", whole)):
        for name, estimate in item.estimates[node].items():
            np.testing.assert_allclose(estimate.mean, record.estimates[node][name].mean[0], rtol=1e-12)
            np.testing.assert_allclose(estimate.covariance, record.estimates[node][name].covariance[0], rtol=1e-12)
    with pytest.raises(ValueError, match=r"arrays for the nodes \['a', 'receiver'\], got a mismatch in \['receiver'\]"):
        run(network, {"a": z["a"]})


class Staying(hop(1.0, 0.1).__class__):
    """A hop whose gain is drawn once and stays."""

    @property
    def remembers(self):
        return True

    def init(self, key):
        return jax.random.normal(key)

    def draw(self, state, key):
        h = super().sample(key)
        return state, h.at[:-1, :-1].multiply(state)


def staying(noise):
    plain = hop(1.0, noise)
    return Staying(plain.law, plain.matrix, plain.noise)


def test_hops_that_remember_keep_their_state():
    """Without noise, what is received over what was sent is one number for each run and hop."""
    plant = LinearPlant([[1.0]], [[0.0]], [1.0], [[1.0]])
    sensor = LinearSensor([[1.0]], [[0.0]])
    node = Network(plant, {"n": Node(sensor, staying(0.0), {})})
    record = monte_carlo(node, 4, 40, 0)
    gains = record.measurements["n"] / record.truth
    np.testing.assert_allclose(gains, np.broadcast_to(gains[:, :1], gains.shape), rtol=1e-12)
    assert abs(gains[:, 0].mean()) < 4 / np.sqrt(40) and 0.5 < gains[:, 0].std() < 1.6
    slots = [{"receiver": {"sensor": staying(0.0)}}, {"receiver": {"sensor": hop(1.0, 0.0)}}]
    record = monte_carlo(Network.of_relays(RelayNetwork(plant, sensor, (), slots), {}, {}), 4, 40, 0)
    gains = record.measurements["receiver"] / record.truth
    np.testing.assert_allclose(gains[:, 2], gains[:, 0], rtol=1e-12)
    np.testing.assert_allclose(gains[:, 1::2], 1.0, rtol=1e-12)
    assert gains[:, 0].std() > 0.5


def test_bad_input_is_refused(designed, quietly):
    net = example()
    schedules, receivers = world(net, designed)
    with pytest.raises(ValueError, match="relay schedules: expected those of"):
        Network.of_relays(net, {"relay_1": schedules["relay_1"]}, receivers)
    with pytest.raises(
        ValueError, match=r"schedule of 'relay_1': expected gains of shape \(3, 1\), got shape \(1, 1\)"
    ):
        short = relay_schedules(quiet(), quietly)["a"]
        Network.of_relays(net, {**schedules, "relay_1": short}, receivers)
    with pytest.raises(ValueError, match="schedule of 'relay_1': expected a Schedule, got 1"):
        Network.of_relays(net, {**schedules, "relay_1": 1}, receivers)
    with pytest.raises(ValueError, match="horizon: expected at most 20 steps"):
        monte_carlo(Network.of_relays(net, schedules, receivers), 21, 10, 0)
    with pytest.raises(ValueError, match="runs: expected a positive whole number"):
        monte_carlo(Network.of_relays(net, schedules, receivers), 6, 0, 0)
