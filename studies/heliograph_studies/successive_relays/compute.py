"""Every number of the reproduction: designs, steady states, certificates, misprints and the simulation."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

import heliograph as hg
from heliograph.files.estimates.estimates_table import write_estimates
from heliograph.relays import RelayDesign
from heliograph.relays.design import GainsByFilter
from heliograph_studies import Stages, Unlisted
from heliograph_studies.successive_relays.certificate import RelayCertificate, certify_relays
from heliograph_studies.successive_relays.misprints import alternating
from heliograph_studies.successive_relays.recursion import MISPRINTS, Recursion, recursion
from heliograph_studies.successive_relays.setting import QUIET_START, Setting, shadowing


def by_filter(result: Recursion) -> dict[str, np.ndarray]:
    """The gains as the library takes them: relay 2 listens at odd k, relay 1 at even k."""
    odd = (np.arange(1, len(result.relay_gain) + 1) % 2 == 1)[:, None, None]
    zero = np.zeros_like(result.relay_gain)
    return {
        "relay_1": np.where(odd, zero, result.relay_gain),
        "relay_2": np.where(odd, result.relay_gain, zero),
        "receiver": result.remote_gain,
    }


NAMES = {"relay_1": "relay_1", "relay_2": "relay_2", "receiver": "remote"}
STEADY = ("paper", "joint", "lmmse", "lmmse_tuned", "no_relay")  # of which the summary tells
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


class Designs(NamedTuple):
    """Gains over the horizon: the paper's, tuned for the receiver, and so at no more power than the paper's."""

    paper: RelayDesign
    tuned: RelayDesign
    bounded: RelayDesign
    best_behind: np.ndarray  # trace of the best linear receiver behind the paper's relays

    def mean_ratio(self, design: RelayDesign) -> float:
        """Mean over k = 1 .. horizon of tr P_k / tr P_k(paper)."""
        return float(np.mean(design.trace("receiver")[1:] / self.paper.trace("receiver")[1:]))


@dataclass(frozen=True)
class Outcome:
    """The numbers by design and filter, traces at k = 0 .. horizon; and what figures and statements are made of."""

    trace: dict[str, np.ndarray]
    monte_carlo: dict[str, np.ndarray]
    steady: dict[str, dict[str, float]]
    tuned_mean_ratio: float
    setting: Unlisted[Setting]
    designs: Unlisted[Designs]
    states: Unlisted[dict[str, Steady]]
    limits: Unlisted[dict[str, float]]
    certificates: Unlisted[dict[str, RelayCertificate]]
    misprints: Unlisted[dict[str, Misprinted]]
    simulated: Unlisted[Simulated]
    shown: Unlisted[hg.Record]


def compute(setting: Setting, stages: Stages) -> Outcome:
    """Compute all of it."""
    network = setting.network()
    designs = stages("designing over the horizon", lambda: design(setting))
    paper = designs.paper
    states = stages("designing the steady state", lambda: steady(setting))
    certificates, misprints = stages("certificates and misprints", lambda: (certify(network, designs), wrong(setting)))
    simulated = stages("simulating", lambda: simulate(setting, paper, stages))
    return Outcome(
        trace={NAMES[name]: paper.trace(name) for name in FILTERS},
        monte_carlo={"remote": simulated.mean["receiver"], "stderr": simulated.error["receiver"]},
        steady={name: {"even": states[name].even, "odd": states[name].odd} for name in STEADY},
        tuned_mean_ratio=designs.mean_ratio(designs.tuned),
        setting=setting, designs=designs, states=states, limits=limits(setting), certificates=certificates,
        misprints=misprints, simulated=simulated,
        shown=hg.monte_carlo(world(network, paper), setting.horizon, 1, setting.seed),
    )  # fmt: skip


def design(setting: Setting) -> Designs:
    """All designs over the horizon."""
    network, horizon = setting.network(), setting.horizon
    paper = hg.relays.local_error_design(network, horizon)
    tuned = hg.relays.receiver_error_design(network, horizon)
    limit = paper.total_power()
    bounded = hg.relays.receiver_error_design(network, horizon, power_limit=limit, sweeps=setting.sweeps)
    behind = hg.relays.receiver_behind_relays(network, paper.gains)
    return Designs(paper, tuned, bounded, np.trace(behind.gains.covariance, axis1=1, axis2=2))


def certify(network: hg.model.RelayNetwork, designs: Designs) -> dict[str, RelayCertificate]:
    """Bounds on the errors of the paper's and of the tuned gains, and of a scalar system that obeys none."""
    certificates = {name: certify_relays(network, getattr(designs, name).gains) for name in ("paper", "tuned")}
    return {**certificates, "scalar": counterexample()}


def wrong(setting: Setting) -> dict[str, Misprinted]:
    """What each misprint does, and the first where W = 4 V and where V = 4 W."""
    right = recursion("none", setting.steady, setting)
    effects = {name: misprinted(name, setting, right) for name in MISPRINTS}
    more, less = replace(setting, process=4 * setting.process), replace(setting, sensor_noise=4 * setting.sensor_noise)
    for name, other in (("lemma_1_process", more), ("lemma_1_sensor_noise", less)):
        effects[name] = misprinted("lemma_1", other, recursion("none", other.steady, other))
    return effects


def steady(setting: Setting) -> dict[str, Steady]:
    """The two-periodic steady state of each design."""
    network = setting.network()
    paper = hg.relays.periodic_local_error_design(network)
    limited = paper.total_power()
    tuned = [hg.relays.periodic_relays_for_best_receiver(network, s) for s in (None, QUIET_START)]
    quiet = hg.relays.periodic_relays_for_best_receiver(network, tuned[1], power_limit=limited)
    relays = {"lmmse": paper.gains, "lmmse_tuned": min(tuned, key=lambda g: _behind(network, g).even
              + _behind(network, g).odd), "lmmse_tuned_from_paper": tuned[0], "lmmse_quiet": quiet}  # fmt: skip
    return {
        "paper": _designed(paper),
        "joint": _designed(hg.relays.periodic_receiver_error_design(network)),
        "joint_quiet": _designed(hg.relays.periodic_receiver_error_design(network, power_limit=limited)),
        **{name: _behind(network, gains) for name, gains in relays.items()},
        "no_relay": _without_relay(setting, setting.link(1)),
        "sensor_itself": _without_relay(setting, hg.perfect()),
    }


def _designed(design: RelayDesign) -> Steady:
    odd, even = design.trace("receiver")[1:]
    return Steady(float(even), float(odd), design.total_power())


def _behind(network: hg.model.RelayNetwork, gains: GainsByFilter) -> Steady:
    odd, even = np.trace(hg.relays.periodic_behind_relays(network, gains), axis1=1, axis2=2)
    silent = {name: gains[name] for name in network.relays} | {"receiver": np.zeros((2, 3, 1))}
    return Steady(float(even), float(odd), hg.relays.periodic_given_design(network, silent).total_power())


def _without_relay(setting: Setting, direct: hg.random_affine.GainAndNoise) -> Steady:
    """Trace of the error of x_(k+1) predicted from what was received up to k: as late as behind a relay."""
    filtered = hg.relays.periodic_local_error_design(setting.without_relays(direct)).covariance["receiver"][-1]
    a = setting.transition
    value = float(np.trace(a @ filtered @ a.T + setting.process_covariance))
    return Steady(value, value, np.zeros(2))


def limits(setting: Setting) -> dict[str, float]:
    """Other steady traces to compare with: filtered without relays, and nothing received."""
    filtered = {
        name: float(hg.relays.periodic_local_error_design(setting.without_relays(direct)).trace("receiver")[-1])
        for name, direct in (("no_relay_filtered", setting.link(1)), ("sensor_itself_filtered", hg.perfect()))
    }
    covariance, a = setting.initial_covariance, setting.transition
    for _ in range(setting.steady):
        covariance = a @ covariance @ a.T + setting.process_covariance
    return {**filtered, "nothing_received": float(np.trace(covariance))}


def misprinted(name: str, setting: Setting, right: Recursion) -> Misprinted:
    """What a misprint does to the trace that is claimed, and to the true one, at k = 0 .. steady."""
    printed = recursion(name, setting.steady, setting)
    true = hg.relays.given_design(setting.network(), by_filter(printed))
    return Misprinted(
        printed.remote_trace / true.trace("receiver"),
        true.trace("receiver") / right.remote_trace,
        true.trace("relay_2") / right.relay_trace[:, 1],
    )


def world(network: hg.model.RelayNetwork, design: RelayDesign) -> hg.Network:
    """The relays with their filters, and the receiver's."""
    schedules = hg.relays.relay_schedules(network, design)
    receiver = hg.filters.ScheduledFilter(schedules.pop("receiver"))
    return hg.Network.of_relays(network, schedules, {"local": receiver})


def initial_states(setting: Setting) -> np.ndarray:
    """x_0 of each run, (runs, 3): where a plant that does not move is after a step."""
    still = hg.LinearPlant(np.eye(3), 0.0, setting.initial_mean, setting.initial_covariance)
    node = hg.Node(hg.LinearSensor([setting.sensing], 0.0), hg.perfect(), {})
    record = hg.monte_carlo(hg.Network(still, {"nobody": node}), 1, setting.runs, setting.seed)
    return np.asarray(record.truth)[:, 0]


def simulate(setting: Setting, design: RelayDesign, stages: Stages) -> Simulated:
    """Mean squared errors of relays and receiver, run as filters in the world."""
    network = setting.network()
    sums = hg.monte_carlo(
        world(network, design), setting.horizon, setting.runs, setting.seed, hg.Statistics(), progress=stages.progress
    )
    start = np.sum((initial_states(setting) - network.initial()[0]) ** 2, axis=1)
    mean, error = {}, {}
    for name in FILTERS:
        statistics = sums[name]["local"]
        batches = np.trace(statistics.outer, axis1=2, axis2=3) / statistics.count[:, None]
        weights = statistics.count / statistics.count.sum()
        mean[name] = np.concatenate([[start.mean()], weights @ batches])
        spread = np.sqrt(weights @ (batches - weights @ batches) ** 2 / (len(batches) - 1))
        error[name] = np.concatenate([[start.std(ddof=1) / np.sqrt(setting.runs)], spread])
    return Simulated(mean, error)


def counterexample() -> RelayCertificate:
    """A scalar system that is bounded as Lemmas 8 and 9 ask, and obeys none of their printed lower bounds."""
    plant = hg.LinearPlant([[0.5]], [[1.0]], [0.0], [[10.0]])
    network = alternating(plant, hg.LinearSensor([[1.0]], [[1.0]]), shadowing(0.5, 0.1), 1e6, 1e6)
    return certify_relays(network, hg.relays.local_error_design(network, 60).gains)


def write_record(outcome: Outcome, folder: Path) -> None:
    """The run that is shown, and the gains of the paper's and of the tuned designs."""
    run, designs = outcome.shown, outcome.designs
    assert run.truth is not None
    estimates = {
        NAMES[node]: {
            name: hg.model.Estimate(np.asarray(e.mean)[0], np.asarray(e.covariance)[0], e.claim)
            for name, e in filters.items()
        }
        for node, filters in run.estimates.items()
    }
    measurements = {NAMES[node]: values[0] for node, values in run.measurements.items()}
    write_estimates(hg.Record(run.time, run.states, run.truth[0], measurements, estimates), folder / "record.csv")
    chosen = {"paper": designs.paper, "tuned": designs.tuned, "tuned_at_paper_power": designs.bounded}
    gains = {f"{name}.{NAMES[f]}": d.gains[f] for name, d in chosen.items() for f in FILTERS}
    np.savez(folder / "gains.npz", allow_pickle=False, **gains)
