"""How often intervals cover the truth: recordings in batches, each kept, so that a run can be taken up again."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import TypedDict

import numpy as np

import heliograph as hg
from heliograph.learning.recordings_apart import fit_each
from heliograph_studies.learning.parts import stored
from heliograph_studies.learning.setting import METHODS, ROWS, Row, learned, square_wave, true_values, world

BATCH = 64
BATCHES = 10  # 640 recordings of each row


class Counts(TypedDict):
    """Of one batch: recordings, those in which no number ran to a limit, and of these those covered."""

    recordings: int
    inside: int
    covered: dict[str, dict[str, int]]


@dataclass(frozen=True)
class Coverage:
    """Of one row: recordings, the share left out, and by method and parameter the percentage covered."""

    recordings: int
    left_out: float
    covered: Mapping[str, Mapping[str, float]]


def compute(parts: Path, seed: int, batches: int, advance: Callable[[str], None]) -> dict[str, Coverage]:
    """Every row, by its name and form; batches that `parts` holds are read from there."""
    parts.mkdir(parents=True, exist_ok=True)
    results: dict[str, list[Counts]] = {}
    for batch in range(batches):
        for row in ROWS:
            key = f"{row.name}.{row.form}"
            advance(f"{key}: recordings {batch * BATCH + 1} to {(batch + 1) * BATCH}")
            results.setdefault(key, []).append(
                stored(parts / f"{key}.{seed}.{batch}.json", partial(counts, row, seed, batch))
            )
    return {key: pooled(item) for key, item in results.items()}


def counts(row: Row, seed: int, batch: int) -> Counts:
    """One batch of one row, fitted and counted."""
    u = square_wave(row)
    record = hg.monte_carlo(world(row), row.steps, BATCH, seed, inputs=u, first_run=batch * BATCH)
    fits = fit_each(builder(row), record.measurements["node"], u, row.form)
    names = [item.name for item in fits.parameters.every]
    truth = np.array([true_values(row)[name] for name in names])
    covered: dict[str, dict[str, int]] = {}
    for method in METHODS:
        low, high = fits.intervals(method)
        hits = ((low <= truth) & (truth <= high))[fits.inside].sum(axis=0)
        covered[method] = {name: int(hit) for name, hit in zip(names, hits, strict=True)}
    return Counts(recordings=BATCH, inside=int(fits.inside.sum()), covered=covered)


@cache
def builder(row: Row) -> Callable[[], hg.Network]:
    """The function that builds a row's network, the same one for all batches, so that one program serves them."""
    return partial(learned, row)


def pooled(batches: list[Counts]) -> Coverage:
    """Percentages over all batches."""
    recordings, inside = sum(b["recordings"] for b in batches), sum(b["inside"] for b in batches)
    covered = {
        method: {name: 100 * sum(b["covered"][method][name] for b in batches) / max(inside, 1) for name in batch}
        for method, batch in batches[0]["covered"].items()
    }
    return Coverage(recordings, 1 - inside / recordings, covered)
