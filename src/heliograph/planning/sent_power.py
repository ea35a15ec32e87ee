"""`hg.power`: what each transmitter of a network sends, from the moments of the true state."""

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.filters.base import AbstractFilter
from heliograph.filters.linear.scheduled_gains import ScheduledFilter
from heliograph.model.channel import Channel
from heliograph.model.channel_side_information import separate_told_numbers
from heliograph.model.over_time import at, first, steps_covered
from heliograph.model.plant import AnyPlant, LinearPlant
from heliograph.model.relays import RECEIVER, SENSOR
from heliograph.model.sensor import AnySensor, is_linear
from heliograph.numerics.angles.angle import wrap_angles
from heliograph.numerics.check import array, check_count, check_horizon, check_seed, fail, instance
from heliograph.numerics.float64 import compile_in_float64
from heliograph.numerics.lapack import spectral_radius
from heliograph.numerics.module import Module, readable
from heliograph.numerics.random_keys import seed_key
from heliograph.numerics.types import Array, ArrayLike, Float
from heliograph.planning.plant_moments import measured_moment_with_one, moments_with_one_over, steady_moment_with_one
from heliograph.planning.transmitters import compute_sent_powers, compute_steady_powers
from heliograph.random_affine.untold_law import believe_untold, has_untold_law
from heliograph.relays.design import given_design
from heliograph.simulation.network import Network
from heliograph.simulation.node import Node

BATCHES = 20  # of runs, from whose spread the standard errors come
SAME_ENTRIES = 1e-9  # of the entries of a schedule that is to be that of a design

Sources = dict[str, tuple[AnySensor, Channel]]  # what sends, by the beginning of its transmitters' names
Moments = Float[np.ndarray, "batch steps m1 m1"]  # E (y, 1)(y, 1)'


@readable
class SentPower(Module):
    """Power that each transmitter sends, in the units of the sensor's output squared.

    Args:
        over_time: mean square at each step by name, (steps,), one step if steady.
        standard_error: its standard error, likewise; zero where it is exact.
        growth: spectral radius squared of a linear plant, the factor by which power grows in the long run at each step
            where it is above 1; NaN where the plant is not linear, or every sensor sends its innovation.
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
        """Sentence on whether the power stays bounded in the long run, from its `growth`.

        A growth of NaN or 1 tells nothing of it.
        """
        if np.isnan(self.growth) or self.growth == 1:
            return "what is sent is known for these steps only"
        if self.growth < 1:
            return "what is sent stays bounded"
        return f"the plant is unstable: what is sent grows by {self.growth:.4g} a step, without limit"


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
        inputs: inputs of the plant, (horizon, inputs); zero unless given, as in the steady state.
        runs: number of drawn trajectories, where plant or sensors are not linear (default 1000).
        seed: of the draws (default 0).

    Returns:
        The powers, with standard errors where they are drawn, and `growth`: the factor by which a linear plant's second
        moment grows at each step in the long run, NaN for other plants and where a sensor has feedback.

    Raises:
        ValueError: no horizon for a plant that is not stable or not linear, or for a sensor with feedback; one whose
            link erases; inputs of another shape, or without a horizon; a sender that decides when to transmit.
    """
    instance("network", network, Network, "a Network").check_sends_each_step("power before any data")
    if horizon is None and inputs is not None:
        raise fail("inputs", "a horizon beside them, as the steady power is that of inputs of 0", "none")
    plant = first(network.plant)
    growth = spectral_radius(np.asarray(plant.matrix)) ** 2 if isinstance(plant, LinearPlant) else float("nan")
    if network.relays is not None:
        sent = _compute_relay_powers(network, horizon)
        return SentPower(sent, {name: np.zeros_like(power) for name, power in sent.items()}, growth)
    sources = _list_sources(network)
    covered = steps_covered((network.plant, sources))
    if horizon is None and covered is not None:
        raise fail("steady power", "a network that does not vary (give a horizon)", "parts that are OverTime")
    steps = 1 if horizon is None else check_horizon(horizon, covered)
    shape = steps, len(plant.inputs)
    u = np.zeros(shape) if inputs is None else array("inputs", inputs, shape)
    moments = _find_output_moments(network, sources, u, horizon, runs, seed)
    # A sensor with feedback sends its innovation, which stays bounded or not whatever the plant does.
    informed = _find_feedback_filters(network)
    for name, informing in informed.items():
        moments[name] = _compute_innovation_moments(informing, u, horizon)
    if informed.keys() == sources.keys():
        growth = float("nan")
    # What each hop of the channels sends, (batches, steps): of drawn trajectories in batches whose spread gives the
    # standard error, of exact moments in one batch, without error.
    over_time, standard_error = {}, {}
    for name, (_, channel) in sources.items():
        for hop, of_batches in _compute_hop_powers(channel, moments[name], horizon).items():
            over_time[f"{name}.{hop}"] = of_batches.mean(axis=0)
            spread = of_batches.std(axis=0, ddof=1) if len(of_batches) > 1 else np.zeros(steps)
            standard_error[f"{name}.{hop}"] = spread / np.sqrt(len(of_batches))
    return SentPower(over_time=over_time, standard_error=standard_error, growth=growth)


def _find_output_moments(
    network: Network, sources: Sources, inputs: Float[np.ndarray, "steps u"], horizon: int | None, runs: int, seed: int
) -> dict[str, Moments]:
    """Return E (y, 1)(y, 1)' of what each sensor measures: exact for linear models, else means of drawn trajectories.

    Args:
        network: the network, for its plant.
        sources: sensor and channel by node.
        inputs: inputs of the plant (steps, inputs).
        horizon: number of steps from the initial law on; None for the steady state.
        runs: number of drawn trajectories.
        seed: of the draws.

    Raises:
        ValueError: no horizon where trajectories are drawn, too few of them.
    """
    if _is_exact(network, sources):
        return _compute_moments(network.plant, sources, inputs, horizon)
    if horizon is None:
        raise fail("power", "a horizon, since plant or sensor is not linear", "none")
    return _draw_moments(network.plant, sources, inputs, check_count("runs", runs, BATCHES), check_seed("seed", seed))


def _is_exact(network: Network, sources: Sources) -> bool:
    """Return whether second moments are exact without random draws: plant and sensors are linear without angles.

    Args:
        network: the network, for its plant.
        sources: sensor and channel by node.
    """
    plant = network.plant
    all_are_linear = all(is_linear(plant, sensor) for sensor, _ in sources.values())
    have_angles = first(plant).circular or any(first(sensor).circular for sensor, _ in sources.values())
    return all_are_linear and not have_angles


def _compute_moments(
    plant: AnyPlant, sources: Sources, inputs: Float[np.ndarray, "steps u"], horizon: int | None
) -> dict[str, Moments]:
    """Return E (y, 1)(y, 1)' of each sensor's output (1, steps, m1, m1), as one batch, for a linear plant.

    Args:
        plant: the plant.
        sources: sensor and channel by node.
        inputs: inputs of the plant (steps, inputs).
        horizon: number of steps from the initial law on; None for the steady state.
    """
    seconds = [steady_moment_with_one(plant)] if horizon is None else moments_with_one_over(plant, len(inputs), inputs)
    return {
        name: np.array([[measured_moment_with_one(sensor, x, k) for k, x in enumerate(seconds)]])
        for name, (sensor, _) in sources.items()
    }


def _compute_hop_powers(
    channel: Channel, moments: Moments, horizon: int | None
) -> dict[str, Float[np.ndarray, "batch steps"]]:
    """Return {hop: powers (batch, steps)} of a channel's hops, from the moments E (y, 1)(y, 1)' of its input.

    Args:
        channel: the channel, which may vary over time.
        moments: E (y, 1)(y, 1)' of its input (batch, steps, m1, m1).
        horizon: number of steps; None for the steady state.
    """
    batches = [[_compute_powers_at(channel, k, now, horizon) for k, now in enumerate(batch)] for batch in moments]
    return {hop: np.array([[now[hop] for now in batch] for batch in batches]) for hop in batches[0][0]}


def _compute_powers_at(channel: Channel, k: int, moment: np.ndarray, horizon: int | None) -> dict[str, float]:
    """Return each hop's power at step k for `moment` = E (y, 1)(y, 1)', or in the long run if `horizon` is None.

    Args:
        channel: the channel, which may vary over time.
        k: the step.
        moment: E (y, 1)(y, 1)' of its input at this step.
        horizon: number of steps; None for the steady state.
    """
    link, _, reported = separate_told_numbers(at(channel, k))
    if reported:  # a link whose gain or noise variance is reported with each message sends the same power
        if not has_untold_law(link):
            raise fail("power of a link whose gain or noise is told", "a known law of what is told", "none")
        link = believe_untold(link)
    return compute_steady_powers(link, moment) if horizon is None else compute_sent_powers(link, moment, step=k)


def _list_sources(network: Network) -> Sources:
    """Return the sensor and channel of each node by name, or those that all nodes share as "common".

    A relay that filters is no source.
    """
    if network.common is not None:
        return {"common": (network.common.sensor, network.common.channel)}
    return {name: (node.sensor, node.channel) for name, node in network.nodes.items() if isinstance(node, Node)}


def _find_feedback_filters(network: Network) -> dict[str, AbstractFilter]:
    """Return by node the filter that sends its prediction back to the node's sensor, of nodes with one.

    Raises:
        ValueError: a link that erases, after which a prediction is worse, and so more is sent.
    """
    nodes = {name: node for name, node in network.nodes.items() if isinstance(node, Node)}
    informed = {name: node.filters[node.informed_by] for name, node in nodes.items() if node.informed_by is not None}
    for name in informed:
        if not nodes[name].complete:
            raise fail(f"power of {name!r}, a sensor with feedback", "a link that loses nothing", "one that erases")
    return informed


def _compute_innovation_moments(
    filter: AbstractFilter, inputs: Float[np.ndarray, "steps u"], horizon: int | None
) -> Moments:
    """Return E (d, 1)(d, 1)' of each step (1, steps, m + 1, m + 1), with d = y - r what a sensor with feedback sends.

    y is the measurement and r its prediction by the filter at the receiver, fed back to the sensor. So d is an
    innovation: E d = 0 and E d d' = C P C' + R. P does not depend on data, so the filter is run over zeros.

    Args:
        filter: the filter at the receiver.
        inputs: inputs of the plant (steps, inputs).
        horizon: number of steps, which has to be given.
    """
    if horizon is None or filter.claim != "exact":
        expected = "a horizon and a linear model, whose filter knows its error before any data"
        raise fail("power of a sensor with feedback", expected, "no horizon" if horizon is None else filter.claim)
    # the filter's model of plant and sensor
    model = filter.assumed
    state = filter.init()
    moments = []
    assert model is not None and model.sensor is not None  # since it predicts a measurement
    for k, u in enumerate(inputs):
        state = filter.predict(state, u, k)
        sensor = at(model.sensor, k)
        c = np.asarray(sensor.matrix)
        moment = np.eye(len(c) + 1)
        # [[C P C' + R, 0], [0, 1]]
        moment[:-1, :-1] = c @ np.asarray(filter.estimate(state).covariance) @ c.T + np.asarray(sensor.noise.covariance)
        moments.append(moment)
        state, _ = filter.correct(state, np.zeros(filter.received), k)
    return np.array([moments])


def _compute_relay_powers(network: Network, horizon: int | None) -> dict[str, Float[np.ndarray, "steps"]]:
    """Return what a sensor and relays that filter send, at each step of the horizon or of their schedules.

    A schedule is a relay's filter s+ = A s + K (z - B s - b), where s is its estimate of the state, z what it receives,
    and gains K are given for each step. The power is exact if B s + b is the z that it would receive if all others had
    its own estimate s, as `relay_schedules` makes them. `horizon` is a number of steps; None for all that schedules
    cover. Powers are by name of the sender, (steps,).

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
    # The schedule's A and B have to be the plant's A and the rows of B that the relay expects. `expected_rows` has the
    # rows of all filters one after another, and those of a filter end at its entry of `ends`.
    expected_rows = moved.predict_maps()[0]
    n = len(relays.states)
    ends = dict(zip(relays.filters, np.cumsum(relays.received), strict=True))
    # What relays send does not depend on the receiver, whose gains may be zero; it is the last of `relays.received`.
    gains = {RECEIVER: np.zeros((steps, n, relays.received[-1]))}
    for (name, schedule), count in zip(schedules.items(), relays.received, strict=False):
        gains[name] = np.asarray(schedule.gain)[:steps]
        expected = expected_rows[:, ends[name] - count : ends[name]]
        pairs = (schedule.transition, moved.transition), (schedule.expected, expected)
        if not all(
            np.shape(a)[1:] == b.shape[1:] and np.allclose(a[:steps], b, SAME_ENTRIES, SAME_ENTRIES) for a, b in pairs
        ):
            raise fail(f"schedule of {name!r}", "s+ = A s + K (z - B s - b), as relay_schedules makes them", "another")
    # The sensor (the first column of the slots) sends y where it transmits, of the power E y'y: the trace of E y y',
    # which E (y, 1)(y, 1)' holds without its last row and column.
    seconds = moments_with_one_over(relays.plant, steps)
    measured = np.array([measured_moment_with_one(relays.sensor, x, k) for k, x in enumerate(seconds)])
    sensor_power = np.trace(measured[:, :-1, :-1], axis1=1, axis2=2) * moved.transmits_in_slot[:, 0]
    return {SENSOR: sensor_power, **given_design(relays, gains).power}


def _draw_moments(
    plant: AnyPlant, sources: Sources, inputs: Float[np.ndarray, "steps u"], runs: int, seed: int
) -> dict[str, Moments]:
    """Return E (y, 1)(y, 1)' of each sensor (batch, steps, m1, m1), as means over batches of drawn trajectories.

    There are BATCHES batches of equal size, whose differences show how exact the mean is.

    Args:
        plant: the plant.
        sources: sensor and channel by node.
        inputs: inputs of the plant (steps, inputs).
        runs: number of trajectories.
        seed: of the random numbers.
    """
    keys = jax.random.split(seed_key(seed), (BATCHES, runs // BATCHES))
    sensors = {name: sensor for name, (sensor, _) in sources.items()}
    return {name: np.asarray(y) for name, y in _average_draws(plant, sensors, jnp.asarray(inputs), keys).items()}


@compile_in_float64
def _average_draws(
    plant: AnyPlant, sensors: dict[str, AnySensor], inputs: Array, keys: jax.Array
) -> dict[str, jax.Array]:
    """Return E (y, 1)(y, 1)' of each sensor at each step, (batch, steps, m1, m1), a mean over drawn trajectories.

    Args:
        plant: the plant.
        sensors: by name.
        inputs: of the plant (steps, inputs).
        keys: a random key for each trajectory (batch, trajectories).
    """

    def draw_trajectory(key: jax.Array) -> dict[str, jax.Array]:
        """Return (y, 1)(y, 1)' of each sensor at each step of one trajectory of the plant, drawn with this key."""
        return _draw_output_squares(plant, sensors, inputs, key)

    squares: dict[str, jax.Array] = jax.vmap(jax.vmap(draw_trajectory))(keys)
    averages: dict[str, jax.Array] = jax.tree.map(lambda of_sensor: of_sensor.mean(axis=1), squares)
    return averages


def _draw_output_squares(
    plant: AnyPlant, sensors: dict[str, AnySensor], inputs: Array, key: jax.Array
) -> dict[str, jax.Array]:
    """Return (y, 1)(y, 1)' of what each sensor measures at each step of one drawn trajectory, (steps, m + 1, m + 1).

    The mean over trajectories estimates the second moments of y, which give the power that is sent. `inputs` are those
    of the plant, (steps, inputs); sensors have m outputs each.
    """
    key_of_start, key_of_steps = jax.random.split(key)

    def draw_step(x: jax.Array, row: tuple[Array, Array]) -> tuple[jax.Array, dict[str, jax.Array]]:
        """Return the state after step k, and (y, 1)(y, 1)' of every sensor, which measures it then.

        `x`: the state before. `row`: number of the step, and the inputs. From outside: `key_of_steps`, the trajectory's
        key, from which each step gets keys of its own, and `sensors` by name. `plant` is the plant, which may vary over
        time.
        """
        k, u = row
        key_of_noise, *keys_of_sensors = jax.random.split(jax.random.fold_in(key_of_steps, k), 1 + len(sensors))
        plant_k = at(plant, k)
        x = plant_k.plus(plant_k.transition(x, u), plant_k.sample_noise(key_of_noise, u))
        squares = {}
        for key_of_sensor, (name, sensor) in zip(keys_of_sensors, sensors.items(), strict=True):
            sensor_k = at(sensor, k)
            y = wrap_angles(sensor_k.measure(x) + sensor_k.noise.sample(key_of_sensor), sensor_k.angles)
            extended = jnp.append(y, 1.0)
            squares[name] = jnp.outer(extended, extended)
        return x, squares

    start = at(plant, 0).sample_initial(key_of_start)
    rows = (jnp.arange(len(inputs)), jnp.asarray(inputs))
    over_time: dict[str, jax.Array]
    _, over_time = jax.lax.scan(draw_step, start, rows)
    return over_time
