"""What the example computes: errors and consistency on either side of the cut, and where heavy tails come from."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

import heliograph as hg
from heliograph_studies.outcome import Inline, Unlisted
from heliograph_studies.range_bearing.setting import SPEED, TURN, Setting, close_by, passing
from heliograph_studies.stages import Stages

CLASSES = 10  # of runs, by how close the target passes
CASES = {
    "elsewhere": "east of the station, where no bearing crosses",
    "across": "west of it, where bearings cross pi",
    "on_a_line": "the same, for filters that know no angles",
}


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

    closest_pass and rmse_by_closest_pass (class,): runs in order of their closest pass, largest distance and error of
    each class. worst_hundredth: share of the square error that the worst hundredth of the runs has. broken: share of
    runs that claim far too little at some step (e' B^-1 e beyond what one in 10,000 reaches); broken_at_closest_pass:
    of these, those where that begins within 3 steps of the closest pass.
    """

    score: Inline[Score]
    closest_pass: np.ndarray
    rmse_by_closest_pass: np.ndarray
    worst_hundredth: float
    broken: float
    broken_at_closest_pass: float


Scores = dict[str, Score]


@dataclass(frozen=True)
class Outcome:
    """Scores by case and filter, and tails by filter; one run's true path and its estimates with and without angles."""

    fading_runs: int
    elsewhere: Scores
    across: Scores
    on_a_line: Scores
    fading: dict[str, Tails]
    truth: Unlisted[np.ndarray]
    paths: Unlisted[dict[str, np.ndarray]]


def compute(setting: Setting, stages: Stages) -> Outcome:
    """Everything."""
    scores, truths, places = {}, {}, {}
    for case, what in CASES.items():
        network = passing(setting, 1.0 if case == "elsewhere" else -1.0, circular=case != "on_a_line")
        work = partial(driven, network, setting, stages.progress)
        scores[case], truths[case], places[case] = stages(f"driving {what}", work)
    errors = np.abs(places["on_a_line"] - truths["on_a_line"])
    worst = int(np.argmax(errors.max(axis=(1, 2))))
    paths = {case: places[case][worst] for case in ("across", "on_a_line")}
    fading = stages("passing a station behind a fading relay", lambda: tails(setting, stages.progress))
    return Outcome(setting.fading_runs, **scores, fading=fading, truth=truths["across"][worst], paths=paths)


def driven(
    network: hg.Network, setting: Setting, progress: Callable[[int, int], None]
) -> tuple[Scores, np.ndarray, np.ndarray]:
    """Scores by filter, and places (run, time, 2): true ones, and as the cubature filter estimates them."""
    u = np.tile([SPEED, TURN], (setting.steps, 1))
    record = hg.monte_carlo(network, setting.steps, setting.runs, setting.seed, inputs=u, progress=progress)
    assert record.truth is not None
    scores = {
        f"{node}_{name}": score(record.errors(node, name), nees_of(record.errors(node, name), estimate))
        for node, estimates in record.estimates.items()
        for name, estimate in estimates.items()
    }
    return scores, record.truth[..., :2], np.asarray(record.estimates["quiet"]["cubature"].mean)[..., :2]


def nees_of(errors: np.ndarray, estimate: hg.model.Estimate) -> np.ndarray:
    """e' B^-1 e / n, (run, time)."""
    weighed = np.linalg.solve(np.asarray(estimate.covariance), errors[..., None])[..., 0]
    result: np.ndarray = np.sum(errors * weighed, axis=-1) / errors.shape[-1]
    return result


def score(errors: np.ndarray, nees: np.ndarray) -> Score:
    """Numbers of one filter."""
    place, (runs, _), n = np.hypot(errors[..., 0], errors[..., 1]), nees.shape, errors.shape[-1]
    reach = 1.96 * np.sqrt(2 / (n * runs))  # of a mean of chi-squares with so many degrees of freedom
    return Score(
        rmse=float(np.sqrt(np.mean(place**2))),
        median=float(np.median(place)),
        largest=float(place.max()),
        nees=float(nees.mean()),
        nees_se=float(nees.mean(axis=1).std(ddof=1) / np.sqrt(runs)),
        inside=float(np.mean(np.abs(nees.mean(axis=0) - 1) <= reach)),
    )


def tails(setting: Setting, progress: Callable[[int, int], None]) -> dict[str, Tails]:
    """Where the errors behind the fading relay are."""
    network = close_by(setting)
    record = hg.monte_carlo(network, setting.fading_steps, setting.fading_runs, setting.seed, progress=progress)
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
            score(errors, nees),
            closest_pass=np.array([distance[runs].min(axis=1).max() for runs in order]),
            rmse_by_closest_pass=np.sqrt([place[runs].mean() for runs in order]),
            worst_hundredth=float(by_run[: max(len(by_run) // 100, 1)].sum() / by_run.sum()),
            broken=float(broken.mean()),
            broken_at_closest_pass=float(near[broken].mean()) if broken.any() else 0.0,
        )
    return result
