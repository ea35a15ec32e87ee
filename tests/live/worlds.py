"""Networks that between them have every kind of filter, few programs to compile, and random events for each."""

import jax.numpy as jnp
import numpy as np

import heliograph as hg
from heliograph.live.event import Event
from heliograph.model.over_time import OverTime

STEPS = 24  # that the schedules cover
PLANT = hg.LinearPlant([[0.95]], 0.04, [1.0], 0.5)
PUSHED = hg.LinearPlant([[0.95]], 0.04, [1.0], 0.5, [[1.0]], inputs=["push"])
SENSOR = hg.LinearSensor([[1.0]], 0.1)
FADING = hg.hop(hg.Discrete([0.6, 1.2], [0.5, 0.5]), 0.05)
BURSTS = hg.gilbert_elliott(hg.hop(1.0, 0.05), hg.hop(0.3, 0.05), 0.1, 0.3)
LOSSES = hg.gilbert_elliott(hg.erasure(hg.hop(1.0, 0.05), 0.9), hg.erasure(hg.hop(0.3, 0.05), 0.4), 0.1, 0.3)


def forgetful() -> hg.Network:
    """Steps, an input, two nodes behind hops that forget, fused in every way."""
    parts = PUSHED, SENSOR, FADING
    local = {
        "linear": hg.linear_filter(*parts),
        "cubature": hg.cubature_filter(*parts),
        "mixture": hg.filters.mixture_filter(*parts),
        "open_loop": hg.filters.open_loop_filter(PUSHED),
    }
    central = hg.filters.sequential_filter([hg.cubature_filter(*parts), hg.cubature_filter(*parts)])
    fused = {
        "central": central,
        "intersection": hg.Fusion("linear", hg.fusion.EqualIntersection()),
        "weights": hg.Fusion("linear", hg.fusion.MatrixWeights()),
        "sent": hg.Fusion("cubature", hg.fusion.EqualIntersection(), hg.fusion.EscapeQuantizer(9, 1.0, 0.9, 2.0, 0.1)),
    }
    return hg.Network(PUSHED, {"a": hg.Node(SENSOR, FADING, local), "b": hg.Node(SENSOR, FADING, local)}, fused)


def remembering() -> hg.Network:
    """Steps, links that remember, one that loses, filters over their modes; and gains fixed before any data."""
    parts = PLANT, SENSOR, BURSTS
    local = {
        "linear": hg.linear_filter(*parts),
        "imm": hg.filters.imm_filter(*parts),
        "particles": hg.filters.particle_filter(*parts, particles=8),
    }
    sure = PLANT, SENSOR, hg.hop(1.0, 0.05)
    gains = {
        "h_infinity": hg.h_infinity.HInfinityFilter(
            plant=PLANT, sensor=SENSOR, gains=OverTime(np.full((STEPS, 1, 1), 0.4)),
            expected_gain=OverTime(np.ones((STEPS, 1, 1))), initial_mean=np.ones(1), claim="none",
            states=PLANT.states, inputs=(), received=1,
        ),
        "polynomial": hg.polynomial_filter(*sure, STEPS),
        "scheduled": hg.filters.scheduled_polynomial_filter(*sure, STEPS),
    }  # fmt: skip
    known = {"informed": hg.filters.side_information_filter(PLANT, SENSOR, LOSSES)}
    nodes = {"a": hg.Node(*parts[1:], local), "b": hg.Node(SENSOR, LOSSES, known), "c": hg.Node(*sure[1:], gains)}
    return hg.Network(PLANT, nodes)


def moving(shared: bool = False) -> hg.Network:
    """Continuous time: a position driven by white noise and a speed that is given; each node of two is a row, or both
    share the sensor's noise."""
    plant = hg.Plant(lambda x, u: x + u[0] * u[1], lambda u: jnp.diag(0.3 * u[1:]), [0.0], 1.0, inputs=["speed", "dt"])
    if not shared:
        local = {
            "cubature": hg.cubature_filter(plant, SENSOR, FADING),
            "extended": hg.extended_filter(plant, SENSOR, FADING),
        }
        central = hg.filters.sequential_filter([local["cubature"], local["cubature"]])
        node = hg.Node(SENSOR, FADING, local)
        return hg.Network(plant, {"a": node, "b": node}, {"central": central})
    sensor = hg.LinearSensor([[1.0], [1.0]], [[0.2, 0.15], [0.15, 0.2]])
    joint = hg.cubature_filter(plant, sensor, hg.perfect(2))
    local = {"cubature": hg.cubature_filter(plant, hg.LinearSensor([[1.0]], 0.2), hg.perfect())}
    return hg.Network.sharing(plant, sensor, hg.perfect(2), {"a": local, "b": local}, {"central": joint})


def events(network: hg.Network, seed: int, count: int, continuous: bool) -> list[Event]:
    """At distinct moments, some of all nodes at once, in the order of time; every third of the inputs."""
    generator = np.random.default_rng(seed)
    results = []
    for i in range(count):
        time = float(np.round(0.3 * i + 0.2 * generator.random(), 3)) if continuous else float(i)
        if network.inputs and generator.random() < 0.3:
            results.append(Event("inputs", i, time, generator.normal(size=1)))
        here = [name for name in network.names if generator.random() < 0.7]
        results += [Event(name, i, time, generator.normal(size=1)) for name in here]
    return results
