"""Networks simulated by native code: what XLA gives, whoever else is simulated and however runs are dealt."""

import gc
import weakref

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as hg
from heliograph.numerics import seed_key
from heliograph.relays.design import local_error_design
from heliograph.simulation.network_filters import AllFilters
from heliograph.simulation.results.reducer import AbstractReducer, OfStep, Trajectories
from heliograph.simulation.runs.native import compile_runs
from heliograph.simulation.simulation_step import World
from heliograph.simulation.transmission.build_reception import make_reception
from straightline.nodes import Node, Unsupported
from tests.relays.relay_problems import example
from tests.simulation.both import Both
from tests.simulation.test_channel_draws import PLANT as ALONE
from tests.simulation.test_channel_draws import SENSOR as GAIN
from tests.simulation.test_channel_draws import in_turn, link
from tests.simulation.test_relay_worlds import relays
from tests.simulation.test_simulate import INPUTS, NETWORK

# Near its least value a trace changes with the square of the weight, which is known to the root of rounding over that
# of the trace's curvature: small where nodes know nearly the same. Covariances agree to 1e-12 all the same.
FLAT = 1e-4
HORIZON, RUNS = 6, 70  # more than two blocks of runs, the last of them not full
LINEAR = hg.LinearPlant([[0.95, 0.1], [0.0, 0.9]], np.diag([0.1, 0.2]), [1.0, 0.0], np.eye(2))
POSITION = hg.LinearSensor([[1.0, 0.5]], 0.3)
TURNING = hg.Plant(lambda x, u: 0.8 * x + 0.3 * jnp.sin(jnp.roll(x, 1)), 0.1 * np.eye(2), np.ones(2), np.eye(2))
BENT = hg.Sensor(lambda x: jnp.array([x[0] + 0.2 * x[1] ** 2, jnp.arctan2(x[1], 2 + x[0] ** 2)]), 0.1 * np.eye(2))
FADINGS = {
    "nakagami": hg.random_affine.Nakagami(0.7, 1.2),
    "rician": hg.random_affine.Rician(0.9, 0.2),
    "shadowing": hg.random_affine.LogNormal(-0.1, 0.3),
    "finite": hg.Discrete([0.5, 1.0], [0.4, 0.6]),
}


def linear() -> hg.Network:
    relay = hg.amplify_and_forward([hg.hop(hg.Rayleigh(0.8), 0.02), hg.hop(1.0, noise=0.01, amplification=1.2)])
    filters = {
        "linear": hg.linear_filter(LINEAR, POSITION, relay),
        "mean": hg.mean_gain_filter(LINEAR, POSITION, relay),
    }
    whole, lossy = hg.Node(POSITION, relay, filters), hg.Node(POSITION, hg.erasure(relay, 0.8), filters)
    rules = {"ci": hg.CovarianceIntersection(), "equal": hg.fusion.EqualIntersection()}
    fused = {name: hg.Fusion("linear", rule) for name, rule in rules.items()}
    return hg.Network(LINEAR, {"a": whole, "b": lossy, "c": whole}, fused)


def nonlinear() -> hg.Network:
    nodes = {}
    for name, law in FADINGS.items():
        channel = hg.hop(law, 0.05, dimension=2)
        nodes[name] = hg.Node(BENT, channel, {"cubature": hg.cubature_filter(TURNING, BENT, channel)})
    return hg.Network(TURNING, nodes)


def with_memory() -> hg.Network:
    chain = hg.random_affine.MarkovChain([[0.9, 0.1], [0.3, 0.7]])
    fading = hg.markov_fading([0.3, 1.0], chain, noise=0.1)
    filters = {"imm": hg.filters.imm_filter(LINEAR, POSITION, fading)}
    slow = hg.model.autoregressive_fading(1.0, 0.2, 0.9, 0.1)
    return hg.Network(LINEAR, {"a": hg.Node(POSITION, fading, filters), "b": hg.Node(POSITION, slow, {})})


def shadowed() -> hg.Network:
    channels = {"a": link(name="road"), "b": link(name="road"), "in turn": in_turn("turn")}
    filters = {"open": hg.filters.open_loop_filter(ALONE)}
    return hg.Network(ALONE, {name: hg.Node(GAIN, channel, filters) for name, channel in channels.items()})


NETWORKS = {
    "linear": linear,
    "nonlinear": nonlinear,
    "with memory": with_memory,
    "shadowed": shadowed,
    "relays": lambda: relays(example(), local_error_design(example(), 20)),
    "quantized": lambda: NETWORK,
}


def by(engine: str, *args: object, **kwargs: object) -> object:
    with pytest.MonkeyPatch.context() as setting:
        setting.setenv("HELIOGRAPH_ENGINE", engine)
        return hg.monte_carlo(*args, **kwargs)


def simulated(network: hg.Network, **kwargs: object) -> tuple[tuple[object, object], ...]:
    """Record and statistics by native code, each by a program of its own, and by XLA."""
    record = by("native", network, HORIZON, RUNS, 5, **kwargs)
    sums = by("native", network, HORIZON, RUNS, 5, hg.Statistics(), **kwargs)
    return (record, sums), by("xla", network, HORIZON, RUNS, 5, Both(), **kwargs)


@pytest.fixture(scope="module", params=NETWORKS)
def by_engine(request: pytest.FixtureRequest) -> tuple[tuple[object, object], ...]:
    u = INPUTS[:HORIZON] if request.param == "quantized" else None
    return simulated(NETWORKS[request.param](), inputs=u)


@pytest.mark.slow
def test_records_are_those_of_xla(by_engine):
    """Draws to the last bits, estimates to 1e-12 of what deviates from step to step."""
    (result, _), (expected, _) = by_engine
    np.testing.assert_allclose(result.truth, expected.truth, rtol=0, atol=1e-13 * np.abs(expected.truth).max())
    for name, z in expected.measurements.items():
        np.testing.assert_allclose(result.measurements[name], z, rtol=0, atol=1e-13 * (1 + np.nanmax(np.abs(z))))
    for node, filters in expected.estimates.items():
        for name, true in filters.items():
            item, covariance = result.estimates[node][name], np.asarray(true.covariance)
            deviation = np.sqrt(np.nanmax(np.diagonal(covariance, axis1=-2, axis2=-1), initial=0.0)) or 1.0
            digits = FLAT if name == "ci" else 1e-12
            np.testing.assert_allclose(item.mean, true.mean, rtol=0, atol=digits * deviation, err_msg=f"{node}/{name}")
            np.testing.assert_allclose(item.covariance, covariance, rtol=0, atol=1e-12 * deviation**2)
            assert item.claim == true.claim


@pytest.mark.slow
def test_statistics_are_those_of_xla(by_engine):
    (_, result), (_, expected) = by_engine
    for node, filters in expected.items():
        for name, true in filters.items():
            item = result[node][name]
            digits = FLAT if name == "ci" else 1e-12
            for part in ("count", "outer", "covariance", "nees"):
                a, b = np.asarray(getattr(item, part)), np.asarray(getattr(true, part))
                np.testing.assert_allclose(a, b, rtol=digits, atol=digits * np.nanmax(np.abs(b), initial=1e-300))
            assert item.failed_runs == true.failed_runs
            np.testing.assert_array_equal(item.failed, true.failed)


@pytest.mark.slow
def test_smoothed_estimates_are_those_of_xla():
    """Of nodes whose links lose nothing, and of one whose do; trajectories and their sums."""
    interval = hg.smoothing.FixedInterval()
    relay = hg.hop(hg.Rayleigh(0.8), 0.05)
    filters = {"linear": hg.linear_filter(LINEAR, POSITION, relay)}
    nodes = {"a": hg.Node(POSITION, relay, filters), "b": hg.Node(POSITION, hg.erasure(relay, 0.8), filters)}
    (result, sums), (expected, true_sums) = simulated(hg.Network(LINEAR, nodes), smooth=interval)
    for node in nodes:
        item, true = result.smoothed.estimates[node]["linear"], expected.smoothed.estimates[node]["linear"]
        np.testing.assert_allclose(item.mean, true.mean, rtol=0, atol=1e-12)
        np.testing.assert_allclose(item.covariance, true.covariance, rtol=0, atol=1e-12)
        for part in ("outer", "covariance", "nees"):
            a, b = (getattr(s.smoothed[node]["linear"], part) for s in (sums, true_sums))
            np.testing.assert_allclose(a, b, rtol=1e-11, atol=1e-12 * np.abs(b).max())


def test_a_run_depends_on_no_other(monkeypatch):
    """Whatever the chunk, the first run, the number of runs: bit for bit."""
    monkeypatch.setenv("HELIOGRAPH_ENGINE", "native")
    network = linear()
    whole = hg.monte_carlo(network, HORIZON, 300, 9)
    cut, later = (
        hg.monte_carlo(network, HORIZON, 300, 9, chunk=64),
        hg.monte_carlo(network, HORIZON, 70, 9, first_run=160),
    )
    for other, runs in ((cut, slice(None)), (later, slice(160, 230))):
        for a, b in zip(jax.tree.leaves(whole.estimates), jax.tree.leaves(other.estimates), strict=True):
            np.testing.assert_array_equal(np.asarray(a)[runs], b)
        np.testing.assert_array_equal(whole.truth[runs], other.truth)


def test_sums_depend_on_no_chunk(monkeypatch):
    monkeypatch.setenv("HELIOGRAPH_ENGINE", "native")
    some = [hg.monte_carlo(linear(), HORIZON, 1000, 9, hg.Statistics(), chunk=chunk) for chunk in (32, 300, 4096)]
    for node, filters in some[0].items():
        for name, filter_ in filters.items():
            for other in some[1:]:
                np.testing.assert_array_equal(filter_.outer, other[node][name].outer)
                np.testing.assert_array_equal(filter_.nees, other[node][name].nees)


def code(network: hg.Network, seed: int = 0):
    world = World(network.plant, make_reception(network), AllFilters(network))
    with jax.enable_x64(True):
        return compile_runs(world, np.zeros((HORIZON, 0)), seed_key(seed), Trajectories(), 8)


@pytest.mark.slow
def test_many_nodes_are_what_each_is_alone(monkeypatch):
    """A few at a time: each node's numbers are those of a network of its own."""
    monkeypatch.setenv("HELIOGRAPH_ENGINE", "native")
    relay, worse = hg.hop(hg.Rayleigh(0.8), 0.05), hg.hop(hg.Rayleigh(0.7), 0.05)
    erased = hg.erasure(relay, 0.5)

    def node(i: int) -> hg.Node:
        """Of two structures in turn, each with two filters alike, and with numbers of its own."""
        sensor, link = hg.LinearSensor([[1.0, 0.1 * i]], 0.3), erased if i % 4 == 1 else relay
        filters = {name: hg.linear_filter(LINEAR, sensor, of) for name, of in (("linear", relay), ("cautious", worse))}
        return hg.Node(sensor, link, filters)

    nodes = {f"n{i}": node(i) for i in range(8)}
    whole, sums = (hg.monte_carlo(hg.Network(LINEAR, nodes), HORIZON, 40, 2, keep) for keep in (None, hg.Statistics()))
    assert list(whole.measurements) == list(nodes) and list(sums) == list(nodes)
    for name in ("n0", "n5", "n6"):
        alone = hg.monte_carlo(hg.Network(LINEAR, {name: nodes[name]}), HORIZON, 40, 2)
        np.testing.assert_allclose(whole.measurements[name], alone.measurements[name], rtol=0, atol=1e-14)
        for f, estimate in alone.estimates[name].items():
            np.testing.assert_allclose(whole.estimates[name][f].mean, estimate.mean, rtol=0, atol=1e-13)
            of_record = hg.simulation.error_statistics(alone, name, f)
            np.testing.assert_allclose(sums[name][f].rmse(), of_record.rmse(), rtol=1e-13)
            assert (sums[name][f].claim, whole.estimates[name][f].claim) == (of_record.claim, of_record.claim)


def test_what_is_kept_of_a_network_goes_with_it(collect_garbage):
    """Its world is built once for all simulations, in parts where nodes are many."""
    fused, channel = linear(), hg.hop(hg.Rayleigh(0.8), 0.02)
    filters = {"linear": hg.linear_filter(LINEAR, POSITION, channel)}
    many = hg.Network(LINEAR, {f"n{i}": hg.Node(POSITION, channel, filters) for i in range(6)})
    held = []
    for network in (fused, many):
        hg.monte_carlo(network, 3, 8, 0)
        held.append(weakref.ref(network))
    del fused, many, network
    collect_garbage()
    assert [one() for one in held] == [None, None]


def test_networks_of_one_structure_share_a_program():
    other = hg.Network(LINEAR, {name: hg.Node(POSITION, hg.hop(1.0, noise), {}) for name, noise in (("a", 0.1),)})
    again = hg.Network(LINEAR, {name: hg.Node(POSITION, hg.hop(1.0, noise), {}) for name, noise in (("a", 0.2),)})
    assert code(other).begun.program is code(again, 1).begun.program


def test_covariances_that_no_data_change_are_computed_once():
    result = code(linear()).begun
    assert sum(part is not None for part in result.shared) == 2  # of both filters at the nodes whose links lose nothing


class Largest(AbstractReducer):
    """The mean error of each step, and the largest of each run's first state."""

    def of_step(self, step):
        error = jnp.abs(step["truth"] - step["estimates"][0].mean[0, 0])
        return OfStep(sums=error, collected=error[0])

    def summed(self, sums, common, count):
        return sums.sums.sum(axis=-1) / count.sum()

    def finish(self, carry, collected, network):
        return carry, collected.max(axis=1)


def test_a_reducer_of_ones_own_is_computed_by_both_engines(monkeypatch):
    network, results = shadowed(), {}
    for engine in ("native", "xla"):
        monkeypatch.setenv("HELIOGRAPH_ENGINE", engine)
        results[engine] = hg.monte_carlo(network, 3, 35, 0, Largest())
    for native_part, other in zip(*results.values(), strict=True):
        np.testing.assert_allclose(native_part, other, rtol=0, atol=1e-13)
    assert [len(part) for part in results["xla"]] == [3, 35]


def test_keys_of_another_hash_are_simulated_by_xla():
    network = hg.Network(ALONE, {"a": hg.Node(GAIN, link(), {})})
    record = hg.monte_carlo(network, 3, 2, jax.random.key(0, impl="rbg"))
    assert np.isfinite(record.truth).all()
    world = World(network.plant, make_reception(network), AllFilters(network))
    with pytest.raises(Unsupported, match="rbg"):
        compile_runs(world, np.zeros((3, 0)), jax.random.key(0, impl="rbg"), Trajectories(), 8)


@pytest.mark.slow
def test_of_a_program_that_is_refused_the_reason_stays_alone(collect_garbage):
    """A program of 200,000 operations is 100 MB, which a traceback would hold."""
    plant = hg.Plant(lambda x, u: x / (1 + jnp.linalg.svd(jnp.outer(x, x))[1]), 0.1 * np.eye(2), np.ones(2), np.eye(2))
    network = hg.Network(plant, {"a": hg.Node(POSITION, hg.perfect(), {})})
    world = World(plant, make_reception(network), AllFilters(network))

    def nodes():
        collect_garbage()
        return sum(isinstance(x, Node) for x in gc.get_objects())

    before = nodes()
    for _ in range(2):
        with pytest.raises(Unsupported, match="svd"):
            compile_runs(world, np.zeros((3, 0)), seed_key(0), Trajectories(), 8)
    assert nodes() == before
