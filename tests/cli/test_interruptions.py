"""Real commands, interrupted while they work: what `make soak` does two hundred times."""

import signal
from pathlib import Path

import pytest

FOLDER = Path(__file__).resolve().parents[2] / "benchmarks"
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not FOLDER.is_dir(), reason="a source distribution has no benchmarks"),
]


@pytest.mark.parametrize(
    ("command", "stages", "number"),
    [
        ("fit", 3, signal.SIGTERM),
        ("fit", 7, signal.SIGINT),
        ("fit", 7, signal.SIGTERM),
        ("run", 4, signal.SIGINT),
        ("serve", 4, signal.SIGTERM),
        ("sweep", 4, signal.SIGINT),
    ],
)
def test_a_command_that_is_interrupted_leaves_no_damage(tmp_path, monkeypatch, command, stages, number):
    """The seventh stage of a fit is its search, in which there is something to keep."""
    monkeypatch.syspath_prepend(FOLDER)
    import interruptions

    interruptions.prepared(tmp_path)
    outcome = interruptions.interrupt(command, number, stages, 0.05, tmp_path)
    assert not outcome.damage, outcome
