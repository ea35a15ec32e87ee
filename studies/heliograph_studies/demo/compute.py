"""What the demonstration computes: estimates and scores for several seeds of the relay."""

from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.filters.gaussian.gaussian import cubature_filter
from heliograph.model.channel import hop, perfect
from heliograph.model.estimate import Estimate
from heliograph.numerics.check import fail
from heliograph.numerics.float64 import compiled
from heliograph.random_affine.base import AbstractRandomAffine, apply
from heliograph.random_affine.moments.second_moments import second_order
from heliograph.simulation.network import Network
from heliograph.simulation.node import Node
from heliograph.simulation.recorded import run
from heliograph_studies.demo import robot
from heliograph_studies.demo.learned import Learned
from heliograph_studies.demo.recording import PlazaRecording
from heliograph_studies.demo.scores import Score, score

SEEDS = 5  # seeds of the relay for the spread: the one asked for and those after it
NAMES = ("relay_aware", "extra_noise", "mean_gain", "perfect_channel", "open_loop")
TABLE_HEADERS = (
    "filter",
    "RMSE (m)",
    "claimed (m)",
    "NEES / dim",
    "in 95 % ellipse",
    "RMSE, all seeds",
    "NEES, all seeds",
)


@dataclass(frozen=True)
class Trial:
    """One draw of the relay: what arrived (rows, 4), every filter's estimates and scores."""

    seed: int
    received: np.ndarray
    estimates: dict[str, Estimate]
    scores: dict[str, Score]


@dataclass(frozen=True)
class Outcome:
    """All that the demonstration found: one trial for each seed, the first of them shown in full.

    learned: the constants learned from the ranges alone; None where nothing was learned.
    """

    recording: PlazaRecording
    extra_variance: float
    trials: list[Trial]
    learned: Learned | None = None


def relay(channel: AbstractRandomAffine, signals: np.ndarray, seed: int) -> np.ndarray:
    """Send recorded signals (rows, inputs) through the channel, drawn anew for each row; NaN stays NaN."""
    missing = np.isnan(signals)
    return np.where(missing, np.nan, _send(channel, np.where(missing, 0.0, signals), np.asarray(seed)))


@compiled
def _send(channel: AbstractRandomAffine, signals: np.ndarray, seed: np.ndarray) -> jax.Array:
    keys = jax.vmap(jax.random.fold_in, in_axes=(None, 0))(jax.random.key(seed), jnp.arange(len(signals)))
    return jax.vmap(lambda key, y: apply(channel.sample(key), y))(keys, signals)


def average_noise(path: AbstractRandomAffine, signals: np.ndarray) -> float:
    """Variance of z - E[z | y] on one path, averaged over the recorded signals: a constant in place of fading."""
    y = signals[~np.isnan(signals)]
    moments = np.array([[np.mean(y**2), np.mean(y)], [np.mean(y), 1.0]])
    with jax.enable_x64(True):
        return float(second_order(path).spread(jnp.asarray(moments), jnp.array([True]))[0, 0])


def networks(drive: robot.Drive, extra_variance: float) -> Network:
    """The example's node with one more competitor, and a node that hears the ranges without any relay."""
    network, count = robot.network_of(drive), len(drive.beacons)
    plant, node = network.plant, network.nodes["robot"]
    assert isinstance(node, Node)
    extra = cubature_filter(plant, node.sensor, hop(1.0, extra_variance, dimension=count))
    direct = cubature_filter(plant, node.sensor, perfect(count))
    relayed = Node(node.sensor, robot.channel, node.filters | {"extra_noise": extra})
    return Network(plant, {"robot": relayed, "direct": Node(node.sensor, perfect(count), {"perfect_channel": direct})})


def one_trial(recording: PlazaRecording, network: Network, seed: int) -> Trial:
    """Draw the relay, run every filter, and score it."""
    received = relay(robot.channel, recording.ranges, seed)
    measurements = {"robot": received, "direct": recording.ranges}
    record = run(network, measurements, recording.odometry, recording.time)
    if failures := record.failures():
        raise fail("demonstration", "sound estimates", "; ".join(failures))
    by_name = {name: e for filters in record.estimates.values() for name, e in filters.items()}
    estimates = {name: by_name[name] for name in NAMES}
    return Trial(seed, received, estimates, {name: score(e, recording.truth) for name, e in estimates.items()})


def compute(recording: PlazaRecording, seed: int, advance: Callable[[str], None] = lambda what: None) -> Outcome:
    """Run the trials of SEEDS seeds; `advance` is told what begins."""
    extra_variance = average_noise(robot.relay, recording.ranges)
    network, trials = networks(robot.DRIVES[recording.name], extra_variance), []
    for s in range(seed, seed + SEEDS):
        advance(f"relay and filters, seed {s}")
        trials.append(one_trial(recording, network, s))
    return Outcome(recording, extra_variance, trials)


def table_rows(outcome: Outcome) -> list[list[str]]:
    """One row for each filter: name, scores of the first seed, and their range over all seeds; see TABLE_HEADERS."""
    rows = []
    for name in NAMES:
        shown, scores = outcome.trials[0].scores[name], [t.scores[name] for t in outcome.trials]
        errors, nees = [s.position_rmse_m for s in scores], [s.nees_per_dimension for s in scores]
        item = shown.position_rmse_m, shown.claimed_rmse_m, shown.nees_per_dimension
        rows.append([name, *map(_short, item), f"{100 * shown.inside_95:.1f} %", _spread(errors), _spread(nees)])
    return rows


def _short(value: float) -> str:
    return f"{value:.2f}" if value < 100 else f"{value:.0f}"


def _spread(values: list[float]) -> str:
    low, high = _short(min(values)), _short(max(values))
    return low if low == high else f"{low}–{high}"
