"""What the example computes: the drive left alone and killed, compared; and how fast messages are used."""

import asyncio
import json
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from heliograph.serving.fleet import Fleet, Options
from heliograph.serving.lanes import Lanes
from heliograph.serving.plant import Link
from heliograph.serving.storage.identity import identity
from heliograph.serving.storage.plant_codec import plant_from
from heliograph.serving.storage.store import Store
from heliograph_studies.live.killed import ALONE, KILLED, WINDOW, killed, left_alone
from heliograph_studies.live.mower import PLANT, network, read_drive
from heliograph_studies.live.server import Server
from heliograph_studies.live.speed import in_memory, many_plants, through

KILLS = 3
MESSAGES = 20_000  # for the speed
STAGES = KILLS + 4


@dataclass(frozen=True)
class Outcome:
    """What was found. `used`: messages that were, by node, of the service left alone and of the one killed."""

    messages: int
    unreceived: int
    kills: int
    again: int
    alone: list[bytes]
    killed: list[bytes]
    used: dict[str, tuple[int, int]]
    late: int
    time: np.ndarray
    mean: np.ndarray
    truth: np.ndarray
    beacons: np.ndarray
    speed: dict[str, float]
    pictures: dict[str, bytes]

    @property
    def identical(self) -> bool:
        """Whether both told the same bytes, and as many of them."""
        return bool(self.alone) and self.alone == self.killed

    @property
    def lost(self) -> int:
        """Messages that were used when nothing happened, and not when it was killed."""
        return sum(max(0, alone - killed) for alone, killed in self.used.values())

    @property
    def counted_twice(self) -> int:
        """Messages that were used more often than when nothing happened."""
        return sum(max(0, killed - alone) for alone, killed in self.used.values())

    @property
    def rmse(self) -> float:
        """Of the position, of the final estimates, in metres."""
        return float(np.sqrt(np.mean(np.sum((self.mean[:, :2] - self.truth) ** 2, axis=1))))


def compute(seed: int, advance: Callable[[str], None] = lambda what: None) -> Outcome:
    """Run everything, in a folder that goes with it."""
    drive = read_drive(seed)
    with TemporaryDirectory() as name:
        folder = Path(name)
        advance("left alone")
        alone = left_alone(folder, drive.lines)
        server = Server(folder)
        server.start()
        try:
            record = asyncio.run(killed(folder, server, drive.lines, len(alone), KILLS, seed, advance))
            advance("how fast")
            lanes, options = _lanes(), Options(WINDOW)
            lines = many_plants(drive.lines, MESSAGES)
            in_memory(lanes, options, lines[:2000])  # compiles
            speed = {"jsonlines": in_memory(lanes, options, lines)}
            for kind in ("mqtt", "nats"):
                speed[kind] = asyncio.run(through(kind, folder, server, lanes, options, lines))
        finally:
            server.kill()
        item, two = (_links(lanes, options, folder / name) for name in (ALONE, KILLED))
    outputs = [json.loads(line) for line in record.finals]
    time = np.array([item["time"] for item in outputs])
    mean = np.array([item["estimates"]["robot"]["filter"]["mean"] for item in outputs])
    used = {node: (link.used, two[node].used) for node, link in item.items()}
    late = sum(link.late for link in item.values())
    return Outcome(len(drive.lines), drive.unreceived, record.kills, record.again, alone, record.finals, used, late,
                   time, mean, drive.truth(time), drive.recording.beacons, speed, record.pictures)  # fmt: skip


def _lanes() -> Lanes:
    with warnings.catch_warnings():  # the drift over an interval is that over its parts but for the heading's share
        warnings.simplefilter("ignore", UserWarning)
        return Lanes(network())


def _links(lanes: Lanes, options: Options, place: Path) -> dict[str, Link]:
    """What the store says that came from each node."""
    fleet = Fleet(lanes, options)
    store = Store(str(place), identity(fleet))
    plant = plant_from(PLANT, store.load([PLANT])[PLANT].body, fleet)
    store.close()
    return plant.links
