"""The example as a folder of results."""

from functools import partial
from pathlib import Path

from heliograph.report.results import Json, Results, report_results
from heliograph_studies.links_with_memory.compute import RUNS, STAGES, STEPS, Outcome, Score, compute


def example(out: Path, seed: int = 0) -> None:
    """Run every filter on both examples and write figures, report and summary to `out`/links-with-memory.

    Raises:
        ValueError: a folder that cannot be written, or one that holds something else.
        ModuleNotFoundError: the extra `report` is not installed.
    """
    report_results(Path(out) / "links-with-memory", STAGES, partial(compute, seed), results)


def results(outcome: Outcome) -> Results:
    """Everything that the folder holds."""
    from heliograph_studies.links_with_memory.page import memory_figures, memory_page

    return Results(memory_figures(outcome), partial(memory_page, outcome), summary(outcome))


def summary(outcome: Outcome) -> dict[str, Json]:
    """Every number: by example and filter, in one shadow, by correlation, and what was found in data."""
    found = outcome.memory
    return {
        "runs": RUNS,
        "steps": {name: {"horizon": horizon, "from": begin} for name, (horizon, begin) in STEPS.items()},
        "e1": {name: numbers(score) for name, score in outcome.e1.items()},
        "e2": {name: numbers(score) for name, score in outcome.e2.items()},
        "told": {name: numbers(score) for name, score in outcome.told.items()},
        "one_shadow": outcome.shadow,
        "curve": {"lambda": outcome.lags.tolist(), "ratio": outcome.ratios.tolist()},
        "memory_test": {
            "correlation": found.correlation[:3].tolist(),
            "standard_error": found.standard_error[:3].tolist(),
            "p_value": found.p_value,
            "predictable": found.predictable,
        },
    }


def numbers(score: Score) -> dict[str, Json]:
    """A score without what runs over time."""
    parts: dict[str, Json] = {"claim": score.claim, "claimed": score.claimed, "true": score.true}
    parts["true_se"] = score.true_se
    return parts if score.exact is None else {**parts, "true_before_data": score.exact}
