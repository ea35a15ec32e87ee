"""Memory of results: what nobody holds is used again, what anybody holds is not, and not much is kept."""

import gc
import tracemalloc

import jax
import numpy as np
import pytest

import straightline

NUMBERS, RUNS = 1000, 300  # 2.4 MB of results
MOST = 1 << 28  # bytes that a process keeps


@pytest.fixture(scope="module")
def doubled():
    with jax.enable_x64(True):
        return straightline.compile(lambda x: 2.0 * x, np.zeros(NUMBERS))


def address(array: np.ndarray) -> int:
    return array.__array_interface__["data"][0]


def test_memory_of_dropped_results_is_used_again(doubled):
    x = np.arange(RUNS * NUMBERS, dtype=float).reshape(RUNS, NUMBERS)
    first = doubled(x)
    place = address(first)
    del first
    again = doubled(x)
    assert address(again) == place and np.array_equal(again, 2 * x)


def test_memory_in_use_is_left_alone(doubled):
    x = np.ones((RUNS, NUMBERS))
    result = doubled(x)
    view, rows = result[7:9, 3:5], iter(result[:1])
    del result
    others = [doubled(k * x) for k in range(2, 6)]
    assert np.array_equal(view, np.full((2, 2), 2.0)) and np.array_equal(next(rows), np.full(NUMBERS, 2.0))
    assert len({address(other) for other in others}) == 4
    assert [other.max() for other in others] == [4.0, 6.0, 8.0, 10.0] == [other.min() for other in others]


def test_fewer_runs_take_the_front_of_kept_memory(doubled):
    x = np.ones((4 * RUNS, NUMBERS))  # more than half of what other tests leave
    place = address(doubled(x))
    fewer = doubled(x[:-10])
    assert address(fewer) == place and fewer.shape == (4 * RUNS - 10, NUMBERS) and address(fewer) % 64 == 0


def test_a_process_keeps_little(doubled):
    x = np.ones((10 * RUNS, NUMBERS))  # 24 MB
    doubled(x)
    gc.collect()
    tracemalloc.start()
    try:
        before = tracemalloc.get_traced_memory()[0]
        held = [doubled(x) for _ in range(MOST // x.nbytes + 3)]
        assert sum(x.nbytes for x in held) > 1.1 * MOST  # all held at once, of which some was kept before
        del held
        assert tracemalloc.get_traced_memory()[0] - before <= MOST
    finally:
        tracemalloc.stop()
