"""`reproduce`: the paper's example and the strong scenario as summary, record, figures and report."""

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

import heliograph as hg
from heliograph.numerics.check import check_count, check_seed
from heliograph.report.results import Json, Results, write_results
from heliograph_studies.cubature_fusion.compute import RUNS, STAGES, Outcome, Reproduction, reproduction
from heliograph_studies.cubature_fusion.setting import NODES, STATES
from heliograph_studies.cubature_fusion.statements import statements
from heliograph_studies.statement import Statement

if TYPE_CHECKING:
    import xarray


def reproduce(out: Path, runs: int | None = None, seed: int = 0) -> None:
    """Reproduce the paper's example and write summary, record, figures and report to `out`/cubature-fusion.

    `runs` Monte Carlo runs (5,000 unless given) of every filter in both scenarios, on the same data.

    Raises:
        ValueError: fewer than 10 runs, a folder that cannot be written or that holds something else.
        ModuleNotFoundError: an extra of `report`, `sweep` is not installed.
    """
    seed = check_seed("seed", seed)
    count = check_count("runs", RUNS if runs is None else runs, 10)  # with fewer a standard error means nothing
    work = partial(reproduction, count, seed)
    write_results(Path(out) / "cubature-fusion", STAGES, work, results, ("xarray", "h5netcdf"))


def results(found: Reproduction) -> Results:
    """Everything that the folder holds."""
    from heliograph_studies.cubature_fusion.page import page
    from heliograph_studies.cubature_fusion.pictures import drawings

    judged = statements(found)
    return Results(
        drawings(found),
        partial(page, found, judged),
        summary(found, judged),
        lambda folder: write_record(found, folder / "record.nc"),
    )


def summary(result: Reproduction, judged: list[Statement]) -> dict[str, Json]:
    """All numbers: by scenario and filter, of the nodes together, and the statements."""
    return {
        "paper": "Cubature Kalman fusion filtering under amplify-and-forward relays with randomly varying channel "
        "parameters",
        "seed": result.seed,
        "runs": result.runs,
        "rmse_is": "root of the mean over runs, nodes and steps 1..T of the squared error summed over the state",
        "scenarios": {o.setting.name: scenario(o) for o in result.outcomes},
        "strong_first_steps": {"runs": result.early.runs, "steps": result.early.steps, **scenario(result.early)},
        "claims": [each.entry() for each in judged],
    }


def scenario(o: Outcome) -> dict[str, Json]:
    """Numbers of every filter, and of every fused estimate."""
    return {
        "filters": {name: numbers(o, name) for name in o.statistics[NODES[0]]},
        "fused": {name: numbers(o, name) for name in o.statistics["fused"]},
    }


def numbers(o: Outcome, name: str) -> dict[str, Json]:
    """RMSE, claimed trace, and where the claim is exceeded most, steps counted from 1."""
    pooled = o.pooled(name)
    rmse, error = pooled.rmse()
    worst = pooled.worst_direction()
    node = "fused" if name in o.statistics["fused"] else NODES[worst.step // o.steps]
    return {
        "rmse": rmse,
        "rmse_se": error,
        "mean_trace": pooled.mean_trace(),
        "worst_direction": {
            "ratio": worst.ratio,
            "standard_error": worst.standard_error,
            "z": worst.z,
            "step": worst.step % o.steps + 1,
            "node": node,
        },
    }


def write_record(result: Reproduction, path: Path) -> None:
    """RMSE, claimed trace and ratio of both scenarios over time as NetCDF; NaN after a scenario's last step."""
    import xarray

    length = max(o.steps for o in result.outcomes)
    parts = [_scenario_record(o, length) for o in result.outcomes]
    about = {"seed": result.seed, "runs": result.runs, "largest_ratio": "searched at each step, so biased upwards"}
    joined = xarray.concat(parts, "scenario")
    joined = joined.assign_coords(scenario=[o.setting.name for o in result.outcomes])
    joined.assign_attrs(about).to_netcdf(path, engine="h5netcdf")


def _scenario_record(o: Outcome, length: int) -> "xarray.Dataset":
    import xarray

    local = {name: [o.statistics[node][name] for node in NODES] for name in o.statistics[NODES[0]]}
    fused = {name: [item] for name, item in o.statistics["fused"].items()}
    data = {}
    for prefix, items, axes in (("", local, ("filter", "node")), ("fused_", fused, ("fused",))):
        for name, values in _over_time([s for group in items.values() for s in group]).items():
            shaped = values.reshape(len(items), *([len(NODES)] if not prefix else []), *values.shape[1:])
            data[prefix + name] = ((*axes, "time", *(("state",) if values.ndim == 3 else ())), shaped)
    coordinates = {"filter": list(local), "node": list(NODES), "fused": list(fused), "state": list(STATES),
                   "time": o.shown.time.astype(int)}  # fmt: skip
    return xarray.Dataset(data, coordinates).reindex(time=np.arange(1, length + 1))


def _over_time(statistics: list[hg.simulation.ErrorStatistics]) -> dict[str, np.ndarray]:
    """Quantities by name, (item, time) or (item, time, state)."""
    actual = np.array([s.actual() for s in statistics])
    claimed = np.array([s.claimed() for s in statistics])
    factor = np.linalg.inv(np.linalg.cholesky(claimed))
    return {
        "rmse": np.sqrt(np.trace(actual, axis1=-2, axis2=-1)),
        "claimed_trace": np.trace(claimed, axis1=-2, axis2=-1),
        "largest_ratio": np.linalg.eigvalsh(factor @ actual @ np.swapaxes(factor, -1, -2))[..., -1],
        "mean_squared_error": np.diagonal(actual, axis1=-2, axis2=-1),
        "claimed_variance": np.diagonal(claimed, axis1=-2, axis2=-1),
    }
