"""The example as a folder of results."""

from dataclasses import asdict
from functools import partial
from pathlib import Path

from heliograph.numerics.check import check_seed
from heliograph.report.results import Json, Results, report_results
from heliograph_studies.demo.recording import find_recording
from heliograph_studies.late_data.compute import STAGES, Outcome, Through, compute


def example(out: Path, seed: int = 0, trace: Path | None = None) -> None:
    """Send a moving point and the demonstration's mower through a network, and write what came to `out`/late-data.

    The network is that of a log (`trace`), or else one with the statistics of a recorded one.

    Raises:
        ValueError: a folder that cannot be written or holds something else, a log without packets.
        ModuleNotFoundError: an extra of `recordings`, `report` is not installed.
    """
    find_recording()  # a missing extra is told before the work starts
    work = partial(compute, check_seed("seed", seed), None if trace is None else Path(trace))
    report_results(Path(out) / "late-data", STAGES, work, results)


def results(outcome: Outcome) -> Results:
    """Everything that the folder holds."""
    from heliograph_studies.late_data.page import late_data_figures, late_data_page

    return Results(late_data_figures(outcome), partial(late_data_page, outcome), summary(outcome))


def summary(outcome: Outcome) -> dict[str, Json]:
    """The network's statistics, errors and verdicts of the point at the top, and those of the mower under `plaza`."""
    network: dict[str, Json] = asdict(outcome.network)
    name: dict[str, Json] = {"file": outcome.trace, "synthetic": outcome.trace is None, "odd_rows": outcome.odd}
    plaza: dict[str, Json] = {**numbers(outcome.mower), "lost_ranges": outcome.unheard}
    return {"trace": {**network, **name}, **numbers(outcome.point), "plaza": plaza}


def numbers(found: Through) -> dict[str, Json]:
    """Errors and consistency by method, and how many events got which verdict."""
    rmse: dict[str, Json] = {name: score.rmse for name, score in found.scores.items()}
    nees: dict[str, Json] = {name: score.nees for name, score in found.scores.items()}
    return {"rmse": rmse, "nees": nees, "counts": dict(found.counts)}
