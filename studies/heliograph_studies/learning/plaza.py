"""What learning gives on a recorded drive, Plaza2: direct ranges, and relayed ones for several seeds of the relay."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from heliograph.report.results import Json
from heliograph_studies.demo import robot
from heliograph_studies.demo.compute import networks, one_trial, relay
from heliograph_studies.demo.learned import direct, fitted, judged, learn, learned_summary, parameters, relayed
from heliograph_studies.demo.recording import PlazaRecording, read_recording
from heliograph_studies.learning.parts import stored

if TYPE_CHECKING:
    from heliograph.report.page import Section

SEEDS = 5
PIECES = SEEDS + 1
Numbers = dict[str, Json]


def plaza(parts: Path, advance: Callable[[str], None]) -> Numbers:
    """Errors of the filters with learned and with calibrated constants; pieces that `parts` holds are read from there.

    rmse and nees: learned from the whole drive, without the truth, and judged on it; calibrated: with the constants
    that were measured with the truth. second_half: learned from the first half, judged on the second.
    """
    parts.mkdir(parents=True, exist_ok=True)
    recording = read_recording()
    advance("learning from direct ranges")
    local = stored(parts / "plaza.direct.json", partial(of_direct, recording))
    items = []
    for seed in range(SEEDS):
        advance(f"learning from relay {seed}")
        items.append(stored(parts / f"plaza.relayed.{seed}.json", partial(of_relayed, recording, seed)))
    return {"direct": local, "relayed": {name: [item[name] for item in items] for name in items[0]}}


def of_direct(recording: PlazaRecording) -> Numbers:
    """Of the ranges as they were recorded."""
    drive = robot.DRIVES[recording.name]
    whole = fitted(partial(direct, drive), recording, recording.ranges, len(recording.time))
    after = judged(whole.network, recording, recording.ranges)
    before = one_trial(recording, networks(drive, 1.0), 0).scores["perfect_channel"]
    return {
        **learned_summary(learn(recording)),
        "rmse": after.position_rmse_m,
        "calibrated": before.position_rmse_m,
        "nees": after.nees_per_dimension,
        "parameters": parameters(whole),
        "log_likelihood": whole.best.total,
    }


def of_relayed(recording: PlazaRecording, seed: int) -> Numbers:
    """Of the ranges behind the relay drawn with one seed."""
    drive, received = robot.DRIVES[recording.name], relay(robot.channel, recording.ranges, seed)
    outcome = fitted(partial(relayed, drive), recording, received, len(received))
    after = judged(outcome.network, recording, received)
    before = one_trial(recording, networks(drive, 1.0), seed).scores["relay_aware"]
    return {
        "seed": seed,
        "rmse": after.position_rmse_m,
        "calibrated": before.position_rmse_m,
        "nees": after.nees_per_dimension,
        "parameters": parameters(outcome),
    }


def plaza_section(result: Numbers) -> "Section":
    """The numbers as a part of the page."""
    from heliograph.report.page import Section, Table

    local, behind = result["direct"], result["relayed"]
    assert isinstance(local, dict) and isinstance(behind, dict)
    rows = [
        ["direct, whole drive", f"{local['rmse']:.3f}", f"{local['calibrated']:.3f}"],
        ["direct, second half (learned from the first)", f"{local['second_half']:.3f}",
         f"{local['second_half_calibrated']:.3f}"],
        *([f"relayed, seed {seed}", f"{after:.2f}", f"{before:.2f}"]
          for seed, after, before in zip(behind["seed"], behind["rmse"], behind["calibrated"], strict=True)),
        ["relayed, mean", f"{np.mean(behind['rmse']):.2f}", f"{np.mean(behind['calibrated']):.2f}"],
    ]  # fmt: skip
    caption = (
        "Position error (RMS, m) of the demonstration's robot: with constants learned from the ranges alone, and with "
        "those that were calibrated by the true path. Behind the relay the gain's variance is learned as well."
    )
    return Section("On a recorded drive", [Table(["ranges", "learned", "calibrated"], rows, caption)])
