"""The mower of the demonstration as a network to serve, and its drive as messages that come late or not at all."""

import json
from dataclasses import dataclass

import numpy as np

import heliograph as hg
from heliograph.live.event import Event
from heliograph_studies.demo.recording import PlazaRecording, read_recording
from heliograph_studies.late_data import plaza
from heliograph_studies.late_data.packets import synthetic_packets
from heliograph_studies.late_data.replay import arrival_of

PLANT = "mower"
SERVED = f"{__name__}:network"
RADIO = 3600.0  # seconds of a radio network's traffic, whose packets' fates the ranges have


@dataclass(frozen=True)
class Drive:
    """Messages in the order of their arrival, one line of JSON each; `unheard` ranges were lost on the way."""

    recording: PlazaRecording
    lines: list[bytes]
    unreceived: int


def network() -> hg.Network:
    """The robot's own filter; `heliograph serve heliograph_studies.live.mower:network` keeps it running."""
    return plaza.network()


def read_drive(seed: int) -> Drive:
    """The recorded odometry at once, and each range with the delay or the loss of a packet of a radio network."""
    recording = read_recording()
    received, unreceived = plaza.ranges(recording, synthetic_packets(RADIO, seed))
    coming = sorted([*plaza.odometry(recording), *received], key=arrival_of)  # stable: else as they were received
    return Drive(recording, [line(event) for event in coming], unreceived)


def line(event: Event, plant: str = PLANT) -> bytes:
    """An event as a message."""
    values = [None if np.isnan(value) else float(value) for value in np.atleast_1d(np.asarray(event.values))]
    results = {"plant": plant, "node": event.node, "sequence": event.sequence, "time": event.time, "values": values}
    return json.dumps(results | {"arrival": arrival_of(event)}).encode()
