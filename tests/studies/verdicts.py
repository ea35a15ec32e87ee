"""A verdict follows from evidence: the check that every paper's statements pass."""

from collections.abc import Mapping, Sequence

from heliograph_studies.statement import Evidence, Rule, Statement, Verdict

Kinds = Mapping[Verdict, Evidence]


def check_verdicts(statements: Sequence[Statement], cases: Sequence[tuple[str, Kinds]]) -> None:
    """Each statement, in order, named by how it begins, gives the verdicts that evidence of both kinds asks for."""
    assert [s.text[: len(start)] for s, (start, _) in zip(statements, cases, strict=True)] == [c[0] for c in cases]
    for statement, (_, kinds) in zip(statements, cases, strict=True):
        assert statement.evidence and isinstance(statement.judge, Rule), statement.text
        assert statement.judge.names <= {*statement.evidence, "evidence"}, statement.text  # it knows nothing else
        assert len(kinds) >= 2, statement.text
        for verdict, evidence in kinds.items():
            assert set(evidence) <= {*statement.evidence, "slack"}, statement.text
            assert statement.judged(**evidence) == verdict, (statement.text, evidence)


def both(name: str, good: object, bad: object) -> Kinds:
    """One number decides."""
    return {"holds": {name: good}, "fails": {name: bad}}  # type: ignore[dict-item]
