"""The example as a folder of results."""

from functools import partial
from pathlib import Path

from heliograph.report.results import Json, Results, report_results
from heliograph_studies.delays.compute import RUNS, STAGES, Outcome, Score, compute, trap
from heliograph_studies.delays.setting import CLOCK_STEPS, STEPS


def example(out: Path, seed: int = 0) -> None:
    """Run every filter behind late links and wrong clocks and write figures, report and summary to `out`/delays.

    Raises:
        ValueError: a folder that cannot be written, or one that holds something else.
        ModuleNotFoundError: the extra `report` is not installed.
    """
    report_results(Path(out) / "delays", STAGES, partial(compute, seed), results)


def results(outcome: Outcome) -> Results:
    """Everything that the folder holds."""
    from heliograph_studies.delays.page import delay_figures, delay_page

    return Results(delay_figures(outcome), partial(delay_page, outcome), summary(outcome))


def summary(outcome: Outcome) -> dict[str, Json]:
    """Every number: of late links over the second half of the steps, of clocks at the last step."""
    return {
        "runs": RUNS,
        "steps": {"delays": STEPS, "clocks": CLOCK_STEPS},
        "delays": {name: variances(score) for name, score in outcome.delays.items()},
        "past_states_claim": trap(),
        "clocks": {
            kind: {name: {part: deviations(s) for part, s in own.items()} for name, own in found.items()}
            for kind, found in outcome.clocks.items()
        },
    }


def variances(score: Score) -> dict[str, Json]:
    """Claim and error of the position."""
    found: dict[str, Json] = {
        "claim": score.claim,
        "claimed": score.mean(score.claimed),
        "true": score.mean(score.true),
        "true_se": score.true_se,
        "claimed_over_time": score.claimed.tolist(),
        "true_over_time": score.true.tolist(),
    }
    if score.before is None:
        return found
    return {**found, "true_before_data": score.mean(score.before), "true_before_data_over_time": score.before.tolist()}


def deviations(score: Score) -> dict[str, Json]:
    """Root mean square error and claimed deviation at the last step."""
    return {"true": score.mean(score.true) ** 0.5, "claimed": score.mean(score.claimed) ** 0.5}
