"""`reproduce`: the paper's example and the strong scenario as summary, record, figures and report."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import rich.console
import rich.progress

import heliograph as hg
from heliograph.files.output_folder import check_replaceable, whole_folder
from heliograph.numerics.check import check_count
from heliograph.papers.claim import Claim
from heliograph.papers.cubature_fusion.claims import claims
from heliograph.papers.cubature_fusion.compute import RUNS, Outcome, Reproduction, Tell, reproduction
from heliograph.papers.cubature_fusion.setting import NODES, STATES

SUMMARY = "summary.json"  # also tells an earlier reproduction from other folders
FOLDER = "cubature-fusion"
FEWEST = 10  # runs: with fewer a standard error means nothing


def reproduce(out: Path, runs: int | None = None, seed: int = 0) -> None:
    """Reproduce the paper's example and write summary, record, figures and report to `out`/cubature-fusion.

    `runs` Monte Carlo runs (5,000 unless given) of every filter in both scenarios, on the same data. The folder appears
    whole or not at all, in place of an earlier reproduction's.

    Raises:
        ValueError: fewer than 10 runs, a folder that cannot be written or that holds something else.
        ModuleNotFoundError: an extra of `report`, `sweep` is not installed.
    """
    import h5netcdf  # noqa: F401  a missing extra is told before the work starts
    import jinja2  # noqa: F401
    import matplotlib  # noqa: F401
    import xarray  # noqa: F401

    count = check_count("runs", RUNS if runs is None else runs, FEWEST)
    target = Path(out) / FOLDER
    check_replaceable(target, SUMMARY)
    with progress() as tell, whole_folder(target) as folder:
        result = reproduction(count, seed, tell)
        tell("judging and drawing", 0, 1)
        write(result, folder)


def write(result: Reproduction, folder: Path) -> None:
    """Write everything into an empty folder."""
    from heliograph.papers.cubature_fusion.page import page
    from heliograph.papers.cubature_fusion.pictures import drawings
    from heliograph.report.figures import png, svg

    judged, vectors = claims(result), {}
    for name, figure in drawings(result).items():
        (folder / f"{name}.png").write_bytes(png(figure))
        vectors[name] = svg(figure)
    (folder / "report.html").write_text(page(result, judged, vectors).html(), encoding="utf-8")
    write_record(result, folder / "record.nc")
    (folder / SUMMARY).write_text(json.dumps(summary(result, judged), indent=2) + "\n", encoding="utf-8")


def summary(result: Reproduction, judged: list[Claim]) -> dict[str, Any]:
    """All numbers: by scenario and filter, of the nodes together, and the claims."""
    return {
        "paper": "Cubature Kalman fusion filtering under amplify-and-forward relays with randomly varying channel "
        "parameters",
        "seed": result.seed,
        "runs": result.runs,
        "rmse_is": "root of the mean over runs, nodes and steps 1..T of the squared error summed over the state",
        "scenarios": {o.setting.name: scenario(o) for o in result.outcomes},
        "strong_first_steps": {"runs": result.early.runs, "steps": result.early.steps, **scenario(result.early)},
        "claims": [claim._asdict() for claim in judged],
    }


def scenario(o: Outcome) -> dict[str, Any]:
    """Numbers of every filter, and of every fused estimate."""
    return {
        "filters": {name: numbers(o, name) for name in o.statistics[NODES[0]]},
        "fused": {name: numbers(o, name) for name in o.statistics["fused"]},
    }


def numbers(o: Outcome, name: str) -> dict[str, Any]:
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


def _scenario_record(o: Outcome, length: int) -> Any:
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


def _over_time(statistics: list[hg.ErrorStatistics]) -> dict[str, np.ndarray]:
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


@contextmanager
def progress() -> Iterator[Tell]:
    """A progress bar on stderr: what is run, and how many of its runs are done; compiling shows as none done."""
    columns = (
        rich.progress.TextColumn("{task.description}"),
        rich.progress.BarColumn(),
        rich.progress.MofNCompleteColumn(),
        rich.progress.TimeElapsedColumn(),
    )
    console = rich.console.Console(stderr=True)
    with rich.progress.Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as shown:
        task = shown.add_task("starting", total=1)

        def tell(what: str, done: int, total: int) -> None:
            shown.update(task, description=what, completed=done, total=total)

        yield tell
