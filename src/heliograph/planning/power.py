"""`hg.power`: what each transmitter of a network sends, from the moments of the true state."""

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.filters.base import AbstractFilter
from heliograph.filters.linear.scheduled import ScheduledFilter
from heliograph.model.channel import Channel
from heliograph.model.over_time import at, first, steps_covered
from heliograph.model.plant import AnyPlant, LinearPlant
from heliograph.model.relays import RECEIVER, SENSOR
from heliograph.model.sensor import AnySensor, is_linear
from heliograph.numerics.angle import wrap_angles
from heliograph.numerics.check import array, check_count, check_horizon, check_seed, fail, instance
from heliograph.numerics.float64 import compile_in_float64
from heliograph.numerics.keys import seed_key
from heliograph.numerics.lapack import spectral_radius
from heliograph.numerics.module import Module, readable
from heliograph.numerics.types import Array, ArrayLike, Float
from heliograph.planning.plant_moments import measurement_moment, moments_over, steady_moment
from heliograph.planning.transmitters import compute_sent_powers, steady_powers
from heliograph.relays.design import given_design
from heliograph.simulation.network import Network
from heliograph.simulation.node import Node

BATCHES = 20  # of runs, from whose spread the standard errors come
SAME = 1e-9  # of the entries of a schedule that is to be that of a design

Sources = dict[str, tuple[AnySensor, Channel]]  # what sends, by the beginning of its transmitters' names
Moments = Float[np.ndarray, "batch steps m1 m1"]  # E (y, 1)(y, 1)'


@readable
class SentPower(Module):
    """Power that each transmitter sends, in the units of the sensor's output squared.

    over_time: mean square at each step by name, (steps,), one step if steady; standard_error of it, zero where it is
    exact. growth: spectral radius squared of a linear plant, the factor by which power grows in the long run at each
    step where it is above 1; NaN where the plant is not linear.
    """

    over_time: dict[str, Float[np.ndarray, "steps"]]
    standard_error: dict[str, Float[np.ndarray, "steps"]]
    growth: float

    @property
    def mean(self) -> dict[str, float]:
        """Power of each transmitter by name, the mean over time."""
        return {name: float(np.mean(power)) for name, power in self.over_time.items()}

    @property
    def peak(self) -> dict[str, float]:
        """Power of each transmitter by name, the largest of any step."""
        return {name: float(np.max(power)) for name, power in self.over_time.items()}

    @property
    def total(self) -> float:
        """Mean over time of all transmitters together."""
        return float(sum(self.mean.values()))

    @property
    def words(self) -> str:
        """Sentence on whether the power stays bounded."""
        if self.growth > 1:
            return f"the plant is unstable: what is sent grows by {self.growth:.4g} a step, without limit"
        return "what is sent stays bounded" if self.growth < 1 else "what is sent is known for these steps only"


def power(
    network: Network, horizon: int | None = None, inputs: ArrayLike | None = None, runs: int = 1000, seed: int = 0
) -> SentPower:
    """Return the power that each transmitter of a network sends: sensors, and relays that amplify what they receive.

    Exact where plant and sensors are linear without angles, from the second moment of the state itself; else from
    drawn trajectories, the channels being exact still. Transmitters are named "node.hop1", "node.hop2" along the node's
    channel, "node.part1.hop1" in a stack. Relays that filter have their names, the sensor that they measure is
    "sensor", and slots are the steps. A sensor with feedback sends its innovation.

    Args:
        network: the network.
        horizon: number of steps from the plant's initial law on; the steady state of a linear plant unless given.
        inputs: inputs of the plant, (horizon, inputs); zero unless given.
        runs: number of drawn trajectories, where plant or sensors are not linear (default 1000).
        seed: of the draws (default 0).

    Returns:
        The powers, with standard errors where they are drawn.

    Raises:
        ValueError: no horizon for a plant that is not stable or not linear, or for a sensor with feedback; inputs of
            another shape.
    """
    instance("network", network, Network, "a Network")
    start = first(network.plant)
    rate = spectral_radius(np.asarray(start.matrix)) ** 2 if isinstance(start, LinearPlant) else float("nan")
    if network.relays is not None:
        sent = _compute_relay_powers(network, horizon)
        return SentPower(sent, {name: np.zeros_like(power) for name, power in sent.items()}, rate)
    sources = _list_sources(network)
    covered = steps_covered((network.plant, sources))
    if horizon is None and covered is not None:
        raise fail("steady power", "a network that does not vary (give a horizon)", "parts that are OverTime")
    steps = 1 if horizon is None else check_horizon(horizon, covered)
    u = np.zeros((steps, len(start.inputs))) if inputs is None else array("inputs", inputs, (steps, len(start.inputs)))
    # E (y, 1)(y, 1)' of each sensor: exact, or the mean of drawn trajectories.
    linear = all(is_linear(network.plant, sensor) and not first(sensor).circular for sensor, _ in sources.values())
    if linear and not start.circular:
        seconds = [steady_moment(network.plant)] if horizon is None else moments_over(network.plant, steps, u)
        y = {
            name: np.array([[measurement_moment(sensor, x, k) for k, x in enumerate(seconds)]])
            for name, (sensor, _) in sources.items()
        }
    elif horizon is None:
        raise fail("power", "a horizon, since plant or sensor is not linear", "none")
    else:
        y = _draw_moments(network.plant, sources, u, check_count("runs", runs, BATCHES), check_seed("seed", seed))
    # A sensor with feedback sends its innovation, which stays bounded or not whatever the plant does.
    for name, informing in _find_feedback_filters(network).items():
        y[name], rate = _compute_innovation_moments(informing, u, horizon), float("nan")
    power, error = {}, {}
    for name, (_, channel) in sources.items():
        for hop, values in _compute_hop_powers(channel, y[name], horizon).items():
            power[f"{name}.{hop}"] = values.mean(axis=0)
            spread = values.std(axis=0, ddof=1) if len(values) > 1 else np.zeros(steps)
            error[f"{name}.{hop}"] = spread / np.sqrt(len(values))
    return SentPower(over_time=power, standard_error=error, growth=rate)


def _compute_hop_powers(
    channel: Channel, moments: Moments, horizon: int | None
) -> dict[str, Float[np.ndarray, "batch steps"]]:
    """Return the powers that a channel's hops send, by name, for each batch and step of E (y, 1)(y, 1)'."""
    batches = [[_compute_powers_at(channel, k, now, horizon) for k, now in enumerate(batch)] for batch in moments]
    return {hop: np.array([[now[hop] for now in batch] for batch in batches]) for hop in batches[0][0]}


def _compute_powers_at(channel: Channel, k: int, moment: np.ndarray, horizon: int | None) -> dict[str, float]:
    """Return the powers sent at step k for `moment` = E (y, 1)(y, 1)', or in the long run if there is no horizon."""
    return steady_powers(at(channel, k), moment) if horizon is None else compute_sent_powers(at(channel, k), moment, k)


def _list_sources(network: Network) -> Sources:
    """Return sensor and channel of each node by its name, or those that all nodes share as "common"."""
    if network.common is not None:
        return {"common": (network.common.sensor, network.common.channel)}
    return {name: (node.sensor, node.channel) for name, node in network.nodes.items() if isinstance(node, Node)}


def _find_feedback_filters(network: Network) -> dict[str, AbstractFilter]:
    """Return the filters that send their prediction back to the sensor, by node."""
    nodes = {name: node for name, node in network.nodes.items() if isinstance(node, Node)}
    return {name: node.filters[node.informed_by] for name, node in nodes.items() if node.informed_by is not None}


def _compute_innovation_moments(
    filter: AbstractFilter, inputs: Float[np.ndarray, "steps u"], horizon: int | None
) -> Moments:
    """Return E (y - r, 1)(y - r, 1)' of each step, with r the reference, the filter's prediction of y; one batch.

    E (y - r)(y - r)' = C P C' + R, which no data change: the filter is run over zeros.
    """
    if horizon is None or filter.claim != "exact":
        expected = "a horizon and a linear model, whose filter knows its error before any data"
        raise fail("power of a sensor with feedback", expected, "no horizon" if horizon is None else filter.claim)
    world, state, moments = filter.premise, filter.init(), []
    assert world is not None and world.sensor is not None  # of a filter that is fed back
    for k, u in enumerate(inputs):
        state = filter.predict(state, u, k)
        sensor = at(world.sensor, k)
        c = np.asarray(sensor.matrix)
        moment = np.eye(len(c) + 1)
        moment[:-1, :-1] = c @ np.asarray(filter.estimate(state).covariance) @ c.T + np.asarray(sensor.noise.covariance)
        moments.append(moment)
        state, _ = filter.correct(state, np.zeros(filter.received), k)
    return np.array([moments])


def _compute_relay_powers(network: Network, horizon: int | None) -> dict[str, Float[np.ndarray, "steps"]]:
    """Return the powers of a sensor and relays that filter, at each step of the horizon or of their schedules.

    Exact for schedules s+ = A s + K (z - B s - b) in which a relay expects the z that others would send if all of them
    had its own estimate s, as `relay_schedules` makes them.

    Raises:
        ValueError: a schedule of another kind.
    """
    relays = network.relays
    assert relays is not None
    filters = [(name, network.nodes[name].filters[Network.LOCAL]) for name in relays.relays]
    schedules = {name: relay.gains.values for name, relay in filters if isinstance(relay, ScheduledFilter)}
    covered = min(len(schedule.gain) for schedule in schedules.values())
    steps = covered if horizon is None else check_horizon(horizon, covered)
    moved = relays.steps(steps)
    rows, n = moved.predict_maps()[0], len(relays.states)
    ends = dict(zip(relays.filters, np.cumsum(relays.received), strict=True))
    gains = {RECEIVER: np.zeros((steps, n, relays.received[-1]))}
    # The schedule's A and B have to be the plant's and the rows that the relay expects.
    for (name, schedule), count in zip(schedules.items(), relays.received, strict=False):
        gains[name] = np.asarray(schedule.gain)[:steps]
        expected = rows[:, ends[name] - count : ends[name]]
        pairs = (schedule.transition, moved.transition), (schedule.expected, expected)
        if not all(np.shape(a)[1:] == b.shape[1:] and np.allclose(a[:steps], b, SAME, SAME) for a, b in pairs):
            raise fail(f"schedule of {name!r}", "s+ = A s + K (z - B s - b), as relay_schedules makes them", "another")
    # The sensor sends y in the slots in which it transmits.
    y = np.array([measurement_moment(relays.sensor, x, k) for k, x in enumerate(moments_over(relays.plant, steps))])
    sensor = np.trace(y[:, :-1, :-1], axis1=1, axis2=2) * moved.transmits_in_slot[:, 0]
    return {SENSOR: sensor, **given_design(relays, gains).power}


def _draw_moments(
    plant: AnyPlant, sources: Sources, inputs: Float[np.ndarray, "steps u"], runs: int, seed: int
) -> dict[str, Moments]:
    """Return E (y, 1)(y, 1)' of each sensor over each batch of drawn trajectories."""
    keys = jax.random.split(seed_key(seed), (BATCHES, runs // BATCHES))
    sensors = {name: sensor for name, (sensor, _) in sources.items()}
    return {name: np.asarray(y) for name, y in _average_draws(plant, sensors, jnp.asarray(inputs), keys).items()}


@compile_in_float64
def _average_draws(
    plant: AnyPlant, sensors: dict[str, AnySensor], inputs: Array, keys: jax.Array
) -> dict[str, jax.Array]:
    """Return E (y, 1)(y, 1)' of each sensor and step, a mean over drawn trajectories for each batch of keys."""

    def simulate(key: jax.Array) -> dict[str, jax.Array]:
        """Draw one trajectory of the plant; return (y, 1)(y, 1)' of each sensor at its steps."""
        begin, rest = jax.random.split(key)

        def draw_step(x: jax.Array, row: tuple[Array, Array]) -> tuple[jax.Array, dict[str, jax.Array]]:
            k, u = row
            moves, *draws = jax.random.split(jax.random.fold_in(rest, k), 1 + len(sensors))
            # The state moves, then every sensor measures it.
            now = at(plant, k)
            x = now.plus(now.transition(x, u), now.sample_noise(moves, u))
            moments = {}
            for draw, (name, sensor) in zip(draws, sensors.items(), strict=True):
                here = at(sensor, k)
                y = jnp.append(wrap_angles(here.measure(x) + here.noise.sample(draw), here.angles), 1.0)
                moments[name] = jnp.outer(y, y)
            return x, moments

        start = at(plant, 0).sample_initial(begin)
        over_time: dict[str, jax.Array] = jax.lax.scan(
            draw_step, start, (jnp.arange(len(inputs)), jnp.asarray(inputs))
        )[1]
        return over_time

    runs: dict[str, jax.Array] = jax.vmap(jax.vmap(simulate))(keys)
    averages: dict[str, jax.Array] = jax.tree.map(lambda moments: moments.mean(axis=1), runs)
    return averages
