"""Whether 95 % intervals of what is learned hold the truth, counted over recordings that are fitted each by itself.

Run: python benchmarks/interval_coverage.py [BATCHES [BATCH]], as many batches of as many recordings for each row: 10 of
64 unless given, a quarter of an hour. Prints, for each law of a link's gain and form of the likelihood, the percentage
of intervals that hold the truth by method and number; then, where the recorded drive is installed (the extra
`recordings`), the errors of the demonstration's robot with constants learned from its ranges, direct and behind the
relay. One plant with a square wave as input, one sensor, a relayed link of which a fifth of the packets is lost,
which is observed, and a direct link.
"""

import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache, partial
from importlib.util import find_spec
from typing import NamedTuple

import jax
import numpy as np

import heliograph as hg
from heliograph.engine.choice import choose_code
from heliograph.learning.free_parameters import Parameters
from heliograph.learning.likelihood.climbs import Evaluated
from heliograph.learning.likelihood.evaluation import Evaluation, evaluate_recording
from heliograph.learning.likelihood.objective import Form, Objective, make_objectives
from heliograph.learning.likelihood.parameter_transforms import from_unconstrained
from heliograph.learning.likelihood.surface import DIFFERENCE_WIDTH
from heliograph.learning.likelihood.trust_region import CONVERGED_GAIN_BY_ROUNDING, maximise_from_starts
from heliograph.learning.long_run_covariance import (
    Method,
    compute_sandwich_covariance,
    estimate_long_run_covariance,
    student_quantile,
)
from heliograph.learning.parametric_network import Build, describe
from heliograph.numerics.float64 import quickly_compiled, to_numpy

BATCHES, BATCH, RELAYS = 10, 64, 5
MEAN, VARIANCE = 0.8, 0.16
PLANT_NOISE, SENSOR_NOISE, HOP_NOISE, DIRECT_NOISE = 0.2, 0.3, 0.3, 0.2
ARRIVAL = 0.8  # observed
UNTOLD = 0.7
STEPS, SHORT = 2000, 500
PERIOD, LEVEL = 60, 0.4  # of the input, a square wave
FORMS: tuple[Form, ...] = ("linear", "conditional")
METHODS: tuple[Method, ...] = ("hessian", "white", "bartlett", "cosines")

RARE = 0.04  # probability of the large gain
RARE_STEP = np.sqrt(VARIANCE / (RARE * (1 - RARE)))  # how much larger it is
LOG_VARIANCE = np.log(1 + VARIANCE / MEAN**2)

LAWS: dict[str, hg.random_affine.AbstractLaw] = {
    "rayleigh": hg.Rayleigh(MEAN / np.sqrt(np.pi / 2)),
    "two_point": hg.Discrete([MEAN - 0.4, MEAN + 0.4], [0.5, 0.5]),
    "log_normal": hg.random_affine.LogNormal(np.log(MEAN) - LOG_VARIANCE / 2, np.sqrt(LOG_VARIANCE)),
    "rare": hg.Discrete([MEAN - RARE * RARE_STEP, MEAN + (1 - RARE) * RARE_STEP], [1 - RARE, RARE]),
}


class Row(NamedTuple):
    """One row of the table: what is recorded, how long, and which form of the likelihood is climbed."""

    name: str
    law: str
    form: Form
    steps: int
    driven: bool = True


ROWS = (
    *(Row(law, law, form, STEPS) for law in LAWS for form in FORMS),
    Row("rayleigh_short", "rayleigh", "linear", SHORT),
    Row("two_point_undriven", "two_point", "conditional", STEPS, driven=False),
    *(Row("uninformed", "uninformed", form, STEPS) for form in FORMS),
)


def square_wave(row: Row) -> np.ndarray:
    """The input of each step."""
    half = np.arange(row.steps) // (PERIOD // 2)
    return np.where(half % 2 == 0, LEVEL, -LEVEL)[:, None] * row.driven


def world(row: Row) -> hg.Network:
    """The network that is recorded."""
    if row.law == "uninformed":
        return unpublished(PLANT_NOISE, HOP_NOISE, UNTOLD)
    return relayed(LAWS[row.law], PLANT_NOISE, SENSOR_NOISE, HOP_NOISE)


def learned(row: Row) -> hg.Network:
    """What is learned of it."""
    plant_noise, hop_noise = hg.free(PLANT_NOISE, "plant_noise"), hg.free(HOP_NOISE, "hop_noise")
    if row.law == "uninformed":
        return unpublished(plant_noise, hop_noise, hg.free(UNTOLD, "arrival"))
    mean, variance = hg.free(MEAN, "mean_gain"), hg.free(true_values(row)["gain_variance"], "gain_variance", "positive")
    law = hg.random_affine.GivenMoments([mean, mean**2 + variance])
    return relayed(law, plant_noise, hg.free(SENSOR_NOISE, "sensor_noise"), hop_noise)


def true_values(row: Row) -> dict[str, float]:
    """What is to be covered, by name."""
    noises = {"plant_noise": PLANT_NOISE, "hop_noise": HOP_NOISE}
    if row.law == "uninformed":
        return {**noises, "arrival": UNTOLD}
    law = LAWS[row.law]
    variance = float(law.moment(2)) - float(law.moment(1)) ** 2
    return {**noises, "mean_gain": MEAN, "gain_variance": variance, "sensor_noise": SENSOR_NOISE}


def relayed(law: hg.random_affine.AbstractLaw, plant_noise: float, sensor_noise: float, hop_noise: float) -> hg.Network:
    """z1 = g y + n1 of which a part is lost and observed, z2 = y + n2 with n2 known."""
    hop = hg.erasure(hg.hop(law, hop_noise), ARRIVAL)
    return _network(plant_noise, sensor_noise, hg.model.with_direct_link(hop, hg.hop(1.0, DIRECT_NOISE)))


def unpublished(plant_noise: float, hop_noise: float, arrival: float) -> hg.Network:
    """Lost without a word, and then noise is added."""
    lossy = hg.dropout(hg.perfect(), arrival)
    return _network(plant_noise, 0.0, hg.amplify_and_forward([lossy, hg.hop(1.0, hop_noise)]))


def _network(plant_noise: float, sensor_noise: float, channel: hg.random_affine.AbstractRandomAffine) -> hg.Network:
    plant = hg.LinearPlant([[0.95]], plant_noise, [0.0], [[1.0]], [[1.0]])
    return hg.Network(plant, {"node": hg.Node(hg.LinearSensor([[1.0]], sensor_noise), channel, {})})


SEEN = 0.05  # information of a coordinate below which the number has run to a limit


@dataclass(frozen=True)
class Fits:
    """Estimates from each of many recordings, on the line on which steps are taken.

    x: estimates (runs, p). hessian: of the negative log-likelihood at each (runs, p, p). scores: of each step
    (runs, steps, p). inside: where the climb arrived at a point at which no number has run to a limit (runs,).
    """

    parameters: Parameters
    x: np.ndarray
    hessian: np.ndarray
    scores: np.ndarray
    inside: np.ndarray

    def intervals(self, method: Method) -> tuple[np.ndarray, np.ndarray]:
        """Ends of 95 % intervals (runs, p), as `Fit.rows` makes them; NaN where a number has run to a limit."""
        reach = np.full(self.x.shape, np.nan)
        for i in np.flatnonzero(self.inside):
            result = estimate_long_run_covariance(method, [self.scores[i]], self.hessian[i])
            spread = np.diag(compute_sandwich_covariance(self.hessian[i], result.covariance))
            reach[i] = student_quantile(result.freedom) * np.sqrt(np.maximum(spread, 0.0))
        return self._back(self.x - reach), self._back(self.x + reach)

    def _back(self, x: np.ndarray) -> np.ndarray:
        columns = [from_unconstrained(e.domain, x[:, i]) for i, e in enumerate(self.parameters.entries)]
        return np.stack(columns, axis=1)


def fit_each(network: Build, z: np.ndarray, u: np.ndarray, form: Form) -> Fits:
    """Fit each of many recordings z (runs, steps, received) by itself, from the network's start, in one program.

    As `hg.fit`, without its other starts and sentences, for free numbers that are single.
    """
    description = describe(network)
    parameters = description.parameters
    objective = next(item for item in make_objectives(description) if item.form == form)

    def outcome(x: np.ndarray, data: np.ndarray) -> Evaluation:
        with jax.enable_x64(True):
            choice = choose_code(evaluate_recording, (objective, x, data, u), [False, True, True, False])
            if choice.code is None:
                return to_numpy(_by_xla(objective, x, data, u))
            return choice.results()

    def evaluate(x: np.ndarray, data: np.ndarray = z) -> Evaluated:
        at = outcome(x, data)
        return np.asarray(at.density.sum(axis=1)), np.asarray(at.score.sum(axis=1)), np.asarray(at.halves.sum(axis=1))

    # Climb from the start, one recording after another: a search goes on with the points that move alone.
    ends = [maximise_from_starts(partial(evaluate, data=data[None]), parameters.start[None]) for data in z]
    x, remaining = np.concatenate([end.x for end in ends]), np.concatenate([end.remaining for end in ends])
    top = outcome(x, z)
    hessian = np.asarray(top.halves).sum(axis=1)
    local = np.diagonal(hessian, axis1=1, axis2=2)
    inside = (2 * remaining < CONVERGED_GAIN_BY_ROUNDING) & np.all(local > SEEN, axis=1)
    # Hessian by central differences of the scores; the information where it is not concave.
    width = DIFFERENCE_WIDTH / np.sqrt(np.maximum(local, SEEN))
    slopes = np.empty(hessian.shape)
    for i in range(x.shape[1]):
        shift = np.zeros(x.shape)
        shift[:, i] = width[:, i]
        slopes[:, i] = (evaluate(x - shift)[1] - evaluate(x + shift)[1]) / (2 * width[:, i, None])
    slopes = (slopes + slopes.swapaxes(1, 2)) / 2
    concave = inside & (np.linalg.eigvalsh(np.nan_to_num(slopes))[:, 0] > 0)
    return Fits(parameters, x, np.where(concave[:, None, None], slopes, hessian), np.asarray(top.score), inside)


@quickly_compiled
def _by_xla(objective: Objective, x: jax.Array, z: jax.Array, u: jax.Array) -> Evaluation:
    return jax.vmap(lambda point, item: evaluate_recording(objective, point, item, u))(x, z)


@cache
def builder(row: Row) -> Callable[[], hg.Network]:
    """The function that builds a row's network, the same one for all batches, so that one program serves them."""
    return partial(learned, row)


def count(row: Row, batches: int, size: int) -> tuple[int, dict[str, dict[str, float]]]:
    """Recordings in which no number ran to a limit, and the percentage of their intervals that hold the truth."""
    u, inside, hits = square_wave(row), 0, {method: dict[str, int]() for method in METHODS}
    for batch in range(batches):
        record = hg.monte_carlo(world(row), row.steps, size, 0, inputs=u, first_run=batch * size)
        fits = fit_each(builder(row), record.measurements["node"], u, row.form)
        names = [parameter.name for parameter in fits.parameters.every]
        truth = np.array([true_values(row)[name] for name in names])
        inside += int(fits.inside.sum())
        for method in METHODS:
            low, high = fits.intervals(method)
            held = ((low <= truth) & (truth <= high))[fits.inside].sum(axis=0)
            for name, number in zip(names, held, strict=True):
                hits[method][name] = hits[method].get(name, 0) + int(number)
    return inside, {m: {n: 100 * hit / max(inside, 1) for n, hit in of.items()} for m, of in hits.items()}


def drive() -> Iterator[str]:
    """Errors on the recorded drive, learned and calibrated: of direct ranges, and behind several draws of the relay."""
    from heliograph_studies.demo import learned as recorded
    from heliograph_studies.demo import robot
    from heliograph_studies.demo.compute import networks, one_trial, relay
    from heliograph_studies.demo.recording import read_recording

    recording = read_recording()
    model = robot.DRIVES[recording.name]

    def judged(build: Callable[[robot.Drive], hg.Network], received: np.ndarray, filter: str, seed: int) -> str:
        fit = recorded.fitted(partial(build, model), recording, received, len(received))
        after = recorded.judged(fit.network, recording, received)
        before = one_trial(recording, networks(model, 1.0), seed).scores[filter].position_rmse_m
        found = ", ".join(f"{name} {item.estimate:.6g}" for name, item in recorded.parameters(fit).items())
        return f"{after.position_rmse_m:.3f} m, calibrated {before:.3f} m, NEES {after.nees_per_dimension:.2f}; {found}"

    yield f"direct, whole drive: {judged(recorded.direct, recording.ranges, 'perfect_channel', 0)}"
    half = recorded.learn(recording)
    yield f"direct, second half: {half.second_half:.3f} m, calibrated {half.second_half_calibrated:.3f} m"
    for seed in range(RELAYS):
        received = relay(robot.channel, recording.ranges, seed)
        yield f"relayed, seed {seed}: {judged(recorded.relayed, received, 'relay_aware', seed)}"


def main(batches: int = BATCHES, size: int = BATCH) -> None:
    """Print everything."""
    for row in ROWS:
        inside, covered = count(row, batches, size)
        print(f"{row.name}, {row.form}: {inside} of {batches * size} recordings")
        for method, values in covered.items():
            print(f"  {method:8}", *(f"{name} {value:.1f}" for name, value in values.items()), flush=True)
    if find_spec("gtsam") is not None:
        for line in drive():
            print(line, flush=True)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
