import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import heliograph as hg


def test_one_node():
    np.testing.assert_array_equal(hg.fusion.level_weights([1.7]), [1.0])
    assert hg.fusion.fused_level([2.0], [1.0]) == 2.0


@settings(max_examples=50)
@given(levels=st.lists(st.floats(0.1, 10), min_size=1, max_size=6), seed=st.integers(0, 1000))
def test_closed_form_is_optimal_and_minkowski_is_sharper(levels, seed):
    g, other = np.array(levels), np.random.default_rng(seed).dirichlet(np.ones(len(levels)))
    best, elsewhere = (np.sum((c * g) ** 2) for c in (hg.fusion.level_weights(levels), other))
    assert best <= elsewhere * (1 + 1e-12)
    assert best == pytest.approx(1 / np.sum(g**-2.0), rel=1e-12)
    # (sum c g)^2 <= N sum c^2 g^2 (Cauchy).
    assert hg.fusion.fused_level(levels, other) <= np.sqrt(len(g) * elsewhere) * (1 + 1e-12)
    assert hg.fusion.fused_level(levels, other) <= max(levels) * (1 + 1e-12)


@settings(max_examples=50)
@given(seed=st.integers(0, 10**6))
def test_no_errors_within_the_local_levels_exceed_the_fused_norm(seed):
    rng = np.random.default_rng(seed)
    count, time, n = rng.integers(1, 5), rng.integers(1, 6), rng.integers(1, 4)
    gamma, norms = rng.uniform(0.1, 2, count), rng.uniform(0, 2, count)
    c, matrix = rng.dirichlet(np.ones(count)), rng.normal(size=(2, n))
    e = rng.normal(size=(count, time, n))
    z = e @ matrix.T
    size = gamma * norms / np.linalg.norm(z, axis=(1, 2))  # each error as large as its level allows
    d = rng.exponential(size=(count, time, n))
    mu = d * rng.uniform(-1, 1, d.shape)
    fused = np.einsum("i,itk->tk", c, z * size[:, None, None] - mu @ matrix.T)
    bound = hg.fusion.fused_error_norm(gamma, c, norms, matrix, d)
    assert np.linalg.norm(fused) <= bound * (1 + 1e-12)


def test_the_fused_norm_at_its_limits():
    args = ([1.0, 2.0], [0.5, 0.5], [3.0, 3.0], np.eye(2))
    assert hg.fusion.fused_error_norm(*args, np.zeros((2, 4, 2))) == pytest.approx(
        3 * hg.fusion.fused_level(*args[:2]), rel=1e-15
    )
    assert np.isnan(hg.fusion.fused_error_norm(*args, np.full((2, 4, 2), np.nan)))  # a quantizer saturated


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: hg.fusion.level_weights([]), "levels: expected positive numbers"),
        (lambda: hg.fusion.level_weights([1.0, -1.0]), "levels: expected positive numbers"),
        (lambda: hg.fusion.fused_level([1.0, 1.0], [0.5, 0.6]), "sum to 1"),
        (lambda: hg.fusion.fused_level([1.0, 1.0], [1.0]), r"shape \(2\)"),
        (
            lambda: hg.fusion.fused_error_norm([1.0], [1.0], [1.0], np.eye(2), np.zeros((1, 3, 1))),
            r"errors: expected shape \(1, any, 2\)",
        ),
        (
            lambda: hg.fusion.fused_error_norm([1.0], [1.0], [-1.0], np.eye(1), np.zeros((1, 3, 1))),
            "no negative number",
        ),
    ],
)
def test_bad_levels(call, message):
    with pytest.raises(ValueError, match=message):
        call()
