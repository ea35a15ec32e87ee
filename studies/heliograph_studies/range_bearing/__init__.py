"""A station that measures range and bearing: across the cut at pi, and close by behind a relay that fades."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import heliograph as hg
from heliograph.report.figures import AMBER, BLUE, GREEN, PURPLE, VERMILION
from heliograph_studies import Inline, Stages, Study, Unlisted, check_fields, sampled
from heliograph_studies.curves import Curve, Panel, curves_over, paths

SPEED, TURN = 1.0, 0.02  # m and rad a step
CHAIN = hg.random_affine.MarkovChain([[0.9, 0.1], [0.3, 0.7]])
QUIET = hg.parallel([hg.hop(1.0, 0.1), hg.hop(1.0, 1e-4)])
NOISY = hg.parallel([hg.hop(1.0, 4.0), hg.hop(1.0, 1e-2)])
LINK = hg.random_affine.Modes(CHAIN, [QUIET, NOISY])


@dataclass(frozen=True)
class Setting:
    """How much is simulated past the two stations, and close by behind the relay that fades.

    bearing: its standard deviation in rad. arrival: probability that a packet of the two stations arrives.
    """

    runs: int = 2000
    steps: int = 40
    fading_runs: int = 1000
    fading_steps: int = 80
    bearing: float = 0.02
    arrival: float = 0.8
    seed: int = 0

    def __post_init__(self) -> None:
        check_fields(self, runs=2, fading_runs=CLASSES, steps=1, fading_steps=1, bearing=(0.0,), arrival=(0.0, 1.0))


def move(x: jax.Array, u: jax.Array) -> jax.Array:
    """x = (x, y, heading), u = (distance, turn)."""
    return jnp.stack([x[0] + u[0] * jnp.cos(x[2]), x[1] + u[0] * jnp.sin(x[2]), x[2] + u[1]])


def look(x: jax.Array) -> jax.Array:
    """Range and bearing from the station in the origin, of a state that begins with the place."""
    return jnp.stack([jnp.hypot(x[0], x[1]), jnp.arctan2(x[1], x[0])])


def passing(setting: Setting, side: float, circular: bool = True) -> hg.Network:
    """A robot that drives past two stations at one place, east of them (side 1) or west (-1), where bearings cross pi.

    Node "quiet" receives through Gaussian noise, node "bursts" through noise that is larger for a while; both lose
    packets. Not `circular`: numbers on a line, as without angles.
    """
    plant = hg.Plant(
        move,
        np.diag([0.05**2, 0.05**2, 0.01**2]),
        [30.0 * side, -12.0 * side, np.pi / 2 * side],
        np.diag([1.0, 1.0, 0.05**2]),
        states=("x", "y", "heading"),
        inputs=("distance", "turn"),
        circular=["heading"] if circular else [],
    )
    # One sensor, seen through quiet noise or through noise in bursts.
    angles = ["bearing"] if circular else []
    sensor = hg.Sensor(look, np.diag([0.5**2, setting.bearing**2]), outputs=("range", "bearing"), circular=angles)
    direct = hg.cubature_filter(plant, sensor, QUIET)
    noisy = hg.cubature_filter(plant, sensor, LINK)
    # Filters of each node, and both nodes together.
    quiet: dict[str, hg.filters.AbstractFilter] = {
        "cubature": direct,
        "extended": hg.extended_filter(plant, sensor, QUIET),
    }
    bursts: dict[str, hg.filters.AbstractFilter] = {
        "cubature": noisy,
        "imm": hg.filters.imm_filter(plant, sensor, LINK),
        "gpb1": hg.filters.gpb1_filter(plant, sensor, LINK),
        "gpb2": hg.filters.gpb2_filter(plant, sensor, LINK),
        "particle": hg.filters.particle_filter(plant, sensor, LINK, particles=50),
    }
    fused: dict[str, hg.Fusion | hg.filters.AbstractFilter] = {
        "intersection": hg.Fusion("cubature", hg.CovarianceIntersection()),
        "central": hg.filters.sequential_filter([direct, noisy]),
    }
    nodes = {
        "quiet": hg.Node(sensor, hg.erasure(QUIET, setting.arrival), quiet),
        "bursts": hg.Node(sensor, hg.erasure(LINK, setting.arrival), bursts),
    }
    return hg.Network(plant, nodes, fused)


def close_by(setting: Setting) -> hg.Network:
    """A target that passes a station; its range comes through two hops that fade, its bearing as it is."""
    step, drift = np.kron([[1.0, 1.0], [0.0, 1.0]], np.eye(2)), np.kron([[1 / 3, 1 / 2], [1 / 2, 1.0]], np.eye(2))
    plant = hg.LinearPlant(
        step,
        0.05 * drift,
        [300.0, 50.0, -10.0, 0.0],
        np.diag([20.0, 20.0, 2.0, 2.0]) ** 2,
        states=("x", "y", "vx", "vy"),
    )
    sensor = hg.Sensor(look, np.diag([1.0, setting.bearing**2]), outputs=("range", "bearing"), circular=["bearing"])
    # The range fades over two hops, the bearing does not.
    relay = hg.amplify_and_forward([hg.hop(hg.Rayleigh(0.8), 0.02) for _ in range(2)])
    channel = hg.parallel([relay, hg.hop(1.0, 1e-4)])
    # Moments by rules of higher degree.
    rules = {"second_order": 2, "four_points": 3, "seven_points": 6}  # degree; but for 2 one point more a direction
    filters: dict[str, hg.filters.AbstractFilter] = {
        "extended": hg.extended_filter(plant, sensor, channel),
        "cubature": hg.cubature_filter(plant, sensor, channel),
    }
    for name, degree in rules.items():
        rule = hg.filters.PolynomialMoments(degree)
        filters[name] = hg.filters.gaussian_filter(plant, sensor, channel, rule)
    return hg.Network(plant, {"station": hg.Node(sensor, channel, filters)})


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
    return np.asarray(hg.nees(errors, np.zeros_like(errors), estimate.covariance) / errors.shape[-1])


def score(errors: np.ndarray, nees: np.ndarray) -> Score:
    """Numbers of one filter."""
    place, (runs, _), n = np.hypot(errors[..., 0], errors[..., 1]), nees.shape, errors.shape[-1]
    reach = 1.96 * np.sqrt(2 / (n * runs))  # of a mean of chi-squares with so many degrees of freedom
    return Score(
        rmse=float(np.sqrt(np.mean(place**2))),
        median=float(np.median(place)),
        largest=float(place.max()),
        nees=float(nees.mean()),
        nees_se=sampled(nees.mean(axis=1)).error,
        inside=float(np.mean(np.abs(nees.mean(axis=0) - 1) <= reach)),
    )


def tails(setting: Setting, progress: Callable[[int, int], None]) -> dict[str, Tails]:
    """Where the errors behind the fading relay are."""
    network = close_by(setting)
    record = hg.monte_carlo(network, setting.fading_steps, setting.fading_runs, setting.seed, progress=progress)
    assert record.truth is not None
    # Runs in order of their closest pass, in classes of one size.
    distance = np.hypot(record.truth[..., 0], record.truth[..., 1])
    nearest, order = distance.argmin(axis=1), np.array_split(np.argsort(distance.min(axis=1)), CLASSES)
    result = {}
    for name, estimate in record.estimates["station"].items():
        errors = record.errors("station", name)
        nees, place = nees_of(errors, estimate), np.sum(errors[..., :2] ** 2, axis=-1)
        by_run = np.sort(place.mean(axis=1))[::-1]
        # Steps at which the claim is far too small.
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


LABELS = {
    "quiet_cubature": "Gaussian noise: cubature",
    "quiet_extended": "Gaussian noise: extended",
    "bursts_cubature": "noise in bursts: cubature",
    "bursts_imm": "noise in bursts: IMM",
    "bursts_gpb1": "noise in bursts: GPB1",
    "bursts_gpb2": "noise in bursts: GPB2",
    "bursts_particle": "noise in bursts: particles",
    "fused_intersection": "both, intersected",
    "fused_central": "both, central filter",
}
RULES = {
    "extended": ("slope at the mean", VERMILION),
    "cubature": ("cubature, 8 points", AMBER),
    "second_order": ("second order, 15 points", PURPLE),
    "four_points": ("4 points a direction", GREEN),
    "seven_points": ("7 points a direction", BLUE),
}


def figures(outcome: Outcome) -> dict[str, Figure]:
    """One run across the cut, and errors behind the fading relay by how close the target passes."""
    named = {"across": ("with angles", BLUE), "on_a_line": ("plain numbers", VERMILION)}
    drawn = [Curve(*named[case], path) for case, path in outcome.paths.items()]
    curves = [Curve(*RULES[name], tails.rmse_by_closest_pass) for name, tails in outcome.fading.items()]
    tenths = np.arange(1.0, len(curves[0].values) + 1)
    return {
        "across": paths(outcome.truth, drawn, np.zeros((1, 2))),
        "closest": curves_over(tenths, Panel("error (m, RMS)", curves), "tenth of the runs, closest pass first"),
    }


example = Study("range-bearing", Setting, compute, 4, figures)
run = example.run
