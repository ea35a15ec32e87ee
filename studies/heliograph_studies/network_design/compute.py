"""What the example computes: designs of six sensors, the demonstration's twin, published networks, schedules, sites."""

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

import heliograph as hg
from heliograph.planning.comparisons import Front
from heliograph.planning.paths.model import path_information
from heliograph_studies.demo import robot
from heliograph_studies.demo.compute import Design, designs, one_trial
from heliograph_studies.demo.compute import networks as demo_networks
from heliograph_studies.demo.recording import read_recording
from heliograph_studies.network_design import setting as models
from heliograph_studies.network_design import theory
from heliograph_studies.network_design.published import Circuit, circuit, packets
from heliograph_studies.network_design.setting import Setting
from heliograph_studies.outcome import Inline
from heliograph_studies.stages import Stages

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
