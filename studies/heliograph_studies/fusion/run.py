"""The example as a folder of results."""

import math
from functools import partial
from pathlib import Path

from heliograph.numerics.check import check_seed
from heliograph.report.results import Json, Results, report_results
from heliograph_studies.fusion.compute import STAGES, Outcome, compute


def example(out: Path, seed: int = 0) -> None:
    """Compute every case and write figures, report and summary to `out`/fusion.

    Raises:
        ValueError: a folder that cannot be written, or one that holds something else.
        ModuleNotFoundError: the extra `report` is not installed.
    """
    report_results(Path(out) / "fusion", STAGES, partial(compute, check_seed("seed", seed)), results)


def results(outcome: Outcome) -> Results:
    """Everything that the folder holds."""
    from heliograph_studies.fusion.page import fusion_page
    from heliograph_studies.fusion.pictures import fusion_figures

    return Results(fusion_figures(outcome), partial(fusion_page, outcome), summary(outcome))


def summary(outcome: Outcome) -> dict[str, Json]:
    """Traces by case and rule, the tree, the scale, the strong scenario, traffic, and what was measured."""
    cases: dict[str, Json] = {name: dict(numbers) for name, numbers in outcome.cases.items()}
    measured: dict[str, Json] = {rule: dict(numbers) for rule, numbers in outcome.measured.items()}
    traffic: dict[str, Json] = {kind: [dict(point) for point in points] for kind, points in outcome.traffic.items()}
    strong: dict[str, Json] = {**outcome.strong, "claimed": dict(outcome.strong_claimed)}
    return {
        **cases,
        "tree": dict(outcome.tree),
        "scale": {name: None if math.isnan(value) else value for name, value in outcome.scale.items()},
        "measured": measured,
        "strong": strong,
        "traffic": traffic,
    }
