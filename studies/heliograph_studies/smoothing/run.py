"""The example as a folder of results."""

from functools import partial
from pathlib import Path

import numpy as np

from heliograph.numerics.check import check_seed
from heliograph.report.results import Json, Results, report_results
from heliograph_studies.smoothing.compute import LAG_STEP, SHOWN, STAGES, Outcome, compute


def example(out: Path, seed: int = 0) -> None:
    """Compute every case and write figures, report and summary to `out`/smoothing.

    Raises:
        ValueError: a folder that cannot be written, or one that holds something else.
        ModuleNotFoundError: the extra `report` is not installed.
    """
    report_results(Path(out) / "smoothing", STAGES, partial(compute, check_seed("seed", seed)), results)


def results(outcome: Outcome) -> Results:
    """Everything that the folder holds."""
    from heliograph_studies.smoothing.page import smoothing_figures, smoothing_page

    figures = smoothing_figures(outcome)
    return Results(figures, partial(smoothing_page, outcome), summary(outcome))


def summary(outcome: Outcome) -> dict[str, Json]:
    """Deviations of the place, mean traces, ratios of variances by lag, the relays' traces, and what was measured."""
    place = {name: places(part) for name, part in lagged(outcome).items()}
    point: dict[str, Json] = {}
    for name, covariance in {"filter": outcome.filtered, "smoother": outcome.smoothed}.items():
        trace = float(np.trace(covariance, axis1=1, axis2=2).mean())
        point[name] = {str(k): float(np.sqrt(places(covariance)[k - 1])) for k in SHOWN} | {"mean_trace": trace}
    filtered = places(outcome.filtered)[LAG_STEP - 1]
    point["lag"] = {name: float(variance[LAG_STEP - 1] / filtered) for name, variance in place.items()}
    relays: dict[str, Json] = {str(lag): dict(traces) for lag, traces in outcome.relays.items()}
    swings: dict[str, Json] = {
        name: {**found, "warned": outcome.warned[name]} for name, found in outcome.pendulum.items()
    }
    checked: dict[str, Json] = {name: dict(found) for name, found in outcome.measured.items()}
    return {
        "constant_velocity": point,
        "successive_relays": {"lag": relays},
        "measured": checked,
        "pendulum": swings,
    }


def lagged(outcome: Outcome) -> dict[str, np.ndarray]:
    """Covariances by the lag's name."""
    return {str(lag): covariance for lag, covariance in outcome.lagged.items()}


def places(covariance: np.ndarray) -> np.ndarray:
    """P_xx + P_yy over time."""
    return np.asarray(covariance[:, 0, 0] + covariance[:, 2, 2])
