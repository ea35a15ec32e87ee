"""One statement of a publication, the evidence on it, and the verdict that follows."""

import ast
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal, NamedTuple, TypeAlias

import numpy as np

from heliograph.report.results_folder import Json

Verdict = Literal["holds", "holds_vacuously", "does_not_apply", "fails"]
OURS = "not in the paper"  # the source of a statement that this page adds

SIGNIFICANT = 3.0  # standard errors: what differs by less may be sampling


class Sampled(NamedTuple):
    """A number found by simulation, and its standard error."""

    value: float
    error: float

    def at_most(self, limit: float) -> bool:
        """Whether it is, but for sampling; not if it is NaN."""
        return self.value - limit <= SIGNIFICANT * self.error

    def below(self, limit: float) -> bool:
        """Whether it is, sampling set aside."""
        return self.value - limit < -SIGNIFICANT * self.error


def sampled(values: np.ndarray) -> Sampled:
    """The mean of independent values, (run,), and its standard error."""
    return Sampled(float(values.mean()), float(values.std(ddof=1) / np.sqrt(len(values))))


Evidence: TypeAlias = Mapping[str, "float | Sampled"]


class Statement(NamedTuple):
    """What a publication states, where, what it says there in numbers, what is found here, and how that is judged.

    `evidence` are the numbers that decide, by name: those that were simulated with their standard errors. `judge` takes
    them by these names and depends on nothing else.
    """

    text: str
    source: str
    paper: str
    ours: str
    evidence: Evidence
    judge: Callable[..., Verdict]

    @property
    def verdict(self) -> Verdict:
        """What follows from the evidence.

        "holds_vacuously": true, but so it would be without any measurement.
        "does_not_apply": what it presupposes is not met here, so that nothing here speaks for it or against it.
        """
        return self.judged()

    @property
    def in_paper(self) -> bool:
        """Whether the publication says it; what this page adds is judged too, and not counted among its statements."""
        return not self.source.startswith(OURS)

    def judged(self, **other: "float | Sampled") -> Verdict:
        """The verdict that would follow if some of the evidence were other."""
        return self.judge(**{**self.evidence, **other})

    def entry(self) -> dict[str, Json]:
        """As it stands in a summary, which calls a statement a claim."""
        evidence = {name: item._asdict() if isinstance(item, Sampled) else item
                    for name, item in self.evidence.items()}  # fmt: skip
        return {"claim": self.text, "source": self.source, "paper": self.paper, "ours": self.ours,
                "verdict": self.verdict, "evidence": evidence}  # fmt: skip


def holds(condition: bool | np.bool) -> Verdict:
    """ "holds" or "fails"."""
    return "holds" if condition else "fails"


def unless_empty(says_something: bool | np.bool) -> Verdict:
    """ "holds" for what says something here, else "holds_vacuously"."""
    return "holds" if says_something else "holds_vacuously"


def if_applies(assumed: bool | np.bool, condition: bool | np.bool) -> Verdict:
    """ "holds" or "fails" where the assumed model is met, else "does_not_apply"."""
    return holds(condition) if assumed else "does_not_apply"


def vacuous(condition: bool | np.bool, anyway: bool | np.bool) -> Verdict:
    """ "fails", or "holds_vacuously" for a statement that says nothing since it would hold `anyway`, or "holds"."""
    return ("holds_vacuously" if anyway else "holds") if condition else "fails"


@dataclass(frozen=True)
class Rule:
    """A verdict as an expression in Python of its evidence's names; `evidence` is all of it by name."""

    text: str

    @property
    def names(self) -> set[str]:
        """What it asks for."""
        names = [node for node in ast.walk(ast.parse(self.text)) if isinstance(node, ast.Name)]
        return {n.id for n in names} - {n.id for n in names if isinstance(n.ctx, ast.Store)} - set(VERDICTS)

    def __call__(self, **evidence: float | Sampled) -> Verdict:
        """The verdict."""
        return eval(self.text, {**VERDICTS, "evidence": evidence, **evidence})  # type: ignore[no-any-return]


VERDICTS: Mapping[str, object] = {
    **{"holds": holds, "unless_empty": unless_empty, "if_applies": if_applies, "vacuous": vacuous, "__builtins__": {}},
    **{function.__name__: function for function in (abs, all, iter, max, min, zip)},
}
