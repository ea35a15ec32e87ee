"""What the example computes: designs of six sensors, the demonstration's twin, published networks, schedules, sites."""

from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import brentq, minimize_scalar

import heliograph as hg
from heliograph.planning.comparisons import Front
from heliograph.planning.paths.model import path_information
from heliograph_studies import Inline, Stages
from heliograph_studies.demo import robot
from heliograph_studies.demo.compute import Design, designs, one_trial
from heliograph_studies.demo.compute import networks as demo_networks
from heliograph_studies.demo.recording import read_recording
from heliograph_studies.network_design import setting as models
from heliograph_studies.network_design import theory
from heliograph_studies.network_design.setting import Setting
from heliograph_studies.network_design.theory import feedback_limit
from heliograph_studies.successive_relays import setting as successive_relays

PLANT = hg.LinearPlant([[1.1, 0.2], [0.2, 0.8]], np.eye(2), [0.0, 0.0], np.eye(2))
SENSOR = hg.LinearSensor([[1.0, 1.0]], 1.0)
CLOSE = 1e-4  # of the published error, to which it is reached


class Circuit(NamedTuple):
    """What designed relays save beside the published ones: error at their power, power at their error."""

    error_saved_percent: float
    power_saved_percent: float


def circuit() -> Circuit:
    """Relays designed for the best receiver behind them, not each for its own error, in the published network."""
    network = successive_relays.Setting().network()
    as_published = hg.relays.periodic_local_error_design(network)
    power, published = as_published.total_power(), float(as_published.trace("receiver")[1:].sum())
    start = dict(successive_relays.QUIET_START)

    def error(share: float) -> float:
        gains = hg.relays.periodic_relays_for_best_receiver(network, start, power_limit=share * power)
        start.update(gains)
        return float(np.trace(hg.relays.periodic_behind_relays(network, gains), axis1=1, axis2=2).sum())

    # Secant steps on the error over 1 / share of the power, until it is the published one.
    tried = [(1.0, error(1.0)), (2.0, error(0.5))]  # by 1 / share, in which the error is nearly a line
    while abs(tried[-1][1] / published - 1) > CLOSE:
        (a, low), (b, high) = tried[-2:]
        following = b + (published - high) * (b - a) / (high - low)
        tried.append((following, error(1 / following)))
    return Circuit(100 * (1 - tried[0][1] / published), 100 * (1 - 1 / tried[-1][0]))


def packets(times: float) -> dict[str, float]:
    """Mean power saved by a relay halfway where the error may be so many times that without losses, in percent.

    A packet over a length d with power p arrives with probability exp(-d^3 / p). `silent`: the relay sends only what
    came; `always`: it sends at each step. Bounded is the mean error of the filter that knows of losses, of which
    packets with arrival q leave what a path of noise D = 1 / q does.
    """

    def error(arrival: float) -> float:
        predicted = feedback_limit(PLANT, SENSOR, [hg.hop(1.0, 1 / arrival - 1)], 1.0).predicted
        return np.inf if predicted is None else float(np.trace(predicted))

    lowest = 1 - 1 / float(np.max(np.abs(np.linalg.eigvals(PLANT.matrix)))) ** 2
    target = times * error(1.0)
    arrival = brentq(lambda q: min(error(q), 1e6) - target, lowest + 1e-6, 1.0, xtol=1e-12)
    loss = -np.log(arrival)

    def silent(share: float) -> float:
        return float(0.125 / (share * loss) + np.exp(-share * loss) * 0.125 / ((1 - share) * loss))

    least = minimize_scalar(silent, bounds=(1e-3, 1 - 1e-3), method="bounded", options={"xatol": 1e-10}).fun
    return {"arrival": float(arrival), "silent": 100 * float(1 - least * loss), "always": 50.0}


Case = dict[str, Any]
CHOSEN = (1, 2, 3)  # how many of the sensors
MOST, FADING = 8, 1.02  # relays on a line, and E g^2 / (E g)^2 of its hops


@dataclass(frozen=True)
class Schedules:
    """One sensor at each step, bursts over two hops, and sensors that are chosen once, by their number."""

    turns: Inline[theory.SendingSchedule]
    bursts: theory.Bursts
    sensors: dict[int, theory.Choice]


@dataclass(frozen=True)
class Outcome:
    """Designs by total power, and what each part of the example finds; sites by the noise of the whole way."""

    one_hop: dict[float, Case]
    two_hops: dict[float, Case]
    front: Front
    demonstration: dict[str, Design]
    circuit: Circuit
    packets: dict[float, dict[str, float]]
    schedules: Schedules
    sites: dict[float, dict[str, dict[str, float]]]


def compute(setting: Setting, stages: Stages) -> Outcome:
    """Everything."""

    def cases(name: str, relayed: bool, totals: tuple[float, ...]) -> dict[float, Case]:
        return {p: stages(name, partial(case, relayed, p), done, len(totals)) for done, p in enumerate(totals)}

    return Outcome(
        cases("six sensors over one hop", False, setting.one_hop),
        cases("six sensors over two hops", True, setting.two_hops),
        stages("the least error over power", lambda: front(setting, stages)),
        stages("the demonstration's relays", lambda: demonstration(setting, stages)),
        *stages("published designs", lambda: (circuit(), {times: packets(times) for times in setting.losses})),
        stages("schedules", lambda: schedules(setting)),
        stages("sites", lambda: {rho: sites(rho, setting.exponent) for rho in setting.rho}),
    )


def case(relayed: bool, total: float) -> Case:
    """The error of equal powers, the best, and the least power for the error of equal powers, with what is proven."""
    network = models.six(relayed)
    paths = hg.planning.paths_of(network, hg.planning.Error())[0]
    hops = paths.kappa.shape
    equal = theory.steady_error(paths, path_information(paths, np.full(hops, total / hops[1])).information)
    best, least = hg.design(network, budget=total), hg.design(network, target_error=equal)
    hop_powers = [float(power[0]) for power in best.powers.values()]
    powers = np.bincount(paths.path, hop_powers)
    result = {"equal": equal, "best": best.error, "powers": powers, "least_power": least.total}
    if not relayed:
        return {**result, "gap": best.certificate.gap}
    sending = [name for name, power in zip(models.NAMES, powers, strict=True) if power > 1e-9 * total]
    narrow = hg.design(models.six(relayed, sending), target_error=equal)
    proven = {"bound": best.bound, "least_power_bound": least.bound}
    return {**result, **proven, "hop_powers": hop_powers, "least_power_same_paths": narrow.total}


def front(setting: Setting, stages: Stages) -> Front:
    """Least errors of two hops, at several total powers."""
    problem, done = hg.planning.DesignProblem(models.six(True)), iter(range(len(setting.front)))
    return hg.planning.error_over_power(
        problem, setting.front, lambda _: stages.progress(next(done), len(setting.front))
    )


def demonstration(setting: Setting, stages: Stages) -> dict[str, Design]:
    """The demonstration's relays as they are, and less the ranges at the start: means over the seeds."""
    recording, seeds = read_recording(), range(setting.seed, setting.seed + setting.seeds)
    network, plain = demo_networks(robot.DRIVES[recording.name], 1.0), []
    for done, seed in enumerate(seeds):
        stages.progress(done, len(seeds))
        plain.append(one_trial(recording, network, seed).scores["relay_aware"])
    return designs(recording, plain, seeds)


def schedules(setting: Setting) -> Schedules:
    """Who of the six sensors sends when, received directly, and how seldom over two hops."""
    paths = hg.planning.paths_of(models.six(False), hg.planning.Error())[0]
    turns = theory.best_schedule(paths, setting.on, setting.periods)
    bursts = theory.burst_sending(models.slow_state(), 0.5)
    return Schedules(turns, bursts, {k: theory.choose_sensors(paths, k, setting.chosen) for k in CHOSEN})


def sites(rho: float, exponent: float) -> dict[str, dict[str, float]]:
    """One relay without fading, and the best number of relays with a little of it."""
    line, best = theory.relay_line(rho, exponent), theory.best_relays(rho, exponent, MOST, FADING)[0]
    return {
        "one_relay": {
            "site": float(line.sites[0]), "noise": line.noise, "midpoint": line.even, "direct": line.direct,
        },
        "with_fading": {"relays": len(best.lengths) - 1, "noise": best.noise, "direct": best.direct},
    }  # fmt: skip
