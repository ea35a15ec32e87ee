"""Messages against error, before any data: rates of senders that decide, thresholds for a budget, and a bound."""

from collections.abc import Callable
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq

from heliograph.filters.event.factory import event_filter
from heliograph.model.channel import Channel
from heliograph.model.plant import AnyPlant, LinearPlant
from heliograph.model.sensor import AnySensor, LinearSensor, refuse_angles
from heliograph.model.trigger import AbstractTrigger
from heliograph.numerics.check import TINY, check_count, fail, scalar
from heliograph.numerics.module import readable
from heliograph.planning.send_on_delta_grid import ScalarSystem, compute_rate_on_grid
from heliograph.random_affine.noises.noise import Gaussian
from heliograph.simulation.network import Network
from heliograph.simulation.node import Node
from heliograph.simulation.simulate import monte_carlo

QUADRATURE_NODES = 80  # Gauss-Legendre nodes of each part of the line: the densities are smooth in each
RAREST_RATE = 1e-6  # rate of messages that a grid holds
LONGEST_LINE = 100  # deviations of a step from 0, beyond which there are too many nodes
GRID_ACCURACY = 1e-3  # relative, of a rate by a grid
TAIL_DEVIATIONS = 12.0  # deviations at which a density ends


@readable
class MessageRate(NamedTuple):
    """Rate of messages and mean square errors, with their standard errors, which are 0 where they are exact.

    Args:
        rate: transmissions a step.
        error: mean square errors of the states, (n,).
        rate_error: standard error of the rate.
        error_error: standard errors of the errors, (n,).
    """

    rate: float
    error: np.ndarray
    rate_error: float
    error_error: np.ndarray


def simulate_rate(
    plant: AnyPlant,
    sensor: AnySensor,
    channel: Channel,
    trigger: AbstractTrigger,
    runs: int = 64,
    horizon: int = 400,
    seed: int = 0,
) -> MessageRate:
    """Return the rate of messages and the error of `event_filter` behind a rule, by simulation: any plant, any link.

    A sender transmits only when its rule asks for it, and `event_filter` uses its silence too. Results are means over
    the last three quarters of the steps, when the start is forgotten.

    Args:
        plant: the plant.
        sensor: the sensor.
        channel: the link, with its losses.
        trigger: the sender's rule of when to send.
        runs: number of simulated runs (default 64).
        horizon: steps of a run (default 400).
        seed: seed of the draws (default 0).

    Raises:
        ValueError: parts that do not fit; counts below 2 runs and 4 steps.
    """
    check_count("runs", runs, 2)  # of fewer no spread is known
    check_count("horizon", horizon, 4)  # whose first quarter is left out
    node = Node(sensor, channel, {"event": event_filter(plant, sensor, channel, trigger)}, trigger=trigger)
    record = monte_carlo(Network(plant, {"sender": node}), horizon, runs, seed)
    # Means over time of each run, whose spread gives the standard errors: transmissions are (runs, steps, 1), errors
    # (runs, steps, n).
    settled = horizon // 4
    sent = record.transmissions["sender"][:, settled:] != 0
    rates = sent.mean(axis=(1, 2))
    squares = (record.errors("sender", "event")[:, settled:] ** 2).mean(axis=1)
    return MessageRate(
        rate=float(rates.mean()),
        error=squares.mean(axis=0),
        rate_error=float(rates.std(ddof=1) / np.sqrt(runs)),
        error_error=squares.std(axis=0, ddof=1) / np.sqrt(runs),
    )


def prediction_error_rate(plant: AnyPlant, sensor: AnySensor, delta: float, loss: float = 0.0) -> MessageRate:
    """Return rate and error of a sender whose Kalman filter sends its estimate where the prediction is off by delta.

    The prediction is that from the last estimate that was acknowledged. Each is lost with probability `loss`, and the
    sender knows. Let P be the variance of the sender's filter, P- that before it measures, and e the difference of its
    estimate and the prediction. Of a plant x+ = a x + N(0, q), measured with noise of variance R in units of x,

        e+ = a e + N(0, s^2),  s^2 = P-^2 / (P- + R),     0 where an estimate arrives.

    Let v(e) be the density of the values e over the steps without an arrival, from one arrival to the next. It solves

        v = kappa (N(.; 0, s^2) + int N(.; a e, s^2) v de),  kappa = 1 within delta, `loss` beyond.

    Let V and M be int v and int e^2 v within delta. Integrals of the equation and of e^2 times it over the whole line
    give the mean length T of such a cycle, the rate and the error, whatever is left beyond:

        T = V + 1 / (1 - loss),  rate = 1 / ((1 - loss) T),
        error = P + (loss s^2 + (1 - loss) M / T) / (1 - loss a^2),  infinite where loss a^2 >= 1.

    Args:
        plant: linear, of one state, with Gaussian noise.
        sensor: linear, of one output, with Gaussian noise.
        delta: distance beyond which is sent, in the unit of the state.
        loss: probability that a transmission is lost (default 0).

    Raises:
        ValueError: another plant or sensor, an angle; a loss of 1 or more.
    Source: Lipsa and Martins, Remote state estimation with communication costs for first-order LTI systems (2011).
    """
    system = _require_scalar_system(plant, sensor)
    a, q, c, r = system
    delta = float(scalar("delta", delta, TINY))
    loss = float(scalar("loss", loss, 0.0, 1.0))
    if loss == 1:
        raise fail("loss", "a number below 1", loss)
    posterior = system.kalman_variance
    s = (a * a * posterior + q) / np.sqrt(a * a * posterior + q + r / c**2)
    # The line in parts, within delta and beyond, with nodes and weights of an integral over it. Beyond delta e stays
    # only where what is sent is lost, so that without losses there is nothing.
    far = delta + TAIL_DEVIATIONS * s / np.sqrt(1 - loss)
    edges = [-far, -delta, delta, far] if loss else [-delta, delta]
    if far > LONGEST_LINE * s:
        most = f"a line of at most {LONGEST_LINE} deviations of a step, {LONGEST_LINE * s:.3g}"
        raise fail("delta and loss", most, f"{far:.3g}")
    nodes, weights = _make_quadrature(edges, s)
    # The integral equation of v at the nodes (Nystrom's method), then the sums over a cycle.
    is_within = np.abs(nodes) <= delta
    kappa = np.where(is_within, 1.0, loss)
    kernel = kappa[:, None] * _normal_density(nodes[:, None] - a * nodes, s * s) * weights  # [to, from]
    visits = np.linalg.solve(np.eye(len(nodes)) - kernel, kappa * _normal_density(nodes, s * s)) * weights  # v de
    # Summed is what lies within delta: what an unstable plant drives beyond the ends of the line does not come back.
    cycle = visits[is_within].sum() + 1 / (1 - loss)
    second = nodes[is_within] ** 2 @ visits[is_within] / cycle
    decay = 1 - loss * a * a
    error = posterior + (loss * s * s + (1 - loss) * second) / decay if decay > 0 else np.inf
    rate = float(1 / ((1 - loss) * cycle))
    return MessageRate(rate=rate, error=np.array([error]), rate_error=0.0, error_error=np.zeros(1))


def least_error(plant: AnyPlant, sensor: AnySensor, rate: float, loss: float = 0.0) -> float:
    """Return the least mean square error of senders that transmit at most at this rate and know what arrived.

    It is computed with thresholds as in `prediction_error_rate`. They are optimal for first-order plants, as others
    proved for links without loss (Lipsa and Martins 2011) and for acknowledged losses (Chakravorty and Mahajan 2020).

    Args:
        plant: the plant, as in `prediction_error_rate`.
        sensor: its sensor, as there.
        rate: transmissions a step.
        loss: probability that a transmission is lost (default 0).

    Raises:
        ValueError: as `prediction_error_rate`; a rate that is not between 0 and 1.
    """
    system = _require_scalar_system(plant, sensor)
    delta = _find_threshold(rate, lambda delta: prediction_error_rate(plant, sensor, delta, loss).rate, system)
    return float(prediction_error_rate(plant, sensor, delta, loss).error[0])


def send_on_delta_rate(plant: AnyPlant, sensor: AnySensor, delta: float) -> float:
    """Return the transmissions a step of send-on-delta in the long run.

    Losses do not change the rate, since a value is compared with the last one sent, whether it arrived or not.
    It comes from the stationary law of (x, last value sent) as a Markov chain on two grids of cells, extrapolated. The
    relative error is 1e-3 if one step in 100 sends, and 1 % if one in 2,500 does.

    Args:
        plant: linear, of one state, stable, without inputs, with Gaussian noise.
        sensor: linear, of one output, with Gaussian noise.
        delta: a value is sent if it is further than this from the last value sent, in the unit of y.

    Raises:
        ValueError: another plant or sensor, an angle; a plant that is not stable; a delta so large
            that less than one message in a million steps is sent; a grid that is too fine, or a rate that converges
            too slowly to be computed.
    """
    system = _require_scalar_system(plant, sensor, without_inputs=True)
    rate = _send_on_delta_rate(system, float(scalar("delta", delta, TINY)))
    if rate < RAREST_RATE:
        raise fail("delta", f"one at which more than {RAREST_RATE:g} messages are sent a step", f"{delta:g}")
    return rate


def _send_on_delta_rate(system: ScalarSystem, delta: float) -> float:
    """Return the rate of messages of send-on-delta, however small, extrapolated from two grids.

    `system`: x+ = a x + w and z = c x + v, with q = Var w and r = Var v.
    """
    if not abs(system.a) < 1:
        raise fail("plant", "a stable one, which has a rate in the long run", f"a = {system.a:g}")
    # Change to the unit of the state, so that c is 1.
    delta = delta / abs(system.c)
    system = system._replace(c=1.0, r=system.r / system.c**2)
    coarse = compute_rate_on_grid(system, delta, share=0.8)
    fine = compute_rate_on_grid(system, delta, share=0.5)
    if fine.rate == coarse.rate:  # if nothing is ever sent, both grids say 0
        return fine.rate
    # Take off the error of the rectangle rule at the cut at delta, which is a multiple of the cell's size squared.
    return float(fine.rate + (fine.rate - coarse.rate) * fine.cell**2 / (coarse.cell**2 - fine.cell**2))


def delta_for_rate(plant: AnyPlant, sensor: AnySensor, rate: float) -> float:
    """Return the delta at which send-on-delta transmits at this rate, by root finding on `send_on_delta_rate`.

    Args:
        plant: the plant, as in `send_on_delta_rate`.
        sensor: its sensor, as there.
        rate: transmissions a step.

    Raises:
        ValueError: as `send_on_delta_rate`; a rate that is not between 0 and 1.
    """
    system = _require_scalar_system(plant, sensor, without_inputs=True)
    return _find_threshold(rate, lambda delta: _send_on_delta_rate(system, delta), system, GRID_ACCURACY)


def _find_threshold(
    rate: float, rate_at: Callable[[float], float], system: ScalarSystem, accuracy: float = 1e-10
) -> float:
    """Return the threshold delta at which the falling function `rate_at(delta)` has this rate.

    Args:
        rate: the rate of messages, between 0 and 1.
        rate_at: the rate of messages by threshold.
        system: plant and sensor, whose noises give a first guess.
        accuracy: relative accuracy of the threshold.
    """
    if not 0 < scalar("rate", rate) < 1:
        raise fail("rate", "a number between 0 and 1", rate)
    # The deviation of a measured value from one step to the next is a first guess of the threshold.
    unit = np.sqrt(system.q * system.c**2 + system.r)
    low = high = unit
    while rate_at(low) < rate:
        low /= 2
    while rate_at(high) > rate:
        high *= 2
    return float(brentq(lambda delta: rate_at(delta) - rate, low, high, rtol=accuracy, xtol=accuracy * unit))


def _require_scalar_system(plant: AnyPlant, sensor: AnySensor, without_inputs: bool = False) -> ScalarSystem:
    """Return a, q, c, r of a linear plant and sensor of one number and Gaussian noise each; ValueError for others.

    Refused are angles too, a plant without noise and a sensor of nothing, behind which there is nothing to send.

    Args:
        plant: the plant.
        sensor: the sensor.
        without_inputs: whether a plant with inputs is refused too.
    """
    expected = "a LinearPlant and LinearSensor of one state and output"
    if not isinstance(plant, LinearPlant) or not isinstance(sensor, LinearSensor):
        raise fail("rate before any data", expected, f"{type(plant).__name__} and {type(sensor).__name__}")
    if len(plant.states) != 1:
        raise fail("rate before any data", expected, "several states")
    if len(sensor.outputs) != 1:
        raise fail("rate before any data", "one output", f"{len(sensor.outputs)}")
    if without_inputs and plant.inputs:  # what is measured moves as they do
        raise fail("rate before any data", "a plant without inputs", list(plant.inputs))
    if not (isinstance(plant.noise, Gaussian) and isinstance(sensor.noise, Gaussian)):
        laws = f"{type(plant.noise).__name__} and {type(sensor.noise).__name__}"
        raise fail("rate before any data", "Gaussian noises (simulate_rate takes any)", laws)
    refuse_angles("rate before any data", plant, sensor)
    system = ScalarSystem(
        a=float(np.asarray(plant.matrix)[0, 0]),
        q=float(np.asarray(plant.noise.covariance)[0, 0]),
        c=float(np.asarray(sensor.matrix)[0, 0]),
        r=float(np.asarray(sensor.noise.covariance)[0, 0]),
    )
    if system.q == 0 or system.c == 0:
        got = f"a variance of {system.q:g} and a matrix of {system.c:g}"
        raise fail("rate before any data", "a plant with noise, and a sensor of its state", got)
    return system


def _make_quadrature(edges: list[float], unit: float) -> tuple[np.ndarray, np.ndarray]:
    """Return Gauss-Legendre nodes and weights on a line that is cut at `edges`, and into intervals of at most 8 units.

    QUADRATURE_NODES nodes suffice on each interval, since the integrand changes over a unit or more.
    """
    intervals: list[tuple[float, float]] = []
    for begin, end in pairwise(edges):  # each part of the line
        count = int(np.ceil((end - begin) / (8 * unit)))
        intervals += pairwise(np.linspace(begin, end, count + 1))
    # Nodes and weights of the interval from -1 to 1, moved to each of these.
    x, w = np.polynomial.legendre.leggauss(QUADRATURE_NODES)
    nodes = np.concatenate([(a + b) / 2 + (b - a) / 2 * x for a, b in intervals])
    weights = np.concatenate([(b - a) / 2 * w for a, b in intervals])
    return nodes, weights


def _normal_density(e: np.ndarray, variance: float) -> np.ndarray:
    """Return the density N(e; 0, variance)."""
    return np.asarray(np.exp(-(e**2) / (2 * variance)) / np.sqrt(2 * np.pi * variance))
