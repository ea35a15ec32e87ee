"""`reproduce`: Section IV's circuit as summary, record, figures and report."""

import json
from pathlib import Path
from typing import Any

import numpy as np

import heliograph as hg
from heliograph.files.output_folder import check_replaceable, whole_folder
from heliograph.files.recording import write_estimates
from heliograph.numerics.check import check_count
from heliograph.papers.successive_relays.claims import claims, tuned_mean_ratio
from heliograph.papers.successive_relays.compute import FILTERS, RUNS, Reproduction, compute
from heliograph.report.progress import progress

SUMMARY = "summary.json"  # also tells an earlier reproduction from other folders
FOLDER = "successive-relays"
STAGES = 5
NAMES = {"relay_1": "relay_1", "relay_2": "relay_2", "receiver": "remote"}
STEADY = ("paper", "joint", "lmmse", "lmmse_tuned", "no_relay")


def reproduce(out: Path, runs: int | None = None, seed: int = 0) -> None:
    """Reproduce the paper's example and write summary, record, figures and report to `out`/successive-relays.

    `runs` Monte Carlo runs (20,000 unless given). The folder appears whole or not at all, in place of an earlier
    reproduction's. The record is `record.csv`, the run of Figs 2 to 4, with each filter's claimed covariance, and
    `gains.npz`, the design.

    Raises:
        ValueError: fewer than 100 runs (standard errors come from batches of runs), a folder that cannot be written
            or that holds something else.
        ModuleNotFoundError: an extra of `report` is not installed.
    """
    from heliograph.papers.successive_relays.page import drawings, page
    from heliograph.report.figures import png, svg

    count = check_count("runs", RUNS if runs is None else runs, 100)
    target = Path(out) / FOLDER
    check_replaceable(target, SUMMARY)
    with progress(STAGES) as advance, whole_folder(target) as folder:
        result = compute(count, seed, advance)
        advance("drawing and writing")
        figures = {name: (png(figure), svg(figure)) for name, figure in drawings(result).items()}
        for name, (pixels, vectors) in figures.items():
            (folder / f"{name}.png").write_bytes(pixels)
            (folder / f"{name}.svg").write_bytes(vectors)
        html = page(result, {name: vectors for name, (_, vectors) in figures.items()}).html()
        (folder / "report.html").write_text(html, encoding="utf-8")
        write_record(result, folder)
        (folder / SUMMARY).write_text(json.dumps(summary(result), indent=2) + "\n", encoding="utf-8")


def summary(result: Reproduction) -> dict[str, Any]:
    """The numbers by design and filter; traces at k = 0 .. 100."""
    simulated = result.simulated
    return {
        "trace": {NAMES[f]: result.paper.trace(f).tolist() for f in FILTERS},
        "monte_carlo": {
            "remote": simulated.mean["receiver"].tolist(),
            "stderr": simulated.error["receiver"].tolist(),
        },
        "steady": {name: {"even": result.steady[name].even, "odd": result.steady[name].odd} for name in STEADY},
        "tuned_mean_ratio": tuned_mean_ratio(result),
        "claims": [claim._asdict() for claim in claims(result)],
    }


def write_record(result: Reproduction, folder: Path) -> None:
    """The run that is shown, and the gains of the paper's and of the tuned designs."""
    run = result.run
    assert run.truth is not None
    estimates = {
        NAMES[node]: {
            name: hg.Estimate(np.asarray(e.mean)[0], np.asarray(e.covariance)[0], e.claim)
            for name, e in filters.items()
        }
        for node, filters in run.estimates.items()
    }
    measurements = {NAMES[node]: values[0] for node, values in run.measurements.items()}
    write_estimates(hg.Record(run.time, run.states, run.truth[0], measurements, estimates), folder / "record.csv")
    designs = {"paper": result.paper, "tuned": result.tuned, "tuned_at_paper_power": result.bounded}
    gains = {f"{design}.{NAMES[f]}": d.gains[f] for design, d in designs.items() for f in FILTERS}
    np.savez(folder / "gains.npz", allow_pickle=False, **gains)
