"""The example as a folder of results."""

from dataclasses import asdict
from functools import partial
from pathlib import Path

from heliograph.numerics.check import check_seed
from heliograph.report.results import Json, Results, report_results
from heliograph_studies.range_bearing.compute import FADING_RUNS, RUNS, STAGES, Outcome, compute


def example(out: Path, seed: int = 0) -> None:
    """Compute every case and write figures, report and summary to `out`/range-bearing.

    Raises:
        ValueError: a folder that cannot be written, or one that holds something else.
        ModuleNotFoundError: the extra `report` is not installed.
    """
    report_results(Path(out) / "range-bearing", STAGES, partial(compute, check_seed("seed", seed)), results)


def results(outcome: Outcome) -> Results:
    """Everything that the folder holds."""
    from heliograph_studies.range_bearing.page import range_bearing_figures, range_bearing_page

    figures = range_bearing_figures(outcome)
    return Results(figures, partial(range_bearing_page, outcome), summary(outcome))


def summary(outcome: Outcome) -> dict[str, Json]:
    """Scores by case and filter, and tails by filter."""
    cases: dict[str, Json] = {
        case: {name: asdict(one) for name, one in found.items()} for case, found in outcome.scores.items()
    }
    fading: dict[str, Json] = {
        name: {
            **asdict(one.score),
            "closest_pass": one.closest.tolist(),
            "rmse_by_closest_pass": one.rmse.tolist(),
            "worst_hundredth": one.worst,
            "broken": one.broken,
            "broken_at_closest_pass": one.at_closest,
        }
        for name, one in outcome.tails.items()
    }
    return {"runs": RUNS, "fading_runs": FADING_RUNS, **cases, "fading": fading}
