"""What the example computes: designs of six sensors, the demonstration's twin, published networks, schedules, sites."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

import heliograph as hg
from heliograph.planning import DesignProblem, PowerDesign, error_over_power
from heliograph.planning.comparisons import Front
from heliograph_studies.demo import robot
from heliograph_studies.demo.compute import networks as demo_networks
from heliograph_studies.demo.compute import one_trial
from heliograph_studies.demo.recording import read_recording
from heliograph_studies.demo.twin import Design, as_it_is, twins
from heliograph_studies.network_design import setting
from heliograph_studies.network_design.published import Circuit, circuit, packets
from heliograph_studies.network_design.theory import (
    Bursts,
    Choice,
    RelayLine,
    SendingSchedule,
    best_relays,
    best_schedule,
    burst_sending,
    choose_sensors,
    relay_line,
)

ONE_HOP, TWO_HOPS = (2.0, 10.0, 50.0), (6.0, 30.0)  # total powers
FRONT = (2.0, 4.0, 8.0, 15.0, 30.0, 60.0)
PERIODS = range(1, 6)
ON = 6.0  # power of the one sensor that sends at a step
SEEDS = 5
LOSSES = (1.1, 3.0)  # times the error without losses
RHOS = (1.0, 4.0, 8.0, 20.0, 60.0)  # noise of the whole way over the power
EXPONENT = 3.0
STAGES = len(ONE_HOP) + len(TWO_HOPS) + len(FRONT) + 6


class Case(NamedTuple):
    """One total power: the error of equal powers, the best found, and the least power for the error of equal ones."""

    equal: float
    best: PowerDesign
    least: PowerDesign
    narrow: PowerDesign  # the least power on the paths of the best


class Outcome(NamedTuple):
    """All that was found."""

    one_hop: dict[float, Case]
    two_hops: dict[float, Case]
    front: Front
    demonstration: dict[str, Design]
    circuit: Circuit
    packets: dict[float, dict[str, float]]
    schedule: SendingSchedule
    bursts: Bursts
    lines: dict[float, tuple[RelayLine, RelayLine]]  # one relay, and the best number of them with fading
    sensors: dict[int, Choice]


def case(relayed: bool, total: float) -> Case:
    """Equal powers, the best, and the least power at the error of equal powers."""
    network = setting.six(relayed)
    best = hg.design(network, budget=total)
    equal = equal_error(network, total)
    least = hg.design(network, target_error=equal)
    sending = [name for name, power in path_powers(best).items() if power > 1e-9 * total]
    narrow = least if not relayed else hg.design(setting.six(relayed, sending), target_error=equal)
    return Case(equal, best, least, narrow)


def equal_error(network: hg.Network, total: float) -> float:
    """The error where all transmitters send the same, and together the total."""
    names = list(hg.power(network).mean)
    each = {name: np.array([total / len(names)]) for name in names}
    designed = hg.planning.designed_network(network, each, hg.planning.Error())
    return hg.design(designed, budget=total, starts=1).present  # whatever is found


def path_powers(design: PowerDesign) -> dict[str, float]:
    """Mean power of all transmitters of each sensor's path."""
    found: dict[str, float] = {}
    for name, power in design.powers.items():
        path = name.partition(".")[0]
        found[path] = found.get(path, 0.0) + float(np.mean(power))
    return found


def demonstration(seed: int) -> dict[str, Design]:
    """The demonstration's relays as they are, and less the ranges at the start."""
    recording = read_recording()
    network = demo_networks(robot.DRIVES[recording.name], 1.0)
    seeds = range(seed, seed + SEEDS)
    plain = [one_trial(recording, network, one).scores["relay_aware"] for one in seeds]
    return {"as_it_is": as_it_is(recording, plain), **twins(recording, seeds)}


def compute(seed: int, advance: Callable[[str], None] = lambda what: None) -> Outcome:
    """Everything; `advance` is told what begins."""
    cases: dict[bool, dict[float, Case]] = {False: {}, True: {}}
    for relayed, totals in ((False, ONE_HOP), (True, TWO_HOPS)):
        for total in totals:
            advance(f"six sensors over {'two hops' if relayed else 'one hop'}, power {total:g}")
            cases[relayed][total] = case(relayed, total)
    front = error_over_power(DesignProblem(setting.six(True)), FRONT, advance)
    advance("the demonstration's relays")
    told_less = demonstration(seed)
    advance("published designs")
    saved = {times: packets(times) for times in LOSSES}
    advance("the published circuit")
    found = circuit()
    advance("schedules")
    paths = setting.six_paths()
    schedule = best_schedule(paths, ON, PERIODS)
    bursts = burst_sending(setting.slow_state(), [0.5, 0.5])
    advance("sites")
    lines = {rho: (relay_line(rho, EXPONENT), best_relays(rho, EXPONENT, 8, 1.02)[0]) for rho in RHOS}
    sensors = {k: choose_sensors(paths, k, 2.0) for k in (1, 2, 3)}
    return Outcome(cases[False], cases[True], front, told_less, found, saved, schedule, bursts, lines, sensors)
