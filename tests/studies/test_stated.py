"""Statements in Markdown: what is stated, where, what is found, the evidence, and the rule of the verdict."""

import pytest

from heliograph_studies import Sampled, stated
from heliograph_studies.statement import Rule

TEMPLATE = """
{% set twice = 2 * size %}
# paper

## The error is at most {{ limit }}
Theorem 1 | one half

It is {{ error | pm(".1f") }},
twice {{ twice }}

```judged
error = {{ error | pm }}
limit = {{ limit }}
steps = 3
holds(error.at_most(limit)
      and steps == 3)
```

# found

{% for name in ("first", "second") %}
## The {{ name }} is small
not in the paper |

so it is

```judged
size_of.{{ name }} = {{ size }}
holds(max(evidence.values()) < 1)
```

{% endfor %}
"""
NUMBERS = {"size": 0.1 + 0.2, "error": Sampled(0.7, 0.1), "limit": 0.5}


@pytest.fixture
def study(tmp_path):
    (tmp_path / "statements.md").write_text(TEMPLATE)
    return str(tmp_path / "__init__.py")


def test_everything_is_read_and_no_digit_is_lost(study):
    groups = stated(study, NUMBERS)
    assert [len(group) for group in groups.values()] == [1, 2] and list(groups) == ["paper", "found"]
    (first,), (second, third) = groups.values()
    assert first[:4] == (
        "The error is at most 0.5",
        "Theorem 1",
        "one half",
        "It is 0.7 ± 0.1, twice 0.6000000000000001",
    )
    assert first.evidence == {"error": Sampled(0.7, 0.1), "limit": 0.5, "steps": 3}
    assert first.verdict == "holds" and first.judged(limit=0.3) == "fails" and first.judged(steps=2) == "fails"
    assert (second.text, third.text) == ("The first is small", "The second is small") and second.paper == ""
    assert third.evidence == {"size_of.second": 0.1 + 0.2} and third.judged(**{"size_of.second": 2.0}) == "fails"


def test_a_rule_that_asks_for_what_is_no_evidence_is_refused_in_a_line(study, tmp_path):
    (tmp_path / "statements.md").write_text(TEMPLATE.replace("steps == 3", "step == 3"))
    with pytest.raises(
        ValueError, match=r"verdict on 'The error .*': expected one that follows from error, limit, ste"
    ):
        stated(study, NUMBERS)
    with pytest.raises(
        ValueError, match=r"statements\.md: expected a template of what was found, got 'limit' is undef"
    ):
        stated(study, {name: value for name, value in NUMBERS.items() if name != "limit"})


def test_a_rule_knows_its_evidence_and_nothing_else():
    rule = Rule("vacuous(all(value < 1 for value in evidence.values()), abs(true) < 1)")
    assert rule.names == {"evidence", "true"}
    assert rule(true=0.5) == "holds_vacuously" and rule(true=-1.5) == "holds" and rule(true=2.0) == "fails"
    with pytest.raises(NameError, match="open"):
        Rule("holds(open)")()
