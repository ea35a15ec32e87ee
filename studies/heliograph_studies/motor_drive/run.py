"""The example as a folder of results."""

from functools import partial
from pathlib import Path

from heliograph.numerics.check import check_seed
from heliograph.report.results import Json, Results, report_results
from heliograph_studies.motor_drive.compute import (
    CASES,
    DEAD_TIME,
    QUANTITIES,
    SEEDS,
    STAGES,
    UNITS,
    Outcome,
    Score,
    compute,
)


def example(out: Path, seed: int = 0) -> None:
    """Run every case and write figures, report and summary to `out`/motor-drive; `seed` is the first of 20.

    Raises:
        ValueError: a folder that cannot be written, or one that holds something else.
        ModuleNotFoundError: the extra `motor` or `report` is not installed.
    """
    check_seed(f"last of {SEEDS} seeds", check_seed("seed", seed) + SEEDS - 1)
    report_results(Path(out) / "motor-drive", STAGES, partial(compute, SEEDS, seed), results, ("gym_electric_motor",))


def results(outcome: Outcome) -> Results:
    """Everything that the folder holds."""
    from heliograph_studies.motor_drive.page import motor_figures, motor_page

    return Results(motor_figures(outcome), partial(motor_page, outcome), summary(outcome))


def summary(outcome: Outcome) -> dict[str, Json]:
    """Every score by trust, case and filter, with the rated values in SI units and what each case is."""
    scores = {
        trust: {case: {name: numbers(s) for name, s in filters.items()} for case, filters in by_case.items()}
        for trust, by_case in outcome.scores.items()
    }
    head: dict[str, Json] = {
        "seeds": outcome.seeds,
        "steps": len(outcome.drive.time),
        "dead_time": DEAD_TIME,
        "rated": UNITS,
    }
    return {**head, "cases": CASES, "failures": outcome.failures, "scores": scores}


def numbers(score: Score) -> dict[str, Json]:
    """A score without what runs over time."""
    ratios = {quantity: score.ratio(quantity) for quantity in QUANTITIES}
    parts = {"rmse": score.rmse, "claimed": score.claimed, "ratio": ratios, "common": score.common}
    return {**parts, "nees_per_dimension": dict(zip(("mean", "low", "high"), score.nees, strict=True))}
