"""Random programs by native code and by XLA: some of those of `make soak`, and that a difference would be found."""

import importlib
from pathlib import Path

import numpy as np
import pytest

BENCHMARKS = Path(__file__).resolve().parents[1] / "benchmarks"
FIRST, SAMPLE = 100_000, 30  # beyond those of `make soak`


@pytest.fixture
def programs(monkeypatch):
    """The modules of random programs: what writes them, and what judges them."""
    monkeypatch.syspath_prepend(BENCHMARKS)
    return importlib.import_module("programs.flow"), importlib.import_module("programs.judged")


def test_a_program_follows_from_its_number(programs):
    flow, _ = programs
    texts = [flow.program(number).text for number in range(20)]
    assert texts == [flow.program(number).text for number in range(20)] and len(set(texts)) == 20
    for text in texts:
        compile(text, "random program", "exec")
    together = "\n".join(texts)
    for word in (
        "fori_loop",
        "lax.scan",
        "while_loop",
        "lax.cond",
        "lax.switch",
        "jax.vmap",
        ".at[",
        "int64",
        "linalg",
    ):
        assert word in together


def test_native_code_computes_a_program_as_xla_does(programs):
    _, judged = programs
    verdict = judged.judged(FIRST)
    assert not verdict.differs and not verdict.refused and verdict.compared > 0


def test_a_wrong_number_is_found(programs, monkeypatch):
    """Each in turn: one that no rounding explains, the other sign of a zero, another type."""
    _, judged = programs
    x = np.array([[1.0, 0.0, np.nan, np.inf, 3.0]])
    moved = np.stack([x, x * (1 + 1e-15), x * (1 - 1e-15)])
    moved[1, 0, 4] = 4.0  # rounding decides it
    wrong, decided = judged.difference(x, moved)
    assert not wrong.any() and decided.tolist() == [[True] * 5]
    for place, value in ((0, 1 + 1e-13), (1, -0.0), (1, 1e-300), (2, 0.0), (3, -np.inf), (3, np.nan)):
        changed = x.copy()
        changed[0, place] = value
        assert np.argwhere(judged.difference(changed, moved)[0]).tolist() == [[0, place]]
    assert judged.difference(np.zeros((1, 5), int), moved)[0].all()
    decides = np.array([[[1]], [[2]]])
    assert not judged.difference(np.array([[5]]), decides)[0].any(), "rounding decides it"


@pytest.mark.slow
def test_native_code_computes_a_sample_as_xla_does(programs):
    flow, judged = programs
    for number in range(FIRST + 1, FIRST + SAMPLE):
        verdict = judged.judged(number)
        assert not verdict.differs, f"program {number}: {verdict.differs}\n{flow.program(number).text}"


@pytest.mark.slow
def test_a_guard_whose_results_another_function_reads(programs):
    """Of a long program, which is several functions: all of what its branches give is merged before any is stored."""
    _, judge = programs
    verdict = judge.judged(822)
    assert (verdict.differs, verdict.refused) == ("", "") and verdict.compared
