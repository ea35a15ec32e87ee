"""Every number of the reproduction: thresholds, bounds, certificates, and what the filter really has."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import heliograph as hg
from heliograph.linear import CriticalArrival
from heliograph.planning.plant_moments import steady_covariance
from heliograph.random_affine import AbstractRandomAffine
from heliograph.simulation import Boundedness
from heliograph_studies import Sampled, Stages, Unlisted
from heliograph_studies.intermittent_observations.mean_error import (
    Iterated,
    from_runs,
    iterate,
    mean_error,
    over_patterns,
)
from heliograph_studies.intermittent_observations.setting import (
    FILTER,
    NODE,
    Example,
    Setting,
    bursts,
    lossy,
    threshold,
)

APART = 0.005  # how far from a threshold verdicts are asked for


class Link(NamedTuple):
    """One example over one link: fail and recover, the judgement, the lower bound's trace, and E P found twice.

    `mean_error` is NaN where there is no quadrature: for more than one state.
    """

    fail: float
    recover: float
    judged: Boundedness
    lower: float
    mean_error: float
    simulated: Sampled

    @property
    def bound(self) -> float:
        """Trace of what E P is at most; NaN where nothing is certified."""
        return float("nan") if self.judged.bound is None else float(np.trace(self.judged.bound))

    def numbers(self) -> dict[str, Any]:
        """Traces of matrices, and the gain K of xhat+ = A xhat + K (z - C xhat) where all arrives."""
        gain = next(gain for arrived, gain in self.judged.gains.items() if all(arrived))
        exact = not np.isnan(self.mean_error)
        return {
            "fail": self.fail,
            "recover": self.recover,
            "bound": self.bound,
            "lower": self.lower,
            "radius": self.judged.radius,
            "gain": gain[:, 0] if len(gain) > 1 else float(gain[0, 0]),
            "mean_error": self.mean_error if exact else self.simulated.value,
            "mean_error_is": "quadrature" if exact else "simulated",
            "simulated": self.simulated.value,
            "simulated_se": self.simulated.error,
        }


class Curves(NamedTuple):
    """tr of bounds and mean against the arrival probability; NaN where they do not exist."""

    arrival: np.ndarray
    upper: np.ndarray
    lower: np.ndarray
    mean: np.ndarray


class BurstCurve(NamedTuple):
    """Recovery, the bound on E P, and E P; NaN where there is none."""

    recover: np.ndarray
    upper: np.ndarray
    mean: np.ndarray


@dataclass(frozen=True)
class Outcome:
    """Everything that summary, figures and report are made of; `tests` are the numbers, matrices by their trace."""

    papers: str
    tests: dict[str, Any]
    setting: Unlisted[Setting]
    critical: Unlisted[dict[str, CriticalArrival]]
    constant: Unlisted[CriticalArrival]
    scalar: Unlisted[Link]
    coupled: Unlisted[Link]
    one_unstable: Unlisted[Link]
    bursts: Unlisted[list[Link]]
    recovery: Unlisted[dict[float, float]]
    components: Unlisted[tuple[float, float]]
    verdicts: Unlisted[dict[str, str]]
    between: Unlisted[np.ndarray]
    below: Unlisted[np.ndarray]
    turning: Unlisted[np.ndarray]
    between_bound: Unlisted[float]
    unknown_losses: Unlisted[dict[str, Boundedness]]
    iterated: Unlisted[Iterated]
    typical: Unlisted[float]
    curves: Unlisted[dict[str, Curves]]
    burst_curves: Unlisted[dict[float, BurstCurve]]


def compute(setting: Setting, stages: Stages) -> Outcome:
    """Compute all of it."""
    parts = stages("thresholds", lambda: thresholds(setting))
    parts |= stages("bounds and simulated filters", lambda: links(setting))
    parts |= stages("patterns, rounding and curves", lambda: patterns(setting, parts["critical"]))
    papers = "Kalman filtering with intermittent observations (Sinopoli et al., 2004) and its successors"
    return Outcome(papers, numbers(parts), setting, **parts)


def thresholds(setting: Setting) -> dict[str, Any]:
    """Critical arrivals and recoveries, and verdicts on either side of them."""
    scalar, always = setting.scalar, judge(setting.scalar, lossy(1.0))

    def recovery(fail: float) -> float:
        return _smallest(lambda recover: judge(scalar, bursts(fail, recover)), setting.digits)

    steady = always.gains[(True,) * len(scalar.output)]  # certified where every packet arrives
    return {
        "critical": {name: hg.linear.critical_arrival(e.plant(), e.sensor()) for name, e in setting.examples.items()},
        "constant": hg.linear.critical_arrival(scalar.plant(), scalar.sensor(), steady),
        "recovery": {fail: recovery(fail) for fail in (0.01, 0.1, 0.5)},
        "components": (critical_component(setting, 0), critical_component(setting, 1)),
        "verdicts": verdicts(setting),
    }


def links(setting: Setting) -> dict[str, Any]:
    """Bounds, quadrature and simulation of the main examples where packets are lost independently, and in bursts."""
    lost, arrival = 1 - setting.arrival, setting.arrival
    independent = {
        name: link(setting, setting.examples[name], lossy(arrival), lost, arrival)
        for name in ("scalar", "coupled", "one_unstable")
    }
    return {
        **independent,
        "bursts": [link(setting, setting.scalar, bursts(*burst), *burst) for burst in setting.bursts],
    }


def patterns(setting: Setting, critical: dict[str, CriticalArrival]) -> dict[str, Any]:
    """What happens between and below the conditions, with unobserved losses, in floating point, and over arrivals."""
    low, turning = critical["scalar"].lower - 0.06, critical["turning"]
    return {
        "between": over_patterns(setting.coupled, setting.between, setting.patterns),
        "below": over_patterns(setting.coupled, low, setting.patterns),
        "turning": over_patterns(setting.turning, (turning.lower + turning.upper) / 2, setting.patterns),
        "between_bound": judge(setting.coupled, lossy(setting.between)).radius,
        "unknown_losses": {
            "dropout": judge(setting.scalar, hg.dropout(hg.perfect(), 0.99)),
            "fading": judge(setting.scalar, hg.hop(hg.Rayleigh(1.0), 0.1)),
        },
        "iterated": iterate(setting.coupled, setting.arrival, setting.iterations),
        "typical": typical(setting, low),
        "curves": {name: curves(setting.examples[name], setting.points) for name in ("scalar", "coupled")},
        "burst_curves": {fail: burst_curve(setting, fail) for fail in (0.05, 0.2, 0.5)},
    }


def numbers(parts: dict[str, Any]) -> dict[str, Any]:
    """The numbers by test."""
    critical, items = parts["critical"], [link.numbers() for link in parts["bursts"]]

    def test(name: str) -> dict[str, Any]:
        return {"threshold": critical[name].upper, "necessary": critical[name].lower, **parts[name].numbers()}

    names = ("fail", "recover", "mean_error", "simulated", "simulated_se", "bound", "lower", "radius")
    return {
        "T1": {**test("scalar"), "constant_gain_threshold": parts["constant"].upper},
        "T2": test("coupled"),
        "T3": test("one_unstable"),
        "T4": {"threshold": parts["components"]},
        "T5": {"threshold": max(parts["recovery"].values()), "by_fail": parts["recovery"]},
        "T6": {name: [numbers[name] for numbers in items] for name in names},
    }


def judge(example: Example, link: AbstractRandomAffine) -> Boundedness:
    """The package's verdict on an example over a link."""
    return hg.simulation.certify_boundedness(example.network(link))


def link(setting: Setting, example: Example, channel: AbstractRandomAffine, fail: float, recover: float) -> Link:
    """Bounds, quadrature and simulation of one example over one link."""
    record = hg.monte_carlo(example.network(channel), setting.horizon, setting.runs, setting.seed)
    arrived = ~np.any(np.isnan(record.measurements[NODE][:, setting.begin :]), axis=2)
    filtered = record.estimates[NODE][FILTER].covariance[:, setting.begin :]
    known = mean_error(example, fail, recover) if example.states == 1 else float("nan")
    simulated = from_runs(example, fail, recover, np.asarray(filtered), arrived)
    return Link(fail, recover, judge(example, channel), lower(example, fail, recover), known, simulated)


def lower(example: Example, fail: float, recover: float) -> float:
    """tr S_1 + tr S_2: losses carry all of S on, arrivals nothing but noise; infinite where losses last too long.

    S_loss = fail w_0 Q + (1 - recover) (A S_loss A' + w_1 Q), w the long-run shares.
    """
    a, q, lost = example.transition, example.process * np.eye(example.states), fail / (fail + recover)
    if (1 - recover) * np.abs(np.linalg.eigvals(a)).max() ** 2 >= 1:
        return float("inf")
    s = steady_covariance(np.sqrt(1 - recover) * a, lost * q)  # fail w_0 + (1 - recover) w_1 = w_1
    return float(np.trace(s + recover * a @ s @ a.T + (1 - lost) * q))


def critical_component(setting: Setting, which: int) -> float:
    """The smallest arrival of one component's packets at which the plant is certified, the other's always arriving."""

    def verdict(arrival: float) -> Boundedness:
        links = [hg.erasure(hg.perfect(), arrival if i == which else 1.0) for i in range(2)]
        return judge(setting.components, hg.parallel(links))

    return _smallest(verdict, setting.digits)


def _smallest(verdict: Callable[[float], Boundedness], digits: float) -> float:
    low, high = 0.0, 1.0
    while high - low > digits:
        middle = (low + high) / 2
        low, high = (low, middle) if verdict(middle).verdict == "certified" else (middle, high)
    return high


def verdicts(setting: Setting) -> dict[str, str]:
    """Verdicts on either side of thresholds, and between the two of the coupled plant."""
    scalar = threshold(setting.scalar.transition[0, 0])
    item, two = (threshold(factor) for factor in np.diag(setting.components.transition))

    def apart(first: float, second: float) -> str:
        links = [hg.erasure(hg.perfect(), p) for p in (first, second)]
        return judge(setting.components, hg.parallel(links)).verdict

    return {
        "below": judge(setting.scalar, lossy(scalar - APART)).verdict,
        "above": judge(setting.scalar, lossy(scalar + APART)).verdict,
        "between": judge(setting.coupled, lossy(setting.between)).verdict,
        "both_above": apart(item + APART, two + APART),
        "first_below": apart(item - APART, two + APART),
        "second_below": apart(item + APART, two - APART),
    }


def typical(setting: Setting, arrival: float) -> float:
    """The median of P of the scalar example at an arrival where its mean diverges, after a long time."""
    record = hg.monte_carlo(setting.scalar.network(lossy(arrival)), setting.horizon, setting.runs, setting.seed)
    return float(np.median(record.estimates[NODE][FILTER].covariance[:, -1]))


def curves(example: Example, points: int) -> Curves:
    """Bounds over arrival probabilities, and E P where there is a quadrature for it."""
    arrival = np.linspace(0.3, 1.0, points)
    upper, below, mean = [], [], []
    for p in arrival:
        judged, least = judge(example, lossy(p)), lower(example, 1 - p, p)
        upper.append(float("nan") if judged.bound is None else float(np.trace(judged.bound)))
        below.append(least if np.isfinite(least) else float("nan"))
        known = example.states == 1 and judged.verdict == "certified"
        mean.append(mean_error(example, 1 - p, p) if known else float("nan"))
    return Curves(arrival, np.array(upper), np.array(below), np.array(mean))


def burst_curve(setting: Setting, fail: float) -> BurstCurve:
    """The scalar example over recovery."""
    recover = np.linspace(0.3, 1.0, setting.points)
    judged = [judge(setting.scalar, bursts(fail, r)) for r in recover]
    upper = np.array([float("nan") if j.bound is None else float(np.trace(j.bound)) for j in judged])
    pairs = zip(recover, upper, strict=True)
    mean = [mean_error(setting.scalar, fail, r) if bound > 0 else float("nan") for r, bound in pairs]
    return BurstCurve(recover, upper, np.array(mean))


def write_record(outcome: Outcome, folder: Path) -> None:
    """The curves."""
    groups = outcome.curves | {f"fail_{fail:g}": curve for fail, curve in outcome.burst_curves.items()}
    arrays = {f"{name}.{field}": values for name, group in groups.items() for field, values in group._asdict().items()}
    np.savez(folder / "curves.npz", allow_pickle=False, **arrays)
