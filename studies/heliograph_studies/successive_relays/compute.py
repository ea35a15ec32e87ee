"""Every number of the reproduction: designs, steady states, certificates, misprints and the simulation."""

from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import numpy as np

import heliograph as hg
from heliograph.relays.design import GainsByFilter
from heliograph_studies.successive_relays import setting
from heliograph_studies.successive_relays.certificate import RelayCertificate, certify_relays
from heliograph_studies.successive_relays.printed import MISPRINTS, by_filter, recursion

RUNS = 20_000
SWEEPS = 200  # of the design at the paper's power
STEADY = 1500  # steps after which a recursion is taken as settled: the plant forgets by 0.98 a step
FILTERS = ("relay_1", "relay_2", "receiver")


class Simulated(NamedTuple):
    """Mean squared error of each filter at k = 0 .. horizon and its standard error, from batches of runs."""

    mean: dict[str, np.ndarray]
    error: dict[str, np.ndarray]


class Misprinted(NamedTuple):
    """Relative to the right recursion: the trace it claims for the remote filter, and what its gains really give."""

    claimed: np.ndarray
    true: np.ndarray
    relay_2: np.ndarray


class Steady(NamedTuple):
    """Steady trace at the end of an even and of an odd step, and the relays' power in each (odd, even)."""

    even: float
    odd: float
    power: np.ndarray


class Reproduction(NamedTuple):
    """Everything that summary, figures and report are made of."""

    seed: int
    runs: int
    network: hg.model.RelayNetwork
    paper: hg.relays.RelayDesign
    tuned: hg.relays.RelayDesign
    bounded: hg.relays.RelayDesign
    best_behind: np.ndarray
    steady: dict[str, Steady]
    limits: dict[str, float]
    certificates: dict[str, RelayCertificate]
    misprints: dict[str, Misprinted]
    simulated: Simulated
    run: hg.Record
    counterexample: RelayCertificate


def compute(runs: int = RUNS, seed: int = 0, advance: Callable[[str], None] = lambda what: None) -> Reproduction:
    """Compute all of it; `advance` is told what begins."""
    network = setting.network()
    advance("designing over the horizon")
    paper = hg.relays.own_error_design(network, setting.HORIZON)
    tuned = hg.relays.receiver_error_design(network, setting.HORIZON)
    bounded = hg.relays.receiver_error_design(network, setting.HORIZON, power_limit=paper.total_power(), sweeps=SWEEPS)
    behind = hg.relays.receiver_behind_relays(network, paper.gains)
    advance("designing the steady state")
    states = steady(network)
    advance("certificates and misprints")
    certificates = {"paper": certify_relays(network, paper.gains), "tuned": certify_relays(network, tuned.gains)}
    wrong = {name: misprinted(name) for name in MISPRINTS}
    advance("simulating")
    simulated = simulate(network, paper, runs, seed)
    shown = hg.monte_carlo(world(network, paper), setting.HORIZON, 1, seed)
    return Reproduction(
        seed=seed, runs=runs, network=network, paper=paper, tuned=tuned, bounded=bounded,
        best_behind=np.trace(behind.gains.covariance, axis1=1, axis2=2), steady=states, limits=limits(paper),
        certificates=certificates, misprints=wrong, simulated=simulated, run=shown,
        counterexample=counterexample(),
    )  # fmt: skip


def steady(network: hg.model.RelayNetwork) -> dict[str, Steady]:
    """The two-periodic steady state of each design."""
    paper = hg.relays.periodic_own_error_design(network)
    listen = {"relay_1": 1, "relay_2": 0}  # slots: odd, even
    start = {name: np.zeros((2, 3, 1)) for name in listen}
    for name, slot in listen.items():
        start[name][slot, :, 0] = setting.QUIET_START[name]
    limited = paper.total_power()
    tuned = [hg.relays.periodic_relays_for_best_receiver(network, s) for s in (None, start)]
    quiet = hg.relays.periodic_relays_for_best_receiver(network, tuned[1], power_limit=limited)
    relays = {"lmmse": paper.gains, "lmmse_tuned": min(tuned, key=lambda g: _behind(network, g).even
              + _behind(network, g).odd), "lmmse_tuned_from_paper": tuned[0], "lmmse_quiet": quiet}  # fmt: skip
    return {
        "paper": _own(paper),
        "joint": _own(hg.relays.periodic_receiver_error_design(network)),
        "joint_quiet": _own(hg.relays.periodic_receiver_error_design(network, power_limit=limited)),
        **{name: _behind(network, gains) for name, gains in relays.items()},
        "no_relay": _without_relay(setting.hop_from_sensor()),
        "sensor_itself": _without_relay(hg.perfect()),
    }


def _own(design: hg.relays.RelayDesign) -> Steady:
    odd, even = design.trace("receiver")[1:]
    return Steady(float(even), float(odd), design.total_power())


def _behind(network: hg.model.RelayNetwork, gains: GainsByFilter) -> Steady:
    odd, even = np.trace(hg.relays.periodic_behind_relays(network, gains), axis1=1, axis2=2)
    silent = {name: gains[name] for name in network.relays} | {"receiver": np.zeros((2, 3, 1))}
    return Steady(float(even), float(odd), hg.relays.periodic_given_design(network, silent).total_power())


def _without_relay(direct: hg.random_affine.GainAndNoise) -> Steady:
    """Trace of the error of x_(k+1) predicted from what was heard up to k: as late as behind a relay."""
    filtered = hg.relays.periodic_own_error_design(setting.without_relays(direct)).covariance["receiver"][-1]
    plant, process = setting.plant(), setting.process_covariance()
    value = float(np.trace(plant.matrix @ filtered @ plant.matrix.T + process))
    return Steady(value, value, np.zeros(2))


def limits(paper: hg.relays.RelayDesign) -> dict[str, float]:
    """Other steady traces to compare with: filtered without relays, and nothing heard."""
    filtered = {
        name: float(hg.relays.periodic_own_error_design(setting.without_relays(direct)).trace("receiver")[-1])
        for name, direct in (("no_relay_filtered", setting.hop_from_sensor()), ("sensor_itself_filtered", hg.perfect()))
    }
    covariance, plant, process = setting.INITIAL_COVARIANCE, setting.plant(), setting.process_covariance()
    for _ in range(STEADY):
        covariance = np.asarray(plant.matrix @ covariance @ plant.matrix.T) + process
    return {**filtered, "nothing_heard": float(np.trace(covariance))}


@cache
def misprinted(name: str, process: float = setting.VARIANCE, sensor: float = setting.VARIANCE) -> Misprinted:
    """What a misprint does to the trace that is claimed, and to the true one, at k = 0 .. STEADY."""
    right, wrong = recursion("none", STEADY, process, sensor), recursion(name, STEADY, process, sensor)
    network = setting.network(setting.plant(process=process), setting.sensor(sensor))
    true = hg.relays.given_design(network, by_filter(wrong))
    return Misprinted(
        wrong.remote_trace / true.trace("receiver"),
        true.trace("receiver") / right.remote_trace,
        true.trace("relay_2") / right.relay_trace[:, 1],
    )


def world(network: hg.model.RelayNetwork, design: hg.relays.RelayDesign) -> hg.Network:
    """The relays with their filters, and the receiver's."""
    schedules = hg.relays.relay_schedules(network, design)
    receiver = hg.filters.ScheduledFilter(schedules.pop("receiver"))
    return hg.Network.of_relays(network, schedules, {"own": receiver})


def initial_states(runs: int, seed: int) -> np.ndarray:
    """x_0 of each run, (runs, 3): where a plant that does not move is after a step."""
    still = hg.LinearPlant(np.eye(3), 0.0, setting.INITIAL_MEAN, setting.INITIAL_COVARIANCE)
    sensor = hg.LinearSensor(setting.SENSING, 0.0)
    found = hg.monte_carlo(hg.Network(still, {"nobody": hg.Node(sensor, hg.perfect(), {})}), 1, runs, seed)
    return np.asarray(found.truth)[:, 0]


def simulate(network: hg.model.RelayNetwork, design: hg.relays.RelayDesign, runs: int, seed: int) -> Simulated:
    """Mean squared errors of relays and receiver, run as filters in the world."""
    found = hg.monte_carlo(world(network, design), setting.HORIZON, runs, seed, hg.Statistics())
    start = np.sum((initial_states(runs, seed) - network.initial()[0]) ** 2, axis=1)
    mean, error = {}, {}
    for name in FILTERS:
        statistics = found[name]["own"]
        batches = np.trace(statistics.outer, axis1=2, axis2=3) / statistics.count[:, None]
        weights = statistics.count / statistics.count.sum()
        mean[name] = np.concatenate([[start.mean()], weights @ batches])
        spread = np.sqrt(weights @ (batches - weights @ batches) ** 2 / (len(batches) - 1))
        error[name] = np.concatenate([[start.std(ddof=1) / np.sqrt(runs)], spread])
    return Simulated(mean, error)


def counterexample() -> RelayCertificate:
    """A scalar system that is bounded as Lemmas 8 and 9 ask, and obeys none of their printed lower bounds."""
    plant = hg.LinearPlant([[0.5]], [[1.0]], [0.0], [[10.0]])
    law = setting.shadowing(0.5, 0.1)
    noisy, quiet = hg.hop(law, 1e6), hg.hop(law, 0.0)
    slots = [
        {"relay_2": {"sensor": noisy, "relay_1": quiet}, "receiver": {"relay_1": noisy}},
        {"relay_1": {"sensor": noisy, "relay_2": quiet}, "receiver": {"relay_2": noisy}},
    ]
    network = hg.model.RelayNetwork(plant, hg.LinearSensor([[1.0]], [[1.0]]), ("relay_1", "relay_2"), slots)
    return certify_relays(network, hg.relays.own_error_design(network, 60).gains)
