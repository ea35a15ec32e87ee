"""The same relays, told less: the ranges at the known start are taken off before sending and added back after.

Both the power and the gain's noise see E (y - r)^2: near the start it is small, and on this drive a quarter throughout.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from heliograph.filters.gaussian.gaussian import cubature_filter
from heliograph.model.centred import centred
from heliograph.model.channel import amplify_and_forward, hop, parallel
from heliograph.numerics.check import fail
from heliograph.random_affine.base import AbstractRandomAffine
from heliograph.simulation.network import Network
from heliograph.simulation.node import Node
from heliograph.simulation.recorded import run
from heliograph_studies.demo import robot
from heliograph_studies.demo.compute import relay
from heliograph_studies.demo.recording import PlazaRecording
from heliograph_studies.demo.scores import Score, score

DESIGNS = {"centred": 1.0, "centred_thousandth": 1e-3}  # by what the sensor's power is multiplied


class Design(NamedTuple):
    """Mean square in m^2 of what a beacon's sensor and its relay send a row, and the scores of each seed."""

    sensor: float
    relay: float
    scores: list[Score]

    @property
    def power(self) -> float:
        """Both together."""
        return self.sensor + self.relay

    @property
    def rmse(self) -> float:
        """Mean over the seeds."""
        return float(np.mean([s.position_rmse_m for s in self.scores]))

    @property
    def claimed(self) -> float:
        """Mean over the seeds."""
        return float(np.mean([s.claimed_rmse_m for s in self.scores]))


def at_start(drive: robot.Drive) -> np.ndarray:
    """The ranges that filter and sender expect at the known start, (4,) m."""
    result: np.ndarray = robot.RANGE_SCALE * np.linalg.norm(drive.start[:2] - drive.beacons, axis=1)
    return result


def channel_less(reference: np.ndarray, power: float) -> AbstractRandomAffine:
    """The relay of each beacon, whose sensor sends so many times its power less its own reference."""
    hops = amplify_and_forward([hop(robot.gain, robot.HOP_VARIANCE, power), hop(robot.gain, robot.HOP_VARIANCE)])
    return parallel([centred(hops, r) for r in reference])


def powers(ranges: np.ndarray, reference: np.ndarray, power: float) -> tuple[float, float]:
    """Mean square of what sensor and relay send, over the ranges that were heard."""
    sent = power * float(np.nanmean((ranges - reference) ** 2))
    return sent, float(robot.gain.moment(2)) * sent + robot.HOP_VARIANCE


def as_it_is(recording: PlazaRecording, scores: list[Score]) -> Design:
    """The demonstration's own relay, with the scores of the filter that knows it."""
    return Design(*powers(recording.ranges, np.zeros(recording.ranges.shape[1]), 1.0), scores)


def twins(
    recording: PlazaRecording, seeds: range, advance: Callable[[str], None] = lambda what: None
) -> dict[str, Design]:
    """Each of DESIGNS, with a cubature filter that knows its relays."""
    drive = robot.DRIVES[recording.name]
    (plant, sensor), reference = robot.model(drive, robot.Constants(drive.gyro_rate)), at_start(drive)
    channels = {name: channel_less(reference, power) for name, power in DESIGNS.items()}
    filters = {name: {name: cubature_filter(plant, sensor, channel)} for name, channel in channels.items()}
    network = Network(plant, {name: Node(sensor, channels[name], filters[name]) for name in DESIGNS})
    results: dict[str, list[Score]] = {name: [] for name in DESIGNS}
    for seed in seeds:
        advance(f"designed relays, seed {seed}")
        received = {name: relay(channel, recording.ranges, seed) for name, channel in channels.items()}
        record = run(network, received, recording.odometry, recording.time)
        if failures := record.failures():
            raise fail("designed relays", "sound estimates", "; ".join(failures))
        for name in DESIGNS:
            results[name].append(score(record.estimates[name][name], recording.truth))
    return {name: Design(*powers(recording.ranges, reference, power), results[name]) for name, power in DESIGNS.items()}
