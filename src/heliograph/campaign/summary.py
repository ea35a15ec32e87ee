"""Results of a campaign: the labelled store, and a table of RMSE and NEES by setting, node and filter."""

import csv
import math
from dataclasses import astuple, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, get_type_hints

import numpy as np
import zarr

from heliograph.campaign.definition import Campaign
from heliograph.campaign.zarr_store import CLAIM, STORE, find_done_chunks, read_labels
from heliograph.disk.atomic_files import name_path_in_errors, replace
from heliograph.disk.quoted_text import quote_for_cell, unquote_cell
from heliograph.numerics.check import fail, file_path

if TYPE_CHECKING:
    import xarray

SUMMARY = "summary.csv"


def open_results(out: str | Path) -> "xarray.Dataset":
    """Open the results of a campaign as an xarray.Dataset, read when used.

    error and variance (setting, run, time, node, filter, state), nees_per_dimension (setting, run, time, node, filter),
    claim (setting, node, filter); with keep = "trajectories" also truth (setting, run, time, state) and measurement
    (setting, run, time, node, received). The parameters of the settings are coordinates along `setting`. NaN where a
    node lacks a filter, and where chunks are missing.

    Args:
        out: the results folder.

    Raises:
        ValueError: a folder without results.
        ModuleNotFoundError: the extra `sweep` is not installed.
    """
    import xarray

    path = file_path("results folder", out) / STORE
    if not path.is_dir():
        raise fail(f"results folder {out}", f"a folder with {STORE}", "none")
    results: xarray.Dataset = xarray.open_zarr(path)
    return results.assign_coords({name: values.compute() for name, values in results.coords.items()})


@dataclass(frozen=True)
class Score:
    """Scores of one filter of one node in one setting, over the finite runs; NaN where there are none.

    `rmse` is the root of the mean over runs and steps of the squared error summed over the state; `nees_per_dimension`
    is 1 if the claim is exact. Standard errors are from the scatter between runs.
    """

    setting: int
    node: str
    filter: str
    claim: str
    rmse: float
    rmse_error: float
    nees_per_dimension: float
    nees_error: float
    runs: int
    finite_runs: int


def read_summary(path: str | Path) -> list[Score]:
    """Read the scores of a campaign from its summary.csv: one score for each setting, node and filter.

    Args:
        path: the file summary.csv in the folder of the results.

    Returns:
        Scores in the order of the rows, with the columns of the file as attributes.

    Raises:
        ValueError: there is no such file, or columns are missing.
    """
    path, kinds = file_path("summary", path), get_type_hints(Score)
    if not path.is_file():
        raise fail(f"summary {path}", "a file", "none of that name")
    with path.open(newline="", encoding="utf-8") as file:
        table = csv.DictReader(file)
        missing = [name for name in kinds if name not in (table.fieldnames or ())]
        if missing:
            raise fail(f"summary {path}", f"columns {', '.join(kinds)}", f"none {', '.join(missing)}")
        rows = [{name: unquote_cell(cell) for name, cell in row.items()} for row in table]
    return [Score(**{name: kind(row[name]) for name, kind in kinds.items()}) for row in rows]


def compute_scores(store: Path, campaign: Campaign) -> list[Score]:
    """Return the scores of every filter by setting and node; the store is read chunk by chunk."""
    group, labels = zarr.open_group(store, mode="r"), read_labels(store)
    claims = np.asarray(group[CLAIM])  # (setting, node, filter), "" where the node has no such filter
    done = find_done_chunks(store, campaign)
    scores = []
    for setting in range(len(campaign.settings)):
        # Squared error and NEES of each run, averages over time (run, node, filter), of the chunks that are done.
        by_chunk = [
            _average_over_time(group, setting, slice(chunk.start, chunk.stop), claims[setting])
            for chunk in campaign.chunks(setting)
            if (setting, chunk.number) in done
        ]
        without_runs = np.empty((2, 0, len(labels.nodes), len(labels.filters)))
        squared, nees = np.concatenate(by_chunk, axis=1) if by_chunk else without_runs
        # A score for each filter that the node has.
        for i, node in enumerate(labels.nodes):
            for j, name in enumerate(labels.filters):
                if claim := str(claims[setting, i, j]):
                    scores.append(_make_score(setting, node, name, claim, squared[:, i, j], nees[:, i, j]))
    return scores


def _average_over_time(group: zarr.Group, setting: int, runs: slice, claims: np.ndarray) -> np.ndarray:
    """Return two means over time, (2, run, node, filter): of squared errors summed over states, and of NEES per state.

    The error is NaN if a filter claims a variance that is not finite in this run.
    """
    names = ("error", "variance", "nees_per_dimension")
    error, variance, nees = (_read_runs(group, name, setting, runs) for name in names)
    squared = np.sum(error**2, axis=-1).mean(axis=1)
    has_variance = np.isfinite(variance).all(axis=(1, -1))
    squared[~has_variance & (claims != "none")] = np.nan
    return np.stack([squared, nees.mean(axis=1)])


def _read_runs(group: zarr.Group, name: str, setting: int, runs: slice) -> np.ndarray:
    """Return the values of some runs of a setting, (run, time, ...), of the variable `name` of the store."""
    array = group[name]
    assert isinstance(array, zarr.Array)
    return np.asarray(array[setting, runs])


def _make_score(setting: int, node: str, name: str, claim: str, squared: np.ndarray, nees: np.ndarray) -> Score:
    """Return RMSE and NEES of a filter, with their standard errors, over the runs whose error is finite.

    Args:
        setting: number of the setting.
        node: name of the node.
        name: name of the filter.
        claim: what the filter says that its covariance is.
        squared: squared error of each run, mean over time (run,); NaN where it does not count.
        nees: NEES per dimension of each run, mean over time (run,).
    """
    finite = np.isfinite(squared)
    mse, mse_error = _compute_mean_and_error(squared[finite])
    mean_nees, nees_error = _compute_mean_and_error(nees[finite])
    rmse = float(np.sqrt(mse))
    return Score(
        setting=setting,
        node=node,
        filter=name,
        claim=claim,
        rmse=rmse,
        rmse_error=mse_error / (2 * rmse) if rmse else 0.0,  # of a root, to first order
        nees_per_dimension=mean_nees,
        nees_error=nees_error,
        runs=len(squared),
        finite_runs=int(finite.sum()),
    )


def _compute_mean_and_error(values: np.ndarray) -> tuple[float, float]:
    """Return the mean of n independent values and its standard error, their deviation over the root of n.

    Both are NaN without values; of one value the error is.
    """
    count = len(values)
    if count == 0:
        return np.nan, np.nan
    error = float(values.std(ddof=1) / np.sqrt(count)) if count > 1 else np.nan
    return float(values.mean()), error


def make_score_headers(campaign: Campaign) -> list[str]:
    """Return the headers of the table of scores."""
    return [*campaign.parameters, "node", "filter", "claim", "RMSE", "±", "NEES / dim", "±", "finite runs"]


def make_score_cells(campaign: Campaign, score: Score) -> list[str]:
    """Return the cells of a score in the table of scores, in the order of `make_score_headers`."""
    setting = campaign.settings[score.setting]
    return [
        *(str(setting.get(name, "")) for name in campaign.parameters),
        score.node,
        score.filter,
        score.claim,
        _format_number(score.rmse, 4),
        _format_number(score.rmse_error, 1),
        _format_number(score.nees_per_dimension, 3),
        _format_number(score.nees_error, 1),
        f"{score.finite_runs}/{campaign.runs}",
    ]


def _format_number(value: float, digits: int) -> str:
    """Return a number to so many digits; a dash for NaN."""
    return "–" if math.isnan(value) else f"{value:.{digits}g}"


def write_summary(store: Path, campaign: Campaign, path: Path) -> None:
    """Write the scores with the parameters of their settings as CSV."""
    partial = path.with_name(f".{path.name}.partial")
    with name_path_in_errors(path), partial.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["setting", *campaign.parameters, *(field.name for field in fields(Score)[1:])])
        for score in compute_scores(store, campaign):
            setting = campaign.settings[score.setting]
            values = [setting.get(name, "") for name in campaign.parameters]
            writer.writerow(map(_format_cell, [score.setting, *values, *astuple(score)[1:]]))
    replace(partial, path)


def _format_cell(value: object) -> object:
    """Return numbers as they are, all else as a text that no spreadsheet takes for a formula."""
    return value if isinstance(value, int | float) else quote_for_cell(str(value))
