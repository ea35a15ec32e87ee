"""What the example computes: the drive left alone and killed, compared; and how fast messages are used."""

import asyncio
import json
import warnings
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from matplotlib.figure import Figure

from heliograph.live import LinkCounts
from heliograph.live.fleet import Fleet
from heliograph.live.fleet_options import Options
from heliograph.live.network_step_program import NetworkProgram
from heliograph.live.stored.plant_codec import unpack_plant
from heliograph.report.figures import BLUE, GREEN, VERMILION
from heliograph.serving.storage.store import Store
from heliograph.serving.storage.store_protocol import identity
from heliograph_studies import Stages, Unlisted
from heliograph_studies.curves import Curve, paths
from heliograph_studies.live import Setting
from heliograph_studies.live.killed import ALONE, KILLED, WINDOW, Killed, killed, left_alone
from heliograph_studies.live.mower import PLANT, Drive, network, read_drive
from heliograph_studies.live.server import Server, find_server
from heliograph_studies.live.speed import in_memory, many_plants, through

Links = dict[str, LinkCounts]  # by node, what the store says that came from it


@dataclass(frozen=True)
class Outcome:
    """Numbers of messages, whether killing changed anything, and how fast messages are used.

    lost: messages that were used when nothing happened and not when it was killed; counted_twice: the other way round.
    pictures: the page as a browser drew it, by name.
    """

    messages: int
    ranges_lost_on_the_way: int
    too_late: int
    kills: int
    final_estimates: int
    final_estimates_identical: bool
    published_again: int
    lost: int
    counted_twice: int
    steps_per_second: dict[str, int]
    position_rmse_m: float
    screenshots: list[str]
    mean: Unlisted[np.ndarray]
    truth: Unlisted[np.ndarray]
    beacons: Unlisted[np.ndarray]
    pictures: Unlisted[dict[str, bytes]]


def compute(setting: Setting, stages: Stages) -> Outcome:
    """Run everything, each stage in a folder that goes with it."""
    find_server()  # what is missing is reported before the work starts
    drive = read_drive(setting.seed)
    alone, links = stages("left alone", lambda: of_alone(drive))
    restarted, after = stages("killed and started again", lambda: of_killed(drive, len(alone), setting, stages))
    speed = stages("how fast", lambda: of_speed(drive, setting))
    outputs = [json.loads(line) for line in restarted.finals]
    mean = np.array([output["estimates"]["robot"]["filter"]["mean"] for output in outputs])
    truth = drive.recording.place(np.array([output["time"] for output in outputs]))
    lost, twice = differences(links, after)
    return Outcome(
        messages=len(drive.lines),
        ranges_lost_on_the_way=drive.unreceived,
        too_late=sum(link.late for link in links.values()),
        kills=restarted.kills,
        final_estimates=len(restarted.finals),
        final_estimates_identical=bool(alone) and alone == restarted.finals,
        published_again=restarted.again,
        lost=lost,
        counted_twice=twice,
        steps_per_second=speed,
        position_rmse_m=float(np.sqrt(np.mean(np.sum((mean[:, :2] - truth) ** 2, axis=1)))),
        screenshots=sorted(restarted.pictures),
        mean=mean,
        truth=truth,
        beacons=drive.recording.beacons,
        pictures=restarted.pictures,
    )


def of_alone(drive: Drive) -> tuple[list[bytes], Links]:
    """Final estimates of a service that nothing happens to, and what it used."""
    with TemporaryDirectory() as name:
        return left_alone(Path(name), drive.lines), links_of(Path(name) / ALONE)


def of_killed(drive: Drive, count: int, setting: Setting, stages: Stages) -> tuple[Killed, Links]:
    """What a service tells that is killed, and what it used."""
    with TemporaryDirectory() as name, Server(Path(name)) as server:
        work = killed(Path(name), server, drive.lines, count, setting.kills, setting.seed, stages.progress)
        return asyncio.run(work), links_of(Path(name) / KILLED)


def of_speed(drive: Drive, setting: Setting) -> dict[str, int]:
    """Steps a second, by where the messages come from."""
    program, options, lines = _lanes(), Options(WINDOW), many_plants(drive.lines, setting.messages)
    in_memory(program, options, lines[:2000])  # compiles
    speed = {"jsonlines": in_memory(program, options, lines)}
    with TemporaryDirectory() as name, Server(Path(name)) as server:
        for kind in ("mqtt", "nats"):
            speed[kind] = asyncio.run(through(kind, Path(name), server, program, options, lines))
    return {name: round(value) for name, value in speed.items()}


@cache
def _lanes() -> NetworkProgram:
    with warnings.catch_warnings():  # the drift over an interval is that over its parts but for the heading's share
        warnings.simplefilter("ignore", UserWarning)
        return NetworkProgram(network())


def links_of(place: Path) -> Links:
    """What the store says that came from each node."""
    fleet = Fleet(_lanes(), Options(WINDOW))
    store = Store(str(place), identity(fleet))
    plant = unpack_plant(PLANT, store.load([PLANT])[PLANT].body, fleet)
    store.close()
    return plant.links


def differences(alone: Links, killed: Links) -> tuple[int, int]:
    """Messages that were used by a service left alone and not by the one killed, and those used more often."""
    pairs = [(link.used, killed[node].used) for node, link in alone.items()]
    return sum(max(0, a - b) for a, b in pairs), sum(max(0, b - a) for a, b in pairs)


def figures(outcome: Outcome) -> dict[str, Figure]:
    """The path of the final estimates, on its map."""
    path = Curve(f"final estimates: {outcome.position_rmse_m:.2f} m off", BLUE, outcome.mean[:, :2])
    return {"map": paths(outcome.truth, [path], outcome.beacons)}


def words(outcome: Outcome) -> dict[str, object]:
    """Colours, and how long late messages are waited for."""
    return {"blue": BLUE, "green": GREEN, "vermilion": VERMILION, "window": WINDOW}


def data(outcome: Outcome, folder: Path) -> None:
    """Write the pictures of the page."""
    for name, picture in outcome.pictures.items():
        (folder / f"{name}.png").write_bytes(picture)
