"""benchmarks/interval_coverage.py: its laws, what it learns, and what intervals cover of few and short recordings."""

import importlib
from pathlib import Path

import pytest

import heliograph as hg


@pytest.fixture
def coverage(monkeypatch):
    """benchmarks/interval_coverage.py, imported as it is when run."""
    monkeypatch.syspath_prepend(Path(__file__).parents[1] / "benchmarks")
    return importlib.import_module("interval_coverage")


def test_the_laws_have_the_moments_that_are_to_be_learned(coverage):
    for name, law in coverage.LAWS.items():
        assert law.moment(1) == pytest.approx(0.8)
        if name != "rayleigh":
            assert law.moment(2) - law.moment(1) ** 2 == pytest.approx(0.16)


@pytest.mark.slow
def test_what_is_learned_starts_at_the_truth(coverage):
    for row in coverage.ROWS:
        result = hg.learning.describe(lambda row=row: coverage.learned(row)).parameters
        assert {item.name: float(item.start) for item in result.every} == pytest.approx(coverage.true_values(row))
        assert coverage.world(row).nodes["node"].received == (1 if row.law == "uninformed" else 2)


@pytest.mark.slow
def test_intervals_by_cosines_cover_most_of_the_truth(coverage):
    row = coverage.ROWS[3]._replace(steps=200)
    assert row.name == "two_point" and row.form == "conditional"
    inside, covered = coverage.count(row, batches=1, size=32)
    assert inside > 24  # of so few steps some have a variance at its limit
    assert min(covered["cosines"].values()) > 75  # 95 less four standard errors of 32
    assert set(covered) == set(coverage.METHODS)
