"""Every number of the reproduction: thresholds, bounds, certificates, and what the filter really has."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

import heliograph as hg
from heliograph_studies.intermittent_observations import setting
from heliograph_studies.intermittent_observations.mean_error import Simulated, from_runs, mean_error, over_patterns
from heliograph_studies.intermittent_observations.rounding import Iterated, iterate
from heliograph_studies.intermittent_observations.setting import FILTER, NODE, Example

RUNS = 4000
HORIZON, SETTLED = 100, 50  # steps of a run, and of them those before E P has settled
PATTERNS = 17  # steps over which all patterns of losses are listed
ITERATIONS = 150  # of the modified Riccati equation in two forms
POINTS = 36  # of a curve
DIGITS = 1e-7  # of a threshold that is searched on a network
APART = 0.005  # how far from a threshold verdicts are asked for


class Link(NamedTuple):
    """One example over one link: fail and recover, the judgement, the lower bound's trace, and E P found twice.

    `mean_error` is NaN where there is no quadrature: for more than one state.
    """

    fail: float
    recover: float
    judged: hg.simulation.Boundedness
    lower: float
    mean_error: float
    simulated: Simulated

    @property
    def bound(self) -> float:
        """Trace of what E P is at most; NaN where nothing is certified."""
        return float("nan") if self.judged.bound is None else float(np.trace(self.judged.bound))


class Curves(NamedTuple):
    """tr of bounds and mean against the arrival probability; NaN where they do not exist."""

    arrival: np.ndarray
    upper: np.ndarray
    lower: np.ndarray
    mean: np.ndarray


class Reproduction(NamedTuple):
    """Everything that summary, figures and report are made of."""

    seed: int
    runs: int
    critical: dict[str, hg.linear.CriticalArrival]
    constant: hg.linear.CriticalArrival
    scalar: Link
    coupled: Link
    one_unstable: Link
    bursts: list[Link]
    recovery: dict[float, float]
    components: tuple[float, float]
    verdicts: dict[str, str]
    between: np.ndarray
    below: np.ndarray
    turning: np.ndarray
    between_bound: float
    untold: dict[str, hg.simulation.Boundedness]
    iterated: Iterated
    typical: float
    curves: dict[str, Curves]
    burst_curves: dict[float, tuple[np.ndarray, np.ndarray, np.ndarray]]


EXAMPLES = {"scalar": setting.SCALAR, "coupled": setting.COUPLED, "one_unstable": setting.ONE_UNSTABLE,
            "components": setting.COMPONENTS, "turning": setting.TURNING}  # fmt: skip


def compute(runs: int = RUNS, seed: int = 0, advance: Callable[[str], None] = lambda what: None) -> Reproduction:
    """Compute all of it; `advance` is told what begins."""
    advance("thresholds")
    critical = {name: hg.linear.critical_arrival(e.plant(), e.sensor()) for name, e in EXAMPLES.items()}
    always = hg.linear.critical_arrival(setting.SCALAR.plant(), setting.SCALAR.sensor(), steady_gain(setting.SCALAR))
    recovery = {fail: critical_recovery(fail) for fail in (0.01, 0.1, 0.5)}
    components = critical_component(0), critical_component(1)
    advance("bounds and simulated filters")
    loss = 1 - setting.ARRIVAL
    independent = [
        link(example, setting.lossy(setting.ARRIVAL), loss, setting.ARRIVAL, runs, seed)
        for example in (setting.SCALAR, setting.COUPLED, setting.ONE_UNSTABLE)
    ]
    bursts = [link(setting.SCALAR, setting.bursts(*each), *each, runs, seed) for each in setting.BURSTS]
    advance("patterns, rounding and curves")
    low = critical["scalar"].lower - 0.06
    return Reproduction(
        seed=seed, runs=runs, critical=critical, constant=always, scalar=independent[0], coupled=independent[1],
        one_unstable=independent[2], bursts=bursts, recovery=recovery, components=components, verdicts=verdicts(),
        between=over_patterns(setting.COUPLED, setting.BETWEEN, PATTERNS),
        below=over_patterns(setting.COUPLED, low, PATTERNS),
        turning=over_patterns(setting.TURNING, (critical["turning"].lower + critical["turning"].upper) / 2, PATTERNS),
        between_bound=judge(setting.COUPLED, setting.lossy(setting.BETWEEN)).radius,
        untold={"dropout": judge(setting.SCALAR, hg.dropout(hg.perfect(), 0.99)),
                "fading": judge(setting.SCALAR, hg.hop(hg.Rayleigh(1.0), 0.1))},
        iterated=iterate(setting.COUPLED, setting.ARRIVAL, ITERATIONS), typical=typical(low, runs, seed),
        curves={"scalar": curves(setting.SCALAR), "coupled": curves(setting.COUPLED)},
        burst_curves={fail: burst_curve(fail) for fail in (0.05, 0.2, 0.5)},
    )  # fmt: skip


def judge(example: Example, link: hg.random_affine.AbstractRandomAffine) -> hg.simulation.Boundedness:
    """The package's verdict on an example over a link."""
    return hg.simulation.certify_boundedness(example.network(link))


def steady_gain(example: Example) -> np.ndarray:
    """A K of the filter that hears everything: the gain that is certified where every packet arrives."""
    return judge(example, setting.lossy(1.0)).gains[(True,) * len(example.output)]


def link(
    example: Example, channel: hg.random_affine.AbstractRandomAffine, fail: float, recover: float, runs: int, seed: int
) -> Link:
    """Bounds, quadrature and simulation of one example over one link."""
    record = hg.monte_carlo(example.network(channel), HORIZON, runs, seed)
    heard = ~np.isnan(record.measurements[NODE]).any(axis=2)[:, SETTLED:]
    filtered = record.estimates[NODE][FILTER].covariance[:, SETTLED:]
    known = mean_error(example, fail, recover) if example.states == 1 else float("nan")
    simulated = from_runs(example, fail, recover, np.asarray(filtered), heard)
    return Link(fail, recover, judge(example, channel), lower(example, fail, recover), known, simulated)


def lower(example: Example, fail: float, recover: float) -> float:
    """tr S_1 + tr S_2: losses carry all of S on, arrivals nothing but noise; infinite where losses last too long.

    S_loss = fail w_0 Q + (1 - recover) (A S_loss A' + w_1 Q), w the long-run shares.
    """
    a, q, n = example.transition, example.process * np.eye(example.states), example.states
    lost = fail / (fail + recover)
    square = np.kron(a, a)
    if (1 - recover) * np.abs(np.linalg.eigvals(a)).max() ** 2 >= 1:
        return float("inf")
    start = (lost * q).ravel()  # fail w_0 + (1 - recover) w_1 = w_1
    s = np.linalg.solve(np.eye(n * n) - (1 - recover) * square, start).reshape(n, n)
    return float(np.trace(s + recover * a @ s @ a.T + (1 - lost) * q))


def critical_recovery(fail: float) -> float:
    """The smallest probability of recovery at which the scalar example is certified, by bisection on verdicts."""
    return _smallest(lambda recover: judge(setting.SCALAR, setting.bursts(fail, recover)))


def critical_component(which: int) -> float:
    """The smallest arrival of one component's packets at which the plant is certified, the other's always arriving."""

    def verdict(arrival: float) -> hg.simulation.Boundedness:
        links = [hg.erasure(hg.perfect(), arrival if i == which else 1.0) for i in range(2)]
        return judge(setting.COMPONENTS, hg.parallel(links))

    return _smallest(verdict)


def _smallest(verdict: Callable[[float], hg.simulation.Boundedness]) -> float:
    low, high = 0.0, 1.0
    while high - low > DIGITS:
        middle = (low + high) / 2
        low, high = (low, middle) if verdict(middle).verdict == "certified" else (middle, high)
    return high


def verdicts() -> dict[str, str]:
    """Verdicts on either side of thresholds, and between the two of the coupled plant."""

    def on(example: Example, arrival: float) -> str:
        return judge(example, setting.lossy(arrival, len(example.output))).verdict

    one, two = 1 - 2.5**-2, 1 - 1.5**-2

    def apart(first: float, second: float) -> str:
        links = [hg.erasure(hg.perfect(), p) for p in (first, second)]
        return judge(setting.COMPONENTS, hg.parallel(links)).verdict

    scalar = 1 - 1.25**-2
    return {
        "below": on(setting.SCALAR, scalar - APART),
        "above": on(setting.SCALAR, scalar + APART),
        "between": on(setting.COUPLED, setting.BETWEEN),
        "both_above": apart(one + APART, two + APART),
        "first_below": apart(one - APART, two + APART),
        "second_below": apart(one + APART, two - APART),
    }


def typical(arrival: float, runs: int, seed: int) -> float:
    """The median of P of the scalar example at an arrival where its mean diverges, after a long time."""
    record = hg.monte_carlo(setting.SCALAR.network(setting.lossy(arrival)), HORIZON, runs, seed)
    return float(np.median(record.estimates[NODE][FILTER].covariance[:, -1]))


def curves(example: Example) -> Curves:
    """Bounds over arrival probabilities, and E P where there is a quadrature for it."""
    arrival = np.linspace(0.3, 1.0, POINTS)
    upper, below, mean = [], [], []
    for p in arrival:
        judged, least = judge(example, setting.lossy(p)), lower(example, 1 - p, p)
        upper.append(float("nan") if judged.bound is None else float(np.trace(judged.bound)))
        below.append(least if np.isfinite(least) else float("nan"))
        known = example.states == 1 and judged.verdict == "certified"
        mean.append(mean_error(example, 1 - p, p) if known else float("nan"))
    return Curves(arrival, np.array(upper), np.array(below), np.array(mean))


def burst_curve(fail: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Recovery, the bound on E P, and E P, of the scalar example; NaN where there is none."""
    recover = np.linspace(0.3, 1.0, POINTS)
    judged = [judge(setting.SCALAR, setting.bursts(fail, r)) for r in recover]
    upper = np.array([float("nan") if j.bound is None else float(np.trace(j.bound)) for j in judged])
    pairs = zip(recover, upper, strict=True)
    mean = [mean_error(setting.SCALAR, fail, r) if bound > 0 else float("nan") for r, bound in pairs]
    return recover, upper, np.array(mean)
