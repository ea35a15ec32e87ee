"""What the example computes: both plants through the network, by every method."""

import warnings
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from heliograph.live.timeline import Timeline
from heliograph.numerics.check import fail
from heliograph_studies import NO_FILE, File, Inline, Stages, Unlisted, check_fields
from heliograph_studies.demo.recording import PlazaRecording, read_recording
from heliograph_studies.late_data import moving, plaza
from heliograph_studies.late_data.packets import Packets, Statistics, read_trace, statistics, synthetic_packets
from heliograph_studies.late_data.replay import METHODS, Estimated, every_method, squared_errors


@dataclass(frozen=True)
class Setting:
    """The network is that of a log at path `trace`, or one with the statistics of a recorded one over `network_s`.

    runs: paths of the moving point, each over `duration` seconds.
    """

    runs: int = 10
    duration: float = 900.0
    network_s: float = 3600.0
    trace: File = NO_FILE
    seed: int = 0

    def __post_init__(self) -> None:
        check_fields(self, runs=1)
        for name in ("duration", "network_s"):
            if not 1.0 <= getattr(self, name) < float("inf"):
                raise fail(name, "seconds, one or more", getattr(self, name))
        object.__setattr__(self, "trace", File(self.trace))  # of a path in any form


FEWEST = 2  # packets in the stretch that is used
Errors = dict[str, tuple[np.ndarray, np.ndarray]]  # by method: squared, and in units of the claim


@dataclass(frozen=True)
class Through:
    """One plant through the network: errors by method, verdicts of the rewound one, and what is shown of one run.

    rmse: root of the mean squared position error; nees: the mean of e' P^-1 e / 2, honestly 1.
    """

    rmse: dict[str, float]
    nees: dict[str, float]
    counts: dict[str, int]
    time: Unlisted[np.ndarray]
    shown: Unlisted[dict[str, Estimated]]
    truth: Unlisted[np.ndarray]


@dataclass(frozen=True)
class Mower:
    """The recorded drive through the network, and how many of its ranges were lost."""

    through: Inline[Through]
    lost_ranges: int


@dataclass(frozen=True)
class Trace:
    """The network. `odd_rows`: rows of the log that are no packets; `file`: its name, None of a synthetic one."""

    network: Inline[Statistics]
    file: str | None
    synthetic: bool
    odd_rows: int


@dataclass(frozen=True)
class Outcome:
    """The network, and the moving point and the mower through it."""

    trace: Trace
    point: Inline[Through]
    plaza: Mower


def compute(setting: Setting, stages: Stages) -> Outcome:
    """Read the network or make one, and send both plants through it."""
    packets, odd = stages("reading packets", partial(packets_of, setting))
    name = Path(setting.trace).name if setting.trace else None
    point = through_moving(packets, setting, stages)
    mower = stages("the mower's ranges", lambda: through_plaza(read_recording(), packets))
    return Outcome(Trace(statistics(packets), name, name is None, odd), point, mower)


def packets_of(setting: Setting) -> tuple[Packets, int]:
    """Packets of the network, and how many rows of its log are none."""
    return read_trace(setting.trace) if setting.trace else (synthetic_packets(setting.network_s, setting.seed), 0)


def through_moving(packets: Packets, setting: Setting, stages: Stages) -> Through:
    """The point, along paths of several seeds; the last is shown."""
    used = moving.packets_of(packets, setting.duration)
    if len(used) < FEWEST:
        expected = f"packets sent from {moving.BEGIN:g} to {moving.BEGIN + setting.duration:g} s after the first"
        raise fail("trace", expected, f"{len(used)} of {len(packets)} over {float(np.ptp(packets.sent)):.0f} s")
    _shared = Timeline(moving.network, 0.0)  # while it lives, the others have its compiled programs
    runs, paths = setting.runs, []
    for run in range(runs):
        work = partial(one_path, used, setting.duration, setting.seed * runs + run)
        paths.append(stages("a moving point", work, done=run, total=runs))
    errors, *shown = zip(*paths, strict=True)
    return through(errors, *(part[-1] for part in shown))


def one_path(
    packets: Packets, duration: float, seed: int
) -> tuple[Errors, dict[str, int], np.ndarray, dict[str, Estimated], np.ndarray]:
    """Errors along a path by method, verdicts, moments, estimates at them, and the truth."""
    moments = moving.moments(duration)
    events, times, path = moving.world(packets, duration, seed)
    shown, counts = every_method(moving.network, events, [], moments)
    errors = {name: squared_errors(e, path[np.searchsorted(times, e.time)]) for name, e in shown.items()}
    return errors, counts, moments, shown, path[np.searchsorted(times, moments)]


def through(
    runs: Sequence[Errors],
    counts: dict[str, int],
    time: np.ndarray,
    shown: dict[str, Estimated],
    truth: np.ndarray,
) -> Through:
    """Means over all moments of several runs."""
    squared, nees = (
        {name: np.concatenate([errors[name][i] for errors in runs]).mean() for name in shown} for i in range(2)
    )
    rmse = {name: float(np.sqrt(mean)) for name, mean in squared.items()}
    return Through(rmse, {name: float(mean) for name, mean in nees.items()}, counts, time, shown, truth)


def through_plaza(recording: PlazaRecording, packets: Packets, methods: Collection[str] = METHODS) -> Mower:
    """The mower."""
    events, lost = plaza.ranges(recording, packets)
    clock = recording.time - recording.start
    moments = np.unique(clock)
    with warnings.catch_warnings():  # the drift over an interval is that over its parts but for the heading's share
        warnings.simplefilter("ignore", UserWarning)
        _shared = Timeline(plaza.network(), 0.0)  # while one of a network lives, others have its compiled programs
        shown, counts = every_method(plaza.network(), events, plaza.odometry(recording), moments, methods)
    errors = {name: squared_errors(estimated, recording.place(estimated.time)) for name, estimated in shown.items()}
    return Mower(through([errors], counts, moments, shown, recording.place(moments)), lost)
