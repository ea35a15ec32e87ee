import gc
import threading

import pytest

from heliograph.numerics import pause_collector


@pytest.fixture(autouse=True)
def on():
    """On at the begin: a thread of an earlier test may be tracing yet."""
    gc.enable()


def test_the_collector_is_off_within_and_as_it_was_afterwards():
    assert gc.isenabled()
    with pause_collector():
        assert not gc.isenabled()
        with pause_collector():  # a trace that begins another
            pass
        assert not gc.isenabled()
    assert gc.isenabled()


def test_it_is_on_again_after_an_error():
    @pause_collector()
    def refused():
        raise ValueError("no")

    with pytest.raises(ValueError, match="no"):
        refused()
    assert gc.isenabled()


def test_who_switched_it_off_finds_it_off():
    gc.disable()
    try:
        with pause_collector():
            pass
        assert not gc.isenabled()
    finally:
        gc.enable()


def test_threads_that_overlap_leave_it_on():
    begun, ended = threading.Event(), threading.Event()

    def second():
        with pause_collector():  # finds it off
            begun.set()
            ended.wait(10)

    with pause_collector():
        thread = threading.Thread(target=second)
        thread.start()
        begun.wait(10)
    assert gc.isenabled()
    ended.set()
    thread.join()
    assert gc.isenabled()
