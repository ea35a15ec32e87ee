"""Room on the interpreter's stack: the same function, and calls within it that map no memory again and again."""

import time
from concurrent.futures import ThreadPoolExecutor

import pytest

from heliograph.numerics import reserve_stack

CALLS = 200


def leaf(depth):
    return 0 if depth == 0 else 1 + leaf(depth - 1)


def from_depth(depth, calls):
    """The seconds of calls that each go four frames deeper."""
    if depth:
        return from_depth(depth - 1, calls)
    begun = time.perf_counter()
    for _ in range(calls):
        leaf(4)
    return time.perf_counter() - begun


def test_it_is_the_same_function():
    def scaled(x, *, by=1):
        """Scale."""
        if by == 0:
            raise ValueError("no")
        return x * by

    roomy = reserve_stack(scaled)
    assert roomy(2, by=3) == 6 and roomy(2) == 2 and (roomy.__name__, roomy.__doc__) == ("scaled", "Scale.")
    with pytest.raises(ValueError, match="no"):
        roomy(2, by=0)
    assert reserve_stack(roomy)(5) == 5


def slowest(measure):
    """The longest time over the median one, of callers that stand at 140 depths."""
    times = [min(measure(depth, CALLS) for _ in range(5)) for depth in range(140)]
    return max(times) / sorted(times)[70]


def test_how_deep_a_caller_stands_makes_no_difference():
    """Without room a call across the end of a chunk takes 20 to 100 times as long: in a thread, as tests have room."""
    with ThreadPoolExecutor(1) as thread:
        assert thread.submit(slowest, reserve_stack(from_depth)).result() < 5
        assert thread.submit(slowest, from_depth).result() > 5
