"""What a verdict is made of."""

import json

import pytest

from heliograph_studies.statement import Sampled, Statement, holds, if_applies, unless_empty, vacuous


@pytest.mark.parametrize(
    ("value", "at_most", "below"), [(1.31, False, False), (1.29, True, False), (0.71, True, False), (0.69, True, True)]
)
def test_what_is_sampled_is_compared_up_to_three_standard_errors(value, at_most, below):
    result = Sampled(value, 0.1)
    assert (result.at_most(1), result.below(1)) == (at_most, below)


def test_what_is_no_number_supports_nothing():
    nothing = Sampled(float("nan"), float("nan"))
    assert not nothing.at_most(1) and not nothing.below(1)


def test_verdicts():
    assert (holds(True), holds(False)) == ("holds", "fails")
    assert (if_applies(True, True), if_applies(True, False), if_applies(False, False)) == (
        "holds", "fails", "does_not_apply"
    )  # fmt: skip
    assert (unless_empty(True), unless_empty(False)) == ("holds", "holds_vacuously")
    assert (vacuous(True, True), vacuous(True, False), vacuous(False, True)) == ("holds_vacuously", "holds", "fails")


def test_a_verdict_follows_the_evidence_into_the_summary():
    judged = Statement("it is small", "(1)", "", "it is", {"size": Sampled(0.5, 0.1), "limit": 1.0},
                       lambda size, limit: holds(size.at_most(limit)))  # fmt: skip
    assert judged.verdict == "holds" and judged.judged(limit=0.1) == "fails"
    entry = json.loads(json.dumps(judged.entry()))
    assert list(entry) == ["claim", "source", "paper", "ours", "verdict", "evidence"]
    assert entry["verdict"] == "holds" and entry["evidence"] == {"size": {"value": 0.5, "error": 0.1}, "limit": 1.0}
