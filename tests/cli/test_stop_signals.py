"""The exit code of a command that a signal stopped gently."""

import signal

import pytest

from heliograph import cli


@pytest.fixture(autouse=True)
def interruptible():
    """What runs in the background ignores SIGINT."""
    inherited = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, inherited)


def test_a_second_signal_of_another_kind_leaves_the_exit_code_of_the_first():
    """Noted, then unwinding: SIGTERM and then SIGINT is 143, as SIGTERM alone."""
    with cli.GentleStop() as stop:
        stop.note_next_signal_only()
        signal.raise_signal(signal.SIGTERM)
        assert stop.code == cli.TERMINATED
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        assert stop.code == cli.TERMINATED


def test_an_interrupt_raised_again_for_a_swallowed_one_leaves_the_exit_code_of_the_first():
    """Work that may be left out swallows SIGTERM, as a callback of the compiler does; SIGINT follows."""

    def swallow_the_first() -> int:
        try:
            signal.raise_signal(signal.SIGTERM)
        except KeyboardInterrupt:
            signal.raise_signal(signal.SIGINT)
        return 1

    with cli.GentleStop() as stop:
        assert stop.run_unless_stopped(swallow_the_first) is None
        assert stop.code == cli.TERMINATED
