"""`reproduce`: thresholds, bounds and simulated filters as summary, figures and report."""

from functools import partial
from pathlib import Path

import numpy as np

from heliograph.numerics.check import check_count
from heliograph.report.results import Json, Results, write_results
from heliograph_studies.intermittent_observations.compute import RUNS, Link, Reproduction, compute
from heliograph_studies.intermittent_observations.statements import statements

STAGES = 3


def reproduce(out: Path, runs: int | None = None, seed: int = 0) -> None:
    """Reproduce the classic examples and write summary, figures and report to `out`/intermittent-observations.

    `runs` Monte Carlo runs (4,000 unless given) of each filter that is told of its losses. The record is `curves.npz`,
    the bounds over arrival and recovery.

    Raises:
        ValueError: fewer than 100 runs, a folder that cannot be written or that holds something else.
        ModuleNotFoundError: an extra of `report` is not installed.
    """
    count = check_count("runs", RUNS if runs is None else runs, 100)
    write_results(Path(out) / "intermittent-observations", STAGES, partial(compute, count, seed), results)


def results(found: Reproduction) -> Results:
    """Everything that the folder holds."""
    from heliograph_studies.intermittent_observations.page import drawings, page

    return Results(drawings(found), partial(page, found), summary(found), partial(write_record, found))


def summary(result: Reproduction) -> dict[str, Json]:
    """The numbers by test; matrices by their trace, gains as K of xhat+ = A xhat + K (z - C xhat)."""
    critical = result.critical
    return {
        "papers": "Kalman filtering with intermittent observations (Sinopoli et al., 2004) and its successors",
        "seed": result.seed,
        "runs": result.runs,
        "tests": {
            "T1": {
                "threshold": critical["scalar"].upper,
                "necessary": critical["scalar"].lower,
                **_link(result.scalar),
                "constant_gain_threshold": result.constant.upper,
            },
            "T2": {
                "threshold": critical["coupled"].upper,
                "necessary": critical["coupled"].lower,
                **_link(result.coupled),
            },
            "T3": {
                "threshold": critical["one_unstable"].upper,
                "necessary": critical["one_unstable"].lower,
                **_link(result.one_unstable),
            },
            "T4": {"threshold": list(result.components)},
            "T5": {
                "threshold": max(result.recovery.values()),
                "by_fail": {f"{fail:g}": value for fail, value in result.recovery.items()},
            },
            "T6": {
                name: [_link(each)[name] for each in result.bursts]
                for name in ("fail", "recover", "mean_error", "simulated", "simulated_se", "bound", "lower", "radius")
            },
        },
        "claims": [each.entry() for each in statements(result)],
    }


def _link(link: Link) -> dict[str, Json]:
    heard = next(gain for arrived, gain in link.judged.gains.items() if all(arrived))
    exact = not np.isnan(link.mean_error)
    return {
        "fail": link.fail,
        "recover": link.recover,
        "bound": link.bound,
        "lower": link.lower,
        "radius": link.judged.radius,
        "gain": heard[:, 0].tolist() if len(heard) > 1 else float(heard[0, 0]),
        "mean_error": link.mean_error if exact else link.simulated.mean,
        "mean_error_is": "quadrature" if exact else "simulated",
        "simulated": link.simulated.mean,
        "simulated_se": link.simulated.error,
    }


def write_record(result: Reproduction, folder: Path) -> None:
    """The curves."""
    independent = {
        f"{name}.{field}": values
        for name, curves in result.curves.items()
        for field, values in curves._asdict().items()
    }
    bursts = {
        f"fail_{fail:g}.{field}": values
        for fail, curves in result.burst_curves.items()
        for field, values in zip(("recover", "upper", "mean"), curves, strict=True)
    }
    np.savez(folder / "curves.npz", allow_pickle=False, **independent, **bursts)
