"""A long recording in chunks side by side: the sequential pass, to far less than a deviation."""

import os
import pickle

import jax
import numpy as np
import pytest

import heliograph as hg
from heliograph.filters.rows import chunks

ROWS = 40_001  # a chunk that is not full at the end
RNG = np.random.default_rng(7)
STEP = 0.1
WALK = hg.LinearPlant(
    np.eye(4) + STEP * np.eye(4, k=2), np.diag([1e-4, 1e-4, 1e-2, 1e-2]), np.zeros(4), np.eye(4),
)  # fmt: skip
PLACES = hg.LinearSensor(np.eye(2, 4), 0.25 * np.eye(2))
TURNING = hg.LinearPlant([[0.99, 0.1], [-0.1, 0.97]], 0.01, [1.0, 1.0], 1.0, [[0.1], [0.0]])
BOTH = hg.LinearSensor(np.eye(2), 0.1)
HOP = hg.hop(hg.Discrete([0.5, 1.2], [0.4, 0.6]), 0.1, dimension=2)
Z = 0.1 * np.cumsum(RNG.normal(size=(ROWS, 2)), axis=0) + 0.5 * RNG.normal(size=(ROWS, 2))
HOLES = np.where(RNG.random(Z.shape) < 0.2, np.nan, Z)
HOLES[7_000:9_500] = np.nan  # an outage across a joint, in which nothing is forgotten
FEW_HOLES = Z.copy()  # most chunks are complete
FEW_HOLES[[20_000, 40_000], [1, 0]] = FEW_HOLES[7_000:9_500] = np.nan
PUSHES = RNG.normal(size=(ROWS, 1))


def moves(u):
    return np.eye(2) + u[0] * np.eye(2, k=1)


def shakes(u):
    return 0.1 * u[0] * np.eye(2)


CLOCKED = hg.LinearPlant(moves, shakes, [0.0, 0.0], np.eye(2), inputs=["dt"])
INTERVALS = RNG.uniform(0.05, 0.2, size=(ROWS, 1))


def sequential(monkeypatch, item, z, u):
    with monkeypatch.context() as patch:
        patch.setattr(chunks, "CHUNKS", ROWS)
        return item.run(z, u), hg.log_likelihood(item, z, u)


def assert_same(of_chunks, of_rows):
    """To 1e-10 of a deviation; two sums of as many densities differ by more than theirs."""
    deviation = np.sqrt(np.diagonal(of_rows.covariances, axis1=1, axis2=2))
    assert np.max(np.abs(of_chunks.means - of_rows.means) / deviation) < 1e-10
    outer = deviation[:, :, None] * deviation[:, None, :]
    assert np.max(np.abs(of_chunks.covariances - of_rows.covariances) / outer) < 1e-10
    size = np.nanmax(np.abs(of_rows.innovations))
    np.testing.assert_allclose(of_chunks.innovations, of_rows.innovations, rtol=0, atol=1e-10 * size)
    np.testing.assert_allclose(of_chunks.innovation_covariances, of_rows.innovation_covariances, rtol=1e-10)
    np.testing.assert_allclose(of_chunks.log_likelihoods, of_rows.log_likelihoods, rtol=1e-9, atol=1e-10)
    for one, other in zip(of_chunks.origin.state, of_rows.origin.state, strict=True):
        np.testing.assert_allclose(np.hstack(one), np.hstack(other), rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize(
    ("item", "z", "u"),
    [
        (hg.kalman_filter(WALK, PLACES), HOLES, None),
        (hg.kalman_filter(WALK, PLACES), FEW_HOLES, None),
        pytest.param(hg.kalman_filter(TURNING, BOTH), FEW_HOLES, PUSHES, marks=pytest.mark.slow),
        pytest.param(hg.linear_filter(TURNING, BOTH, HOP), HOLES, PUSHES, marks=pytest.mark.slow),
        pytest.param(hg.linear_filter(WALK, PLACES, hg.perfect(2)), Z, None, marks=pytest.mark.slow),
        pytest.param(hg.kalman_filter(CLOCKED, BOTH), HOLES, INTERVALS, marks=pytest.mark.slow),
    ],
    ids=[
        "missing",
        "few missing",
        "few missing, and inputs",
        "random gain and inputs",
        "moments that grow for ever",
        "steps of their own",
    ],
)
def test_it_is_the_sequential_pass(monkeypatch, item, z, u):
    of_rows, likelihood = sequential(monkeypatch, item, z, u)
    assert_same(item.run(z, u), of_rows)
    assert hg.log_likelihood(item, z, u) == pytest.approx(likelihood, rel=1e-12)


def in_chunks(item, z=Z, u=None):
    u = np.zeros((len(z), 0)) if u is None else u
    return chunks.filter_in_chunks(item, z, u, lambda filter, state, innovation, k: innovation.log_likelihood)


def test_what_forgets_is_filtered_in_chunks():
    assert in_chunks(hg.kalman_filter(WALK, PLACES)) is not None
    assert in_chunks(hg.linear_filter(WALK, PLACES, hg.perfect(2))) is not None


@pytest.mark.parametrize(
    "item",
    [
        hg.kalman_filter(hg.LinearPlant(np.eye(2), np.zeros((2, 2)), np.zeros(2), np.eye(2)), BOTH),
        hg.extended_filter(WALK, hg.Sensor(lambda x: x[:2], 0.25 * np.eye(2), ["x", "y"])),
    ],
    ids=["a constant is never forgotten", "not linear"],
)
def test_what_does_not_stays_sequential(item):
    assert in_chunks(item) is None


def test_means_far_from_zero_are_as_near_as_their_rounding():
    """Positions of a million metres known to a decimetre: eps of them is 2e-9 of a deviation, and enters the speeds."""
    far = Z + 1e6 + 100.0 * np.arange(ROWS)[:, None] * STEP
    assert in_chunks(hg.kalman_filter(WALK, PLACES), far) is not None


def test_means_alone_move_where_rows_are_complete():
    """Of 20 chunks the first, the three that lack rows, and the last, which is not full."""
    item, u = hg.kalman_filter(WALK, PLACES), np.zeros((ROWS, 0))
    rows = chunks.FilterRecursion(item, lambda filter, state, innovation, k: innovation.log_likelihood)
    with jax.enable_x64(True):
        begun = chunks.find_chunk_starts(rows, chunks.initial_state_if_linear(item), (FEW_HOLES, u))
    assert np.flatnonzero(~begun.covered).tolist() == [0, 3, 4, 9, 19]


def no_such_files(*_):
    raise OSError("none here")


@pytest.mark.parametrize("mapped", [True, False], ids=["mapped", "filled"])
def test_equal_covariances_are_an_array_as_any_other(monkeypatch, mapped):
    """Of 130,000 rows, 17 MB, nearly all are one matrix, in memory that the system shows again and again, if it can."""
    if not mapped:
        monkeypatch.setattr(os, "memfd_create", no_such_files, raising=False)
    item = hg.kalman_filter(WALK, PLACES)
    results, others = (item.run(np.tile(Z, (4, 1))[:130_000]).covariances for _ in range(2))
    assert results.flags.c_contiguous and results.flags.writeable
    settled = results[5_000].copy()
    assert (results[2_048:] == settled).all() and not (results[0] == settled).all()
    # What is written is seen in its place alone.
    results[70_000:70_002] *= 2.0
    assert np.flatnonzero((results[2_048:] != settled).any(axis=(1, 2))).tolist() == [67_952, 67_953]
    assert (others[2_048:] == settled).all()
    # A part outlives the whole, and a copy both.
    part, copied = results[-5:], pickle.loads(pickle.dumps(others[3_000:3_010]))
    del results, others
    assert (part == settled).all() and (copied == settled).all()


def test_few_rows_stay_sequential():
    assert in_chunks(hg.kalman_filter(WALK, PLACES), Z[:30_000]) is None


def test_a_lost_filter_is_lost_to_the_end():
    """A filter whose numbers overflow in the third chunk: NaN from there on, as row by row."""
    growing = hg.kalman_filter(hg.LinearPlant([[2.0]], [[1.0]], [0.0], [[1.0]]), hg.LinearSensor([[1.0]], [[1.0]]))
    z = Z[:, :1].copy()
    z[5_000:7_000] = np.nan
    with pytest.warns(UserWarning, match="no finite number from row 5512 on"):
        means = growing.run(z).means
    assert np.isfinite(means[:5_511]).all() and np.isnan(means[5_511:]).all()
