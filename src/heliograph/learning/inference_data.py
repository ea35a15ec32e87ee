"""A fit as ArviZ reads it: draws of the free numbers by their Laplace approximation, and the likelihood of each row."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np

from heliograph.learning.intervals import Method
from heliograph.learning.likelihood_maximum import Solution
from heliograph.numerics.check import check_count, check_seed, fail
from heliograph.numerics.process.extras import check_installed

if TYPE_CHECKING:  # an extra
    import xarray as xr

BLOCK = 64  # draws whose rows are computed side by side
METHOD: Method = "hessian"  # the curvature of the likelihood alone


def make_inference_data(solution: Solution, draws: int, seed: int) -> Any:
    """Return draws, the log-likelihood of each row at each of them, and their sums, as ArviZ keeps them.

    Raises:
        ValueError: numbers at an end of their domain, or which the data do not identify; fewer than two draws.
        ModuleNotFoundError: without ArviZ (extra "arviz").
    """
    check_count("draws", draws, 2)
    random = np.random.default_rng(check_seed("seed", seed))
    check_installed(["arviz", "xarray"])
    wrong = [row.name for row in solution.rows(METHOD) if row.boundary or not row.identified]
    if wrong:
        raise fail("fit, to_arviz", "numbers inside their domains that the data identify", ", ".join(wrong))
    covariance, _ = solution.covariance(METHOD)
    points = solution.x + random.multivariate_normal(np.zeros(len(solution.x)), covariance, draws, method="cholesky")
    density = np.concatenate([_evaluate_rows(solution, points[k : k + BLOCK]) for k in range(0, draws, BLOCK)])
    groups = {
        "posterior": _make_posterior(solution, points),
        "log_likelihood": _list_arrived_rows(solution, density),
        "sample_stats": _make_sums(density),
    }
    arviz = import_module("arviz")
    if hasattr(arviz, "InferenceData"):
        return arviz.InferenceData(**groups)
    return import_module("xarray").DataTree.from_dict(groups)  # from version 1.0 on


def _evaluate_rows(solution: Solution, points: np.ndarray) -> np.ndarray:
    """Return log p of each row given those before it, (points, rows) over all recordings."""
    density = np.asarray(solution.surface.evaluate_rows(points).density)
    return np.concatenate([density[:, i, :steps] for i, steps in enumerate(solution.surface.data.lengths)], axis=1)


def _make_posterior(solution: Solution, points: np.ndarray) -> "xr.Dataset":
    """Return the free numbers at points of the line, by name."""
    values = np.stack([solution.parameters.entries_at(x) for x in points])
    names = [entry.name for entry in solution.parameters.entries]
    return _make_dataset({name: (("chain", "draw"), values[None, :, i]) for i, name in enumerate(names)})


def _list_arrived_rows(solution: Solution, density: np.ndarray) -> "xr.Dataset":
    """Return the rows in which something arrived, with the recording and the row of each."""
    data = solution.surface.data
    rows = [(i, k) for i, steps in enumerate(data.lengths) for k in range(steps)]
    arrived = np.array([bool(np.isfinite(data.measurements[i, k]).any()) for i, k in rows])
    recording, row = np.array(rows)[arrived].T
    content = {"rows": (("chain", "draw", "arrival"), density[None][:, :, arrived])}
    return _make_dataset(content, {"recording": ("arrival", recording), "row": ("arrival", row)})


def _make_sums(density: np.ndarray) -> "xr.Dataset":
    """Return the log-likelihood of all rows at each draw."""
    return _make_dataset({"lp": (("chain", "draw"), density.sum(axis=1)[None])})


def _make_dataset(content: dict[str, Any], more: dict[str, Any] | None = None) -> "xr.Dataset":
    """Return arrays (chain, draw, ...) as a dataset with these coordinates."""

    import xarray as xr

    draws = next(iter(content.values()))[1].shape[1]
    return xr.Dataset(content, {"chain": [0], "draw": np.arange(draws), **(more or {})})
