import numpy as np
import pytest

import heliograph as hg
from heliograph.model.over_time import at, steps_covered


def test_an_unmarked_array_never_varies():
    assert np.array_equal(at(np.eye(3), 1), np.eye(3))
    assert steps_covered(np.eye(3)) is None


def test_a_marked_array_is_read_at_its_step():
    values = np.arange(6.0).reshape(3, 2)
    assert np.array_equal(at({"a": hg.model.OverTime(values)}, 2)["a"], values[2])
    assert steps_covered({"a": hg.model.OverTime(values)}) == 3


@pytest.mark.parametrize("k", [1, np.int64(1)])
def test_a_number_over_time_is_an_array_at_its_step(k):
    """So that what is read can be stacked again: a NumPy number is no array."""
    read = at(hg.model.OverTime(np.arange(3.0)), k)
    assert isinstance(read, np.ndarray) and read.shape == () and read == 1.0
    both = hg.model.over_time([read, read + 1])
    assert np.array_equal(hg.model.over_time([at(both, 0), at(both, 1)]).values, [1.0, 2.0])


def test_objects_over_time_come_back_as_given():
    channels = [hg.hop(hg.Rayleigh(s), 0.1) for s in (0.5, 1.0, 2.0)]
    moved = hg.model.over_time(channels)
    assert [float(at(moved, k).law.scale) for k in range(3)] == [0.5, 1.0, 2.0]


@pytest.mark.parametrize(
    "other", [hg.hop(hg.random_affine.Nakagami(1.0), 0.1), hg.hop(hg.Rayleigh(1.0), 0.1, dimension=2)]
)
def test_objects_of_another_structure_or_shape_do_not_stack(other):
    with pytest.raises(ValueError, match="one structure"):
        hg.model.over_time([hg.hop(hg.Rayleigh(1.0), 0.1), other])


def test_nothing_over_time_is_refused():
    with pytest.raises(ValueError, match="at least one item"):
        hg.model.over_time([])
    with pytest.raises(ValueError, match="leading time axis"):
        hg.model.OverTime(np.float64(3.0))
