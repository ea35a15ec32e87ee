"""`reproduce`: Section 4's example and our scenario as summary, record, figures and report."""

from functools import partial
from pathlib import Path

import numpy as np

from heliograph.numerics.check import check_count, check_seed
from heliograph.report.results import Json, Results, write_results
from heliograph_studies.quadratic_bias.compute import (
    NODE,
    RUNS,
    Outcome,
    Reproduction,
    compute,
    gain_percent,
    settled_mean,
    simulated_mean,
    simulated_over_time,
)
from heliograph_studies.quadratic_bias.statements import statements

STAGES = 5


def reproduce(out: Path, runs: int | None = None, seed: int = 0) -> None:
    """Reproduce the paper's example and write summary, record, figures and report to `out`/quadratic-bias.

    `runs` Monte Carlo runs (20,000 unless given) of every filter, on the same data.

    Raises:
        ValueError: fewer than 100 runs (standard errors come from batches of runs), a folder that cannot be written
            or that holds something else.
        ModuleNotFoundError: an extra of `report`, `sweep` is not installed.
    """
    seed = check_seed("seed", seed)
    count = check_count("runs", RUNS if runs is None else runs, 100)
    work = partial(compute, count, seed)
    write_results(Path(out) / "quadratic-bias", STAGES, work, results, ("xarray", "h5netcdf"))


def results(found: Reproduction) -> Results:
    """Everything that the folder holds."""
    from heliograph_studies.quadratic_bias.page import drawings, page

    return Results(
        drawings(found), partial(page, found), summary(found), lambda folder: write_record(found, folder / "record.nc")
    )


def summary(result: Reproduction) -> dict[str, Json]:
    """All numbers: the example's at the top, our scenario's under `outage`."""
    return {
        "paper": "Quadratic filtering with dynamical bias under amplify-and-forward relays",
        "seed": result.seed,
        "runs": result.example.statistics["linear"].runs,
        "averaged": f"t = {result.example.model.settled + 1} ... {result.example.model.horizon}",
        "gain_percent_is": "100 (1 - ratio of the means of the error variances) against the linear filter",
        **numbers(result.example),
        "outage": numbers(result.outage),
        "claims": [each.entry() for each in statements(result)],
    }


def numbers(outcome: Outcome) -> dict[str, Json]:
    """Designed covariances over t = 0 ... horizon, their means and gains, and what the simulation found."""
    states, designs = outcome.model.states, outcome.designs
    simulated = {}
    for name in outcome.statistics:
        mean, error = simulated_mean(outcome, name)
        difference, own = simulated_mean(outcome, name, "linear")
        simulated[name] = {
            **named(states, mean),
            **named(states, error, "_se"),
            "minus_linear": {**named(states, difference), **named(states, own, "_se")},
        }
    return {
        "covariance": {
            name: named(states, np.diagonal(values, axis1=1, axis2=2).T) for name, values in designs.covariance.items()
        },
        "mean_covariance": {name: named(states, settled_mean(outcome, name)) for name in designs.covariance},
        "gain_percent": {
            name: named(states, gain_percent(outcome, name))
            for name in [*designs.covariance, "mixture"]
            if name != "linear"
        },
        "monte_carlo": simulated,
        "skewness": designs.skewness,
    }


def named(states: tuple[str, ...], values: np.ndarray, suffix: str = "") -> dict[str, Json]:
    """Values by state."""
    return {f"{state}{suffix}": value.tolist() for state, value in zip(states, np.asarray(values), strict=True)}


def write_record(result: Reproduction, path: Path) -> None:
    """Covariances and mean squared errors over time of the example, and its run, as NetCDF."""
    import xarray

    outcome, run = result.example, result.example.run
    covariance, estimates = outcome.designs.covariance, run.estimates[NODE]
    assert run.truth is not None
    data = {
        "covariance": (("design", "time", "state", "state_2"), np.array(list(covariance.values()))),
        "mean_squared_error": (
            ("filter", "step", "state"),
            np.array([simulated_over_time(outcome, name) for name in outcome.statistics]),
        ),
        "truth": (("step", "state"), run.truth),
        "measurement": (("step",), run.measurements[NODE][:, 0]),
        "estimate": (("filter", "step", "state"), np.array([e.mean for e in estimates.values()])),
    }
    coordinates = {
        "design": list(covariance),
        "filter": list(outcome.statistics),
        "state": list(outcome.model.states),
        "time": np.arange(outcome.model.horizon + 1),
        "step": np.arange(1, outcome.model.horizon + 1),
    }
    about = {"seed": result.seed, "runs": outcome.statistics["linear"].runs}
    xarray.Dataset(data, coordinates, about).to_netcdf(path, engine="h5netcdf")
