"""Run the example: `python -m heliograph.examples.motor_drive --out out`."""

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from heliograph.examples.motor_drive.compute import (
    CASES,
    DEAD_TIME,
    QUANTITIES,
    SEEDS,
    TRUSTS,
    UNITS,
    Outcome,
    Score,
    compute,
)
from heliograph.examples.motor_drive.drive import simulator
from heliograph.files.output_folder import check_replaceable, whole_folder
from heliograph.report.progress import progress

SUMMARY = "summary.json"  # also tells earlier results from other folders


def run_motor_drive(out: Path, seeds: int = SEEDS) -> Path:
    """Compute, draw, and write figures, report and summary to `out`/motor-drive.

    The folder appears whole or not at all.

    Raises:
        ValueError: fewer than 2 seeds, a folder that cannot be written, or one that holds something else.
        ModuleNotFoundError: the extra `motor` or `report` is not installed.
    """
    from heliograph.examples.motor_drive.page import motor_figures, motor_page
    from heliograph.report.figures import png, svg

    simulator()  # a missing extra is told before the work starts
    target = Path(out) / "motor-drive"
    check_replaceable(target, SUMMARY)
    with progress(len(TRUSTS) * len(CASES) + 1) as advance, whole_folder(target) as folder:
        outcome = compute(seeds, advance)
        advance("drawing")
        drawings = {}
        for name, figure in motor_figures(outcome).items():
            drawings[name] = svg(figure)
            (folder / f"{name}.png").write_bytes(png(figure))
            (folder / f"{name}.svg").write_bytes(drawings[name])
        (folder / "report.html").write_text(motor_page(outcome, drawings).html(), encoding="utf-8")
        (folder / SUMMARY).write_text(json.dumps(summary(outcome), indent=2) + "\n", encoding="utf-8")
    return target


def summary(outcome: Outcome) -> dict[str, Any]:
    """Every score by trust, case and filter, with the rated values in SI units and what each case is."""
    scores = {
        trust: {case: {name: numbers(s) for name, s in filters.items()} for case, filters in by_case.items()}
        for trust, by_case in outcome.scores.items()
    }
    head = {"seeds": outcome.seeds, "steps": len(outcome.drive.time), "dead_time": DEAD_TIME, "rated": UNITS}
    return {**head, "cases": CASES, "failures": outcome.failures, "scores": scores}


def numbers(score: Score) -> dict[str, Any]:
    """A score without what runs over time."""
    ratios = {quantity: score.ratio(quantity) for quantity in QUANTITIES}
    parts = {"rmse": score.rmse, "claimed": score.claimed, "ratio": ratios, "common": score.common}
    return {**parts, "nees_per_dimension": dict(zip(("mean", "low", "high"), score.nees, strict=True))}


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser("python -m heliograph.examples.motor_drive", description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="folder that gets the folder motor-drive")
    parser.add_argument("--seeds", type=int, default=SEEDS, help=f"seeds of sensors and relays (default {SEEDS})")
    arguments = parser.parse_args()
    try:
        print(f"Report: {run_motor_drive(arguments.out, arguments.seeds) / 'report.html'}")
    except (ValueError, ModuleNotFoundError) as error:
        sys.exit(str(error))


if __name__ == "__main__":
    main()
