"""`reproduce`: Section IV's circuit as summary, record, figures and report."""

from functools import partial
from pathlib import Path

import numpy as np

import heliograph as hg
from heliograph.files.recording import write_estimates
from heliograph.numerics.check import check_count, check_seed
from heliograph.report.results import Json, Results, write_results
from heliograph_studies.successive_relays.compute import FILTERS, RUNS, Reproduction, compute
from heliograph_studies.successive_relays.statements import statements, tuned_mean_ratio

STAGES = 4
NAMES = {"relay_1": "relay_1", "relay_2": "relay_2", "receiver": "remote"}
STEADY = ("paper", "joint", "lmmse", "lmmse_tuned", "no_relay")


def reproduce(out: Path, runs: int | None = None, seed: int = 0) -> None:
    """Reproduce the paper's example and write summary, record, figures and report to `out`/successive-relays.

    `runs` Monte Carlo runs (20,000 unless given). The record is `record.csv`, the run of Figs 2 to 4, with each
    filter's claimed covariance, and `gains.npz`, the design.

    Raises:
        ValueError: fewer than 100 runs (standard errors come from batches of runs), a folder that cannot be written
            or that holds something else.
        ModuleNotFoundError: an extra of `report` is not installed.
    """
    seed = check_seed("seed", seed)
    count = check_count("runs", RUNS if runs is None else runs, 100)
    write_results(Path(out) / "successive-relays", STAGES, partial(compute, count, seed), results)


def results(found: Reproduction) -> Results:
    """Everything that the folder holds."""
    from heliograph_studies.successive_relays.page import drawings, page

    return Results(drawings(found), partial(page, found), summary(found), partial(write_record, found))


def summary(result: Reproduction) -> dict[str, Json]:
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
        "claims": [each.entry() for each in statements(result)],
    }


def write_record(result: Reproduction, folder: Path) -> None:
    """The run that is shown, and the gains of the paper's and of the tuned designs."""
    run = result.run
    assert run.truth is not None
    estimates = {
        NAMES[node]: {
            name: hg.model.Estimate(np.asarray(e.mean)[0], np.asarray(e.covariance)[0], e.claim)
            for name, e in filters.items()
        }
        for node, filters in run.estimates.items()
    }
    measurements = {NAMES[node]: values[0] for node, values in run.measurements.items()}
    write_estimates(hg.Record(run.time, run.states, run.truth[0], measurements, estimates), folder / "record.csv")
    designs = {"paper": result.paper, "tuned": result.tuned, "tuned_at_paper_power": result.bounded}
    gains = {f"{design}.{NAMES[f]}": d.gains[f] for design, d in designs.items() for f in FILTERS}
    np.savez(folder / "gains.npz", allow_pickle=False, **gains)
