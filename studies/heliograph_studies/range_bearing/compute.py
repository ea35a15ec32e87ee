"""What the example computes: errors and consistency on either side of the cut, and where heavy tails come from."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

import heliograph as hg
from heliograph_studies.range_bearing.setting import FADING_STEPS, SPEED, STEPS, TURN, close_by, passing

RUNS, FADING_RUNS = 2000, 1000
CLASSES = 10  # of runs, by how close the target passes
CASES = {
    "elsewhere": "east of the station, where no bearing crosses",
    "across": "west of it, where bearings cross pi",
    "on_a_line": "the same, for filters that know no angles",
}
STAGES = len(CASES) + 1


@dataclass(frozen=True)
class Score:
    """Of one filter over all runs and steps: error of the place (m), NEES per dimension with its standard error.

    inside: share of steps at which the runs' mean NEES is in its 95 % chi-square interval.
    """

    rmse: float
    median: float
    largest: float
    nees: float
    nees_se: float
    inside: float


@dataclass(frozen=True)
class Tails:
    """Of one filter behind the fading relay: its score, and how the square error is spread over the runs.

    closest and rmse (class,): runs in order of their closest pass, largest distance and error of each class. worst:
    share of the square error that the worst hundredth of the runs has. broken: share of runs that claim far too little
    at some step (e' B^-1 e beyond what one in 10,000 reaches); at_closest: of these, those where that begins within 3
    steps of the closest pass.
    """

    score: Score
    closest: np.ndarray
    rmse: np.ndarray
    worst: float
    broken: float
    at_closest: float


@dataclass(frozen=True)
class Outcome:
    """Scores by case and filter; one run's true path and estimates across the cut; tails by filter."""

    scores: dict[str, dict[str, Score]]
    truth: np.ndarray
    paths: dict[str, np.ndarray]
    tails: dict[str, Tails]


def nees_of(errors: np.ndarray, estimate: hg.model.Estimate) -> np.ndarray:
    """e' B^-1 e / n, (run, time)."""
    weighed = np.linalg.solve(np.asarray(estimate.covariance), errors[..., None])[..., 0]
    result: np.ndarray = np.sum(errors * weighed, axis=-1) / errors.shape[-1]
    return result


def score(errors: np.ndarray, nees: np.ndarray) -> Score:
    """Numbers of one filter."""
    place, (runs, _), n = np.hypot(errors[..., 0], errors[..., 1]), nees.shape, errors.shape[-1]
    by_run = nees.mean(axis=1)
    reach = 1.96 * np.sqrt(2 / (n * runs))  # of a mean of chi-squares with so many degrees of freedom
    return Score(
        rmse=float(np.sqrt(np.mean(place**2))),
        median=float(np.median(place)),
        largest=float(place.max()),
        nees=float(nees.mean()),
        nees_se=float(by_run.std(ddof=1) / np.sqrt(runs)),
        inside=float(np.mean(np.abs(nees.mean(axis=0) - 1) <= reach)),
    )


def across(seed: int, advance: Callable[[str], None]) -> tuple[dict[str, dict[str, Score]], dict[str, hg.Record]]:
    """Scores by case and filter, and the records."""
    u = np.tile([SPEED, TURN], (STEPS, 1))
    networks = {"elsewhere": passing(1.0), "across": passing(-1.0), "on_a_line": passing(-1.0, circular=False)}
    scores, records = {}, {}
    for case, what in CASES.items():
        advance(f"driving {what}")
        record = records[case] = hg.monte_carlo(networks[case], STEPS, RUNS, seed, inputs=u)
        scores[case] = {
            f"{node}_{name}": score(record.errors(node, name), nees_of(record.errors(node, name), estimate))
            for node, found in record.estimates.items()
            for name, estimate in found.items()
        }
    return scores, records


def tails(seed: int) -> dict[str, Tails]:
    """Where the errors behind the fading relay are."""
    record = hg.monte_carlo(close_by(), FADING_STEPS, FADING_RUNS, seed)
    assert record.truth is not None
    distance = np.hypot(record.truth[..., 0], record.truth[..., 1])
    nearest, order = distance.argmin(axis=1), np.array_split(np.argsort(distance.min(axis=1)), CLASSES)
    result = {}
    for name, estimate in record.estimates["station"].items():
        errors = record.errors("station", name)
        nees, place = nees_of(errors, estimate), np.sum(errors[..., :2] ** 2, axis=-1)
        by_run = np.sort(place.mean(axis=1))[::-1]
        beyond = nees > 23.51 / 4  # chi-square with 4 degrees of freedom: one in 10,000
        broken = beyond.any(axis=1)
        near = np.abs(beyond.argmax(axis=1) - nearest) <= 3
        result[name] = Tails(
            score=score(errors, nees),
            closest=np.array([distance[runs].min(axis=1).max() for runs in order]),
            rmse=np.sqrt([place[runs].mean() for runs in order]),
            worst=float(by_run[: max(len(by_run) // 100, 1)].sum() / by_run.sum()),
            broken=float(broken.mean()),
            at_closest=float(near[broken].mean()) if broken.any() else 0.0,
        )
    return result


def compute(seed: int, advance: Callable[[str], None] = lambda what: None) -> Outcome:
    """Everything; `advance` is told what begins."""
    scores, records = across(seed, advance)
    line = records["on_a_line"]
    worst = int(np.argmax(np.abs(line.errors("quiet", "cubature")[..., :2]).max(axis=(1, 2))))
    truth = records["across"].truth
    assert truth is not None
    drawn = {case: np.asarray(records[case].estimates["quiet"]["cubature"].mean)[worst, :, :2] for case in
             ("across", "on_a_line")}  # fmt: skip
    advance("passing a station behind a fading relay")
    return Outcome(scores, truth[worst, :, :2], drawn, tails(seed))
