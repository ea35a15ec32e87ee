"""What the example computes: in every case of truth and model, each filter's errors and claims over the seeds."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from zlib import crc32

import jax
import jax.numpy as jnp
import numpy as np
import scipy

import heliograph as hg
from heliograph.numerics.check import fail
from heliograph.numerics.float64 import compiled
from heliograph.random_affine.base import apply
from heliograph.simulation.draws import CHANNEL, SENSOR, draw_key
from heliograph_studies import Stages, Unlisted, check_fields
from heliograph_studies.motor_drive.machine import (
    CURRENT,
    RATED,
    ROTOR_RESISTANCE,
    STEP,
    Drive,
    Machine,
    draw_truth,
    euler,
    plant,
    simulate_drive,
)

SENSOR_VARIANCE = 0.05**2  # A^2
HOP_VARIANCE = 0.05**2  # A^2, at the relay and at the receiver
# Probabilities known to 0.02, as the publication's are; the simulated channel has the nominal ones.
STEADY = hg.Discrete([0.8, 0.9, 1.0], [0.2, 0.3, 0.5], 0.02)
FADING = hg.Discrete([0.7, 0.85, 1.0], [0.3, 0.3, 0.4], 0.02)
DEEP_FADING = hg.Discrete([0.4, 0.7, 1.0], [0.2, 0.3, 0.5], 0.02)
CHANNELS: dict[str, hg.random_affine.AbstractRandomAffine] = {
    "relay_1": hg.amplify_and_forward(
        [hg.hop(FADING, HOP_VARIANCE, dimension=2), hg.hop(STEADY, HOP_VARIANCE, dimension=2)]
    ),
    "relay_2": hg.amplify_and_forward(
        [hg.hop(DEEP_FADING, HOP_VARIANCE, dimension=2), hg.hop(STEADY, HOP_VARIANCE, dimension=2)]
    ),
    "wired": hg.perfect(2),
}


def currents(states: int) -> hg.LinearSensor:
    """Both currents in A, of a state per unit."""
    return hg.LinearSensor(CURRENT * np.eye(2, states), SENSOR_VARIANCE, ("i_alpha", "i_beta"))


def network(plant: hg.Plant) -> hg.Network:
    """The three nodes with their filters on one model of the machine, and what is fused of the two behind relays."""
    sensor = currents(len(plant.states))
    nodes = {}
    for name, channel in CHANNELS.items():
        filters: dict[str, hg.filters.AbstractFilter] = {
            "zero_mean": hg.cubature_filter(plant, sensor, channel, hg.filters.ZeroMean()),
            "polytope": hg.cubature_filter(plant, sensor, channel, hg.filters.Polytope()),
            "mean_gain": hg.mean_gain_filter(plant, sensor, channel),
        }
        wired = {"perfect": hg.cubature_filter(plant, sensor, channel), "open_loop": hg.filters.open_loop_filter(plant)}
        nodes[name] = hg.Node(sensor, channel, wired if name == "wired" else filters)
    optimal, equal = hg.CovarianceIntersection(), hg.fusion.EqualIntersection()
    fusions = {name: hg.Fusion(name, optimal) for name in ("zero_mean", "polytope")}
    return hg.Network(plant, nodes, fusions | {"equal_weights": hg.Fusion("zero_mean", equal)})


def received(truth: np.ndarray, seed: int) -> dict[str, np.ndarray]:
    """What reaches each node (steps, 2) in A; the three receive one machine, each with its own sensor and channel."""
    sensor = currents(truth.shape[1])
    return {
        name: np.asarray(_send(sensor, channel, truth, seed, crc32(name.encode())))
        for name, channel in CHANNELS.items()
    }


@compiled
def _send(
    sensor: hg.LinearSensor, channel: hg.random_affine.AbstractRandomAffine, truth: np.ndarray, seed: int, place: int
) -> jax.Array:
    key = jax.random.key(seed)

    def single(k: jax.Array, x: jax.Array) -> jax.Array:
        y = sensor.measure(x) + sensor.noise.sample(draw_key(key, k, place, SENSOR))
        z: jax.Array = apply(channel.sample(draw_key(key, k, place, CHANNEL)), y)
        return z

    return jax.vmap(single)(jnp.arange(len(truth)), jnp.asarray(truth))


TRUSTS = {"stated": 1.0, "tenth": 10.0}  # process noise as stated, and a tenth of its deviations
QUANTITIES = {"current": slice(0, 2), "flux": slice(2, 4), "speed": slice(4, 5)}
UNITS = {"current": float(RATED[0]), "flux": float(RATED[2]), "speed": float(RATED[4])}


@dataclass(frozen=True)
class Setting:
    """`seeds` of sensors and relays, the first with `seed`; what departs from the filters' model in some of the cases.

    dead_time of the inverter in seconds; resistance: the filters' rotor resistance over the machine's.
    """

    seeds: int = 20
    dead_time: float = 2e-6
    resistance: float = 1.2
    seed: int = 0

    def __post_init__(self) -> None:
        check_fields(self, seeds=2)
        if not 0 <= self.dead_time < STEP:
            raise fail("dead_time", f"seconds, at least 0 and less than a step of {STEP:g}", self.dead_time)
        if not 0 < self.resistance < np.inf:
            raise fail("resistance", "a positive number", self.resistance)


@dataclass(frozen=True)
class Case:
    """One truth, (steps, n) per unit or one for each seed, the commanded voltages, and the filters' model of it."""

    name: str
    voltages: np.ndarray
    truths: list[np.ndarray]
    model: hg.Plant


@dataclass(frozen=True)
class Score:
    """One filter in one case: for each quantity in SI units, actual and claimed root mean square, and their ratio.

    common: share of the squared error that is the same for all seeds (of the sensors and channels), hence the model's;
    without bias for the number of seeds. nees_per_dimension: mean and 95 % interval, 1 if the claim is exact.
    claimed_over_time (time,) by quantity; nees_over_time (time,), per dimension.
    """

    rmse: dict[str, float]
    claimed: dict[str, float]
    ratio: dict[str, float]
    common: dict[str, float]
    nees_per_dimension: dict[str, float]
    claimed_over_time: Unlisted[dict[str, np.ndarray]]
    nees_over_time: Unlisted[np.ndarray]


Scores = dict[str, Score]  # by filter, "node/filter"


@dataclass(frozen=True)
class Outcome:
    """Scores by trust, case and filter; the drive of the case "load" and its first seed's means.

    rated: values in SI units. failures: what `Record.failures` says, by trust and case. shown: (time, 5) in SI units by
    trust and filter.
    """

    seeds: int
    steps: int
    dead_time: float
    rated: dict[str, float]
    cases: dict[str, str]
    failures: list[str]
    scores: dict[str, dict[str, Scores]]
    drive: Unlisted[Drive]
    shown: Unlisted[dict[str, dict[str, np.ndarray]]]


CASES = {
    "own_model": "truth drawn from the filters' own model, process noise included",
    "no_load": "simulator without load",
    "load": "simulator with friction, fan and load step",
    "euler": "load; the filters step by Euler's rule",
    "resistance": "load; the filters' rotor resistance is 20 % too high",
    "dead_time": "load; the inverter has a dead time of 2 µs",
    "everything": "load, wrong resistance and dead time (no Euler)",
    "load_as_state": "load; the filters estimate its torque as a sixth state",
}


def drives(setting: Setting) -> tuple[Drive, Drive, Drive]:
    """Without load, loaded, and loaded behind an inverter with a dead time."""
    return simulate_drive(loaded=False), simulate_drive(), simulate_drive(dead_time=setting.dead_time)


def cases(simulated: Sequence[Drive], setting: Setting, trust: float) -> list[Case]:
    """One departure at a time, then all that can occur together, then a cure for the greatest."""
    free, loaded, dead = simulated
    right, wrong = (plant(Machine(r), trust=trust) for r in (ROTOR_RESISTANCE, setting.resistance * ROTOR_RESISTANCE))
    drawn = [np.asarray(_draw_truth(right, loaded.voltages, seed)) for seed in seeds_of(setting)]
    result = [Case("own_model", loaded.voltages, drawn, right)]
    for name, drive, model in (
        ("no_load", free, right),
        ("load", loaded, right),
        ("euler", loaded, plant(Machine(integrate=euler), trust=trust)),
        ("resistance", loaded, wrong),
        ("dead_time", dead, right),
        ("everything", dead, wrong),
        ("load_as_state", loaded, plant(Machine(), load_is_state=True, trust=trust)),
    ):
        truth = drive.truth[:, : len(model.states)]
        result.append(Case(name, drive.voltages, [truth] * setting.seeds, model))
    return result


def seeds_of(setting: Setting) -> range:
    """All seeds."""
    return range(setting.seed, setting.seed + setting.seeds)


@compiled
def _draw_truth(model: hg.Plant, voltages: np.ndarray, seed: int) -> jax.Array:
    return draw_truth(model, voltages, jax.random.key(seed))


def run_case(case: Case, seeds: range) -> hg.Record:
    """Run every filter on what each seed's sensors and channels make of the truth; a leading axis of seeds."""
    listeners = network(case.model)
    draws = zip(seeds, case.truths, strict=True)
    records = [hg.run(listeners, received(truth, seed), case.voltages) for seed, truth in draws]
    estimates = jax.tree.map(lambda *parts: np.stack(parts), *[record.estimates for record in records])
    return replace(records[0], truth=np.stack(case.truths), measurements={}, estimates=estimates)


def score(record: hg.Record, node: str, name: str) -> Score:
    """Score one filter of a record with a leading axis of seeds."""
    errors, bound = record.errors(node, name), np.asarray(record.estimates[node][name].covariance)
    seeds, _, n = errors.shape
    mean_square, claim = np.mean(errors**2, axis=0), np.diagonal(bound.mean(axis=0), axis1=1, axis2=2)
    bias = errors.mean(axis=0) ** 2 - errors.var(axis=0, ddof=1) / seeds
    nees = hg.nees(errors, np.zeros_like(errors), bound) / n
    rmse, claimed, common, claimed_over_time = {}, {}, {}, {}
    for quantity, part in QUANTITIES.items():
        rmse[quantity] = _root_mean_square(UNITS[quantity] * np.sqrt(mean_square[:, part].sum(axis=1)))
        claimed_over_time[quantity] = UNITS[quantity] * np.sqrt(claim[:, part].sum(axis=1))
        claimed[quantity] = _root_mean_square(claimed_over_time[quantity])
        common[quantity] = float(bias[:, part].sum() / mean_square[:, part].sum())
    ratio = {quantity: rmse[quantity] / claimed[quantity] for quantity in QUANTITIES}
    # The mean over independent seeds, and its 95 % interval by Student's law.
    of_seed = nees.mean(axis=1)
    mean, width = of_seed.mean(), scipy.stats.t.ppf(0.975, seeds - 1) * of_seed.std(ddof=1) / np.sqrt(seeds)
    interval = {"mean": float(mean), "low": float(mean - width), "high": float(mean + width)}
    return Score(rmse, claimed, ratio, common, interval, claimed_over_time, nees.mean(axis=0))


def _root_mean_square(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def compute(setting: Setting, stages: Stages) -> Outcome:
    """All cases at both levels of trust."""
    simulated = stages("the simulator", partial(drives, setting))
    scores: dict[str, dict[str, Scores]] = {}
    shown: dict[str, dict[str, np.ndarray]] = {}
    failures: list[str] = []
    for level, trust in TRUSTS.items():
        scores[level] = {}
        for done, case in enumerate(cases(simulated, setting, trust)):
            work = partial(judged, case, seeds_of(setting))
            scores[level][case.name], failed, means = stages(f"process noise {level}", work, done, len(CASES))
            failures += [f"{level}, {case.name}: {line}" for line in failed]
            if case.name == "load":
                shown[level] = means
    drive = simulated[1]
    return Outcome(
        setting.seeds, len(drive.time), setting.dead_time, UNITS, CASES, failures, scores, drive, shown
    )  # fmt: skip


def judged(case: Case, seeds: range) -> tuple[Scores, list[str], dict[str, np.ndarray]]:
    """Scores of a case, what failed, and the first seed's means in SI units."""
    record = run_case(case, seeds)
    names = [(node, name) for node, filters in record.estimates.items() for name in filters]
    scores = {f"{node}/{name}": score(record, node, name) for node, name in names}
    rated = RATED[: len(case.model.states)]
    means = {f"{n}/{f}": np.asarray(record.estimates[n][f].mean[0]) * rated for n, f in names}
    return scores, list(record.failures()), means
