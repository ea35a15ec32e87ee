"""A fit as ArviZ reads it: draws of the free numbers by their Laplace approximation, and the likelihood of each row."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np

from heliograph.learning.estimate_table import Solution
from heliograph.learning.long_run_covariance import Method
from heliograph.numerics.check import check_count, check_seed, fail
from heliograph.numerics.process.optional_packages import check_installed

if TYPE_CHECKING:  # an extra
    import xarray as xr

DRAWS_AT_ONCE = 64  # draws whose rows are computed side by side
METHOD: Method = "hessian"  # the curvature of the likelihood alone


def make_inference_data(solution: Solution, draws: int, seed: int) -> Any:
    """Return draws of the free numbers, and the log-likelihood of each row at each of them, as ArviZ keeps them.

    ArviZ compares and plots Bayesian fits. The draws are normal about the maximum likelihood estimate, with the inverse
    curvature of the log-likelihood there as covariance (the Laplace approximation). They are drawn in unconstrained
    coordinates (such as logarithms of positive numbers).

    Args:
        solution: the fit: its maximum `x` (p,), covariance and likelihood.
        draws: number of draws, 2 at least.
        seed: seed of the draws.

    Returns:
        An `arviz.InferenceData`, or an `xarray.DataTree` from ArviZ 1.0 on, with the groups posterior, log_likelihood
        and sample_stats (the sums lp).

    Raises:
        ValueError: numbers at an end of their domain, or which the data do not identify; fewer than two draws.
        ModuleNotFoundError: without ArviZ (extra "arviz").
    """
    check_count("draws", draws, 2)
    random = np.random.default_rng(check_seed("seed", seed))
    check_installed(["arviz", "xarray"])
    # A number at an end of its domain, or one that the data say nothing of, has no normal law.
    without_normal_law = [row.name for row in solution.rows(METHOD) if row.boundary or not row.identified]
    if without_normal_law:
        expected = "numbers inside their domains that the data identify"
        raise fail("fit, to_arviz", expected, ", ".join(without_normal_law))
    # Draw points (draws, p) by the Laplace approximation, and evaluate l for each row in blocks, to limit the memory.
    covariance, _ = solution.covariance(METHOD)
    points = solution.x + random.multivariate_normal(np.zeros(len(solution.x)), covariance, draws, method="cholesky")
    density = np.concatenate(
        [_evaluate_row_likelihoods(solution, points[k : k + DRAWS_AT_ONCE]) for k in range(0, draws, DRAWS_AT_ONCE)]
    )
    groups = {
        "posterior": _make_posterior(solution, points),
        "log_likelihood": _select_arrived_rows(solution, density),
        "sample_stats": _make_total_likelihood_dataset(density),
    }
    # ArviZ before version 1.0 has a class of its own; later it takes a tree of xarray datasets.
    arviz = import_module("arviz")
    if hasattr(arviz, "InferenceData"):
        return arviz.InferenceData(**groups)
    return import_module("xarray").DataTree.from_dict(groups)  # from version 1.0 on


def _evaluate_row_likelihoods(solution: Solution, points: np.ndarray) -> np.ndarray:
    """Return log p of each row given those before, at unconstrained points, (points, rows of all recordings).

    `evaluate_rows(points).density` is (points, recordings, rows), filled up to the longest recording: `lengths` are the
    true ones.
    """
    density = np.asarray(solution.surface.evaluate_rows(points).density)
    return np.concatenate([density[:, i, :steps] for i, steps in enumerate(solution.surface.data.lengths)], axis=1)


def _make_posterior(solution: Solution, points: np.ndarray) -> "xr.Dataset":
    """Return the free numbers of the table (for instance logarithms of variances) at posterior draws, as a dataset.

    All draws are one chain, axis 0.

    Args:
        solution: the fit.
        points: draws of the unconstrained coordinates of the free numbers (draws, p).
    """
    values = np.stack([solution.parameters.entries_at(x) for x in points])  # (draws, entries)
    names = [entry.name for entry in solution.parameters.entries]
    return _make_dataset({name: (("chain", "draw"), values[None, :, i]) for i, name in enumerate(names)})


def _select_arrived_rows(solution: Solution, density: np.ndarray) -> "xr.Dataset":
    """Return log p (draws, rows) of the rows in which something arrived, with the recording and row of each.

    Args:
        solution: the fit, with its data.
        density: log p of all rows of all recordings, one recording after the other (draws, rows).
    """
    data = solution.surface.data
    rows = [(i, k) for i, steps in enumerate(data.lengths) for k in range(steps)]
    arrived = np.array([bool(np.isfinite(data.measurements[i, k]).any()) for i, k in rows])
    recording, row = np.array(rows)[arrived].T
    content = {"rows": (("chain", "draw", "arrival"), density[None][:, :, arrived])}
    return _make_dataset(content, {"recording": ("arrival", recording), "row": ("arrival", row)})


def _make_total_likelihood_dataset(density: np.ndarray) -> "xr.Dataset":
    """Return the log-likelihood of all rows at each draw, as a dataset, from log p (draws, rows) of each row."""
    return _make_dataset({"lp": (("chain", "draw"), density.sum(axis=1)[None])})


def _make_dataset(content: dict[str, Any], further_coordinates: dict[str, Any] | None = None) -> "xr.Dataset":
    """Return a dataset of arrays (chain, draw, ...), given as {name: (axes, values)}; the one chain has number 0.

    Args:
        content: {name: (names of the axes, values)}, of which the first two axes are chain and draw.
        further_coordinates: {name: (axis, values)} of other axes; none unless given.
    """
    import xarray as xr

    _axes, values = next(iter(content.values()))
    coordinates = {"chain": [0], "draw": np.arange(values.shape[1])}
    return xr.Dataset(content, coordinates | (further_coordinates or {}))
