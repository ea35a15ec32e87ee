"""What each transmitter of a network sends: mean, peak and by step, from the moments of the true state."""

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.filters.fed_back import FedBackFilter
from heliograph.filters.scheduled import ScheduledFilter
from heliograph.model.channel import Channel
from heliograph.model.over_time import at, first, steps_covered
from heliograph.model.plant import AnyPlant, LinearPlant
from heliograph.model.relays import RECEIVER, SENSOR
from heliograph.model.sensor import AnySensor, is_linear
from heliograph.numerics.angle import wrapped
from heliograph.numerics.check import array, check_count, check_horizon, check_seed, fail, instance
from heliograph.numerics.float64 import compiled
from heliograph.numerics.module import Module
from heliograph.numerics.readable import readable
from heliograph.numerics.types import Array, ArrayLike, Float
from heliograph.planning.channel_power import sent_powers, steady_powers
from heliograph.planning.state_power import growth, of_sensor, seconds_over, steady_second
from heliograph.relays.design import expected_maps, given_design
from heliograph.simulation.draws import seed_key
from heliograph.simulation.network import OWN, Network
from heliograph.simulation.node import Node

BATCHES = 20  # of runs, from whose spread the standard errors come
ALIKE = 1e-9  # of the entries of a schedule that is to be one of a design

Worlds = dict[str, tuple[AnySensor, Channel]]  # what sends, by the beginning of its transmitters' names


@readable
class SentPower(Module):
    """What each transmitter sends, in the units of the sensor's output squared.

    over_time: mean square at each step by name, (steps,), one step if steady; standard_error of it, zero where it is
    exact. growth: spectral radius squared of a linear plant, the factor by which power grows in the long run at each
    step where it is above 1; NaN where the plant is not linear.
    """

    over_time: dict[str, Float[np.ndarray, "steps"]]
    standard_error: dict[str, Float[np.ndarray, "steps"]]
    growth: float

    @property
    def mean(self) -> dict[str, float]:
        """Mean over time."""
        return {name: float(np.mean(power)) for name, power in self.over_time.items()}

    @property
    def peak(self) -> dict[str, float]:
        """The largest mean square of any step."""
        return {name: float(np.max(power)) for name, power in self.over_time.items()}

    @property
    def total(self) -> float:
        """Mean over time of all transmitters together."""
        return float(sum(self.mean.values()))

    @property
    def words(self) -> str:
        """Whether the power stays."""
        if self.growth > 1:
            return f"the plant is unstable: what is sent grows by {self.growth:.4g} a step, without limit"
        return "what is sent stays bounded" if self.growth < 1 else "what is sent is known for these steps only"


def power(
    network: Network, horizon: int | None = None, inputs: ArrayLike | None = None, runs: int = 1000, seed: int = 0
) -> SentPower:
    """Mean square of what each transmitter of a network sends: its sensors, and relays that amplify what they hear.

    In the steady state of a linear plant, or over a `horizon` from the plant's initial law on; `inputs` (horizon,
    inputs) of the plant. Exact where plant and sensors are linear without angles, from E (x, 1)(x, 1)' of the state
    itself; else from `runs` drawn trajectories, the channels being exact still. Transmitters are called
    "node.hop1", "node.hop2" along the node's channel, "node.part1.hop1" in a stack. Relays that filter are called by
    their names, the sensor that they hear "sensor", and slots are the steps.

    A sensor that hears its filter back sends what this does not expect, over a horizon.

    Raises:
        ValueError: no horizon for a plant that is not stable or not linear, or where a sensor hears back; inputs of
            another shape.
    """
    instance("network", network, Network, "a Network")
    start = first(network.plant)
    rate = growth(start) ** 2 if isinstance(start, LinearPlant) else float("nan")
    if network.relays is not None:
        sent = _of_relays(network, horizon)
        return SentPower(sent, {name: np.zeros_like(power) for name, power in sent.items()}, rate)
    worlds = _worlds(network)
    covered = steps_covered((network.plant, worlds))
    if horizon is None and covered is not None:
        raise fail("steady power", "a network that does not vary (give a horizon)", "parts that are OverTime")
    steps = 1 if horizon is None else check_horizon(horizon, covered)
    u = np.zeros((steps, len(start.inputs))) if inputs is None else array("inputs", inputs, (steps, len(start.inputs)))
    straight = all(is_linear(network.plant, s) and not first(s).circular for s, _ in worlds.values())
    if straight and not start.circular:
        seconds = steady_second(network.plant)[None] if horizon is None else seconds_over(network.plant, steps, u)
        y = {name: np.array([[of_sensor(s, x, k) for k, x in enumerate(seconds)]]) for name, (s, _) in worlds.items()}
    elif horizon is None:
        raise fail("power", "a horizon, since plant or sensor is not linear", "none")
    else:
        y = _drawn(network.plant, worlds, u, check_count("runs", runs, BATCHES), check_seed("seed", seed))
    for name, item in _tellers(network).items():
        y[name], rate = _left(item, u, horizon), float("nan")
    sent, error = {}, {}
    for name, (_, channel) in worlds.items():
        each = [[_at_step(channel, k, now, horizon) for k, now in enumerate(batch)] for batch in y[name]]
        for hop in each[0][0]:
            found = np.array([[now[hop] for now in batch] for batch in each])
            sent[f"{name}.{hop}"] = found.mean(axis=0)
            spread = found.std(axis=0, ddof=1) if len(found) > 1 else np.zeros(steps)
            error[f"{name}.{hop}"] = spread / np.sqrt(len(found))
    return SentPower(sent, error, rate)


def _at_step(channel: Channel, k: int, second: np.ndarray, horizon: int | None) -> dict[str, float]:
    """What is sent at a step, or where there is no horizon in the long run."""
    return steady_powers(at(channel, k), second) if horizon is None else sent_powers(at(channel, k), second, k)


def _worlds(network: Network) -> Worlds:
    if network.common is not None:
        return {"common": (network.common.sensor, network.common.channel)}
    return {name: (node.sensor, node.channel) for name, node in network.nodes.items() if isinstance(node, Node)}


def _tellers(network: Network) -> dict[str, FedBackFilter]:
    """The filters that sensors hear back, by node."""
    each = {name: list(node.filters.values()) for name, node in network.nodes.items() if isinstance(node, Node)}
    return {name: item for name, items in each.items() for item in items if isinstance(item, FedBackFilter)}


def _left(item: FedBackFilter, inputs: Float[np.ndarray, "steps u"], horizon: int | None) -> np.ndarray:
    """C P C' + R of the filter's own prediction, which no data change, as one batch of E (y - r, 1)(y - r, 1)'."""
    if horizon is None or item.claim != "exact":
        expected = "a horizon and a linear model, whose filter knows its error before any data"
        raise fail("power of a sensor that hears back", expected, "no horizon" if horizon is None else item.claim)
    state, found = item.init(), []
    for k, u in enumerate(inputs):
        state = item.predict(state, u, k)
        sensor = at(item.base.sensor, k)
        c = np.asarray(sensor.matrix)
        one = np.eye(len(c) + 1)
        one[:-1, :-1] = c @ np.asarray(state.covariance) @ c.T + np.asarray(sensor.noise.covariance)
        found.append(one)
        state, _ = item.correct(state, np.zeros(item.received), k)
    return np.array([found])


def _of_relays(network: Network, horizon: int | None) -> dict[str, Float[np.ndarray, "steps"]]:
    """Exact for schedules that expect what they would hear if their own estimate were everybody's."""
    relays = network.relays
    assert relays is not None
    own = {name: network.nodes[name].filters[OWN] for name in relays.relays}
    schedules = {name: item.gains.values for name, item in own.items() if isinstance(item, ScheduledFilter)}
    known = min(len(one.gain) for one in schedules.values())
    steps = known if horizon is None else check_horizon(horizon, known)
    moved = relays.steps(steps)
    rows, n = expected_maps(moved)[0], len(relays.states)
    ends = dict(zip(relays.filters, np.cumsum(relays.received), strict=True))
    gains = {RECEIVER: np.zeros((steps, n, relays.received[-1]))}
    for (name, one), heard in zip(schedules.items(), relays.received, strict=False):
        gains[name] = np.asarray(one.gain)[:steps]
        pairs = (one.transition, moved.transition), (one.expected, rows[:, ends[name] - heard : ends[name]])
        if not all(np.shape(a)[1:] == b.shape[1:] and np.allclose(a[:steps], b, ALIKE, ALIKE) for a, b in pairs):
            raise fail(f"schedule of {name!r}", "s+ = A s + K (z - B s - b), as relay_schedules makes them", "another")
    y = np.array([of_sensor(relays.sensor, x, k) for k, x in enumerate(seconds_over(relays.plant, steps))])
    sensor = np.trace(y[:, :-1, :-1], axis1=1, axis2=2) * moved.talks[:, 0]
    return {SENSOR: sensor, **given_design(relays, gains).power}


def _drawn(
    plant: AnyPlant, worlds: Worlds, inputs: Float[np.ndarray, "steps u"], runs: int, seed: int
) -> dict[str, Float[np.ndarray, "batch steps m1 m1"]]:
    """E (y, 1)(y, 1)' of each sensor over each batch of drawn trajectories."""
    count = runs // BATCHES
    keys = jax.random.split(seed_key(seed), (BATCHES, count))
    sensors = {name: sensor for name, (sensor, _) in worlds.items()}
    return {name: np.asarray(found) for name, found in _moments(plant, sensors, jnp.asarray(inputs), keys).items()}


@compiled
def _moments(plant: AnyPlant, sensors: dict[str, AnySensor], inputs: Array, keys: jax.Array) -> dict[str, jax.Array]:
    def run(key: jax.Array) -> dict[str, jax.Array]:
        begin, rest = jax.random.split(key)

        def step(x: jax.Array, item: tuple[Array, Array]) -> tuple[jax.Array, dict[str, jax.Array]]:
            k, u = item
            moves, *draws = jax.random.split(jax.random.fold_in(rest, k), 1 + len(sensors))
            now = at(plant, k)
            x = now.transition(x, u) + now.sample_noise(moves, u)
            heard = {}
            for draw, (name, sensor) in zip(draws, sensors.items(), strict=True):
                one = at(sensor, k)
                y = jnp.append(wrapped(one.measure(x) + one.noise.sample(draw), one.angles), 1.0)
                heard[name] = jnp.outer(y, y)
            return x, heard

        start = at(plant, 0).sample_initial(begin)
        result: dict[str, jax.Array] = jax.lax.scan(step, start, (jnp.arange(len(inputs)), jnp.asarray(inputs)))[1]
        return result

    found: dict[str, jax.Array] = jax.tree.map(lambda each: each.mean(axis=1), jax.vmap(jax.vmap(run))(keys))
    return found
