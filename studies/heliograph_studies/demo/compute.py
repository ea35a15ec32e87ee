"""The demonstration: filters behind a recorded drive's relays, the same relays sending less, and learned constants."""

from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import heliograph as hg
from heliograph.numerics.check import fail
from heliograph.numerics.module import Module
from heliograph.random_affine.moments.signal_path import apply
from heliograph_studies import Inline, Stages, Unlisted, check_fields
from heliograph_studies.demo import robot
from heliograph_studies.demo.learned import Learned, Score, learn, score
from heliograph_studies.demo.recording import PlazaRecording, find_recording, read_recording


@dataclass(frozen=True)
class Setting:
    """recording: plaza1 or plaza2; `seeds` draws of the relays, the first with `seed`, which is shown in full."""

    recording: str = "plaza2"
    seeds: int = 5
    seed: int = 0

    def __post_init__(self) -> None:
        check_fields(self, seeds=1)
        self.files()

    def files(self) -> list[Path]:
        """What is read."""
        return [find_recording(self.recording)]


NAMES = ("relay_aware", "extra_noise", "mean_gain", "perfect_channel", "open_loop")
DESIGNS = {"centred": 1.0, "centred_thousandth": 1e-3}  # by what the sensor's power is multiplied
Scores = dict[str, dict[str, Any]]  # by quantity and filter


@dataclass(frozen=True)
class Trial:
    """One draw of the relay: what arrived (rows, 4), every filter's estimates and scores."""

    received: np.ndarray
    estimates: dict[str, hg.model.Estimate]
    scores: dict[str, Score]


@dataclass(frozen=True)
class Design:
    """Error and claim (m) as means over the seeds, and the mean square (m^2) that a beacon's sensor and relay send."""

    rmse: float
    claimed: float
    power: float
    sensor: Unlisted[float]
    relay: Unlisted[float]
    scores: Unlisted[list[Score]]


@dataclass(frozen=True)
class Outcome:
    """Scores of the first seed and of all, what was learned of the constants, and the designed relays."""

    recording: str
    rows: int
    first: Inline[Scores]
    seeds: dict[str, Any]
    learned: Learned
    designs: dict[str, Design]
    drive: Unlisted[PlazaRecording]
    shown: Unlisted[Trial]
    extra_variance: Unlisted[float]


def compute(setting: Setting, stages: Stages) -> Outcome:
    """Everything."""
    drive = stages("reading the recording", lambda: read_recording(setting.recording))
    seeds = range(setting.seed, setting.seed + setting.seeds)
    extra_variance = average_noise(robot.relay, drive.ranges)
    network, trials = networks(robot.DRIVES[drive.name], extra_variance), []
    for done, seed in enumerate(seeds):
        trials.append(stages("relays and filters", partial(one_trial, drive, network, seed), done, len(seeds)))
    learned = stages("learning the constants without the truth", lambda: learn(drive))
    designed = stages("designed relays", lambda: designs(drive, [t.scores["relay_aware"] for t in trials], seeds))
    spread = {
        field.name: {name: [getattr(t.scores[name], field.name) for t in trials] for name in NAMES}
        for field in fields(Score)
    }
    first = {q: {name: values[0] for name, values in by_name.items()} for q, by_name in spread.items()}
    return Outcome(
        drive.name.capitalize(), len(drive.time), first, {"seed": list(seeds), **spread}, learned, designed, drive,
        trials[0], extra_variance,
    )  # fmt: skip


def relay(channel: hg.random_affine.AbstractRandomAffine, signals: np.ndarray, seed: int) -> np.ndarray:
    """Send recorded signals (rows, inputs) through the channel, drawn anew for each row; NaN stays NaN."""
    missing = np.isnan(signals)
    send, rows = _Send(channel, np.asarray(seed)), np.arange(len(signals))
    return np.where(missing, np.nan, hg.simulation.over_runs(send, rows, np.where(missing, 0.0, signals)))


class _Send(Module):
    """What arrives of a row: the channel is drawn from the seed and the row's number."""

    channel: hg.random_affine.AbstractRandomAffine
    seed: np.ndarray

    def __call__(self, row: jax.Array, signal: jax.Array) -> jax.Array:
        return apply(self.channel.sample(jax.random.fold_in(jax.random.key(self.seed), row)), signal)


def average_noise(path: hg.random_affine.AbstractRandomAffine, signals: np.ndarray) -> float:
    """Variance of z - E[z | y] on one path, averaged over the recorded signals: a constant in place of fading."""
    y = signals[~np.isnan(signals)]
    moments = np.array([[np.mean(y**2), np.mean(y)], [np.mean(y), 1.0]])
    with jax.enable_x64(True):
        return float(hg.random_affine.second_order(path).spread(jnp.asarray(moments), jnp.array([True]))[0, 0])


def networks(drive: robot.Drive, extra_variance: float) -> hg.Network:
    """The example's node with one more competitor, and a node that receives the ranges without any relay."""
    network, count = robot.network_of(drive), len(drive.beacons)
    plant, node = network.plant, network.nodes["robot"]
    assert isinstance(node, hg.Node)
    extra = hg.cubature_filter(plant, node.sensor, hg.hop(1.0, extra_variance, dimension=count))
    direct = hg.cubature_filter(plant, node.sensor, hg.perfect(count))
    relayed = hg.Node(node.sensor, robot.channel, node.filters | {"extra_noise": extra})
    return hg.Network(
        plant, {"robot": relayed, "direct": hg.Node(node.sensor, hg.perfect(count), {"perfect_channel": direct})}
    )


def estimated(
    recording: PlazaRecording, network: hg.Network, received: dict[str, np.ndarray]
) -> dict[str, hg.model.Estimate]:
    """What every filter of a network makes of the drive, by the filter's name."""
    record = hg.run(network, received, recording.odometry, recording.time)
    if failures := record.failures():
        raise fail("demonstration", "sound estimates", "; ".join(failures))
    return {name: estimate for filters in record.estimates.values() for name, estimate in filters.items()}


def one_trial(recording: PlazaRecording, network: hg.Network, seed: int) -> Trial:
    """Draw the relay, run every filter, and score it."""
    received = relay(robot.channel, recording.ranges, seed)
    by_name = estimated(recording, network, {"robot": received, "direct": recording.ranges})
    estimates = {name: by_name[name] for name in NAMES}
    return Trial(received, estimates, {name: score(e, recording.truth) for name, e in estimates.items()})


def channel_less(reference: np.ndarray, power: float) -> hg.random_affine.AbstractRandomAffine:
    """The relay of each beacon, whose sensor sends so many times its power less its own reference."""
    hops = hg.amplify_and_forward(
        [hg.hop(robot.gain, robot.HOP_VARIANCE, power), hg.hop(robot.gain, robot.HOP_VARIANCE)]
    )
    return hg.parallel([hg.model.centred(hops, r) for r in reference])


def designs(recording: PlazaRecording, scores: list[Score], seeds: range) -> dict[str, Design]:
    """The relays as they are, with the scores of the filter that knows them, and the same relays, sending less.

    The ranges at the known start are taken off before sending and added back after. Both the power and the gain's noise
    see E (y - r)^2: near the start it is small, and on this drive a quarter throughout.
    """
    drive = robot.DRIVES[recording.name]
    # r: the ranges at the known start; what is sent is y - r.
    reference = robot.RANGE_SCALE * np.linalg.norm(drive.start[:2] - drive.beacons, axis=1)
    plant, sensor = robot.model(drive, robot.Constants(drive.gyro_rate))
    channels = {name: channel_less(reference, power) for name, power in DESIGNS.items()}
    nodes = {
        name: hg.Node(sensor, channel, {name: hg.cubature_filter(plant, sensor, channel)})
        for name, channel in channels.items()
    }
    network = hg.Network(plant, nodes)
    # The same draws of the relay for all designs.
    scored: dict[str, list[Score]] = {name: [] for name in DESIGNS}
    for seed in seeds:
        received = {name: relay(channel, recording.ranges, seed) for name, channel in channels.items()}
        for name, estimate in estimated(recording, network, received).items():
            scored[name].append(score(estimate, recording.truth))
    # Powers E (y - r)^2 of what is sent.
    plain = _design(recording.ranges, np.zeros(len(reference)), 1.0, scores)
    less = {name: _design(recording.ranges, reference, power, scored[name]) for name, power in DESIGNS.items()}
    return {"as_it_is": plain, **less}


def _design(ranges: np.ndarray, reference: np.ndarray, power: float, scores: list[Score]) -> Design:
    """Powers over the ranges that arrived, and mean scores."""
    sent = power * float(np.nanmean((ranges - reference) ** 2))
    relayed = float(robot.gain.moment(2)) * sent + robot.HOP_VARIANCE
    rmse, claimed = (float(np.mean([getattr(s, q) for s in scores])) for q in ("position_rmse_m", "claimed_rmse_m"))
    return Design(rmse, claimed, sent + relayed, sent, relayed, scores)


def data(outcome: Outcome, folder: Path) -> None:
    """Write what arrived with the odometry, and all estimates of the first seed."""
    trial, drive = outcome.shown, outcome.drive
    columns = {"time": drive.time, **dict(zip(robot.network.inputs, drive.odometry.T, strict=True))}
    columns |= dict(zip(robot.network.nodes["robot"].outputs, trial.received.T, strict=True))
    hg.files.write_table(columns, folder / "measurements.csv")
    record = hg.Record(drive.time, robot.network.states, None, {}, {"robot": trial.estimates})
    hg.files.write_estimates(record, folder / "estimates.parquet")
