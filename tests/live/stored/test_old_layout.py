"""Layouts of stored states: a covariance of an older one is read as the factors of now."""

import numpy as np
import pytest

import heliograph as hg
from heliograph.factors.factored_gaussian import Gaussian
from heliograph.live.stored import (
    can_read_layout,
    describe_old_layout,
    factorise_covariance,
    relocate_parts,
    split_by_path,
)
from heliograph.live.stored.old_layout import place_flags

NEW = {
    ".mean": [2, 3],
    ".lower": [2, 3],
    ".variances": [2, 3],
    ".inner.lower": [0],
    ".inner.variances": [1],
    ".law": [4],
}
OLD = {".mean": [2, 3], ".covariance": [2, 3, 3], ".inner.covariance": [1, 1], ".law": [4]}


def test_an_older_layout_is_that_of_now_with_covariances():
    assert describe_old_layout(NEW) == OLD and list(describe_old_layout(NEW)) == list(OLD)
    assert can_read_layout(OLD, NEW) and can_read_layout(NEW, NEW) and can_read_layout(OLD, OLD)
    for other in (
        OLD | {".covariance": [2, 2, 2]},
        OLD | {".more": []},
        {path: shape for path, shape in OLD.items() if path != ".law"},
        NEW | {".covariance": [2, 3, 3]},
    ):
        assert not can_read_layout(other, NEW)


def test_a_gaussian_that_is_a_part_of_its_own_stood_beside_the_others():
    """Its parts are found under their old paths, as factors and as a covariance; one that was nested stays."""
    new = {".gaussian" + path: shape for path, shape in NEW.items() if path[1:] in ("mean", "lower", "variances")}
    new |= {".law": [4], ".errors.gaussian.mean": [2]}
    flat = {path.replace(".gaussian", ""): shape for path, shape in new.items()}
    old = {".mean": [2, 3], ".covariance": [2, 3, 3], ".law": [4], ".errors.mean": [2]}
    assert describe_old_layout(new) == old
    assert (
        can_read_layout(flat, new)
        and can_read_layout(old, new)
        and can_read_layout(new, new)
        and not can_read_layout(new, flat)
    )
    parts = {path: np.full(shape, float(i)) for i, (path, shape) in enumerate(flat.items())}
    assert [part.flat[0] for part in relocate_parts(parts, new).values()] == [0, 1, 2, 3, 4]
    assert can_read_layout(
        {path: shape for path, shape in old.items() if path != ".errors.mean"} | {".errors.gaussian.mean": [2]}, new
    )


def test_a_sum_of_an_event_filter_has_its_parts_in_the_order_that_they_had_with_covariances():
    """Snapshots without names of parts are read by this order."""
    sensor = hg.LinearSensor([[1.0]], 0.1)
    start = hg.event_filter(hg.LinearPlant([[0.9]], 0.1, [0.0], 1.0), sensor, hg.perfect(1), hg.SendOnDelta(0.5)).init()
    before = describe_old_layout({path: part.shape for path, part in split_by_path(start).items()})
    assert list(before) == [".weight", ".mean", ".covariance", ".label", ".begun", ".moved"]
    assert before[".covariance"] == list(start.gaussian.covariance.shape)


@pytest.mark.parametrize("count", [1, 63, 130])
def test_factors_of_covariances_are_theirs(count):
    """To rounding of the deviations, over sizes from 1e-6 to 1e6, of tied states too: each pivot is known to n eps."""
    generator = np.random.default_rng(count)
    for n in (1, 3):
        roots = generator.normal(size=(count, n, n)) * 10.0 ** generator.uniform(-6, 6, (count, n, 1))
        roots[0, :, 1:] = 0.0
        covariance = roots @ np.swapaxes(roots, -1, -2)
        lower, variances = factorise_covariance(covariance.reshape(count, 1, n, n))
        assert lower.shape == (count, 1, n * (n - 1) // 2) and variances.shape == (count, 1, n)
        assert np.all(variances >= 0)
        again = Gaussian(variances, lower, variances).covariance[:, 0]
        size = np.sqrt(np.einsum("kii,kjj->kij", covariance, covariance))
        assert np.max(np.abs(again - covariance) / size) < 4 * n * np.finfo(float).eps


def test_parts_move_to_their_paths_of_now():
    generator = np.random.default_rng(0)
    parts = {path: generator.normal(size=(5, *shape)) for path, shape in OLD.items()}
    parts[".covariance"] = parts[".covariance"] @ np.swapaxes(parts[".covariance"], -1, -2)
    parts[".inner.covariance"] **= 2
    results = relocate_parts(parts, NEW)
    assert {path: list(part.shape[1:]) for path, part in results.items()} == NEW
    np.testing.assert_array_equal(results[".law"], parts[".law"])
    np.testing.assert_array_equal(results[".inner.variances"], parts[".inner.covariance"][..., 0])
    whole = Gaussian(*(results[path] for path in (".mean", ".lower", ".variances"))).covariance
    np.testing.assert_allclose(whole, parts[".covariance"], rtol=1e-12)


def test_flags_whose_columns_were_noted_as_those_of_their_numbers_are_put_in_their_places():
    """Two filters side by side with two flags each and an integer between, one alone with a flag last, and a memory."""
    right = {
        "x": {".mean": [[1], 0, 1], ".covariance": [[1, 1], 2, 3], ".on": [[], 4, 5], ".k": [[], 6, 7]},
        "y": {".mean": [[1], 1, 2], ".covariance": [[1, 1], 3, 4], ".on": [[], 5, 6], ".k": [[], 7, 8]},
        "z": {".mean": [[2], 12, 14], ".moved": [[], 14, 15]},
        "memory": {"[0]": [[], 15, 16], "[1]": [[3], 16, 19]},
    }
    right["x"][".end"], right["y"][".end"] = [[2], 8, 10], [[2], 10, 12]
    lost = {("x", ".on"), ("y", ".on"), ("x", ".end"), ("y", ".end"), ("z", ".moved"), ("memory", "[0]")}
    wrong = {
        name: {
            path: [shape, 1, 1 + end - begin] if (name, path) in lost else [shape, begin, end]
            for path, (shape, begin, end) in parts.items()
        }
        for name, parts in right.items()
    }
    assert place_flags(wrong) == right == place_flags(right)
