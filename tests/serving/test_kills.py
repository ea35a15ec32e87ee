"""A real process, killed with -9 while it works: what `make soak` does fifty times."""

from pathlib import Path

import pytest

FOLDER = Path(__file__).resolve().parents[2] / "benchmarks"
pytestmark = pytest.mark.skipif(not FOLDER.is_dir(), reason="a source distribution has no benchmarks")


@pytest.mark.slow
def test_a_killed_service_loses_nothing_and_counts_nothing_twice(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(FOLDER)
    import kills

    result = kills.killed(1, 1, tmp_path)
    assert kills.sound(result), result
    for name, wrong in (("lost", 1), ("finals_identical", False), ("exit_code", 2)):
        assert not kills.sound(result | {name: wrong})
