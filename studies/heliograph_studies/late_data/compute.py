"""What the example computes: both plants through the network, by every method."""

import warnings
from collections.abc import Callable, Collection
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from heliograph.live.timeline import Timeline
from heliograph.numerics.check import fail
from heliograph_studies.demo.recording import PlazaRecording, read_recording
from heliograph_studies.late_data import moving, plaza
from heliograph_studies.late_data.packets import Packets, Statistics, statistics
from heliograph_studies.late_data.replay import METHODS, Heard, Score, every_method, score, squared_errors
from heliograph_studies.late_data.synthetic import synthetic_packets
from heliograph_studies.late_data.trace import read_trace

RUNS = 10  # paths of the moving point
STAGES = RUNS + 2
SYNTHETIC = 3600.0  # s
FEWEST = 2  # packets in the stretch that is used


@dataclass(frozen=True)
class Through:
    """One plant through the network: scores by method, verdicts of the rewound one, and what is shown of one run."""

    scores: dict[str, Score]
    counts: dict[str, int]
    time: np.ndarray
    shown: dict[str, Heard]
    truth: np.ndarray


@dataclass(frozen=True)
class Outcome:
    """All that was found. `odd`: rows of the trace that are no packets; `trace`: its name, None of a synthetic one."""

    trace: str | None
    odd: int
    network: Statistics
    point: Through
    mower: Through
    unheard: int


def compute(seed: int, trace: Path | None, advance: Callable[[str], None] = lambda what: None) -> Outcome:
    """Read the network or make one, and send both plants through it."""
    advance("reading packets")
    packets, odd = (synthetic_packets(SYNTHETIC, seed), 0) if trace is None else read_trace(trace)
    name = None if trace is None else trace.name
    point = through_moving(packets, seed, advance)
    advance("the mower's ranges")
    mower, unheard = through_plaza(read_recording(), packets)
    return Outcome(name, odd, statistics(packets), point, mower, unheard)


def through_moving(packets: Packets, seed: int, advance: Callable[[str], None], runs: int = RUNS) -> Through:
    """The point, along paths of several seeds."""
    used = moving.packets_of(packets)
    if len(used) < FEWEST:
        wanted = f"packets sent from {moving.BEGIN:g} to {moving.BEGIN + moving.DURATION:g} s after the first"
        raise fail("trace", wanted, f"{len(used)} of {len(packets)} over {float(np.ptp(packets.sent)):.0f} s")
    parts: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {name: [] for name in METHODS}
    _shared = Timeline(moving.network, 0.0)  # while it lives, the others have its compiled programs
    for run in range(runs):
        advance(f"a moving point, path {run + 1} of {runs}")
        events, times, path = moving.world(used, seed * runs + run)
        found, counts = every_method(moving.network, events, [], moving.moments())
        for name, heard in found.items():
            parts[name].append(squared_errors(heard, path[np.searchsorted(times, heard.time)]))
    truth = path[np.searchsorted(times, moving.moments())]
    return Through({name: score(part) for name, part in parts.items()}, counts, moving.moments(), found, truth)


def through_plaza(
    recording: PlazaRecording, packets: Packets, methods: Collection[str] = METHODS
) -> tuple[Through, int]:
    """The mower, and how many of its ranges were lost."""
    events, unheard = plaza.ranges(recording, packets)
    clock = recording.time - recording.start
    moments = np.unique(clock)
    with warnings.catch_warnings():  # the drift over an interval is that over its parts but for the heading's share
        warnings.simplefilter("ignore", UserWarning)
        _shared = Timeline(plaza.network(), 0.0)  # while one of a network lives, others have its compiled programs
        found, counts = every_method(plaza.network(), events, plaza.odometry(recording), moments, methods)
    path = np.concatenate([recording.start_pose[None, :2], recording.truth[:, :2]])
    known = np.concatenate([[0.0], clock])

    def truth(time: np.ndarray) -> np.ndarray:
        return np.column_stack([np.interp(time, known, path[:, i]) for i in range(2)])

    scores = {name: score([squared_errors(heard, truth(heard.time))]) for name, heard in found.items()}
    return Through(scores, counts, moments, found, truth(moments)), unheard
