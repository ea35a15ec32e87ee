"""What the soak looks for it finds; the soak itself is not run here."""

import json
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from heliograph.simulation.results.statistics import ErrorStatistics

FOLDER = Path(__file__).resolve().parents[1] / "benchmarks"
pytestmark = pytest.mark.skipif(not FOLDER.is_dir(), reason="a source distribution has no benchmarks")


@pytest.fixture(scope="module")
def soak() -> Any:
    """benchmarks/soak.py, imported as it is when run."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(FOLDER)
        import soak as module

        yield module


BATCHES = 50  # of runs, whose spread gives standard errors


def statistics(ratio: float, claim: str = "exact", runs: int = 5000, seed: int = 0) -> ErrorStatistics:
    """Gaussian errors whose second component has `ratio` times the claimed variance, at three steps."""
    covariance = np.array([[1.0, 0.3], [0.3, 1e-12]]) * np.array([[1.0, 1e-6], [1e-6, 1.0]])
    actual = covariance * np.sqrt(np.array([[1.0, ratio], [ratio, ratio**2]]))
    errors = np.random.default_rng(seed).multivariate_normal(np.zeros(2), actual, size=(runs, 3))
    deal = (np.arange(runs)[:, None] % BATCHES == np.arange(BATCHES)).astype(float)
    i, j = np.triu_indices(2)
    pairs = np.einsum("rb,rtp->btp", deal, errors[..., i] * errors[..., j])
    claimed = np.broadcast_to(covariance[i, j], (BATCHES, 3, 3))
    return ErrorStatistics(deal.sum(axis=0), pairs, claimed, np.zeros((BATCHES, 3)), claim)


@pytest.mark.parametrize(("ratio", "claim", "result"), [(1.3, "exact", True), (1.3, "upper", True),
(0.7, "exact", True),
                                                        (0.7, "upper", False), (1.0, "exact", False)])  # fmt: skip
def test_a_broken_claim_stands_out(soak: ModuleType, ratio: float, claim: str, result: bool) -> None:
    place = soak.worst_place(statistics(ratio, claim), np.random.default_rng(1))
    z = abs(place.z) if claim == "exact" else place.z
    assert (z > soak.SUSPECT) == result


def test_a_certainty_that_is_wrong_is_hopelessly_far(soak: ModuleType) -> None:
    sure = statistics(1.0)
    pairs, claimed = sure.pairs.copy(), np.array(sure.claimed_pairs)
    pairs[..., 1:], claimed[..., 1:] = 0.0, 0.0
    certain = ErrorStatistics(sure.count, pairs, claimed, sure.nees, "exact")
    assert np.isfinite(soak.worst_place(certain, np.random.default_rng(1)).z)
    pairs[..., 2] = 1e-3
    assert soak.worst_place(certain, np.random.default_rng(1)).z > 1e6


def test_a_state_that_is_known_may_be_off_by_rounding_of_its_size(soak: ModuleType) -> None:
    """Of a state of size 500 a millionth is a wrong certainty, 1e-13 is none."""
    for error, wrong in ((1e-13, False), (1e-6, True)):
        pairs, nothing = np.full((4, 1, 1), 64 * error**2), np.zeros((4, 1, 1))
        known = ErrorStatistics(np.full(4, 64.0), pairs, nothing, np.zeros((4, 1)), "exact")
        assert np.isinf(soak.excesses(known, np.eye(1), np.array([500.0]))).any() == wrong


def test_chance_is_looked_at_again_and_what_is_broken_stays_broken(soak: ModuleType) -> None:
    """Ten suspects of a true claim end at the first look; a variance 1.3 times the claimed one goes through both."""
    for ratio, ends in ((1.0, soak.AGAIN[0]), (1.3, soak.AGAIN[1])):
        for seed in range(10):
            results = {"a": {"b": statistics(ratio, runs=5000, seed=seed)}}
            place = soak.Place(5.0, 1, np.array([0.0, 1.0]))
            z, runs = soak.looked_at_again(place, "exact", lambda _, result=results: result, ("a", "b"), np.zeros(2))
            assert runs == ends and (abs(z) > soak.SUSPECT) == (ends == soak.AGAIN[1])
    assert soak.looked_at_again(soak.Place(-5.0, 1, np.ones(2)), "upper", {}.get, ("a", "b"), np.zeros(2)) == (-5.0, 0)


def test_what_is_no_number_and_unknown_is_hidden(soak: ModuleType) -> None:
    item = statistics(1.0)
    assert not soak.hidden(item)
    broken = np.array(item.pairs)
    broken[0, 1, 0] = np.nan
    silent = ErrorStatistics(item.count, broken, item.claimed_pairs, item.nees, "exact")
    known = ErrorStatistics(
        item.count, broken, item.claimed_pairs, item.nees, "exact", failed=np.ones(3), failed_runs=1
    )
    assert soak.hidden(silent) and not soak.hidden(known)
    indefinite = np.array(item.claimed_pairs)
    indefinite[..., 2] = -1e-15
    assert soak.hidden(ErrorStatistics(item.count, item.pairs, indefinite, item.nees, "exact"))


def test_the_summary_counts_what_is_wrong(soak: ModuleType) -> None:
    row = {
        "index": 0,
        "comparisons": 1000,
        "hidden": [],
        "suspects": [],
        "flagged": [],
        "claims": {"exact": 2},
        "seconds": 1,
    }
    suspect = {"at": "a/b", "claim": "upper", "step": 0, "first": 5.0}
    rows = [row, row | {"index": 1, "suspects": [suspect | {"again": 8.0}, suspect | {"again": -8.0}]},
            row | {"index": 2, "hidden": ["a/c"], "scaling": "a/b: off"}]  # fmt: skip
    result = soak.summary(rows, {"seed": 1})
    assert [s["again"] for s in result["broken claims"]] == [8.0]
    assert result["unflagged"] == [{"index": 2, "at": ["a/c"]}] and len(result["depend on units"]) == 1
    assert result["limit in standard errors"] == pytest.approx(5.1, abs=0.2)


def test_the_last_soak_tried_all_and_every_promise_held(soak: ModuleType) -> None:
    """What benchmarks/soak.json says, which docs/theory.md tells."""
    content = json.loads(soak.RESULTS.read_text())
    assert (content["networks"], content["seed"], content["runs"]) == (soak.COUNT, soak.SEED, soak.RUNS)
    assert content["rescaled"] >= 200 and set(content["estimates by claim"]) == {"exact", "upper", "nominal"}
    assert [content[name] for name in ("errors", "broken claims", "unflagged", "depend on units")] == [[], [], [], []]
