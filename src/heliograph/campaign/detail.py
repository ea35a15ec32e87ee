"""Scores of single states, over all steps and at some of them, from a second pass over the store."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import zarr

from heliograph.campaign.labels import Labels
from heliograph.campaign.plan import Campaign
from heliograph.campaign.store import CLAIM, done_chunks, stored_labels


@dataclass(frozen=True)
class Detail:
    """Scores of one state of one filter over the finite runs, at a step counted from 1, or over all steps (`step` 0).

    `claimed` is the root of the mean claimed variance, `nees_per_dimension` the mean of the squared error over the
    claimed variance, 1 if the claim is exact. Standard errors are from the scatter between runs; NaN without finite
    runs.
    """

    setting: int
    node: str
    filter: str
    claim: str
    state: str
    step: int
    rmse: float
    rmse_error: float
    claimed: float
    nees_per_dimension: float
    nees_error: float
    finite_runs: int


def details(store: Path, campaign: Campaign, settings: Sequence[int], steps: Sequence[int]) -> list[Detail]:
    """Return the scores of every state of every filter in these settings: over all steps, then at each given step."""
    group, labels = zarr.open_group(store, mode="r"), stored_labels(store)
    claims, done = np.asarray(group[CLAIM]), done_chunks(store, campaign)
    results: list[Detail] = []
    for setting in settings:
        chunks = [chunk for chunk in campaign.chunks(setting) if (setting, chunk.number) in done]
        parts = [_sums(group, setting, slice(c.start, c.stop), claims[setting], steps) for c in chunks]
        if parts:
            sums = [np.sum(part, axis=0) for part in zip(*parts, strict=True)]
            results += _described(setting, labels, claims[setting], [0, *steps], sums)
    return results


def _sums(
    group: zarr.Group, setting: int, runs: slice, claims: np.ndarray, steps: Sequence[int]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Count finite runs (node, filter); sum squared errors, claimed variances and their ratios, and the squares."""
    error, variance = (np.asarray(group[name][setting, runs]) for name in ("error", "variance"))  # type: ignore[index]
    squared = error**2
    claimed = np.isfinite(variance).all(axis=(1, -1)) | (claims == "none")
    counted = np.isfinite(squared).all(axis=(1, -1)) & claimed  # (run, node, filter)
    with np.errstate(divide="ignore", invalid="ignore"):
        values = np.stack([squared, variance, squared / variance])
    at = np.concatenate([values.mean(axis=2, keepdims=True), values[:, :, [step - 1 for step in steps]]], axis=2)
    at = np.where(counted[None, :, None, :, :, None], at, 0.0)
    return counted.sum(axis=0), at.sum(axis=1), (at**2).sum(axis=1)


def _described(
    setting: int, labels: Labels, claims: np.ndarray, steps: Sequence[int], sums: Sequence[np.ndarray]
) -> list[Detail]:
    count, first, second = sums
    with np.errstate(divide="ignore", invalid="ignore"):
        n = count[None, None, :, :, None]
        # Mean and its standard error over n runs: sqrt((E[x^2] - E[x]^2) / (n - 1)).
        mean = first / n
        error = np.sqrt(np.maximum(second / n - mean**2, 0.0) / (n - 1))
        rmse, claimed = np.sqrt(mean[:2])
        halved = np.where(rmse > 0, error[0] / (2 * rmse), 0.0)  # of a root, to first order
    return [
        Detail(
            setting, node, name, str(claims[i, j]), state, step, float(rmse[k, i, j, s]), float(halved[k, i, j, s]),
            float(claimed[k, i, j, s]), float(mean[2, k, i, j, s]), float(error[2, k, i, j, s]), int(count[i, j])
        )
        for k, step in enumerate(steps)
        for i, node in enumerate(labels.nodes)
        for j, name in enumerate(labels.filters)
        if claims[i, j]
        for s, state in enumerate(labels.states)
    ]  # fmt: skip
