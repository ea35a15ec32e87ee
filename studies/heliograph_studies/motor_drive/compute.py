"""What the example computes: in every case of truth and model, each filter's errors and claims over the seeds."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import jax
import numpy as np
from scipy import stats

import heliograph as hg
from heliograph.numerics.check import check_count
from heliograph.numerics.float64 import compiled
from heliograph_studies.motor_drive.drive import Drive, simulate_drive
from heliograph_studies.motor_drive.listeners import network, received
from heliograph_studies.motor_drive.machine import RATED, ROTOR_RESISTANCE, Machine, draw_truth, euler, plant

SEEDS = 20
DEAD_TIME = 2e-6  # s, of the inverter
WRONG_RESISTANCE = 1.2 * ROTOR_RESISTANCE
TRUSTS = {"stated": 1.0, "tenth": 10.0}  # process noise as stated, and a tenth of its deviations
QUANTITIES = {"current": slice(0, 2), "flux": slice(2, 4), "speed": slice(4, 5)}
UNITS = {"current": float(RATED[0]), "flux": float(RATED[2]), "speed": float(RATED[4])}


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
    without bias for the number of seeds. nees: (NEES per dimension, its 95 % interval), 1 if the claim is exact.
    actual_over_time and claimed_over_time (time,) by quantity; nees_over_time (time,), per dimension.
    """

    rmse: dict[str, float]
    claimed: dict[str, float]
    common: dict[str, float]
    nees: tuple[float, float, float]
    actual_over_time: dict[str, np.ndarray]
    claimed_over_time: dict[str, np.ndarray]
    nees_over_time: np.ndarray

    def ratio(self, quantity: str) -> float:
        """Actual over claimed; above 1 is too sure."""
        return self.rmse[quantity] / self.claimed[quantity]


@dataclass(frozen=True)
class Outcome:
    """Scores by trust, case and filter ("node/filter"); the drive of the case "load" and its first seed's means.

    shown: (time, 5) in SI units by trust and filter. failures: what `Record.failures` says, by trust and case.
    """

    seeds: int
    drive: Drive
    scores: dict[str, dict[str, dict[str, Score]]]
    shown: dict[str, dict[str, np.ndarray]]
    failures: list[str]


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

STAGES = len(TRUSTS) * len(CASES)


def cases(trust: float, seeds: range) -> list[Case]:
    """One departure at a time, then all that can occur together, then a cure for the greatest."""
    free, loaded, dead = simulate_drive(loaded=False), simulate_drive(), simulate_drive(dead_time=DEAD_TIME)
    right, wrong = plant(Machine(), trust=trust), plant(Machine(WRONG_RESISTANCE), trust=trust)
    local = [np.asarray(_draw_truth(right, loaded.voltages, seed)) for seed in seeds]
    results = [Case("own_model", loaded.voltages, local, right)]
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
        results.append(Case(name, drive.voltages, [truth] * len(seeds), model))
    return results


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
    nees = np.einsum("kti,kti->kt", errors, np.linalg.solve(bound, errors[..., None])[..., 0]) / n
    actual_over_time, claimed_over_time, common = {}, {}, {}
    for quantity, part in QUANTITIES.items():
        actual_over_time[quantity] = UNITS[quantity] * np.sqrt(mean_square[:, part].sum(axis=1))
        claimed_over_time[quantity] = UNITS[quantity] * np.sqrt(claim[:, part].sum(axis=1))
        common[quantity] = float(bias[:, part].sum() / mean_square[:, part].sum())
    return Score(
        rmse={q: float(np.sqrt(np.mean(v**2))) for q, v in actual_over_time.items()},
        claimed={q: float(np.sqrt(np.mean(v**2))) for q, v in claimed_over_time.items()},
        common=common,
        nees=_mean_and_interval(nees.mean(axis=1)),
        actual_over_time=actual_over_time,
        claimed_over_time=claimed_over_time,
        nees_over_time=nees.mean(axis=0),
    )


def _mean_and_interval(values: np.ndarray) -> tuple[float, float, float]:
    """Mean of independent values and its 95 % interval by Student's law."""
    mean, seeds = float(values.mean()), len(values)
    width = float(stats.t.ppf(0.975, seeds - 1) * values.std(ddof=1) / np.sqrt(seeds))
    return mean, mean - width, mean + width


def compute(count: int, seed: int = 0, advance: Callable[[str], None] = lambda what: None) -> Outcome:
    """Run all cases at both levels of trust with `count` seeds from `seed` on; `advance` is told what begins.

    Raises:
        ValueError: fewer than 2 seeds.
        ModuleNotFoundError: the extra `motor` is not installed.
    """
    check_count("seeds", count, 2)
    scores: dict[str, dict[str, dict[str, Score]]] = {}
    shown: dict[str, dict[str, np.ndarray]] = {}
    failures, seeds = [], range(seed, seed + count)
    for level, trust in TRUSTS.items():
        scores[level] = {}
        for case in cases(trust, seeds):
            advance(f"process noise {level}: {CASES[case.name]}")
            record = run_case(case, seeds)
            failures += [f"{level}, {case.name}: {line}" for line in record.failures()]
            names = [(node, name) for node, filters in record.estimates.items() for name in filters]
            scores[level][case.name] = {f"{node}/{name}": score(record, node, name) for node, name in names}
            if case.name == "load":
                shown[level] = {f"{n}/{f}": np.asarray(record.estimates[n][f].mean[0]) * RATED[:5] for n, f in names}
    return Outcome(count, simulate_drive(), scores, shown, failures)
