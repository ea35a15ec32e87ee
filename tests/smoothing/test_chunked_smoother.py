"""A long recording smoothed in chunks side by side: the sequential smoother, to far less than a deviation."""

import warnings

import numpy as np
import pytest

import heliograph as hg
from heliograph.filters.rows import chunks

ROWS = 34_001  # a chunk that is not full at the end
RNG = np.random.default_rng(11)
WALK = hg.LinearPlant(np.eye(4) + 0.1 * np.eye(4, k=2), np.diag([1e-4, 1e-4, 1e-2, 1e-2]), np.zeros(4), np.eye(4))
PLACES = hg.LinearSensor(np.eye(2, 4), 0.25 * np.eye(2))
TURNING = hg.LinearPlant([[0.99, 0.1], [-0.1, 0.97]], 0.01, [1.0, 1.0], 1.0, [[0.1], [0.0]])
HOP = hg.hop(hg.Discrete([0.5, 1.2], [0.4, 0.6]), 0.1, dimension=2)
Z = 0.1 * np.cumsum(RNG.normal(size=(ROWS, 2)), axis=0) + 0.5 * RNG.normal(size=(ROWS, 2))
FEW_HOLES = Z.copy()  # most chunks are complete
FEW_HOLES[[20_000, 33_000], [1, 0]] = FEW_HOLES[7_000:9_500] = np.nan
Z[RNG.random(Z.shape) < 0.2] = np.nan
Z[7_000:9_500] = np.nan  # an outage across a joint, in which neither what was nor what comes is forgotten
PUSHES = RNG.normal(size=(ROWS, 1))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("item", "z", "u"),
    [
        (hg.kalman_filter(WALK, PLACES), Z, None),
        (hg.kalman_filter(WALK, PLACES), FEW_HOLES, None),
        (hg.linear_filter(TURNING, hg.LinearSensor(np.eye(2), 0.1), HOP), Z, PUSHES),
    ],
    ids=["Kalman", "few missing", "random gain and inputs"],
)
def test_it_is_the_sequential_smoother(monkeypatch, item, z, u):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # these data are not the plant's
        of_chunks = hg.rts_smoother(item, z, u)
        monkeypatch.setattr(chunks, "CHUNKS", ROWS)
        of_rows = hg.rts_smoother(item, z, u)
    deviation = np.sqrt(np.diagonal(of_rows.covariances, axis1=1, axis2=2))
    assert np.max(np.abs(of_chunks.means - of_rows.means) / deviation) < 1e-10
    outer = deviation[:, :, None] * deviation[:, None, :]
    assert np.max(np.abs(of_chunks.covariances - of_rows.covariances) / outer) < 1e-10
    assert of_chunks.claim == of_rows.claim


@pytest.mark.slow
def test_it_doubts_a_filter_that_is_not_consistent():
    sure = hg.kalman_filter(WALK, hg.LinearSensor(np.eye(2, 4), 0.01 * np.eye(2)))
    with pytest.warns(UserWarning, match="smoothing: squared innovations are 22.8"):
        hg.rts_smoother(sure, Z)
